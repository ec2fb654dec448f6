"""Make keyframes of a run with ranges and bearings: the instants at which each robot measured or was measured."""

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.frontend.sensor_delay import SensorDelay, sensor_delay
from coloc_graph.measurements import MAX_KEYFRAME_INTERVAL, Keyframes, RangeBearings, Steps
from coloc_graph.run import OdometrySample, Ranges, Run
from coloc_graph.team import Ranging, Wheels

Array = NDArray[np.float64]

ONE_INSTANT = 0.01  # s within which measurements are of one keyframe
READ_AT_ONCE = 10.0  # s of a run that are read at a time
MAX_GAP = 5.0  # s between odometry samples, above which there is no odometry
DELAY_SIGMAS = 4.0  # standard deviations of the prior within which an unknown delay is tabulated
DELAY_STEP = 0.05  # s, step of that table
MIN_LATE = 0.12  # s by which a robot's delay must differ from the usual to be corrected
LATE_SIGMAS = 5.0  # standard deviations by which it must differ too


@dataclass(frozen=True, eq=False)
class _Path:
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


def keyframes_of(run: Run, *, between_robots: bool = True) -> Keyframes:
    """Make the keyframes of a run with ranges and bearings.

    Parameters
    ----------
    run
        The run.
    between_robots
        False to ignore measurements between robots.

    Returns
    -------
    Keyframes
        Keyframes with odometry between them, the measurements, and warnings.

    Raises
    ------
    InputError
        A robot that measured has no odometry, or nothing was measured.
    """
    names, landmarks = run.team.names, tuple(one.name for one in run.team.landmarks)
    numbers = {name: n for n, name in enumerate((*names, *landmarks))}
    samples, ranges = _read(run)
    paths = [_path(run, robot, samples[robot]) for robot in names]
    rows: list[tuple[float, int, int, float, float]] = []
    outside = 0
    warnings = []
    late = _late(run, paths, ranges)
    for robot in names:
        if robot in late:
            by, sigma = late[robot]
            ranges[robot] = [replace(one, time=one.time - by) for one in ranges[robot]]
            warnings.append(
                f"{run.path}: the clock of {robot}'s range sensor is {abs(by):.2f} s "
                f"{'ahead of' if by > 0 else 'behind'} that of its odometry (1 sigma {sigma:.3f} s, by how bearings "
                "change while it turns); the times of its measurements were corrected"
            )
        if any(one.bearing is None for one in ranges[robot]):
            raise InputError(
                f"{run.path}: {robot} measured ranges without bearings, and the run holds no stances: ranges alone "
                "leave robots on circles, and mirrored; record stances, or bearings"
            )
        for one in ranges[robot]:
            for target, distance, bearing in zip(one.targets, one.range.tolist(), _bearings(one).tolist(), strict=True):
                if target in names and not between_robots:
                    continue
                if not all(_is_covered(paths[numbers[who]], one.time) for who in (robot, target) if who in names):
                    outside += 1
                    continue
                rows.append((one.time, numbers[robot], numbers[target], distance, bearing))
    if not rows:
        raise InputError(f"{run.path}: no range was measured while there is odometry: record both at the same time")
    rows.sort()
    table = np.array(rows)
    time, robot_of, target_of = table[:, 0], table[:, 1].astype(int), table[:, 2].astype(int)
    times, keyframe, target_keyframe = _instants(time, robot_of, target_of, len(names))
    if outside:
        warnings.append(f"{run.path}: {outside} ranges were measured while there is no odometry and are not used")
    steps = []
    for name, path, at in zip(names, paths, times, strict=True):
        wheels = run.team[name].wheels or Wheels()
        steps.append(_steps(path, at, wheels) if path is not None else _no_steps())
    return Keyframes(
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


def _bearings(record: Ranges) -> Array:
    """Return the bearings (n,) of a record [rad]; NaN where there are none."""
    return np.full(len(record.range), np.nan) if record.bearing is None else record.bearing


def _late(run: Run, paths: list[_Path | None], ranges: dict[str, list[Ranges]]) -> dict[str, tuple[float, float]]:
    """Robots whose measurements are stamped late against their odometry, with the delay and its sigma [s].

    A delay that all robots share is the odometry's own and is estimated with the poses; a robot that differs has a
    sensor clock that is off.
    """
    standing = {one.name: n for n, one in enumerate(run.team.landmarks)}
    found: dict[str, SensorDelay] = {}
    for robot, path in zip(run.team.names, paths, strict=True):
        seen = [
            (one.time, standing[target], distance, bearing)
            for one in ranges[robot]
            for target, distance, bearing in zip(one.targets, one.range.tolist(), _bearings(one).tolist(), strict=True)
            if target in standing
        ]
        if path is None or not seen:
            continue
        table = np.array(seen)
        delay = sensor_delay(table[:, 0], table[:, 1].astype(int), table[:, 2], table[:, 3], path.at)
        if delay is not None:
            found[robot] = delay
    late = {}
    for robot, delay in found.items():
        wheels = run.team[robot].wheels or Wheels()
        usual, tolerated = wheels.delay, max(DELAY_SIGMAS * wheels.delay_sigma, MIN_LATE)
        if len(found) > 2:
            usual, tolerated = float(np.median([one.value for one in found.values()])), MIN_LATE
        off = delay.value - usual
        if abs(off) > max(tolerated, LATE_SIGMAS * delay.sigma):
            late[robot] = off, delay.sigma
    return late


def _ranging(run: Run, robot: str) -> Ranging:
    """Noise of a robot's range sensor; a robot that never measured needs none."""
    ranging = run.team[robot].ranging
    if ranging is None:
        if run.topics.get(f"/{robot}/ranges"):
            raise InputError(
                f"{run.path}: robot {robot} measured ranges, but the team states no noise for them: "
                "give it [robots.ranging] in team.toml"
            )
        return Ranging(range_sigma=1.0, bearing_sigma_deg=1.0)
    return ranging


def _read(run: Run) -> tuple[dict[str, list[OdometrySample]], dict[str, list[Ranges]]]:
    """Read odometry and ranges of all robots, interval by interval, since a chunk of the file holds all robots."""
    odometry: dict[str, list[OdometrySample]] = {robot: [] for robot in run.team.names}
    ranges: dict[str, list[Ranges]] = {robot: [] for robot in run.team.names}
    begin, end = run.start or 0.0, run.end or 0.0
    for start in np.arange(begin, end + READ_AT_ONCE, READ_AT_ONCE).tolist():
        until = start + READ_AT_ONCE
        for robot in run.team.names:
            odometry[robot] += [one for one in run.odometry(robot, start, until) if start <= one.time < until]
            ranges[robot] += [one for one in run.ranges(robot, start, until) if start <= one.time < until]
    return odometry, ranges


def _path(run: Run, robot: str, samples: list[OdometrySample]) -> _Path | None:
    if not samples:
        if run.topics.get(f"/{robot}/ranges"):
            raise InputError(f"{run.path}: robot {robot} measured ranges, but has no odometry: record it too")
        return None
    poses = np.array([one.pose for one in samples])
    poses[:, 2] = np.unwrap(poses[:, 2])
    variances = np.array([np.diagonal(one.covariance) for one in samples])
    variances[0] = 0.0
    return _Path(np.array([one.time for one in samples]), poses, np.cumsum(variances, axis=0))


def _is_covered(path: _Path | None, time: float) -> bool:
    """Return whether there is odometry shortly before and after a time."""
    if path is None or not path.times[0] <= time <= path.times[-1]:
        return False
    after = int(np.searchsorted(path.times, time, side="right"))
    return after >= len(path.times) or bool(path.times[after] - path.times[after - 1] <= MAX_GAP)


def _instants(
    time: Array, robot: NDArray[np.int64], target: NDArray[np.int64], robots: int
) -> tuple[list[Array], NDArray[np.int64], NDArray[np.int64]]:
    """Keyframe times of each robot, and for each measurement the keyframes of the robot and of the target."""
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
    """Insert times into ascending ones until no gap is longer than `LONGEST_STEP`."""
    parts = [
        np.linspace(before, after, int(np.ceil((after - before) / MAX_KEYFRAME_INTERVAL)), endpoint=False)
        for before, after in itertools.pairwise(times.tolist())
    ]
    return np.concatenate([*parts, times[-1:]])


def _shares(time: Array, robot: NDArray[np.int64], target: NDArray[np.int64], ranging: list[Ranging]) -> Array:
    """Weights (n, 2) of ranges and bearings whose errors are correlated in time.

    With a correlation exp(-t / memory), n measurements determine their mean as well as 1 + (n - 1) (1 - r) / (1 + r)
    independent ones, r being the correlation of neighbours: the first has weight 1, and each later one
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


def _steps(path: _Path, times: Array, wheels: Wheels) -> Steps:
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
