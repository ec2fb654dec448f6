"""Poses of one robot over stances or over time, estimated or true."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of one robot.

    Parameters
    ----------
    robot : str
        Its name.
    times : (n,) float
        Times [UTC s].
    T_world_body : (n, 4, 4) float
        Poses [m].
    stances : (n,) int or None
        Index of each pose's stance; None of poses without stances.
    covariances : (n, 6, 6) float or None
        In GTSAM's tangent: rotation [rad] first, then translation [m], body frame; None of truth.
    """

    robot: str
    times: Array
    T_world_body: Array
    stances: NDArray[np.int64] | None = None
    covariances: Array | None = None

    def __len__(self) -> int:
        return len(self.times)

    def where(self, kept: NDArray[np.bool_]) -> "Trajectory":
        """Return the poses where `kept` (n,) is true."""
        stances = None if self.stances is None else self.stances[kept]
        covariances = None if self.covariances is None else self.covariances[kept]
        return Trajectory(self.robot, self.times[kept], self.T_world_body[kept], stances, covariances)

    @property
    def positions(self) -> Array:
        """Positions in the world, (n, 3) [m]."""
        return np.asarray(self.T_world_body[:, :3, 3])
