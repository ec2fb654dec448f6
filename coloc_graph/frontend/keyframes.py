"""Make keyframes of a run with ranges and bearings: the instants at which each robot measured or was measured."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.frontend.keyframe_stream import DELAY_SIGMAS, KeyframeStream, OdometryPath, path_of
from coloc_graph.frontend.sensor_delay import SensorDelay, sensor_delay
from coloc_graph.measurements import Keyframes
from coloc_graph.run import OdometrySample, Ranges, Run
from coloc_graph.team import Team, Wheels

Array = NDArray[np.float64]

READ_AT_ONCE = 10.0  # s of a run that are read at a time
MIN_LATE = 0.12  # s by which a robot's delay must differ from the usual to be corrected
LATE_SIGMAS = 5.0  # standard deviations by which it must differ too


def keyframes_of(run: Run, *, between_robots: bool = True) -> Keyframes:
    """Make the keyframes of a run with ranges, with or without bearings.

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
    samples, ranges = _read(run)
    paths = [_path(run, robot, samples[robot]) for robot in run.team.names]
    warnings = []
    late = _late(run, paths, ranges)
    stream = KeyframeStream(run.team, between_robots=between_robots)
    for robot in run.team.names:
        _require_noise(run, robot)
        if robot in late:
            by, sigma = late[robot]
            ranges[robot] = [replace(one, time=one.time - by) for one in ranges[robot]]
            warnings.append(
                f"{run.path}: the clock of {robot}'s range sensor is {abs(by):.2f} s "
                f"{'ahead of' if by > 0 else 'behind'} that of its odometry (1 sigma {sigma:.3f} s, by how bearings "
                "change while it turns); the times of its measurements were corrected"
            )
        bearings = sum(len(one.targets) for one in ranges[robot] if one.bearing is not None)
        if bearings and not _has_bearings(run.team, robot):
            warnings.append(
                f"{run.path}: {bearings} bearings of {robot} are not used: the team states no noise for them; add "
                "bearing_sigma_deg to its [robots.ranging]"
            )
        stream.add(*samples[robot], *ranges[robot])
    keyframes = stream.take()
    if not len(keyframes.measured):
        raise InputError(f"{run.path}: no range was measured while there is odometry: record both at the same time")
    if stream.outside:
        warnings.append(
            f"{run.path}: {stream.outside} ranges were measured while there is no odometry and are not used"
        )
    return replace(keyframes, warnings=tuple(warnings))


def _late(
    run: Run, paths: list[OdometryPath | None], ranges: dict[str, list[Ranges]]
) -> dict[str, tuple[float, float]]:
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
            if one.bearing is not None and _has_bearings(run.team, robot)
            for target, distance, bearing in zip(one.targets, one.range.tolist(), one.bearing.tolist(), strict=True)
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


def _has_bearings(team: Team, robot: str) -> bool:
    ranging = team[robot].ranging
    return ranging is not None and ranging.has_bearings


def _require_noise(run: Run, robot: str) -> None:
    """Raise `InputError` where a robot measured ranges whose noise is not stated."""
    if run.team[robot].ranging is None and run.topics.get(f"/{robot}/ranges"):
        raise InputError(
            f"{run.path}: robot {robot} measured ranges, but the team states no noise for them: "
            "give it [robots.ranging] in team.toml"
        )


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


def _path(run: Run, robot: str, samples: list[OdometrySample]) -> OdometryPath | None:
    path = path_of(samples)
    if path is None and run.topics.get(f"/{robot}/ranges"):
        raise InputError(f"{run.path}: robot {robot} measured ranges, but has no odometry: record it too")
    return path
