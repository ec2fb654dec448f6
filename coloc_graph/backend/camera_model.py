"""Projection of the marker plane into cameras of robots on a floor, with derivatives by pose, mount and markers.

Vectorised over n cameras. Tangents of bodies and cameras are GTSAM's: rotation first, on the right. Those of a mount
are errors of height [m], tilt and roll [rad]; those of markers errors of span (relative) and height [m]. Plain numpy,
no graph.
"""

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.lie import hat, sl3_vee
from coloc_graph.geometry.mounting import camera_rotation, roll_axis, tilt_axis
from coloc_graph.team import Markers, Mount

Array = NDArray[np.float64]

UNEVALUABLE = 1e3  # whitened residual, without gradient, of what cannot be evaluated (a camera in the plane)
HATS = hat(np.eye(3))
# d vee(-(hat(w) + v n^T)) by w, (8, 3), and by v for each entry of n, (3, 8, 3)
_BY_TURN = -sl3_vee(HATS).T
_BY_SHIFT = -np.stack([sl3_vee(np.eye(3)[:, :, None] * np.eye(3)[k]).T for k in range(3)])


class BatchModel(Protocol):
    """Residuals of n measurements of one kind, evaluated at once."""

    def at(
        self, T_world_i: Array, T_world_j: Array, errors: Sequence[Array]
    ) -> tuple[Array, list[Array], NDArray[np.bool_]]:
        """Return whitened residuals (n, rows) at poses (n, 4, 4) and calibration `errors` (n, size) of each variable.

        With their Jacobians by both bodies (n, rows, 6) and by each variable (n, rows, size), and a mask (n,) of those
        that can be evaluated: the others are meaningless.
        """


class Model(Protocol):
    """One measurement with its constants; models of the same `kind` are evaluated together, in one `batch`."""

    @property
    def rows(self) -> int:
        """Number of its residuals."""

    @property
    def kind(self) -> Hashable:
        """Key of the models that can share a batch."""

    @staticmethod
    def batch(models: Sequence[Any]) -> BatchModel:
        """Return the batch of models of one kind."""


class Mounts:
    """`T_body_camera` of n mounts as a function of their errors (n, 6): height, tilt, roll, yaw, x, y."""

    def __init__(self, mounts: Sequence[Mount]) -> None:
        self._yaw, self._tilt, self._roll = np.deg2rad([[m.yaw_deg, m.tilt_deg, m.roll_deg] for m in mounts]).T
        self._t: Array = np.array([(m.x, m.y, m.height) for m in mounts])

    def at(self, errors: Array) -> "MountedCameras":
        """Return the cameras of mounts with `errors` (n, 6)."""
        tilt, roll = self._tilt + errors[:, 1], self._roll + errors[:, 2]
        t = self._t.copy()
        t += errors[:, [4, 5, 0]]
        return MountedCameras(camera_rotation(self._yaw + errors[:, 3], tilt, roll), t, tilt_axis(roll))


@dataclass(frozen=True, eq=False)
class MountedCameras:
    """Cameras in their bodies: `R` (n, 3, 3) and `t` (n, 3) [m] of T_body_camera.

    `tilt_axis` (n, 3) is the axis of tilt in the camera frame.
    """

    R: Array
    t: Array
    tilt_axis: Array

    @property
    def by_errors(self) -> Array:
        """Derivatives (n, 6, 6) of the cameras' tangents by the mounts' errors."""
        out = np.zeros((len(self.t), 6, 6))
        out[:, 3:, 0] = self.R[:, 2]
        out[:, :3, 1] = self.tilt_axis
        out[:, :3, 2] = roll_axis()
        out[:, :3, 3] = self.R[:, 2]
        out[:, 3:, 4], out[:, 3:, 5] = self.R[:, 0], self.R[:, 1]
        return out

    @property
    def by_body(self) -> Array:
        """Derivatives (n, 6, 6) of the cameras' tangents by the bodies': the adjoints of T_camera_body."""
        out = np.zeros((len(self.t), 6, 6))
        Rt = self.R.mT
        out[:, :3, :3] = out[:, 3:, 3:] = Rt
        out[:, 3:, :3] = -Rt @ hat(self.t)
        return out


@dataclass(frozen=True, eq=False)
class SeenPlanes:
    """Marker planes in n cameras: `P` (n, 3, 3) takes plane coordinates (X, Y, 1) to camera rays; n . X = 1 there.

    `cameras` are their mounts, `R` (n, 3, 3) their rotations against the plane. `seen` (n,) is False where a camera is
    in the plane.
    """

    P: Array
    P_inverse: Array
    cameras: MountedCameras
    R: Array
    seen: NDArray[np.bool_]

    @property
    def by_height(self) -> Array:
        """Derivatives (n, 6) of the cameras' tangents by the height of the plane: a higher plane is a lower camera."""
        out = np.zeros((len(self.R), 6))
        out[:, 3:] = -self.R[:, 2]
        return out

    @property
    def n(self) -> Array:
        """The planes (n, 3) [1/m]."""
        return self.P_inverse[:, 2]

    @property
    def generators(self) -> Array:
        """Derivatives (n, 8, 6) of vee(A) by the cameras' tangents, where P changes by A P."""
        out = np.empty((len(self.R), 8, 6))
        out[:, :, :3] = _BY_TURN
        out[:, :, 3:] = np.tensordot(self.n, _BY_SHIFT, axes=1)
        return out


def see(T_plane_body: Array, cameras: MountedCameras, height: Array) -> SeenPlanes:
    """Return the planes z = `height` (n,) in cameras on bodies at `T_plane_body` (n, 4, 4)."""
    R_body = T_plane_body[:, :3, :3]
    R = R_body @ cameras.R
    x, y, z = ((R_body @ cameras.t[..., None])[..., 0] + T_plane_body[:, :3, 3]).T
    d = z - height
    seen = np.abs(d) > 1e-4
    d = np.where(seen, d, 1.0)
    # a point (x, y, height) is R^T (x - t_x, y - t_y, -d) in the camera
    shift, back = np.zeros_like(R), np.zeros_like(R)
    shift[:, 0, 0] = shift[:, 1, 1] = back[:, 0, 0] = back[:, 1, 1] = 1.0
    shift[:, 0, 2], shift[:, 1, 2], shift[:, 2, 2] = -x, -y, -d
    back[:, 0, 2], back[:, 1, 2], back[:, 2, 2] = -x / d, -y / d, -1 / d
    return SeenPlanes(R.mT @ shift, back @ R, cameras, R, seen)


@dataclass(frozen=True, eq=False)
class MarkersModel:
    """Residual of the rays to two markers of a robot in another robot's camera, in a view turned by `R_camera_view`.

    Variables: the observer's mount (3,), and the markers (2,).
    """

    x: Array
    covariance: Array
    mount: Mount
    markers: Markers
    R_camera_view: Array = field(default_factory=lambda: np.eye(3))

    rows = 4
    kind = "markers"

    @staticmethod
    def batch(models: Sequence["MarkersModel"]) -> "_Markers":
        """Return the batch of models."""
        return _Markers(models)

    def planar_pose(self, mount: Array, markers: Array) -> tuple[float, float, float] | None:
        """Return x, y [m] and heading [rad] of the robot in a level observer; None where a ray goes up."""
        camera = Mounts([self.mount]).at(mount[None])
        rays = np.column_stack([self.x, np.ones(2)]) @ (camera.R[0] @ self.R_camera_view).T
        above = camera.t[0, 2] - self.markers.height - markers[1]
        if not (above > 0 and rays[:, 2].max() < -1e-3):
            return None
        a, b = camera.t[0, :2] - rays[:, :2] * (above / rays[:, 2:])
        (ax, ay), (bx, by) = self.markers.positions[:2]
        heading = math.atan2(b[1] - a[1], b[0] - a[0]) - math.atan2(by - ay, bx - ax)
        c, s = math.cos(heading), math.sin(heading)
        mx, my = (ax + bx) / 2, (ay + by) / 2
        return float((a[0] + b[0]) / 2 - c * mx + s * my), float((a[1] + b[1]) / 2 - s * mx - c * my), heading


class _Markers:
    """Batch of sighted markers."""

    def __init__(self, models: Sequence[MarkersModel]) -> None:
        self._x = np.array([one.x for one in models])
        self._roots = np.linalg.inv(np.linalg.cholesky(np.array([one.covariance for one in models])))
        self._mounts = Mounts([one.mount for one in models])
        self._R_camera_view = np.array([one.R_camera_view for one in models])
        self._nominal = np.array([one.markers.p_body[:2] for one in models])

    @cached_property
    def _of_markers(self) -> Array:
        """Derivatives (n, 2, 3, 2) of the markers (n, 2, 3) by their errors."""
        out = np.zeros((*self._nominal.shape, 2))
        out[..., :2, 0], out[..., 2, 1] = self._nominal[..., :2], 1.0
        return out

    def at(
        self, T_world_i: Array, T_world_j: Array, errors: Sequence[Array]
    ) -> tuple[Array, list[Array], NDArray[np.bool_]]:
        mount, markers = errors
        cameras, n = self._mounts.at(mount), len(mount)
        p_body = self._nominal + (self._of_markers @ markers[:, None, :, None])[..., 0]
        R_wo, R_ws = T_world_i[:, :3, :3], T_world_j[:, :3, :3]
        R_cw = (R_wo @ cameras.R).mT
        t = T_world_j[:, :3, 3] - T_world_i[:, :3, 3] - (R_wo @ cameras.t[..., None])[..., 0]
        p_camera = (p_body @ R_ws.mT + t[:, None]) @ R_cw.mT
        p_view = p_camera @ self._R_camera_view
        seen = p_view[:, :, 2].min(axis=1) > 1e-3
        w = 1 / np.where(seen[:, None], p_view[..., 2], 1.0)
        x = p_view[..., :2] * w[..., None]
        e = (self._roots @ (x - self._x).reshape(n, 4, 1))[..., 0]
        project = np.zeros((n, 2, 2, 3))
        project[..., 0, 0] = project[..., 1, 1] = w
        project[..., 2] = -x * w[..., None]
        project = project @ self._R_camera_view[:, None].mT
        turned = project @ (R_cw @ R_ws)[:, None]
        by_camera = self._roots @ np.concatenate([project @ hat(p_camera), -project], axis=-1).reshape(n, 4, 6)
        by_seen = self._roots @ np.concatenate([-turned @ hat(p_body), turned], axis=-1).reshape(n, 4, 6)
        by_markers = self._roots @ (turned @ self._of_markers).reshape(n, 4, 2)
        return (
            e,
            [by_camera @ cameras.by_body, by_seen, by_camera @ cameras.by_errors, by_markers],
            seen,
        )
