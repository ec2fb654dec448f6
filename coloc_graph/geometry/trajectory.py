"""Poses of one robot over stances or over time, estimated or true."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of one robot: `T_world_body` (n, 4, 4) [m] at `times` (n,) [UTC s].

    `stances` (n,) numbers the stances the poses belong to; `covariances` (n, 6, 6) are in GTSAM's tangent
    (rotation first, body frame), None where there are none (truth).
    """

    robot: str
    times: Array
    T_world_body: Array
    stances: NDArray[np.int64] | None = None
    covariances: Array | None = None

    def __len__(self) -> int:
        return len(self.times)

    def where(self, kept: NDArray[np.bool_]) -> "Trajectory":
        """The poses where `kept` (n,) is true."""
        stances = None if self.stances is None else self.stances[kept]
        covariances = None if self.covariances is None else self.covariances[kept]
        return Trajectory(self.robot, self.times[kept], self.T_world_body[kept], stances, covariances)

    @property
    def positions(self) -> Array:
        """Positions in the world, (n, 3) [m]."""
        return np.asarray(self.T_world_body[:, :3, 3])
