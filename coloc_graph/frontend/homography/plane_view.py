"""Cameras turned towards the marker plane, in whose frames the homographies of fisheyes are fitted.

Points (x, y, 1) before an image plane cannot describe rays beside and behind a camera. In a view along the plane's
normal every ray that meets the plane has such coordinates. A homography between two views is one between the cameras:
H_cj_ci = R_cj_vj H_vj_vi R_ci_vi^T.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.lie import sl3_adjoint
from coloc_graph.measurements import HomographyMeasurement, MarkerSpan
from coloc_graph.team import Camera

Array = NDArray[np.float64]


def view_of_plane(camera: Camera, N: Array) -> Camera:
    """Return a fisheye turned so that its view is along N (3,), a pinhole as it is."""
    if camera.model != "fisheye":
        return camera
    axis = np.array([-N[1], N[0], 0.0])  # z x N
    if N[2] < -1 + 1e-9:
        return camera.turned(np.diag([1.0, -1.0, -1.0]))
    A = np.array([[0.0, 0.0, axis[1]], [0.0, 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return camera.turned(np.eye(3) + A + A @ A / (1 + N[2]))


def between_cameras(H_vj_vi: Array, camera_i: Camera, camera_j: Camera) -> Array:
    """Return the homography (3, 3) in the cameras' own frames of one between their views."""
    if camera_i.model == camera_j.model == "pinhole":
        return H_vj_vi
    return np.asarray(camera_j.R_camera_view @ H_vj_vi @ camera_i.R_camera_view.T)


def measured_between_cameras(
    measured: HomographyMeasurement, camera_i: Camera, camera_j: Camera
) -> HomographyMeasurement:
    """Return the measurement in the cameras' own frames of one between their views."""
    if camera_i.model == camera_j.model == "pinhole":
        return measured
    Ad, back = adjoints(camera_i)
    return replace(
        measured,
        H_j_i=between_cameras(measured.H_j_i, camera_i, camera_j),
        information=back.T @ measured.information @ back,
        shared=None if measured.shared is None else Ad @ measured.shared @ Ad.T,
        by_time_offset=None if measured.by_time_offset is None else Ad @ measured.by_time_offset,
        by_lenses=None if measured.by_lenses is None else Ad @ measured.by_lenses,
    )


def adjoints(camera_i: Camera) -> tuple[Array, Array]:
    """Return the matrix (8, 8) that takes coordinates h in the view of camera i to those in its own frame, and back."""
    R = camera_i.R_camera_view
    return sl3_adjoint(R, R.T), sl3_adjoint(R.T, R)


def span_in_view(span: MarkerSpan, camera_i: Camera) -> MarkerSpan:
    """Return a span in a view with its derivatives by the homography in the cameras' own frames."""
    if camera_i.model == "pinhole":
        return span
    return replace(span, by_h=span.by_h @ adjoints(camera_i)[1], R_camera_view=camera_i.R_camera_view)
