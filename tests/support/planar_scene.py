"""Two observers above a marker plane, with exact geometry: what the front end's tests measure against."""

from dataclasses import dataclass

import msgspec
import numpy as np

from coloc_graph.frontend import PointPairs
from coloc_graph.geometry.lie import floor_pose, se3_inverse, sl3_exp, sl3_normalise, so3_exp
from coloc_graph.team import Camera, Markers, Mount

CAMERA = Camera(width=320, height=240, fx=301.0, fy=301.0, cx=159.5, cy=119.5)
MOUNT = Mount(height=0.40, tilt_deg=20.0)
MARKERS = Markers(height=0.15, positions=((0.0, 0.125), (0.0, -0.125)))


@dataclass(frozen=True)
class Scene:
    """Observers i and j a distance apart, turned towards each other, as in the paper's single step."""

    mount_i: Mount = MOUNT
    mount_j: Mount = MOUNT
    markers: Markers = MARKERS
    distance: float = 0.8
    angle_deg: float = 35.0

    @property
    def T_world_i(self):
        return floor_pose(0.0, self.distance / 2, -np.deg2rad(self.angle_deg) / 2)

    @property
    def T_world_j(self):
        return floor_pose(0.0, -self.distance / 2, np.deg2rad(self.angle_deg) / 2)

    @property
    def T_i_j(self):
        return se3_inverse(self.T_world_i) @ self.T_world_j

    @property
    def T_world_ci(self):
        return self.T_world_i @ self.mount_i.T_body_camera

    @property
    def T_world_cj(self):
        return self.T_world_j @ self.mount_j.T_body_camera

    @property
    def N(self):
        """The plane's normal in camera i, from the camera to the plane."""
        return self.T_world_ci[:3, :3].T @ np.array([0.0, 0.0, -1.0])

    @property
    def d(self):
        return self.mount_i.height - self.markers.height

    @property
    def H_j_i(self):
        T_cj_ci = se3_inverse(self.T_world_cj) @ self.T_world_ci
        return sl3_normalise(T_cj_ci[:3, :3] + np.outer(T_cj_ci[:3, 3], self.N) / self.d)

    def seen(self, points_world):
        """Pixels in cameras i and j of points (n, 3), and which both see."""
        uv, both = [], np.ones(len(points_world), bool)
        for T in (self.T_world_ci, self.T_world_cj):
            pixels, inside = CAMERA.project((points_world - T[:3, 3]) @ T[:3, :3])
            uv.append(pixels)
            both &= inside
        return uv[0], uv[1], both

    def pixels(self, n, rng):
        """Pixels (n, 2) in both images of n random points on the marker plane that both see."""
        points = np.column_stack([rng.uniform(0.3, 2.5, 60 * n), rng.uniform(-1.2, 1.2, 60 * n)])
        points = np.column_stack([points, np.full(len(points), self.markers.height)])
        uv_i, uv_j, both = self.seen(points)
        assert both.sum() >= n
        return uv_i[both][:n], uv_j[both][:n]


def mounted(mount, **changes):
    return msgspec.structs.replace(mount, **changes)


def pairs_of(uv_i, uv_j, covariance_i, covariance_j=None):
    """Point pairs of pixels, with covariances in pixels (n, 2, 2) or one sigma [px]."""
    covariance_j = covariance_i if covariance_j is None else covariance_j
    as_matrices = [
        np.broadcast_to(c**2 * np.eye(2) if np.isscalar(c) else c, (len(uv_i), 2, 2)) / CAMERA.fx**2
        for c in (covariance_i, covariance_j)
    ]
    return PointPairs(CAMERA.normalise(uv_i), CAMERA.normalise(uv_j), *as_matrices)


def geometry(rng, n):
    """R (n, 3, 3), T, N (n, 3), d (n,) of pairs of cameras both on one side of a plane that camera 1 looks at."""
    R = so3_exp(rng.uniform(-0.6, 0.6, (n, 3)))
    N = rng.normal(size=(n, 3)) * (0.5, 0.5, 0.2) + (0, 0, 1.0)
    N /= np.linalg.norm(N, axis=1, keepdims=True)
    d = rng.uniform(0.2, 3.0, n)
    T = rng.normal(size=(n, 3))
    T *= (d * rng.uniform(0.2, 0.8, n) / np.linalg.norm(T, axis=1))[:, None]
    return R, T, N, d


def homography(R, T, N, d):
    return R + T[..., :, None] * N[..., None, :] / np.asarray(d)[..., None, None]


def small_homographies(information, n, rng):
    """Errors exp(h) (n, 3, 3) of homographies, drawn from an information (8, 8)."""
    return sl3_exp(rng.multivariate_normal(np.zeros(8), np.linalg.inv(information), n))
