"""What a method makes of a graph: the poses of all robots at all stances, and what is needed to doubt them."""

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.graph import PoseGraph
from coloc_graph.errors import EstimationError
from coloc_graph.trajectory import Trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Estimate:
    """Poses of all robots at all stances that are tied to the reference.

    `trajectories` by robot, one pose a stance it observed in. `chi2` with `dof` degrees of freedom says how
    well the measurements agree (dof 0: nothing could contradict). `untied` are the (robot, stance) that no
    measurement ties to the reference; they have no pose.
    """

    method: str
    graph: PoseGraph
    trajectories: Mapping[str, Trajectory]
    untied: tuple[tuple[str, int], ...] = ()
    chi2: float = 0.0
    dof: int = 0
    iterations: int = 0

    def pose(self, robot: str, stance: int) -> gtsam.Pose3:
        """T_world_body of a robot at a stance; `EstimationError` where it has none."""
        T, _ = self._at(robot, stance)
        return gtsam.Pose3(T)

    def covariance(self, robot: str, stance: int) -> Array:
        """Covariance (6, 6) of that pose: GTSAM's tangent, rotation [rad] first, then translation [m], body frame."""
        return self._at(robot, stance)[1]

    def _at(self, robot: str, stance: int) -> tuple[Array, Array]:
        trajectory = self.trajectories.get(robot)
        if trajectory is not None and trajectory.stances is not None and trajectory.covariances is not None:
            for index in np.flatnonzero(trajectory.stances == stance):
                return trajectory.T_world_body[index], trajectory.covariances[index]
        raise EstimationError(f"robot {robot} has no pose at stance {stance}")


def make_estimate(
    method: str,
    graph: PoseGraph,
    poses: Mapping[int, gtsam.Pose3],
    covariances: Mapping[int, Array],
    *,
    chi2: float = 0.0,
    dof: int = 0,
    iterations: int = 0,
) -> Estimate:
    """An estimate of poses and covariances (6, 6) by key."""
    trajectories = {}
    for robot in graph.robots:
        at = [s for s in graph.stances if robot in s.observers and graph.key(robot, s.index) in poses]
        if not at:
            continue
        keys = [graph.key(robot, stance.index) for stance in at]
        trajectories[robot] = Trajectory(
            robot=robot,
            times=np.array([stance.start for stance in at]),
            T_world_body=np.array([poses[key].matrix() for key in keys]),
            stances=np.array([stance.index for stance in at]),
            covariances=np.array([covariances[key] for key in keys]),
        )
    return Estimate(method, graph, trajectories, graph.untied(poses), chi2, dof, iterations)
