"""What comes of a drive: where robots and landmarks are, and what is off of wheels and sensors."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.lie import floor_pose
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.measurements import Drive

Array = NDArray[np.float64]

#: Where a pose (x, y, heading) is among the tangent components of one in space.
PLACE = np.array([3, 4, 2])
#: What a pose on the floor has of the others [rad, m]: nothing.
FLAT = 1e-6


@dataclass(frozen=True, eq=False)
class PlacedLandmark:
    """A landmark: `position` (2,) in the world [m], its `covariance` (2, 2), whether the team said where it is, and how
    often it was measured."""

    name: str
    position: Array
    covariance: Array
    stated: bool
    measured: int


@dataclass(frozen=True, eq=False)
class Errors:
    """What is off of a robot's wheels (scale, turn scale, delay [s]) and sensor (offset [m], scale, bearing [rad], x,
    y [m], depth, offset of robots [m]), with covariances; None where it was stated without a tolerance."""

    wheels: tuple[Array, Array] | None
    ranging: tuple[Array, Array] | None


@dataclass(frozen=True, eq=False, repr=False)
class DriveEstimate:
    """Poses of all robots at their keyframes, landmarks, errors of wheels and sensors by robot.

    `noise` (robots, 2) is what the standard deviations of ranges and bearings were multiplied with to be those of the
    residuals. `residuals` (n, 2) are of ranges and bearings in their sigmas, NaN where a measurement was not
    taken in; `doubted` (n,) are those that all others contradict, which weigh next to nothing.
    `chi2` with `dof` degrees of freedom is of everything else, of what of it is new. `unplaced` are robots whose
    measurements do not say where they are. `on_map` says that the world is the landmarks' map.
    """

    drive: Drive
    trajectories: Mapping[str, Trajectory]
    landmarks: tuple[PlacedLandmark, ...]
    errors: Mapping[str, Errors]
    noise: Array
    doubted: NDArray[np.bool_]
    residuals: Array
    chi2: float
    dof: float
    iterations: int
    on_map: bool
    unplaced: tuple[str, ...] = ()

    def __repr__(self) -> str:
        agreement = f", chi2/dof {self.chi2 / self.dof:.2f}" if self.dof > 0 else ""
        return (
            f"DriveEstimate({self.drive!r}, {len(self.trajectories)} robots and {len(self.landmarks)} landmarks "
            f"placed, {int(self.doubted.sum())} measurements doubted{agreement})"
        )


def trajectory(robot: str, times: Array, poses: Array, covariances: Array) -> Trajectory:
    """A trajectory in space of poses (n, 3) x, y, heading, with covariances (n, 3, 3) in the body frame."""
    C = np.zeros((len(poses), 6, 6))
    C[:, [0, 1, 5], [0, 1, 5]] = FLAT**2
    C[:, PLACE[:, None], PLACE] = covariances
    return Trajectory(robot=robot, times=times, T_world_body=floor_pose(*poses.T), covariances=C)
