"""Marker plane in a camera's frame, from the mount, and its distance from a known marker span."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.measurements import Plane
from coloc_graph.team import Floor, Markers, Mount

Array = NDArray[np.float64]


def plane_from_mount(mount: Mount, markers: Markers, floor: Floor | None = None) -> Plane:
    """Compute the marker plane of a camera from its mount.

    Parameters
    ----------
    mount
        Mount of the camera.
    markers
        Markers, all at one height above the floor.
    floor
        Tolerances of the floor; by default it is flat.

    Returns
    -------
    Plane
        Normal and distance in the camera frame, with standard deviations.

    Raises
    ------
    DegenerateGeometry
        The camera is not above the markers.
    """
    d = mount.height - markers.height
    if d <= 0:
        raise DegenerateGeometry(
            f"the camera ({mount.height} m) is not above the markers ({markers.height} m), so the distance d of their "
            "plane is not positive: mount the camera higher or the markers lower"
        )
    floor = floor or Floor()
    return Plane(
        N=mount.R_body_camera.T @ np.array([0.0, 0.0, -1.0]),
        d=d,
        normal_sigma=float(np.deg2rad(floor.tilt_sigma_deg)),
        d_sigma=float(np.hypot(markers.height_sigma, floor.height_sigma)),
        normal_from_mount=True,
        d_from_mount=True,
    )


def on_plane(rays: Array, plane: Plane) -> Array:
    """Intersect rays with the plane.

    Parameters
    ----------
    rays
        Rays in the camera frame, (n, 3) of any length, or normalised image coordinates, (n, 2).
    plane
        Plane in the camera frame.

    Returns
    -------
    numpy.ndarray
        Points in the camera frame, (n, 3) [m]; NaN for rays that do not meet the plane in front of the camera.
    """
    if rays.shape[1] == 2:
        rays = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    along = rays @ plane.N
    return np.asarray(rays * (plane.d / np.where(along > 1e-6, along, np.nan))[:, None])


def distance_from_span(plane: Plane, rays_a: Array, rays_b: Array, markers: Markers) -> Plane:
    """Scale the plane's distance so that two markers lie their known span apart.

    Parameters
    ----------
    plane
        Plane in the camera frame; its distance is replaced.
    rays_a, rays_b
        Both markers at the same n instants, as in `on_plane`.
    markers
        Markers with a known span.

    Returns
    -------
    Plane
        Plane whose `d_sigma` carries the scatter over the instants and the tolerance of the span.

    Raises
    ------
    DegenerateGeometry
        There are fewer than two markers or instants.
    """
    if markers.span is None:
        raise DegenerateGeometry("the robot carries one marker: there is no span to take the scale from")
    spans = np.linalg.norm(on_plane(rays_a, plane) - on_plane(rays_b, plane), axis=1) / plane.d
    spans = spans[np.isfinite(spans)]
    if len(spans) < 2:
        raise DegenerateGeometry("both markers of the robot are never seen at once: let it turn towards the camera")
    middle = np.median(spans)
    kept = spans[np.abs(spans - middle) <= 5 * 1.4826 * np.median(np.abs(spans - middle)) + 1e-12]
    d = markers.span / kept.mean()
    relative = np.hypot(markers.span_sigma / markers.span, kept.std() / kept.mean() / np.sqrt(len(kept)))
    return replace(plane, d=float(d), d_sigma=float(d * relative), d_from_mount=False)
