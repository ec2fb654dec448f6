"""An estimate against truth: lengths as in the paper's Table II, ATE, heading, and NEES."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.lie import floor_pose, se3_inverse, so3_exp, so3_log, yaw
from coloc_graph.trajectory import Trajectory

Array = NDArray[np.float64]

#: True poses further apart in time than this are not joined [s].
LONGEST_TRUTH_GAP = 0.25
#: A robot that got no further than this stayed where it was [m].
STAYED = 0.05
#: Tangent components of a pose on the floor: heading, x, y.
PLANAR = [2, 3, 4]


@dataclass(frozen=True)
class RobotAccuracy:
    """One robot's row of Table II. Lengths are straight from its first to its last estimated pose [m]."""

    robot: str
    true_length: float
    estimated_length: float
    ate: float
    end_position_error: float
    heading_error_deg: float

    @property
    def length_error(self) -> float:
        """Estimated less true length [m]."""
        return self.estimated_length - self.true_length

    @property
    def length_error_percent(self) -> float | None:
        """Size of the length error in % of the true length; None for a robot that did not get anywhere."""
        return 100 * abs(self.length_error) / self.true_length if self.true_length > STAYED else None


@dataclass(frozen=True)
class DistanceAccuracy:
    """The distance between two robots that stayed where they were [m]."""

    robot_i: str
    robot_j: str
    true: float
    estimated: float

    @property
    def error(self) -> float:
        """Estimated less true distance [m]."""
        return self.estimated - self.true


@dataclass(frozen=True)
class Accuracy:
    """A team's accuracy: RMS position error over all poses [m], the largest end errors of any robot, and the
    average NEES per degree of freedom (1 where the covariances tell the truth) over `nees_poses` poses. `distances`
    are those of the pairs of robots that stayed where they were, of which lengths say nothing."""

    robots: tuple[RobotAccuracy, ...]
    ate: float
    end_position_error: float
    heading_error_deg: float
    anees: float | None
    nees_poses: int
    distances: tuple[DistanceAccuracy, ...] = ()


def align(
    estimated: Mapping[str, Trajectory], truth: Mapping[str, Trajectory], reference: str, *, on_floor: bool
) -> dict[str, Array]:
    """The true poses T_world_body (n, 4, 4) at each robot's estimated poses, in the estimate's world.

    That is where the reference robot truly stood at its first pose (the floor below it with `on_floor`): one
    alignment for the whole team, by time stamp. Raises `InputError` where truth does not cover the estimate.
    """
    at = {robot: true_poses(truth, trajectory) for robot, trajectory in estimated.items()}
    if reference not in at:
        raise InputError(f"the estimate does not hold the reference robot {reference}; nothing can be compared")
    T_truth_world = at[reference][0]
    if on_floor:
        x, y, _ = T_truth_world[:3, 3]
        T_truth_world = floor_pose(x, y, yaw(T_truth_world))
    T_world_truth = se3_inverse(T_truth_world)
    return {robot: T_world_truth @ poses for robot, poses in at.items()}


def evaluate(estimated: Mapping[str, Trajectory], true: Mapping[str, Array], *, on_floor: bool) -> Accuracy:
    """Compare an estimate with the true poses (n, 4, 4) of `align`.

    `on_floor`: the NEES is that of heading, x and y, since the floor decides the rest.
    """
    rows, squared, nees = [], [], []
    for robot, trajectory in estimated.items():
        T_true = true[robot]
        off = trajectory.positions - T_true[:, :3, 3]
        squared.append((off**2).sum(axis=1))
        turned = np.rad2deg(yaw(trajectory.T_world_body[-1]) - yaw(T_true[-1]))
        rows.append(
            RobotAccuracy(
                robot=robot,
                true_length=float(np.linalg.norm(T_true[-1, :3, 3] - T_true[0, :3, 3])),
                estimated_length=float(np.linalg.norm(trajectory.positions[-1] - trajectory.positions[0])),
                ate=float(np.sqrt(squared[-1].mean())),
                end_position_error=float(np.linalg.norm(off[-1])),
                heading_error_deg=float(abs((turned + 180) % 360 - 180)),
            )
        )
        nees.append(nees_of(trajectory, T_true, PLANAR if on_floor else list(range(6))))
    all_nees = np.concatenate(nees)
    return Accuracy(
        robots=tuple(rows),
        ate=float(np.sqrt(np.concatenate(squared).mean())),
        end_position_error=max(row.end_position_error for row in rows),
        heading_error_deg=max(row.heading_error_deg for row in rows),
        anees=float(all_nees.mean()) if len(all_nees) else None,
        nees_poses=len(all_nees),
        distances=tuple(
            DistanceAccuracy(
                i,
                j,
                true=float(np.linalg.norm(true[j][-1, :3, 3] - true[i][-1, :3, 3])),
                estimated=float(np.linalg.norm(estimated[j].positions[-1] - estimated[i].positions[-1])),
            )
            for i, j in itertools.combinations([row.robot for row in rows if row.true_length <= STAYED], 2)
            if estimated[i].times[-1] == estimated[j].times[-1]  # not where one drove by
        ),
    )


def true_poses(truth: Mapping[str, Trajectory], estimated: Trajectory) -> Array:
    """The true poses (n, 4, 4) at an estimate's times: the latest at or before each, or between two that are near.

    Robots stand while they observe, and truth may be sparse then; while they move it is followed from sample to
    sample, at most `LONGEST_TRUTH_GAP` apart. Raises `InputError` where there is no truth at a time.
    """
    true = truth.get(estimated.robot)
    if true is None or not len(true):
        raise InputError(f"the truth does not hold robot {estimated.robot}, which the estimate does")
    index = np.searchsorted(true.times, estimated.times + 1e-6, side="right") - 1
    if (index < 0).any():
        first = int((index < 0).argmax())
        stance = first if estimated.stances is None else int(estimated.stances[first])
        raise InputError(
            f"the truth of robot {estimated.robot} begins after stance {stance}; record it from the first stance on"
        )
    T_world_body = true.T_world_body[index].copy()
    after = np.minimum(index + 1, len(true) - 1)
    gap = true.times[after] - true.times[index]
    share = np.clip((estimated.times - true.times[index]) / np.where(gap > 0, gap, 1.0), 0, 1)
    share = np.where((gap > 0) & (gap <= LONGEST_TRUTH_GAP), share, 0.0)[:, None]
    ahead = true.T_world_body[after]
    turn = so3_log(T_world_body[:, :3, :3].mT @ ahead[:, :3, :3])
    moved = share[:, 0] > 0
    T_world_body[moved, :3, :3] = (T_world_body[:, :3, :3] @ so3_exp(share * turn))[moved]
    T_world_body[:, :3, 3] += share * (ahead[:, :3, 3] - T_world_body[:, :3, 3])
    return T_world_body


def nees_of(estimated: Trajectory, T_true: Array, components: list[int]) -> Array:
    """Normalised estimation error squared per degree of freedom, of each pose that has a covariance to speak of.

    The pose that defines the world has none and is left out; a pose held over several stances counts once.
    """
    if estimated.covariances is None:
        return np.empty(0)
    values = []
    for index in range(len(estimated)):
        if index and np.array_equal(estimated.T_world_body[index], estimated.T_world_body[index - 1]):
            continue
        covariance = estimated.covariances[index][np.ix_(components, components)]
        if np.sqrt(np.diag(covariance)).max() < 1e-5:
            continue
        T_body_true = gtsam.Pose3(se3_inverse(estimated.T_world_body[index]) @ T_true[index])
        xi = gtsam.Pose3.Logmap(T_body_true)[components]
        values.append(float(xi @ np.linalg.solve(covariance, xi)) / len(components))
    return np.array(values)
