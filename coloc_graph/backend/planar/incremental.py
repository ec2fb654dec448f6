"""Fixed-lag smoother of a ranging run, with earlier poses marginalised: `KeyframeEstimator`.

A filter gives initial values of robots and landmarks. The estimate of a keyframe is kept twice: at its time, and when
it leaves the window, corrected by later measurements. Between steps in the whole window, poses that are not recent are
marginalised for the time being.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.estimate import Estimate
from coloc_graph.backend.fixed_lag import marginal_factor
from coloc_graph.backend.floor_poses import in_body
from coloc_graph.backend.forgetting import require_all
from coloc_graph.backend.marginals import Marginals, tree_covariances
from coloc_graph.backend.planar.factors import KeyframeFactors, State
from coloc_graph.backend.planar.filter import INITIAL_PERIOD, Filter, Models, aligned
from coloc_graph.backend.planar.problem import KeyframeProblem
from coloc_graph.backend.planar.summary import ranging_estimate, trajectories_of
from coloc_graph.backend.solver import eliminated
from coloc_graph.backend.validation import require_following
from coloc_graph.geometry.se2 import compose
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.measurements import Keyframes, RangeBearings, Steps
from coloc_graph.team import Team

Array = NDArray[np.float64]
Index = NDArray[np.int64]

LAG = 40.0  # s for which poses are corrected
UPDATE_PERIOD = 1.0  # s between updates
RECENT = 0.125  # part of the lag in which each update corrects poses, and after which one corrects the whole window
CALIBRATION_TIME = 300.0  # s at the beginning in which no pose leaves: wheels and sensors are not calibrated yet


@dataclass(frozen=True, eq=False)
class Latest:
    """Poses of robots at a time [UTC s]: by name, (x, y, heading) and its covariance (3, 3) in the body frame."""

    time: float
    poses: dict[str, tuple[Array, Array]]


class _Window(NamedTuple):
    """Poses that are variables: each robot's from the keyframe of a number on, and what those before say of them."""

    begins: tuple[int, ...]
    past: gtsam.LinearContainerFactor | None = None


@dataclass(frozen=True, eq=False)
class _Log:
    """Estimates of poses, as they were noted: robots and keyframes, poses (n, 3) and covariances (n, 3, 3)."""

    entries: list[tuple[Index, Index, Array, Array]] = field(default_factory=list)

    def arrays(self, factors: KeyframeFactors) -> tuple[Array, Array]:
        """Return the last ones of all keyframes; NaN where there is none."""
        poses, C = np.full((len(factors), 3), np.nan), np.full((len(factors), 3, 3), np.nan)
        for robots, numbers, some, some_C in self.entries:
            at = factors.first[robots] + numbers
            poses[at], C[at] = some, some_C
        return poses, C


class KeyframeEstimator:
    """Fixed-lag smoother of a ranging run, to which keyframes are added as they come.

    Parameters
    ----------
    team : Team
        The team.
    lag : float
        Time for which poses are corrected [s].
    calibrating : float
        Time at the beginning in which all poses are [s].
    forgets : bool
        Forget what has left the window, so that memory stays bounded in a mission of any length; then there is no
        `estimate` of the whole.
    """

    def __init__(
        self, team: Team, *, lag: float = LAG, calibrating: float = CALIBRATION_TIME, forgets: bool = False
    ) -> None:
        self._team, self._lag, self._calibrating, self._forgets = team, lag, calibrating, forgets
        self._keyframes = _nothing(team)  # those of the window
        models = Models(team, self._keyframes)
        self._filter = Filter(team, self._keyframes, INITIAL_PERIOD)
        self._factors = KeyframeFactors(self._keyframes, models)
        self._state = State(np.empty((0, 3)), self._factors.start())
        self._begun = np.inf  # time of the first keyframe [UTC s]
        self._window = self._active = _Window(self._keyframes.begins)  # those active may be the recent ones only
        self._next = -np.inf  # time of the next step in the whole window [UTC s]
        self._gauge: tuple[int, int, Array] | None = None  # robot, keyframe and pose that define the world
        self._landmarks: set[int] = set()
        self._latest: dict[int, tuple[Array, Array]] = {}
        # of all keyframes, unless it forgets
        self._came: list[Keyframes] = []
        self._smoothed, self._online = _Log(), _Log()

    def add(self, new: Keyframes) -> Latest:
        """Add keyframes with all that was measured at them, and return the newest poses.

        Parameters
        ----------
        new : Keyframes
            What has come since the last call, as by `Keyframes.between`: each robot's keyframes from its last one on.

        Raises
        ------
        MeasurementError
            They do not follow those added before, or a measurement is of a keyframe that has left the window.
        """
        require_following(self._keyframes, new)
        if not self._forgets:
            self._came.append(new)
        ends, rows = self._keyframes.ends, len(self._keyframes.measured)
        self._follow(self._keyframes.followed_by(new))
        if not self._filter.is_complete:
            for row in range(rows, len(self._keyframes.measured)):
                self._filter.take(row)
        time = max((float(times[-1]) for times in self._keyframes.times if len(times)), default=-np.inf)
        self._begun = min([self._begun, *(float(times[0]) for times in new.times if len(times))])
        self._enter_robots()
        self._enter_landmarks()
        if np.isfinite(self._state.poses[:, 0]).any():
            whole = time >= self._next
            if whole:
                self._active, self._next = self._window, time + RECENT * self._lag
                self._step()  # one of two: in few steps robust weights would not converge before poses leave
            _, tree = self._step()
            self._note_latest(ends, tree)
            if whole and time >= self._begun + self._calibrating:
                self._leave(time - self._lag, tree)
            if whole:
                self._active = self._without(time - RECENT * self._lag)
        return Latest(time, {self._team.names[robot]: one for robot, one in self._latest.items()})

    def _follow(self, keyframes: Keyframes) -> None:
        """Go on with the keyframes of another window: more have come, or older ones have left."""
        before, poses = self._keyframes, np.split(self._state.poses, self._factors.first[1:-1])
        models = Models(self._team, keyframes)
        if not self._filter.is_complete or len(self._latest) < len(self._team.names):
            self._filter.follow(keyframes, models)  # it has more to give
        self._keyframes, self._factors = keyframes, KeyframeFactors(keyframes, models)
        self._state = State(np.concatenate(aligned(poses, before, keyframes)), self._state.shared)

    def _enter_robots(self) -> None:
        """Give poses to new keyframes of the robots that have any: the first ones by the filter, then by odometry."""
        factors, poses = self._factors, self._state.poses
        for robot, times in enumerate(self._keyframes.times):
            if robot not in self._filter.placed_at or not len(times):
                continue
            own = poses[factors.first[robot] : factors.first[robot + 1]]
            entered = int(np.isfinite(own[:, 0]).sum())
            if not entered:
                self._active = self._window
                whole = self._filter.whole()[robot]
                entered = int(np.isfinite(whole[:, 0]).sum())
                own[:entered] = whole[:entered]
                if not factors.models.map_known and self._gauge is None:
                    self._gauge = robot, self._keyframes.begins[robot], own[0].copy()
            deltas, _ = factors.models.wheels[robot].steps(
                slice(entered - 1, len(times) - 1), factors.wheels(self._state.shared)[robot]
            )
            for k, (x, y, yaw) in enumerate(deltas.tolist(), start=entered):
                a, b, c = own[k - 1].tolist()
                own[k] = compose((a, b, c), (x, y, yaw))

    def _enter_landmarks(self) -> None:
        """Add landmarks that the filter knows since the last time."""
        for number in range(len(self._keyframes.landmarks)):
            position = self._filter.landmark(number)
            if position is not None and number not in self._landmarks and not self._factors.is_exact(number):
                self._factors.landmarks(self._state.shared)[number] = position
                self._landmarks.add(number)
                self._active = self._window

    def _problem(self, steps: Index, measured: Index) -> KeyframeProblem:
        """Return the problem of some factors in the window, with what those before it say."""
        gauge = None
        if self._gauge is not None:
            robot, number, at = self._gauge
            gauge = int(self._factors.first[robot]) + number - self._keyframes.begins[robot], at
        return KeyframeProblem(self._factors, steps, measured, gauge, self._active.past)

    def _inside(self) -> NDArray[np.bool_]:
        """Return True of the poses (n,) that are active."""
        before = np.array(self._active.begins) - self._keyframes.begins
        in_window = np.arange(len(self._factors)) >= (self._factors.first[:-1] + before)[self._factors.robot]
        return in_window & np.isfinite(self._state.poses[:, 0])

    def _step(self) -> tuple[gtsam.GaussianFactorGraph, gtsam.GaussianBayesTree]:
        """Take one Gauss-Newton step in the window, which was at its optimum before; return what it solved, and how."""
        factors, inside = self._factors, self._inside()
        problem = self._problem(factors.steps_between(inside), factors.measured_between(inside, self._landmarks))
        linear, newest = problem.linear(self._state), factors.keys.names[self._newest()].tolist()
        # the newest are at the root, where covariances cost least
        ordering = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(linear, newest)
        tree, _ = eliminated(linear, ordering)
        self._state = problem.moved(self._state, tree.optimize())
        return linear, tree

    def _without(self, before: float) -> _Window:
        """Marginalise poses from before a time [UTC s], but the newest of robots, and return the window of the rest."""
        factors, inside = self._factors, self._inside()
        old, past = factors.times < before, self._active.past
        old[self._lasts()] = False
        gone = old & inside
        if gone.any():
            steps, measured = factors.steps_between(inside), factors.measured_between(inside, self._landmarks)
            seen = gone[factors.seen[measured]] & factors.of_robot[measured]
            touched = gone[steps] | gone[steps + 1], gone[factors.observer[measured]] | seen
            linear = self._problem(steps[touched[0]], measured[touched[1]]).linear(self._state)
            # in the order of the whole graph: one robot after the other would tie all poses of the others
            order, names = gtsam.Ordering.ColamdGaussianFactorGraph(linear), factors.keys.names[np.flatnonzero(gone)]
            values, gone_names = factors.values(self._state, linear.keyVector()), set(names.tolist())
            past = marginal_factor(linear, values, [k for k in map(order.at, range(order.size())) if k in gone_names])
        counts = [int(one.sum()) for one in np.split(old, factors.first[1:-1])]
        return _Window(tuple(np.add(self._keyframes.begins, counts).tolist()), past)

    def _leave(self, before: float, solved: gtsam.GaussianBayesTree) -> None:
        """Keep the estimates of poses from before a time [UTC s], and drop them."""
        self._window = self._active = self._without(before)
        gone = np.flatnonzero(np.isfinite(self._state.poses[:, 0]) & ~self._inside())
        if len(gone) and not self._forgets:
            self._note(self._smoothed, gone, solved)
        self._follow(self._keyframes.since(self._window.begins))

    def _note(self, log: _Log, poses: Index, tree: gtsam.GaussianBayesTree) -> None:
        """Note the estimates of poses, with their covariances by the step's Bayes tree."""
        factors, at = self._factors, self._state.poses[poses]
        robots = factors.robot[poses]
        C = np.array(tree_covariances(tree, factors.keys.names[poses].tolist(), factors.keys.size)).reshape(-1, 3, 3)
        numbers = poses - factors.first[robots] + np.array(self._keyframes.begins)[robots]
        log.entries.append((robots, numbers, at, in_body(at, C)))

    def _note_latest(self, ends: Sequence[int], tree: gtsam.GaussianBayesTree) -> None:
        """Keep the estimate of each robot's newest keyframe at its time, of those that have a new one."""
        new = []
        for pose in self._newest():
            robot = int(self._factors.robot[pose])
            if robot not in self._latest or self._keyframes.ends[robot] > ends[robot]:
                new.append(pose)
        self._note(self._online, np.array(new, int), tree)
        robots, _, poses, C = self._online.entries[-1]
        self._latest |= zip(robots.tolist(), zip(poses, C, strict=True), strict=True)
        if self._forgets:
            self._online.entries.clear()

    def _lasts(self) -> list[int]:
        """Return the newest keyframe of each robot that has one."""
        return [int(end) - 1 for end, n in zip(self._factors.first[1:], self._keyframes.times, strict=True) if len(n)]

    def _newest(self) -> list[int]:
        """Return the newest pose of each robot that has one."""
        return [one for one in self._lasts() if np.isfinite(self._state.poses[one, 0])]

    def estimate(self) -> Estimate:
        """Return the smoothed estimate of all keyframes that were added.

        Raises
        ------
        EstimationError
            It forgets what has left the window, and something has.
        """
        forgotten = self._forgets and any(self._keyframes.begins)
        require_all("the keyframes in its window" if forgotten else None, "estimate the whole run")
        C = np.zeros((len(self._factors.free),) * 2)
        if self._latest:
            self._active = self._window
            linear, tree = self._step()
            C = self._factors.shared_covariance(Marginals(linear, self._factors.keys.size))
            self._note(self._smoothed, np.flatnonzero(np.isfinite(self._state.poses[:, 0])), tree)
        factors = self._whole()
        poses, covariances = self._smoothed.arrays(factors)
        return ranging_estimate(factors, State(poses, self._state.shared), covariances, C, self._landmarks, 0)

    @property
    def online(self) -> dict[str, Trajectory]:
        """Poses as they were estimated at their times, by robot; none if it forgets."""
        factors = self._whole()
        return trajectories_of(factors, *self._online.arrays(factors))

    def _whole(self) -> KeyframeFactors:
        """Return the factors of all keyframes that were kept."""
        whole = self._keyframes if self._forgets else _nothing(self._team).followed_by(*self._came)
        return KeyframeFactors(whole, Models(self._team, whole))


def _nothing(team: Team) -> Keyframes:
    """Return the keyframes of a team of which none has come."""
    landmarks, n = tuple(one.name for one in team.landmarks), len(team.names)
    steps = Steps(np.zeros(1), np.zeros((1, 0, 3)), np.zeros((0, 3, 3)))
    nothing, nobody = np.zeros(0), np.zeros(0, int)
    measured = RangeBearings(nothing, *(nobody,) * 4, nothing, nothing, np.zeros((0, 2)))
    return Keyframes(team.names, landmarks, (nothing,) * n, (steps,) * n, measured)
