"""What a camera on a robot on a floor sees of the marker plane, and how that changes with pose, mount and markers.

Tangents: a body's and a camera's are GTSAM's, rotation first, on the right. A mount's are the errors of height [m],
tilt and roll [rad]; markers' those of the span (relative) and of their height [m]. Plain numpy, no graph.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.spans import SpanModel
from coloc_graph.lie import hat, rotation_z, sl3_adjoint, sl3_log, sl3_log_derivative, sl3_vee
from coloc_graph.measurements import HomographyMeasurement, MarkerSpan
from coloc_graph.team import R_BODY_OPTICAL, Markers, Mount

Array = NDArray[np.float64]

#: A residual that cannot be evaluated (a camera in the plane, a homography beyond all bounds): far, and no gradient.
BEYOND = 1e3
_HATS = hat(np.eye(3))
# d vee(-(hat(w) + v n^T)) by w, (8, 3), and by v for each entry of n, (3, 8, 3)
_BY_TURN = -sl3_vee(_HATS).T
_BY_SHIFT = -np.stack([sl3_vee(np.eye(3)[:, :, None] * np.eye(3)[k]).T for k in range(3)])


@dataclass(frozen=True, eq=False)
class MountModel:
    """`T_body_camera` of a mount that is off by (3,) of height, tilt, roll, and what these do to the camera."""

    mount: Mount

    @cached_property
    def _R_yaw(self) -> Array:
        return rotation_z(np.deg2rad(self.mount.yaw_deg))

    def at(self, errors: Array) -> "MountedCamera":
        """The camera of a mount that is off by `errors` (3,)."""
        m = self.mount
        height, tilt, roll = errors.tolist()
        tilt, roll = tilt + math.radians(m.tilt_deg), roll + math.radians(m.roll_deg)
        ct, st, cr, sr = math.cos(tilt), math.sin(tilt), math.cos(roll), math.sin(roll)
        R_yt = self._R_yaw @ np.array([[ct, 0.0, st], [0.0, 1.0, 0.0], [-st, 0.0, ct]])
        R_ro = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]]) @ R_BODY_OPTICAL
        return MountedCamera(R_yt @ R_ro, np.array([m.x, m.y, m.height + height]), R_ro)


@dataclass(frozen=True, eq=False)
class MountedCamera:
    """Where a camera is in its body: `R` (3, 3) and `t` (3,) [m] of T_body_camera, `R_ro` that of roll and optics."""

    R: Array
    t: Array
    R_ro: Array

    @property
    def by_errors(self) -> Array:
        """The camera's tangent (6, 3) by the mount's errors."""
        out = np.zeros((6, 3))
        out[3:, 0] = self.R[2]
        out[:3, 1] = self.R_ro[1]
        out[:3, 2] = R_BODY_OPTICAL[0]
        return out

    @property
    def by_body(self) -> Array:
        """The camera's tangent (6, 6) by the body's: the adjoint of T_camera_body."""
        out = np.zeros((6, 6))
        out[:3, :3] = out[3:, 3:] = self.R.T
        out[3:, :3] = -self.R.T @ _hat(self.t)
        return out


@dataclass(frozen=True, eq=False)
class _Seen:
    """The marker plane in one camera: plane coordinates (X, Y, 1) to camera rays is `P` (3, 3), and n . X = 1 there.

    `camera` is where it is in the body, `R` (3, 3) how it is turned against the plane.
    """

    P: Array
    P_inverse: Array
    camera: MountedCamera
    R: Array

    @property
    def by_height(self) -> Array:
        """The camera's tangent (6,) by the height of the plane: a higher plane is a lower camera."""
        return np.concatenate([np.zeros(3), -self.R[2]])

    @property
    def n(self) -> Array:
        return np.asarray(self.P_inverse[2])

    @property
    def generators(self) -> Array:
        """vee(A) (8, 6) by the camera's tangent, where P changes by A P."""
        return np.hstack([_BY_TURN, np.tensordot(self.n, _BY_SHIFT, axes=1)])


def _see(T_plane_body: Array, mount: MountModel, errors: Array, height: float) -> _Seen | None:
    """The plane z = `height` in the camera; None where the camera is in it."""
    camera = mount.at(errors)
    R = T_plane_body[:3, :3] @ camera.R
    t = T_plane_body[:3, :3] @ camera.t + T_plane_body[:3, 3]
    d = t[2] - height
    if not abs(d) > 1e-4:
        return None
    # a point (x, y, height) is R^T (x - t_x, y - t_y, -d) in the camera
    P = R.T @ np.array([[1.0, 0.0, -t[0]], [0.0, 1.0, -t[1]], [0.0, 0.0, -d]])
    P_inverse = np.array([[1.0, 0.0, -t[0] / d], [0.0, 1.0, -t[1] / d], [0.0, 0.0, -1 / d]]) @ R
    return _Seen(P, P_inverse, camera, R)


def _hat(v: Array) -> Array:
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


@dataclass(frozen=True, eq=False)
class Residual:
    """A whitened residual (m,), and its Jacobians by the two bodies (m, 6), their mounts (m, 3), and the movers'
    markers (m, 2) in the order of `HomographyModel.movers`; by the offset of the clocks (m,)."""

    e: Array
    by_i: Array
    by_j: Array
    by_mount_i: Array
    by_mount_j: Array
    by_markers: tuple[Array, ...]
    by_offset: Array


class HomographyModel:
    """A measured homography, and the spans of the movers in the same images, against what poses and mounts predict.

    Rows 0 to 7 are the sl(3) coordinates h of log(H_measured^-1 H_predicted), whitened by the information; each span
    adds three, see `SpanModel`: what counts of it is decided for mount i off by `about` (3,), known to `tilt_sigma`.
    The plane is level at the markers' height: in the world where robots stand on a floor, and else in body i. `movers`
    is whose markers they are, the first one's height being that of the plane.
    """

    def __init__(
        self,
        measured: HomographyMeasurement,
        spans: tuple[MarkerSpan, ...],
        mount_i: Mount,
        mount_j: Mount,
        markers: dict[str, Markers],
        on_floor: bool,
        about: Array,
        tilt_sigma: float,
    ) -> None:
        self.measured, self.on_floor = measured, on_floor
        self.movers = tuple(markers)
        self._height = next(iter(markers.values())).height
        self._mount_i, self._mount_j = MountModel(mount_i), MountModel(mount_j)
        level = _see(np.eye(4), self._mount_i, about, self._height)
        self._lengths = [markers[one.mover].span or 0.0 for one in spans]
        self.spans: tuple[SpanModel, ...] = ()
        if level is not None:
            near = zip(spans, self._lengths, strict=True)
            made = (SpanModel.near(one, level.n, tilt_sigma, length) for one, length in near)
            self.spans = tuple(one.weighing(measured.share) for one in made)
        self._H_inverse: Array = np.asarray(np.linalg.inv(measured.H_j_i), float)
        b = measured.by_time_offset
        self._by_offset = np.zeros(8) if b is None else b
        # with the offset as a variable of its own the information is that at the right offset
        own = np.linalg.inv(measured.information) - measured.time_offset_sigma**2 * np.outer(
            self._by_offset, self._by_offset
        )
        self._root = np.linalg.cholesky(np.linalg.inv((own + own.T) / 2)).T
        # what is linear in h: first the whitening, then what it does to the spans
        self._by_h = np.vstack([self._root, *(one.by_h for one in self.spans)])

    @property
    def rows(self) -> int:
        """How many numbers it measures."""
        return len(self._by_h)

    def at(
        self,
        T_world_i: Array,
        T_world_j: Array,
        mount_i: Array,
        mount_j: Array,
        markers: tuple[Array, ...],
        offset: float = 0.0,
        *,
        derivatives: bool = True,
    ) -> Residual | None:
        """The residual at poses (4, 4), errors of mounts (3,) and of markers (2,), and of the clocks' offset [s].

        None where it cannot be evaluated.
        """
        height = self._height + float(markers[0][1])
        if self.on_floor:
            T_plane_i, T_plane_j = T_world_i, T_world_j
        else:
            T_plane_i, T_plane_j = np.eye(4), _inverse(T_world_i) @ T_world_j
        i = _see(T_plane_i, self._mount_i, mount_i, height)
        j = _see(T_plane_j, self._mount_j, mount_j, height)
        if i is None or j is None:
            return None
        H = j.P @ i.P_inverse
        h = _off(self._H_inverse, H)
        if h is None:
            return None
        e = self._by_h @ (h - offset * self._by_offset)
        at_spans = []
        row = 8
        for one, length, errors in zip(self.spans, self._lengths, self._errors(markers), strict=True):
            rows = slice(row, row + len(one.weights))
            off, by_n, by_length = one.at(i.n, length * (1 + errors[0]))
            e[rows] += off
            at_spans.append((rows, by_n, length * by_length))
            row = rows.stop
        none = np.empty((0, 0))
        if not derivatives:
            return Residual(e, none, none, none, none, (), none)

        by_h = self._by_h @ sl3_log_derivative(h)
        by_camera_i = by_h @ -i.generators
        by_camera_j = by_h @ sl3_adjoint(np.linalg.inv(H)) @ j.generators
        by_span = [np.zeros((self.rows, 2)) for _ in self.movers]
        n = i.n
        for (rows, by_n, by_length), one in zip(at_spans, self.spans, strict=True):
            by_camera_i[rows, :3] += by_n @ _hat(n)
            by_camera_i[rows, 3:] += np.outer(by_n @ n, n)
            by_span[self.movers.index(one.mover)][rows, 0] += by_length
        by_span[0][:, 1] = by_camera_i @ i.by_height + by_camera_j @ j.by_height
        by_j = by_camera_j @ j.camera.by_body
        # without a floor the plane goes where body i goes, which is body j the other way
        by_i = by_camera_i @ i.camera.by_body if self.on_floor else -by_j @ _adjoint(_inverse(T_plane_j))
        return Residual(
            e,
            by_i,
            by_j,
            by_camera_i @ i.camera.by_errors,
            by_camera_j @ j.camera.by_errors,
            tuple(by_span),
            -self._by_h @ self._by_offset,
        )

    def _errors(self, markers: tuple[Array, ...]) -> list[Array]:
        return [markers[self.movers.index(one.mover)] for one in self.spans]


def _off(H_measured_inverse: Array, H: Array) -> Array | None:
    """The coordinates (8,) of a homography in those of the measured one; None where it is beyond all bounds."""
    E = H_measured_inverse @ H
    scale = np.linalg.det(E)
    if not scale > 1e-9:
        return None
    h = sl3_log(E / np.cbrt(scale))
    return h if np.isfinite(h).all() else None


def _inverse(T: Array) -> Array:
    out = np.eye(4)
    out[:3, :3] = T[:3, :3].T
    out[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return out


def _adjoint(T: Array) -> Array:
    R = T[:3, :3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    out[3:, :3] = _hat(T[:3, 3]) @ R
    return out


@dataclass(frozen=True, eq=False)
class StatedPlaneModel:
    """A measured homography of a plane that is stated in camera i, against what two cameras and the plane predict.

    The plane's own variable is the error (3,) of n = N / d, across two directions and along the normal, relative to
    the stated |n|.
    """

    measured: HomographyMeasurement
    n: Array
    mount_i: Mount
    mount_j: Mount

    rows = 8

    @cached_property
    def _constants(self) -> tuple[Array, Array, Array, Array, Array]:
        T_bi_ci, T_bj_cj = self.mount_i.T_body_camera, self.mount_j.T_body_camera
        size = float(np.linalg.norm(self.n))
        sides = np.linalg.svd(self.n[None])[2][1:]
        by_error = size * np.stack([*sides, self.n / size], axis=1)
        root = np.linalg.cholesky(self.measured.information).T
        back = np.asarray(np.linalg.inv(self.measured.H_j_i), float)
        return T_bi_ci, _inverse(T_bj_cj), np.asarray(by_error, float), np.asarray(root, float), back

    def at(self, T_world_i: Array, T_world_j: Array, errors: Array) -> tuple[Array, Array, Array, Array] | None:
        """The whitened residual (8,) and its Jacobians by both bodies (8, 6) and the plane's errors (8, 3); None where
        it cannot be evaluated."""
        T_bi_ci, T_cj_bj, by_error, root, H_inverse = self._constants
        n = self.n + by_error @ errors
        T_bj_bi = _inverse(T_world_j) @ T_world_i
        T_cj_ci = T_cj_bj @ T_bj_bi @ T_bi_ci
        H = T_cj_ci[:3, :3] + np.outer(T_cj_ci[:3, 3], n)
        h = _off(H_inverse, H)
        if h is None:
            return None
        by_h = root @ sl3_log_derivative(h)
        back = np.linalg.inv(H)
        # a point X on the plane goes to R X + t: camera i turned by w and shifted by v adds R (w x X + v)
        R, t = T_cj_ci[:3, :3], T_cj_ci[:3, 3]
        by_camera = np.concatenate([R @ _HATS, R.T[:, :, None] * n])
        by_ci = sl3_vee(back @ by_camera).T
        T_ci_bi = _inverse(T_bi_ci)
        by_i = by_h @ by_ci @ _adjoint(T_ci_bi)
        by_j = -by_i @ _adjoint(_inverse(T_bj_bi))
        by_n = sl3_vee(back @ (t[:, None] * np.eye(3)[:, None, :])).T
        by_plane = np.asarray(by_h @ by_n @ by_error, float)
        return root @ h, by_i, by_j, by_plane


@dataclass(frozen=True, eq=False)
class MarkersModel:
    """The rays to two markers of a robot, as seen by another one's camera, against where they should be."""

    x: Array
    covariance: Array
    mount: Mount
    markers: Markers

    rows = 4

    def place(self, mount: Array, markers: Array) -> tuple[float, float, float] | None:
        """x, y [m] and heading [rad] of the robot in an observer that stands level; None where a ray goes up."""
        camera = self._constants[0].at(mount)
        rays = np.column_stack([self.x, np.ones(2)]) @ camera.R.T
        above = camera.t[2] - self.markers.height - markers[1]
        if not (above > 0 and rays[:, 2].max() < -1e-3):
            return None
        a, b = camera.t[:2] - rays[:, :2] * (above / rays[:, 2:])
        (ax, ay), (bx, by) = self.markers.positions[:2]
        heading = math.atan2(b[1] - a[1], b[0] - a[0]) - math.atan2(by - ay, bx - ax)
        c, s = math.cos(heading), math.sin(heading)
        mx, my = (ax + bx) / 2, (ay + by) / 2
        return float((a[0] + b[0]) / 2 - c * mx + s * my), float((a[1] + b[1]) / 2 - s * mx - c * my), heading

    @cached_property
    def _constants(self) -> tuple[MountModel, Array]:
        return MountModel(self.mount), np.linalg.inv(np.linalg.cholesky(self.covariance))

    def at(
        self, T_world_observer: Array, T_world_seen: Array, mount: Array, markers: Array
    ) -> tuple[Array, Array, Array, Array, Array] | None:
        """The whitened residual (4,), and its Jacobians by observer and seen (4, 6), by the observer's mount (4, 3) and
        by the markers (4, 2); None where a marker is not before the camera."""
        model, roots = self._constants
        camera = model.at(mount)
        nominal = self.markers.p_body[:2]
        scale = np.array([1 + markers[0], 1 + markers[0], 1.0])
        p_body = nominal * scale + np.array([0.0, 0.0, markers[1]])
        R_wo, R_ws = T_world_observer[:3, :3], T_world_seen[:3, :3]
        R_cw = (R_wo @ camera.R).T
        p_camera = (p_body @ R_ws.T + T_world_seen[:3, 3] - T_world_observer[:3, 3] - R_wo @ camera.t) @ R_cw.T
        if not p_camera[:, 2].min() > 1e-3:
            return None
        w = 1 / p_camera[:, 2]
        x = p_camera[:, :2] * w[:, None]
        e = np.asarray((roots @ (x - self.x)[..., None])[..., 0], float)
        project: Array = np.zeros((2, 2, 3))
        project[:, 0, 0] = project[:, 1, 1] = w
        project[:, :, 2] = -x * w[:, None]
        project = np.asarray(roots @ project, float)
        by_camera: Array = np.concatenate([project @ hat(p_camera), -project], axis=2).reshape(4, 6)
        turned = np.asarray(project @ (R_cw @ R_ws), float)
        by_seen: Array = np.concatenate([-turned @ hat(p_body), turned], axis=2).reshape(4, 6)
        of_markers = np.zeros((2, 3, 2))
        of_markers[:, :2, 0], of_markers[:, 2, 1] = nominal[:, :2], 1.0
        by_markers = np.asarray((turned @ of_markers).reshape(4, 2), float)
        return e.ravel(), by_camera @ camera.by_body, by_seen, by_camera @ camera.by_errors, by_markers
