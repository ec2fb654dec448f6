"""A floor that is not quite level: `UnevenFloor` tilts whoever stands on it by the place where he stands."""

import numpy as np
from numpy.typing import ArrayLike

from coloc_graph.geometry.lie import floor_pose
from coloc_graph.simulation.paths import FLOOR_GRAIN, Array, tilt_rotation

#: Waves that make up the slope along one axis: enough for it to be normally distributed.
WAVES = 64


class UnevenFloor:
    """A smooth slope at every place: normal with `sigma` [rad] along x and along y, another one `FLOOR_GRAIN` away.

    The floor is at z = 0 everywhere; only bodies tilt. Source: Rahimi and Recht, "Random Features for Large-Scale
    Kernel Machines", 2007.
    """

    def __init__(self, sigma: float, rng: np.random.Generator) -> None:
        self._scale = sigma * np.sqrt(2 / WAVES)
        self._waves = rng.standard_normal((2, WAVES, 2)) / (FLOOR_GRAIN / 2)
        self._phases = rng.uniform(0, 2 * np.pi, (2, WAVES))

    def slope(self, xy: ArrayLike) -> Array:
        """Slopes of the floor along x and y [rad] at places (n, 2) [m], (n, 2)."""
        phases = np.einsum("awj,nj->naw", self._waves, np.asarray(xy, float)) + self._phases
        return np.asarray(self._scale * np.cos(phases).sum(axis=-1))

    def pose(self, planar: ArrayLike) -> Array:
        """T_world_body (n, 4, 4) of bodies at x, y [m], yaw [rad], (n, 3)."""
        planar = np.asarray(planar, float)
        T_world_body = floor_pose(*planar.T)
        x, y = self.slope(planar[:, :2]).T
        c, s = np.cos(planar[:, 2]), np.sin(planar[:, 2])
        # nose up where it rises ahead, which is a negative pitch
        T_world_body[:, :3, :3] = T_world_body[:, :3, :3] @ tilt_rotation(c * y - s * x, -(c * x + s * y))
        return T_world_body
