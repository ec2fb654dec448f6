"""The pose graph of a team: one pose a robot and move, stay-put constraints, relative poses, the floor."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from coloc_graph.errors import EstimationError
from coloc_graph.measurements import RelativePose
from coloc_graph.run import Stance
from coloc_graph.team import Floor

#: The world frame is fixed this firmly [rad, m]; far below anything that is measured.
GAUGE_SIGMA = 1e-6
#: A floor that is called exactly flat is taken as flat to this much [rad, m].
LEAST_FLOOR_SIGMA = 1e-5


@dataclass(frozen=True)
class StayPut:
    """The paper's constraint: an anchor's pose at stance `after` is its pose at stance `before`.

    It is enforced exactly: both stances share one variable, since every equality factor of GTSAM 4.3 fails
    somewhere.
    """

    robot: str
    before: int
    after: int


@dataclass(frozen=True)
class PoseGraph:
    """What a team measured, as a graph.

    Nodes are the poses T_world_body of the observers, one a robot and number of its moves. The world frame is
    where the reference robot stands at the first stance: its body, or, where there is a `floor`, the floor
    beneath it (the same on a level floor), x along its heading.
    """

    reference: str
    robots: tuple[str, ...]
    stances: tuple[Stance, ...]
    relative_poses: tuple[RelativePose, ...]
    floor: Floor | None = None

    def __post_init__(self) -> None:
        if not self.stances:
            raise EstimationError("there is no stance to estimate: record one in which two robots stand and watch")
        first = self.stances[0]
        if self.reference not in first.observers:
            raise EstimationError(
                f"the reference robot {self.reference} does not observe at stance {first.index}, where the world "
                f"frame is set: name one of {', '.join(first.observers)} as the reference in the team"
            )
        for pose in self.relative_poses:
            for robot in (pose.robot_i, pose.robot_j):
                if (robot, pose.stance) not in self.moves:
                    raise EstimationError(
                        f"a relative pose at stance {pose.stance} names {robot}, which does not observe there"
                    )

    @cached_property
    def moves(self) -> dict[tuple[str, int], int]:
        """How often a robot has moved before it observed at a stance, by (robot, stance index)."""
        count = dict.fromkeys(self.robots, 0)
        moves: dict[tuple[str, int], int] = {}
        for before, stance in zip((None, *self.stances), self.stances, strict=False):
            for robot in self.robots:
                if before is not None and robot not in stance.anchors:
                    count[robot] += 1
            moves |= {(robot, stance.index): count[robot] for robot in stance.observers}
        return moves

    @cached_property
    def stay_puts(self) -> tuple[StayPut, ...]:
        """The constraints, in the order of the stances."""
        return tuple(
            StayPut(robot, before.index, after.index)
            for before, after in zip(self.stances, self.stances[1:], strict=False)
            for robot in after.anchors
            if robot in before.observers and robot in after.observers
        )

    def key(self, robot: str, stance: int) -> int:
        """GTSAM's key of a robot's pose at a stance."""
        return int(gtsam.mrsymbol(ord("x"), self.robots.index(robot) + 1, self.moves[robot, stance]))

    @property
    def reference_key(self) -> int:
        """The key of the pose that defines the world."""
        return self.key(self.reference, self.stances[0].index)

    def factors(self, keys: Iterable[int]) -> gtsam.NonlinearFactorGraph:
        """The graph over these keys: gauge, floor priors, between-factors of the relative poses among them."""
        wanted = set(keys)
        graph = gtsam.NonlinearFactorGraph()
        tilt, height = GAUGE_SIGMA, GAUGE_SIGMA
        if self.floor is not None:
            tilt = max(float(np.deg2rad(self.floor.tilt_sigma_deg)), LEAST_FLOOR_SIGMA)
            height = max(self.floor.height_sigma, LEAST_FLOOR_SIGMA)
        gauge = gtsam.noiseModel.Diagonal.Sigmas([tilt, tilt, GAUGE_SIGMA, GAUGE_SIGMA, GAUGE_SIGMA, height])
        graph.add(gtsam.PriorFactorPose3(self.reference_key, gtsam.Pose3(), gauge))
        if self.floor is not None:
            level = gtsam.noiseModel.Isotropic.Sigma(2, tilt)
            on_floor = gtsam.noiseModel.Diagonal.Precisions(np.array([0.0, 0.0, height**-2]))
            up = gtsam.Unit3(np.array([0.0, 0.0, 1.0]))
            for key in sorted(wanted - {self.reference_key}):
                graph.add(gtsam.AttitudeFactorPose3(key, up, level))
                graph.add(gtsam.PoseTranslationPrior3D(key, np.zeros(3), on_floor))
        for pose in self.relative_poses:
            i, j = self.key(pose.robot_i, pose.stance), self.key(pose.robot_j, pose.stance)
            if i in wanted and j in wanted:
                noise = gtsam.noiseModel.Gaussian.Covariance(pose.covariance)
                graph.add(gtsam.BetweenFactorPose3(i, j, pose.T_i_j, noise))
        return graph

    def untied(self, known: Iterable[int]) -> tuple[tuple[str, int], ...]:
        """The (robot, stance) whose pose is not among these keys, in the order of the stances."""
        keys = set(known)
        return tuple(
            (robot, stance.index)
            for stance in self.stances
            for robot in stance.observers
            if self.key(robot, stance.index) not in keys
        )
