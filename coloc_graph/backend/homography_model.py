"""Residuals of homographies, and of the movers' spans in the same images, by poses, mounts and markers.

Vectorised, with the tangents of `camera_model`. Plain numpy, no graph.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.camera_model import HATS, Mounts, SeenPlanes, see
from coloc_graph.backend.span_factor import SpanModel, Spans
from coloc_graph.geometry.lie import hat, se3_inverse, sl3_adjoint, sl3_log, sl3_log_derivative, sl3_vee
from coloc_graph.measurements import HomographyMeasurement
from coloc_graph.team import Markers, Mount
from coloc_graph.team.camera import LENS_TERMS

Array = NDArray[np.float64]


class HomographyModel:
    """Residual of a measured homography, and of the spans of the movers in the same images.

    Rows 0 to 7 are the sl(3) coordinates h of log(H_measured^-1 H_predicted), whitened by the information; each span
    adds three, see `SpanModel`. The
    plane is level at the height of the first mover's markers: in the world where robots stand on a floor, otherwise in
    body i. `movers` are the robots whose markers were seen.

    Variables: both mounts (3,), the markers (2,) of each mover, and the clocks' offset (1,) [s], times `clock_sign`.
    """

    def __init__(
        self,
        measured: HomographyMeasurement,
        spans: Sequence[SpanModel],
        mount_i: Mount,
        mount_j: Mount,
        markers: dict[str, Markers],
        on_floor: bool,
        clock_sign: float = 1.0,
    ) -> None:
        self.on_floor, self.movers = on_floor, tuple(markers)
        self.height = next(iter(markers.values())).height
        self.mount_i, self.mount_j = mount_i, mount_j
        self.spans = tuple(one.weighing(measured.share) for one in spans)
        self.H_inverse: Array = np.asarray(np.linalg.inv(measured.H_j_i), float)
        b = measured.by_time_offset
        self.by_offset = np.zeros(8) if b is None else clock_sign * b
        # the offset is a variable of its own: the information is that at a known offset
        own = np.linalg.inv(measured.information) - measured.time_offset_sigma**2 * np.outer(
            self.by_offset, self.by_offset
        )
        root = np.linalg.cholesky(np.linalg.inv((own + own.T) / 2)).T
        #: Logarithm of the square root of the determinant of its information, but for a constant.
        self.log_det = float(np.log(root.diagonal()).sum() - 0.5 * sum(one.log_det for one in self.spans))
        # linear in h: the whitening, then the effect on the spans
        self.by_h = np.vstack([root, *(one.by_h for one in self.spans)])

    @property
    def rows(self) -> int:
        """Number of its residuals."""
        return len(self.by_h)

    @property
    def kind(self) -> Hashable:
        """True on a floor, number of movers, number of spans."""
        return self.on_floor, len(self.movers), len(self.spans)

    @staticmethod
    def batch(models: Sequence["HomographyModel"]) -> "_Homographies":
        """Return the batch of models of one kind."""
        return _Homographies(models)


@lru_cache(maxsize=256)
def level_plane(mount: Mount, errors: tuple[float, ...], height: float) -> Array | None:
    """Plane n . X = 1 (3,) at a height over the floor, in the camera of a level robot with these errors of its mount.

    None at the camera's height.
    """
    level = see(np.eye(4)[None], Mounts([mount]).at(np.array([errors])), np.array([height]))
    return level.n[0] if level.seen[0] else None


class _Homographies:
    """Batch of homographies of one kind."""

    def __init__(self, models: Sequence[HomographyModel]) -> None:
        self._on_floor = models[0].on_floor
        self._height = np.array([one.height for one in models])
        self._mounts_i, self._mounts_j = Mounts([m.mount_i for m in models]), Mounts([m.mount_j for m in models])
        self._H_inverse = np.array([one.H_inverse for one in models])
        self._by_h = np.array([one.by_h for one in models])
        self._by_offset = np.array([one.by_offset for one in models])
        # spans by their index in each model, with the index of the mover that each is of
        self._spans = [
            (np.array([one.movers.index(span.mover) for one, span in zip(models, each, strict=True)]), Spans(each))
            for each in zip(*(one.spans for one in models), strict=True)
        ]

    def at(
        self, T_world_i: Array, T_world_j: Array, errors: Sequence[Array]
    ) -> tuple[Array, list[Array], NDArray[np.bool_]]:
        mount_i, mount_j, *markers, offset = errors
        height = self._height + markers[0][:, 1]
        if self._on_floor:
            T_plane_i, T_plane_j = T_world_i, T_world_j
        else:
            T_plane_j = se3_inverse(T_world_i) @ T_world_j
            T_plane_i = np.broadcast_to(np.eye(4), T_plane_j.shape)
        i = see(T_plane_i, self._mounts_i.at(mount_i), height)
        j = see(T_plane_j, self._mounts_j.at(mount_j), height)
        h, there = _off(self._H_inverse, j.P @ i.P_inverse)
        e = (self._by_h @ (h - offset * self._by_offset)[..., None])[..., 0]

        by_h = self._by_h @ sl3_log_derivative(h)
        by_camera_i = -by_h @ i.generators
        by_camera_j = by_h @ (sl3_adjoint(i.P @ j.P_inverse, j.P @ i.P_inverse) @ j.generators)
        by_markers, longer = np.zeros((len(markers), *e.shape, 2)), np.array(markers)[:, :, 0]
        first, every, by_camera = 8, np.arange(len(e)), _by_camera(i)
        for whose, spans in self._spans:
            rows = slice(first, first + spans.rows)
            first = rows.stop
            off, by_n, by_longer = spans.at(i.n, longer[whose, every])
            e[:, rows] += off
            by_markers[whose, every, rows, 0] += by_longer
            by_camera_i[:, rows] += by_n @ by_camera
        by_markers[0, :, :, 1] = (by_camera_i @ i.by_height[..., None] + by_camera_j @ j.by_height[..., None])[..., 0]
        by_j = by_camera_j @ j.cameras.by_body
        # without a floor the plane goes where body i goes, which is body j the other way
        by_i = by_camera_i @ i.cameras.by_body if self._on_floor else -by_j @ _adjoint(se3_inverse(T_plane_j))
        by_mounts = [by_camera_i @ i.cameras.by_errors, by_camera_j @ j.cameras.by_errors]
        by_offset = -self._by_h @ self._by_offset[..., None]
        return e, [by_i, by_j, *by_mounts, *by_markers, by_offset], i.seen & j.seen & there


def _by_camera(seen: SeenPlanes) -> Array:
    """Derivatives (n, 3, 6) of the planes n . X = 1 (n, 3) by the cameras' tangents."""
    n = seen.n
    return np.concatenate([hat(n), n[:, :, None] * n[:, None, :]], axis=2)


def _off(H_measured_inverse: Array, H: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the sl(3) coordinates (n, 8) of homographies relative to the measured ones, and a mask (n,).

    Coordinates outside the mask cannot be evaluated, and are 0.
    """
    E = H_measured_inverse @ H
    scale = np.linalg.det(E)
    near = scale > 1e-9
    h = sl3_log(np.where(near[:, None, None], E / np.cbrt(np.where(near, scale, 1.0))[:, None, None], np.eye(3)))
    near &= np.isfinite(h).all(axis=1)
    return np.where(near[:, None], h, 0.0), near


def _adjoint(T: Array) -> Array:
    """Return the adjoints (n, 6, 6) of poses (n, 4, 4)."""
    R = T[:, :3, :3]
    out = np.zeros((len(T), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = R
    out[:, 3:, :3] = hat(T[:, :3, 3]) @ R
    return out


@dataclass(frozen=True, eq=False)
class StatedPlaneModel:
    """Residual of a measured homography of a plane that is stated in camera i.

    The plane's own variable is the error (3,) of n = N / d, across two directions and along the normal, relative to
    the stated |n|. The other two are the terms (LENS_TERMS,) that the lens models of both cameras leave.
    """

    measured: HomographyMeasurement
    n: Array
    mount_i: Mount
    mount_j: Mount

    rows = 8
    kind = "stated plane"

    @property
    def log_det(self) -> float:
        """Logarithm of the square root of the determinant of its information."""
        return float(0.5 * np.linalg.slogdet(self.measured.information)[1])

    @staticmethod
    def batch(models: Sequence["StatedPlaneModel"]) -> "_StatedPlanes":
        """Return the batch of models."""
        return _StatedPlanes(models)


class _StatedPlanes:
    """Batch of homographies of stated planes."""

    def __init__(self, models: Sequence[StatedPlaneModel]) -> None:
        self._T_bi_ci = np.array([one.mount_i.T_body_camera for one in models])
        self._T_cj_bj = se3_inverse(np.array([one.mount_j.T_body_camera for one in models]))
        self._n = np.array([one.n for one in models])
        sides = np.linalg.svd(self._n[:, None])[2].copy()
        size = np.linalg.norm(self._n, axis=1)[:, None]
        sides[:, 0] = self._n / size
        self._by_error = size[..., None] * sides[:, [1, 2, 0]].mT
        self._root = np.linalg.cholesky(np.array([one.measured.information for one in models])).mT
        self._H_inverse = np.linalg.inv(np.array([one.measured.H_j_i for one in models]))
        none = np.zeros((2, 8, LENS_TERMS))
        lenses = [none if one.measured.by_lenses is None else one.measured.by_lenses for one in models]
        self._by_lens_i, self._by_lens_j = -self._root @ np.moveaxis(np.array(lenses), 1, 0)

    def at(
        self, T_world_i: Array, T_world_j: Array, errors: Sequence[Array]
    ) -> tuple[Array, list[Array], NDArray[np.bool_]]:
        n = self._n + (self._by_error @ errors[0][..., None])[..., 0]
        T_bj_bi = se3_inverse(T_world_j) @ T_world_i
        T_cj_ci = self._T_cj_bj @ T_bj_bi @ self._T_bi_ci
        R, t = T_cj_ci[:, :3, :3], T_cj_ci[:, :3, 3]
        H = R + t[:, :, None] * n[:, None, :]
        h, near = _off(self._H_inverse, H)
        by_h = self._root @ sl3_log_derivative(h)
        back = np.linalg.inv(np.where(near[:, None, None], H, np.eye(3)))[:, None]
        # a point X on the plane goes to R X + t: camera i turned by w and shifted by v adds R (w x X + v)
        by_camera = np.concatenate([R[:, None] @ HATS, R.mT[..., None] * n[:, None, None]], axis=1)
        by_ci = sl3_vee(back @ by_camera).mT
        by_i = by_h @ by_ci @ _adjoint(se3_inverse(self._T_bi_ci))
        by_j = -by_i @ _adjoint(se3_inverse(T_bj_bi))
        by_n = sl3_vee(back @ (t[:, None, :, None] * np.eye(3)[:, None, :])).mT
        e = self._root @ h[..., None]
        e += self._by_lens_i @ errors[1][..., None] + self._by_lens_j @ errors[2][..., None]
        return e[..., 0], [by_i, by_j, by_h @ by_n @ self._by_error, self._by_lens_i, self._by_lens_j], near
