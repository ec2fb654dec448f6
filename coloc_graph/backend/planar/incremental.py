"""Fixed-lag smoother of a ranging run, with earlier poses marginalised: `IncrementalKeyframes`.

A filter gives initial values of robots and landmarks. The estimate of a keyframe is kept twice: at its time, and when
it leaves the window, corrected by later measurements.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.estimate import Estimate
from coloc_graph.backend.floor_poses import in_body, trajectory
from coloc_graph.backend.linear_system import LinearSystem, Summary
from coloc_graph.backend.marginals import Marginals
from coloc_graph.backend.planar.batch import found_landmarks
from coloc_graph.backend.planar.factors import KeyframeFactors, State, robust
from coloc_graph.backend.planar.filter import INITIAL_PERIOD, Filter
from coloc_graph.backend.planar.summary import Found, ranging_estimate
from coloc_graph.backend.sensor_calibration import SensorErrors
from coloc_graph.geometry.se2 import compose
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.measurements import Keyframes
from coloc_graph.team import Team

Array = NDArray[np.float64]
Index = NDArray[np.int64]

LAG = 40.0  # s for which poses are corrected
UPDATE_PERIOD = 1.0  # s between updates
LEAVING_PERIOD = 4.0  # s between marginalisations
CALIBRATION_TIME = 300.0  # s at the beginning in which no pose leaves: wheels and sensors are not calibrated yet


@dataclass(frozen=True, eq=False)
class Latest:
    """Poses of robots at a time [UTC s]: by name, (x, y, heading) and its covariance (3, 3) in the body frame."""

    time: float
    poses: dict[str, tuple[Array, Array]]


@dataclass(frozen=True, eq=False)
class _Solved:
    """Window after its last step: its poses, their linear system, and its Bayes tree."""

    poses: Index
    system: LinearSystem
    ordering: gtsam.Ordering
    tree: gtsam.GaussianBayesTree

    def covariances(self, poses: Index) -> Array:
        """Return covariances (n, 3, 3) of some poses, along the world's axes."""
        return np.array([self.tree.marginalCovariance(pose) for pose in poses.tolist()]).reshape(-1, 3, 3)


class IncrementalKeyframes:
    """Fixed-lag smoother of a ranging run, in the order of time.

    Parameters
    ----------
    team : Team
        The team.
    keyframes : Keyframes
        Keyframes, odometry and measurements.
    lag : float
        Time for which poses are corrected [s].
    calibrating : float
        Time at the beginning in which all poses are [s].
    """

    def __init__(
        self, team: Team, keyframes: Keyframes, *, lag: float = LAG, calibrating: float = CALIBRATION_TIME
    ) -> None:
        self.keyframes, self._lag, self._calibrating = keyframes, lag, calibrating
        self._filter = Filter(team, keyframes, INITIAL_PERIOD)
        self._factors = factors = KeyframeFactors(keyframes, self._filter.models)
        self._state = State(np.full((len(factors), 3), np.nan), factors.start())
        self._entered = [0] * len(keyframes.robots)  # number of keyframes of each that were added
        self._inside = np.zeros(len(factors), bool)
        self._left = -np.inf  # time before which all poses were marginalised [UTC s]
        self._before: tuple[Summary, Array] | None = None  # their marginal, and its linearisation point
        self._gauge: tuple[int, Array] | None = None
        self._landmarks: set[int] = set()
        self._next = 0
        self._taken = np.zeros(len(keyframes.measured), bool)
        self._solved: _Solved | None = None
        self._smoothed, self._online = (np.full((len(factors), 3), np.nan) for _ in range(2))
        self._smoothed_C, self._online_C = (np.full((len(factors), 3, 3), np.nan) for _ in range(2))

    def add(self, time: float) -> Latest:
        """Add all measurements before a time [UTC s], and return the newest poses."""
        m = self.keyframes.measured
        while self._next < len(m) and m.time[self._next] < time:
            if not self._filter.is_complete:
                self._filter.take(self._next)
            self._next += 1
        before = list(self._entered)
        self._enter_robots(time)
        self._enter_landmarks()
        if self._inside.any():
            self._solved = self._step()
            self._note_latest(before)
            self._leave(time)
        latest = {}
        for robot, (name, count) in enumerate(zip(self.keyframes.robots, self._entered, strict=True)):
            if count:
                last = int(self._factors.first[robot]) + count - 1
                latest[name] = self._online[last], self._online_C[last]
        return Latest(time, latest)

    def _enter_robots(self, time: float) -> None:
        """Add new keyframes of the robots that have poses: the first ones by the filter, then by odometry."""
        factors, poses = self._factors, self._state.poses
        for robot, times in enumerate(self.keyframes.times):
            if robot not in self._filter.out.placed_at:
                continue
            first, until = int(factors.first[robot]), int(np.searchsorted(times, time))
            entered = self._entered[robot]
            if not entered and until:
                whole = self._filter.out.whole(self.keyframes, factors.models)[robot][:until]
                entered = max(int(np.isfinite(whole[:, 0]).sum()), 1)
                poses[first : first + entered] = whole[:entered]
                if not factors.models.map_known and self._gauge is None:
                    self._gauge = first, poses[first].copy()
            if until > entered:
                deltas, _ = factors.models.wheels[robot].steps(
                    slice(entered - 1, until - 1), factors.wheels(self._state.shared)[robot]
                )
                for k, (x, y, yaw) in enumerate(deltas.tolist(), start=first + entered):
                    a, b, c = poses[k - 1].tolist()
                    poses[k] = compose((a, b, c), (x, y, yaw))
            new = np.arange(first + self._entered[robot], first + max(until, entered))
            self._inside[new] = factors.times[new] >= self._left
            self._entered[robot] = max(until, entered)

    def _enter_landmarks(self) -> None:
        """Add landmarks that the filter knows since the last time."""
        for number in range(len(self.keyframes.landmarks)):
            position = self._filter.landmark(number)
            if position is not None and number not in self._landmarks and not self._factors.is_exact(number):
                self._factors.landmarks(self._state.shared)[number] = position
                self._landmarks.add(number)

    def _steps(self, inside: NDArray[np.bool_]) -> Index:
        """Return the poses from which there are steps to others inside."""
        factors = self._factors
        ends: Index = np.flatnonzero(inside[:-1] & inside[1:])
        steps: Index = ends[factors.robot[ends] == factors.robot[ends + 1]]
        return steps

    def _measured(self, inside: NDArray[np.bool_]) -> Index:
        """Return the processed measurements between poses inside, or of known landmarks."""
        factors, m = self._factors, self.keyframes.measured
        earliest = factors.times[inside].min() - 1.0
        index = np.arange(np.searchsorted(m.time, earliest), self._next)
        landmark = m.target[index] - len(self.keyframes.robots)
        placed = np.array(
            [n in self._landmarks or factors.is_exact(n) for n in range(len(self.keyframes.landmarks))], bool
        )
        there = inside[factors.seen[index]]
        if len(placed):
            there = np.where(landmark < 0, there, placed[np.maximum(landmark, 0)])
        found: Index = index[inside[factors.observer[index]] & there]
        return found

    def _system(self, steps: Index, measured: Index) -> LinearSystem:
        """Linearise some factors in the window, with the marginal of those before it."""
        factors, state = self._factors, self._state
        rows = [factors.steps(state, steps), robust(factors.measured(state, measured))[0]]
        if self._before is None and self._gauge is not None:
            rows.append(factors.gauge(state, *self._gauge))
        system = factors.system(state, rows, priors=self._before is None)
        if self._before is not None:
            before, at = self._before
            system.add_summary(before, self._vector()[before.columns] - at)
        return system

    def _vector(self) -> Array:
        """Return all variables by their numbers."""
        return np.concatenate([self._state.poses.ravel(), self._state.shared])

    def _step(self) -> _Solved:
        """Take one Gauss-Newton step in the window, which was at its optimum before."""
        measured = self._measured(self._inside)
        self._taken[measured] = True
        system = self._system(self._steps(self._inside), measured)
        ordering = system.ordering(self._newest())
        tree = system.eliminated(ordering)
        moved = self._factors.moved(self._state, system.step(tree, ordering))
        self._state.poses[:], self._state.shared[:] = moved.poses, moved.shared
        return _Solved(np.flatnonzero(self._inside), system, ordering, tree)

    def _leave(self, time: float) -> None:
        """Keep the estimates of poses older than the lag, and marginalise them."""
        solved, factors, times = self._solved, self._factors, self._factors.times
        if solved is None or time < times.min() + self._calibrating or time - self._lag < self._left + LEAVING_PERIOD:
            return
        self._left = time - self._lag
        gone = self._inside & (times < self._left)
        if not gone.any():
            return
        self._keep(np.flatnonzero(gone))
        steps, measured = self._steps(self._inside), self._measured(self._inside)
        seen = gone[factors.seen[measured]] & factors.of_robot[measured]
        system = self._system(steps[gone[steps] | gone[steps + 1]], measured[gone[factors.observer[measured]] | seen])
        before = system.summed_up(np.flatnonzero(gone))
        self._before = before, self._vector()[before.columns]
        self._inside &= ~gone

    def _keep(self, poses: Index) -> None:
        """Keep the smoothed estimates of poses."""
        assert self._solved is not None
        self._smoothed[poses] = self._state.poses[poses]
        self._smoothed_C[poses] = in_body(self._state.poses[poses], self._solved.covariances(poses))

    def _note_latest(self, before: list[int]) -> None:
        """Keep the estimate of each robot's newest keyframe at its time."""
        solved = self._solved
        assert solved is not None
        had = self._factors.first[:-1] + before
        poses = np.array([one for one in self._newest() if one >= had[self._factors.robot[one]]], int)
        self._online[poses] = self._state.poses[poses]
        self._online_C[poses] = in_body(self._state.poses[poses], solved.covariances(poses))

    def _newest(self) -> list[int]:
        """Return the newest pose in the window of each robot that has one."""
        newest = [int(first) + count - 1 for first, count in zip(self._factors.first[:-1], self._entered, strict=True)]
        return [one for one, count in zip(newest, self._entered, strict=True) if count and self._inside[one]]

    def estimate(self) -> Estimate:
        """Return the smoothed estimate of all keyframes that were added."""
        factors, state = self._factors, self._state
        C = np.zeros((len(factors.free),) * 2)
        if self._solved is not None:
            self._solved = self._step()
            solved = self._solved
            marginals = Marginals(solved.system.graph, factors.keys.size, solved.ordering)
            self._smoothed[solved.poses] = state.poses[solved.poses]
            inside = np.array([marginals.covariance(pose) for pose in solved.poses.tolist()])
            self._smoothed_C[solved.poses] = in_body(state.poses[solved.poses], inside)
            C = factors.shared_covariance(marginals)
        errors = [
            factors.errors_in(robot, state.shared, C) if count else SensorErrors(None, None)
            for robot, count in enumerate(self._entered)
        ]
        landmarks = found_landmarks(factors, state.shared, C, sorted(self._landmarks))
        found = Found(State(self._smoothed, state.shared), self._smoothed_C, landmarks, errors)
        return ranging_estimate(factors, found, self._taken, 0)

    @property
    def times(self) -> tuple[float, ...]:
        """Times of the updates that add everything, one each `UPDATE_PERIOD` [UTC s]."""
        begin, end = self._factors.times.min(), self._factors.times.max()
        return tuple((begin + UPDATE_PERIOD * np.arange(1, np.ceil((end - begin) / UPDATE_PERIOD) + 2)).tolist())

    @property
    def online(self) -> dict[str, Trajectory]:
        """Poses as they were estimated at their times, by robot."""
        found, factors = {}, self._factors
        for robot, name in enumerate(self.keyframes.robots):
            own = slice(factors.first[robot], factors.first[robot + 1])
            there = np.isfinite(self._online[own, 0])
            if there.any():
                found[name] = trajectory(
                    name,
                    self.keyframes.times[robot][there],
                    self._online[own][there],
                    self._online_C[own][there],
                    factors.models.wheels[robot].wheels.direction_sigma_deg,
                )
        return found
