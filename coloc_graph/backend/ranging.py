"""Graph of a ranging run, whose nodes are robots at keyframes, and how its measurements agree with an estimate."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.chi2_test import Agreement
from coloc_graph.backend.floor_poses import joint_in_space
from coloc_graph.backend.marginals import Marginals
from coloc_graph.errors import EstimationError
from coloc_graph.measurements import Keyframes, Node, RangeBearing
from coloc_graph.team import Team

Array = NDArray[np.float64]
Index = NDArray[np.int64]


# the test of other kinds rejects good ones: successive errors are correlated (docs/ranging-runs.md)
OUTLIER = 6.0  # residual of a range or bearing beyond which a measurement is an outlier [sigmas]


def pose_key(keyframes: Keyframes, robots: Index, numbers: Index) -> Index:
    """Return GTSAM's keys (n,) of keyframes' poses, by robot and number: the same however many keyframes there are."""
    keys: Index = numbers * len(keyframes.robots) + robots
    return keys


def outliers_of(residuals: Array) -> NDArray[np.bool_]:
    """Return which measurements of residuals (n, 2) are outliers; NaN are nothing that was measured."""
    return np.asarray(np.fmax.reduce(np.abs(residuals), axis=-1) > OUTLIER)


@dataclass(frozen=True, eq=False, repr=False)
class KeyframeGraph:
    """Odometry, ranges and bearings of a team that has no stances, as a graph: a node is a robot at a keyframe.

    `joint` and `diagnose` take it as they take a `PoseGraph`.

    Parameters
    ----------
    team : Team
        The team, with its range sensors, wheels and landmarks.
    keyframes : Keyframes
        Keyframes, steps between them, and ranges and bearings.
    """

    team: Team
    keyframes: Keyframes

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.keyframes!r})"

    @property
    def robots(self) -> tuple[str, ...]:
        """Robots, by number."""
        return self.keyframes.robots

    @property
    def names(self) -> tuple[str, ...]:
        """Robots, then landmarks: the names of `robot` and `target` of the measurements, by number."""
        return (*self.keyframes.robots, *self.keyframes.landmarks)

    @property
    def on_map(self) -> bool:
        """True if a landmark's position is stated: the world is their map, otherwise the reference's first pose."""
        return any(one.position is not None for one in self.team.landmarks)

    @cached_property
    def measurements(self) -> tuple[RangeBearing, ...]:
        """All measurements, one by one."""
        m, names = self.keyframes.measured, self.names
        columns = (m.time, m.robot, m.keyframe, m.target, m.target_keyframe, m.range, m.bearing)
        return tuple(
            RangeBearing(row, time, names[robot], keyframe, names[target], target_keyframe, distance, bearing)
            for row, (time, robot, keyframe, target, target_keyframe, distance, bearing) in enumerate(
                zip(*(column.tolist() for column in columns), strict=True)
            )
        )

    @cached_property
    def nodes(self) -> tuple[Node, ...]:
        """Every keyframe of every robot."""
        return tuple(node for robot in self.keyframes.robots for node in self.nodes_of(robot))

    def nodes_of(self, robot: str) -> Iterator[Node]:
        """Yield the keyframes of a robot."""
        number = self.keyframes.robots.index(robot)
        begin = self.keyframes.begins[number]
        return ((robot, begin + n) for n in range(len(self.keyframes.times[number])))


@dataclass(frozen=True, eq=False, repr=False)
class RangingProblem(KeyframeGraph):
    """Graph of a ranging run, and how its measurements agree with the estimate.

    Parameters
    ----------
    numbers : mapping of str to (n,) int
        By robot, the keyframe of each pose of its trajectory.
    residuals : (m, 2) float
        Of ranges and bearings in units of their noise; NaN where a measurement was not used, or there is no bearing.
    noise : (robots, 2) float
        Factors on the stated standard deviations of ranges and of bearings.
    direction_sigmas : (robots,) float
        Standard deviation [rad] of each body's heading about that in which its wheels drive.
    solved : callable or None
        Gives the marginal covariances of all poses, by `pose_key`; None of an incremental estimate, which has
        marginalised most.
    """

    numbers: Mapping[str, NDArray[np.int64]]
    residuals: Array
    noise: Array
    direction_sigmas: Array
    solved: Callable[[], Marginals] | None = None

    @cached_property
    def outliers(self) -> NDArray[np.bool_]:
        """True where a measurement was rejected (m,): its robust weight is near 0."""
        return outliers_of(self.residuals)

    @property
    def used(self) -> NDArray[np.bool_]:
        """True where a measurement is in the estimate and is no outlier, (m,)."""
        return np.isfinite(self.residuals[:, 0]) & ~self.outliers

    @property
    def counts(self) -> dict[str, int]:
        """Number of measurements of each landmark, outliers included."""
        target = self.keyframes.measured.target[np.isfinite(self.residuals[:, 0])]
        counts = np.bincount(target, minlength=len(self.names)).tolist()
        return dict(zip(self.keyframes.landmarks, counts[len(self.keyframes.robots) :], strict=True))

    def residual(self, measurement: RangeBearing) -> float:
        """RMS residual of a range and bearing in units of its noise; NaN where it was not used."""
        off = self.residuals[measurement.row]
        return float(np.sqrt(np.mean(off[np.isfinite(off)] ** 2))) if np.isfinite(off[0]) else float("nan")

    def agreement(self, row: int) -> Agreement:
        """Return how a range and bearing agrees with the estimate."""
        return Agreement(float(np.nanmax(self.residuals[row] ** 2)), 1)

    def joint(self, nodes: Sequence[Node], T_world_body: Array) -> Array:
        """Return the joint covariance (6 n, 6 n) of different nodes at (n, 4, 4), in their bodies' tangents."""
        if self._marginals is None:
            raise EstimationError("ranging runs have no joint covariances incrementally: solve it in batch")
        owner = np.array([self.robots.index(robot) for robot, _ in nodes])
        keys = pose_key(self.keyframes, owner, np.array([number for _, number in nodes]))
        whole = joint_in_space(T_world_body, self._marginals.joint(keys.tolist()))
        whole[2::6, 2::6] += (owner[:, None] == owner) * self.direction_sigmas[owner] ** 2
        return whole

    @cached_property
    def _marginals(self) -> Marginals | None:
        return None if self.solved is None else self.solved()

    def reason(self, row: int) -> str | None:
        """Return why a measurement is not used; None where it is."""
        if self.outliers[row]:
            return self.agreement(row).reason
        if not np.isfinite(self.residuals[row, 0]):
            return "one of its ends has no pose"
        return None
