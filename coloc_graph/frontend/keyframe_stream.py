"""Make keyframes of ranges, bearings and odometry as they come: `KeyframeStream`.

A keyframe is an instant at which a robot measured or was measured.
"""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coloc_graph.measurements import MAX_KEYFRAME_INTERVAL, Keyframes, RangeBearings, Steps
from coloc_graph.run import OdometrySample, Ranges
from coloc_graph.team import Ranging, Team, Wheels

Array = NDArray[np.float64]

ONE_INSTANT = 0.01  # s within which measurements are of one keyframe
MAX_GAP = 5.0  # s between odometry samples, above which there is no odometry
DELAY_SIGMAS = 4.0  # standard deviations of the prior within which an unknown delay is tabulated
DELAY_STEP = 0.05  # s, step of that table


@dataclass(frozen=True, eq=False)
class OdometryPath:
    """Odometry of a robot: `times` (n,), `poses` (n, 3) with unwrapped heading, and cumulated `variances` (n, 3)."""

    times: Array
    poses: Array
    variances: Array

    def at(self, times: Array) -> Array:
        """Interpolate poses (m, 3) at times (m,)."""
        return np.stack([np.interp(times, self.times, column) for column in self.poses.T], axis=-1)

    def until(self, times: Array) -> Array:
        """Interpolate cumulated variances (m, 3) at times (m,)."""
        return np.stack([np.interp(times, self.times, column) for column in self.variances.T], axis=-1)


def path_of(samples: Iterable[OdometrySample]) -> OdometryPath | None:
    """Return the odometry of a robot; None where there is none."""
    samples = tuple(samples)
    if not samples:
        return None
    poses = np.array([one.pose for one in samples])
    poses[:, 2] = np.unwrap(poses[:, 2])
    variances = np.array([np.diagonal(one.covariance) for one in samples])
    variances[0] = 0.0
    return OdometryPath(np.array([one.time for one in samples]), poses, np.cumsum(variances, axis=0))


class KeyframeStream:
    """Maker of keyframes: `add` records as they come, `take` what can be made of them.

    Parameters
    ----------
    team : Team
        The team; landmarks may be measured too.
    between_robots : bool
        False to ignore measurements between robots.
    """

    def __init__(self, team: Team, *, between_robots: bool = True) -> None:
        self._team, self._between_robots = team, between_robots
        self.names, self.landmarks = team.names, tuple(one.name for one in team.landmarks)
        self._numbers = {name: n for n, name in enumerate((*self.names, *self.landmarks))}
        self._odometry: list[list[OdometrySample]] = [[] for _ in self.names]
        self._ranges: list[Ranges] = []
        self._last = [np.empty(0) for _ in self.names]  # time of the last keyframe, once there is one
        self._measured = [-np.inf] * len(self.names)  # time of the last measurement
        self._count = [0] * len(self.names)  # keyframes that were made
        self._pairs: dict[tuple[int, int], float] = {}  # time at which a robot measured a target last
        self._has_bearings = [one.ranging is None or one.ranging.has_bearings for one in team.robots]
        #: Number of ranges that were measured while there was no odometry.
        self.outside = 0

    def add(self, *records: OdometrySample | Ranges) -> None:
        """Add records; of each robot they come in the order of time."""
        for one in records:
            if isinstance(one, Ranges):
                self._ranges.append(one)
            else:
                self._odometry[self._numbers[one.robot]].append(one)

    def take(self, until: float = np.inf) -> Keyframes:
        """Return what follows the keyframes taken before, as `KeyframeEstimator.add` takes it.

        Of what was measured before a time [UTC s], when all of it and the odometry up to it, later by its delay, have
        been added.
        """
        paths = [path_of(samples) for samples in self._odometry]
        rows: list[tuple[float, int, int, float, float]] = []
        for one in self._ranges:
            if one.time < until:
                rows += self._rows(one, paths)
        self._ranges = [one for one in self._ranges if one.time >= until]
        rows.sort()
        table = np.array(rows).reshape(-1, 5)
        time, robot, target = table[:, 0], table[:, 1].astype(int), table[:, 2].astype(int)
        begins = [count - len(last) for count, last in zip(self._count, self._last, strict=True)]
        times, keyframe, target_keyframe = self._instants(time, robot, target)
        steps = []
        for n, (name, path, at) in enumerate(zip(self.names, paths, times, strict=True)):
            wheels = self._team[name].wheels or Wheels()
            steps.append(_steps(path, at, wheels) if path is not None and len(at) else _no_steps())
            late = min(float(at[-1]) if len(at) else until, until) - wheels.delay - DELAY_SIGMAS * wheels.delay_sigma
            if path is not None and np.isfinite(late):
                del self._odometry[n][: max(int(np.searchsorted(path.times, late)) - 1, 0)]
        share = np.where(np.isfinite(table[:, 3:5]), self._shares(time, robot, target), 0.0)
        measured = RangeBearings(
            time, robot, keyframe, target, target_keyframe, table[:, 3].copy(), table[:, 4].copy(), share
        )
        return Keyframes(self.names, self.landmarks, tuple(times), tuple(steps), measured, begins=tuple(begins))

    def _rows(self, one: Ranges, paths: list[OdometryPath | None]) -> Iterable[tuple[float, int, int, float, float]]:
        robot = self._numbers[one.robot]
        # bearings whose noise is not stated are none
        has = one.bearing is not None and self._has_bearings[robot]
        bearings = one.bearing if has and one.bearing is not None else np.full(len(one.targets), np.nan)
        for target, distance, bearing in zip(one.targets, one.range.tolist(), bearings.tolist(), strict=True):
            number = self._numbers[target]
            if number < len(paths) and not self._between_robots:
                continue
            if all(_is_covered(paths[who], one.time) for who in (robot, number) if who < len(paths)):
                yield one.time, robot, number, distance, bearing
            else:
                self.outside += 1

    def _instants(
        self, time: Array, robot: NDArray[np.int64], target: NDArray[np.int64]
    ) -> tuple[list[Array], NDArray[np.int64], NDArray[np.int64]]:
        """Keyframe times of each robot from its last one on, and for each measurement the keyframes of both ends."""
        times = []
        keyframe, target_keyframe = np.full(len(time), -1), np.full(len(time), -1)
        for n, had in enumerate(self._last):
            own, seen = robot == n, target == n
            all_times = np.unique(time[own | seen])
            first = np.diff(np.concatenate([[self._measured[n]], all_times])) > ONE_INSTANT
            of_keyframes = np.concatenate([had, all_times[first]])
            instants = _filled(of_keyframes)
            number = np.searchsorted(instants, of_keyframes)[np.cumsum(first) - 1 + len(had)]
            number += self._count[n] - len(had)
            keyframe[own] = number[np.searchsorted(all_times, time[own])]
            target_keyframe[seen] = number[np.searchsorted(all_times, time[seen])]
            times.append(instants)
            self._count[n] += len(instants) - len(had)
            if len(all_times):
                self._last[n], self._measured[n] = instants[-1:], float(all_times[-1])
        return times, keyframe, target_keyframe

    def _shares(self, time: Array, robot: NDArray[np.int64], target: NDArray[np.int64]) -> Array:
        """Weights (n, 2) of ranges and bearings whose errors are correlated in time.

        With a correlation exp(-t / memory), n measurements determine their mean as well as 1 + (n - 1) (1 - r) /
        (1 + r) independent ones, r being the correlation of neighbours: the first has weight 1, and each later one
        (1 - r) / (1 + r) = tanh(t / (2 memory)).
        """
        since = np.empty(len(time))
        for n, (at, *pair) in enumerate(zip(time.tolist(), robot.tolist(), target.tolist(), strict=True)):
            since[n] = at - self._pairs.get((pair[0], pair[1]), -np.inf)
            self._pairs[pair[0], pair[1]] = at
        ranging = (self._team[name].ranging or Ranging(range_sigma=1.0, bearing_sigma_deg=1.0) for name in self.names)
        memory = np.array([(one.range_memory, one.bearing_memory) for one in ranging])[robot]
        with np.errstate(divide="ignore"):
            shares = np.tanh(np.maximum(since, ONE_INSTANT)[:, None] / (2 * memory))
        return np.where((memory > 0) & np.isfinite(since)[:, None], shares, 1.0)


def _is_covered(path: OdometryPath | None, time: float) -> bool:
    """Return whether there is odometry shortly before and after a time."""
    if path is None or not path.times[0] <= time <= path.times[-1]:
        return False
    after = int(np.searchsorted(path.times, time, side="right"))
    return after >= len(path.times) or bool(path.times[after] - path.times[after - 1] <= MAX_GAP)


def _filled(times: Array) -> Array:
    """Insert times into ascending ones until no gap is longer than `LONGEST_STEP`."""
    parts = [
        np.linspace(before, after, int(np.ceil((after - before) / MAX_KEYFRAME_INTERVAL)), endpoint=False)
        for before, after in itertools.pairwise(times.tolist())
    ]
    return np.concatenate([*parts, times[-1:]])


def _steps(path: OdometryPath, times: Array, wheels: Wheels) -> Steps:
    reach = DELAY_SIGMAS * wheels.delay_sigma
    count = int(np.ceil(reach / DELAY_STEP))
    delays: Array = wheels.delay + DELAY_STEP * np.arange(-count, count + 1, dtype=np.float64)
    twists: Array = np.stack([_twists(path.at(times - delay)) for delay in delays])
    variances = np.diff(path.until(times - wheels.delay), axis=0)
    return Steps(delays, twists, _covariances(twists[count], variances))


def _no_steps() -> Steps:
    return Steps(np.zeros(1), np.zeros((1, 0, 3)), np.zeros((0, 3, 3)))


def _twists(poses: Array) -> Array:
    """SE(2) logarithms (n - 1, 3) of the steps between poses (n, 3) in one frame."""
    d = np.diff(poses, axis=0)
    c, s = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    x, y = c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1]
    half = d[:, 2] / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        k = np.where(np.abs(half) > 1e-6, half / np.tan(half), 1.0)
    return np.stack([k * x + half * y, -half * x + k * y, d[:, 2]], axis=-1)


def _covariances(twists: Array, variances: Array) -> Array:
    """Covariances (n - 1, 3, 3) of steps from the sums of their increments' variances.

    A heading error grows evenly along a step: it moves the end by half its size, with a third of the variance.
    """
    C = np.zeros((len(twists), 3, 3))
    along, across, turn = np.maximum(variances, 1e-10).T
    length = twists[:, 0]
    C[:, 0, 0] = along
    C[:, 1, 1] = across + turn * length**2 / 3
    C[:, 2, 2] = turn
    C[:, 1, 2] = C[:, 2, 1] = turn * length / 2
    return C
