"""From a run with ranges and bearings to keyframes: `keyframes_of`."""

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.frontend.sensor_delay import SensorDelay, sensor_delay
from coloc_graph.measurements import MAX_KEYFRAME_INTERVAL, Drive, RangeBearings, Steps
from coloc_graph.run import OdometrySample, Ranges, Run
from coloc_graph.team import Ranging, Wheels

Array = NDArray[np.float64]

#: Measurements no further apart are of one instant [s].
ONE_INSTANT = 0.01
#: So much of a run is read at a time [s].
READ_AT_ONCE = 10.0
#: Odometry with a gap longer than this says nothing there [s].
LONGEST_GAP = 5.0
#: A delay that is not known is looked for so far on either side [its sigmas], in steps of so much [s].
DELAYS_SIGMAS = 4.0
DELAY_STEP = 0.05
LEAST_LATE = 0.12  # smaller differences between robots' delays are usual [s]
CLEARLY = 5.0  # and a delay differs by this many of its sigmas


@dataclass(frozen=True, eq=False)
class _Way:
    """A robot's odometry: `times` (n,), `poses` (n, 3) with the heading unwound, and what its increments' variances add
    up to (n, 3)."""

    times: Array
    poses: Array
    variances: Array

    def at(self, times: Array) -> Array:
        """Poses (m, 3) at some times."""
        return np.stack([np.interp(times, self.times, column) for column in self.poses.T], axis=-1)

    def until(self, times: Array) -> Array:
        """Variances (m, 3) that have come together at some times."""
        return np.stack([np.interp(times, self.times, column) for column in self.variances.T], axis=-1)


def keyframes_of(run: Run, *, between_robots: bool = True) -> Drive:
    """The keyframes of a run: of each robot, the instants at which it measured or was measured.

    Without `between_robots` what robots measured of each other is left out. Raises `InputError` where a robot that
    measured has no odometry, or nothing was measured.
    """
    names, landmarks = run.team.names, tuple(one.name for one in run.team.landmarks)
    numbers = {name: n for n, name in enumerate((*names, *landmarks))}
    samples, ranges = _read(run)
    ways = [_way(run, robot, samples[robot]) for robot in names]
    rows: list[tuple[float, int, int, float, float]] = []
    outside = 0
    warnings = []
    late = _late(run, ways, ranges)
    for robot in names:
        if robot in late:
            by, sigma = late[robot]
            ranges[robot] = [replace(one, time=one.time - by) for one in ranges[robot]]
            warnings.append(
                f"{run.path}: the clock of {robot}'s range sensor is {abs(by):.2f} s "
                f"{'ahead of' if by > 0 else 'behind'} that of its odometry (1 sigma {sigma:.3f} s, by how bearings "
                "change while it turns); the times of its measurements were corrected"
            )
        for one in ranges[robot]:
            for target, distance, bearing in zip(one.targets, one.range.tolist(), one.bearing.tolist(), strict=True):
                if target in names and not between_robots:
                    continue
                if not all(_is_covered(ways[numbers[who]], one.time) for who in (robot, target) if who in names):
                    outside += 1
                    continue
                rows.append((one.time, numbers[robot], numbers[target], distance, bearing))
    if not rows:
        raise InputError(f"{run.path}: no range was measured while there is odometry; record both at the same time")
    rows.sort()
    table = np.array(rows)
    time, robot_of, target_of = table[:, 0], table[:, 1].astype(int), table[:, 2].astype(int)
    times, keyframe, target_keyframe = _instants(time, robot_of, target_of, len(names))
    if outside:
        warnings.append(f"{run.path}: {outside} ranges were measured where there is no odometry, and are left out")
    steps = []
    for name, way, at in zip(names, ways, times, strict=True):
        wheels = run.team[name].wheels or Wheels()
        steps.append(_steps(way, at, wheels) if way is not None else _no_steps())
    return Drive(
        robots=names,
        landmarks=landmarks,
        times=tuple(times),
        steps=tuple(steps),
        measured=RangeBearings(
            time=time,
            robot=robot_of,
            keyframe=keyframe,
            target=target_of,
            target_keyframe=target_keyframe,
            range=table[:, 3],
            bearing=table[:, 4],
            share=_shares(time, robot_of, target_of, [_ranging(run, name) for name in names]),
        ),
        warnings=tuple(warnings),
    )


def _late(run: Run, ways: list[_Way | None], ranges: dict[str, list[Ranges]]) -> dict[str, tuple[float, float]]:
    """Robots whose measurements are stamped late against their odometry, by how much, and the sigma of that [s].

    A delay that all robots share is the odometry's own, which the estimate finds; who differs has a clock that is off.
    """
    standing = {one.name: n for n, one in enumerate(run.team.landmarks)}
    found: dict[str, SensorDelay] = {}
    for robot, way in zip(run.team.names, ways, strict=True):
        seen = [
            (one.time, standing[target], distance, bearing)
            for one in ranges[robot]
            for target, distance, bearing in zip(one.targets, one.range.tolist(), one.bearing.tolist(), strict=True)
            if target in standing
        ]
        if way is None or not seen:
            continue
        table = np.array(seen)
        delay = sensor_delay(table[:, 0], table[:, 1].astype(int), table[:, 2], table[:, 3], way.at)
        if delay is not None:
            found[robot] = delay
    late = {}
    for robot, delay in found.items():
        wheels = run.team[robot].wheels or Wheels()
        usual, tolerated = wheels.delay, max(DELAYS_SIGMAS * wheels.delay_sigma, LEAST_LATE)
        if len(found) > 2:
            usual, tolerated = float(np.median([one.value for one in found.values()])), LEAST_LATE
        off = delay.value - usual
        if abs(off) > max(tolerated, CLEARLY * delay.sigma):
            late[robot] = off, delay.sigma
    return late


def _ranging(run: Run, robot: str) -> Ranging:
    """How well a robot measures; one that never did may have no such sensor."""
    ranging = run.team[robot].ranging
    if ranging is None:
        if run.topics.get(f"/{robot}/ranges"):
            raise InputError(
                f"{run.path}: robot {robot} measured ranges, and the team does not say how well; "
                "give it [robots.ranging] in team.toml"
            )
        return Ranging(range_sigma=1.0, bearing_sigma_deg=1.0)
    return ranging


def _read(run: Run) -> tuple[dict[str, list[OdometrySample]], dict[str, list[Ranges]]]:
    """The odometry and the ranges of all robots, a while of all of them at a time: a chunk of the file holds all."""
    odometry: dict[str, list[OdometrySample]] = {robot: [] for robot in run.team.names}
    ranges: dict[str, list[Ranges]] = {robot: [] for robot in run.team.names}
    begin, end = run.start or 0.0, run.end or 0.0
    for start in np.arange(begin, end + READ_AT_ONCE, READ_AT_ONCE).tolist():
        until = start + READ_AT_ONCE
        for robot in run.team.names:
            odometry[robot] += [one for one in run.odometry(robot, start, until) if start <= one.time < until]
            ranges[robot] += [one for one in run.ranges(robot, start, until) if start <= one.time < until]
    return odometry, ranges


def _way(run: Run, robot: str, samples: list[OdometrySample]) -> _Way | None:
    if not samples:
        if run.topics.get(f"/{robot}/ranges"):
            raise InputError(f"{run.path}: robot {robot} measured ranges, and has no odometry; record it too")
        return None
    poses = np.array([one.pose for one in samples])
    poses[:, 2] = np.unwrap(poses[:, 2])
    variances = np.array([np.diagonal(one.covariance) for one in samples])
    variances[0] = 0.0
    return _Way(np.array([one.time for one in samples]), poses, np.cumsum(variances, axis=0))


def _is_covered(way: _Way | None, time: float) -> bool:
    """Whether there is odometry before and after a time, not too far from it."""
    if way is None or not way.times[0] <= time <= way.times[-1]:
        return False
    after = int(np.searchsorted(way.times, time, side="right"))
    return after >= len(way.times) or bool(way.times[after] - way.times[after - 1] <= LONGEST_GAP)


def _instants(
    time: Array, robot: NDArray[np.int64], target: NDArray[np.int64], robots: int
) -> tuple[list[Array], NDArray[np.int64], NDArray[np.int64]]:
    """The instants of each robot, and for each measurement whose it is of who measured and of who was measured."""
    times = []
    keyframe, target_keyframe = np.full(len(time), -1), np.full(len(time), -1)
    for n in range(robots):
        own, seen = robot == n, target == n
        all_times = np.unique(time[own | seen])
        first = np.r_[True, np.diff(all_times) > ONE_INSTANT] if len(all_times) else np.empty(0, bool)
        instants = _filled(all_times[first])
        number = np.searchsorted(instants, all_times[first])[np.cumsum(first) - 1]
        keyframe[own] = number[np.searchsorted(all_times, time[own])]
        target_keyframe[seen] = number[np.searchsorted(all_times, time[seen])]
        times.append(instants)
    return times, keyframe, target_keyframe


def _filled(times: Array) -> Array:
    """Ascending times, and as many in between as it takes to leave no gap too long."""
    parts = [
        np.linspace(before, after, int(np.ceil((after - before) / MAX_KEYFRAME_INTERVAL)), endpoint=False)
        for before, after in itertools.pairwise(times.tolist())
    ]
    return np.concatenate([*parts, times[-1:]])


def _shares(time: Array, robot: NDArray[np.int64], target: NDArray[np.int64], ranging: list[Ranging]) -> Array:
    """How much of each measurement is new, (n, 2) of range and bearing.

    Of errors that are correlated as exp(-t / memory), n measurements know their mean as well as
    1 + (n - 1) (1 - r) / (1 + r) independent ones, r of neighbours: the first counts whole, and each that follows
    (1 - r) / (1 + r) = tanh(t / (2 memory)).
    """
    share = np.ones((len(time), 2))
    order = np.lexsort((time, target, robot))
    again = (np.diff(robot[order]) == 0) & (np.diff(target[order]) == 0)
    late, since = order[1:][again], np.diff(time[order])[again]
    memory = np.array([(one.range_memory, one.bearing_memory) for one in ranging])[robot[late]]
    with np.errstate(divide="ignore"):
        share[late] = np.where(memory > 0, np.tanh(np.maximum(since, ONE_INSTANT)[:, None] / (2 * memory)), 1.0)
    return share


def _steps(way: _Way, times: Array, wheels: Wheels) -> Steps:
    reach = DELAYS_SIGMAS * wheels.delay_sigma
    count = int(np.ceil(reach / DELAY_STEP))
    delays: Array = wheels.delay + DELAY_STEP * np.arange(-count, count + 1, dtype=np.float64)
    twists: Array = np.stack([_twists(way.at(times - delay)) for delay in delays])
    variances = np.diff(way.until(times - wheels.delay), axis=0)
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
    """Covariances (n - 1, 3, 3) of steps, of what their increments' variances add up to.

    A heading that is off spreads evenly over the step, and moves its end by half as much, with a third of the variance.
    """
    C = np.zeros((len(twists), 3, 3))
    along, across, turn = np.maximum(variances, 1e-10).T
    length = twists[:, 0]
    C[:, 0, 0] = along
    C[:, 1, 1] = across + turn * length**2 / 3
    C[:, 2, 2] = turn
    C[:, 1, 2] = C[:, 2, 1] = turn * length / 2
    return C
