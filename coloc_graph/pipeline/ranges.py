"""Ranges of a run with stances, placed by an estimate of the stances alone."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence, Set
from itertools import chain
from typing import Any

import numpy as np

from coloc_graph.backend import Estimate
from coloc_graph.backend.graph import PoseKeys
from coloc_graph.backend.landmarks import ALWAYS
from coloc_graph.frontend import WheelTrack
from coloc_graph.frontend.stance_ranges import (
    NO_ODOMETRY,
    StanceRanges,
    Standing,
    locate_landmarks,
    merged,
    ranges_of_stances,
)
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.measurements import Sighting
from coloc_graph.run import OdometrySample, Ranges, Run, Stance
from coloc_graph.team import Team

#: T_world_body (4, 4) by robot, of the robots that have a pose at a stance.
Poses = Mapping[str, Any]

OUTSIDE = "they are from before the first stance, or after the last"


def ranges_of_run(run: Run, estimate: Estimate, *, odometry: bool) -> StanceRanges:
    """Average all ranges between robots of a run with stances, at the poses of an estimate.

    Raises
    ------
    RunError
        A range is not positive, or names neither a robot nor a landmark of the team.
    """
    graph = estimate.graph
    poses: dict[int, dict[str, Any]] = defaultdict(dict)
    for robot, trajectory in estimate.trajectories.items():
        assert trajectory.stances is not None
        for stance, T in zip(trajectory.stances.tolist(), trajectory.T_world_body, strict=True):
            poses[stance][robot] = T
    standing = standing_of(graph.stances, poses, graph.times)
    wheels = {robot: list(run.odometry(robot)) if odometry else [] for robot in run.team.names}
    recorded = {robot: list(run.ranges(robot)) for robot in run.team.names}
    landmarks = {name: one.T_world_body.matrix() for name, one in estimate.landmarks.items()}
    return place_ranges(run.team, standing, wheels, recorded, graph.stances, landmarks)


def unusable_ranges(run: Run) -> StanceRanges:
    """Count the ranges and bearings that no estimate of a run with stances can use, wherever its robots are."""
    stances, team = run.stances, run.team
    if team.floor is None or not run.has_ranges:
        return StanceRanges((), {})
    stands = {
        stance.index: dict.fromkeys({*stance.observers, *stance.anchors} - {*stance.movers}) for stance in stances
    }
    standing = standing_of(stances, stands, {})
    unused: Counter[str] = Counter()
    bearings = 0
    for robot in team.names:
        sensor = team[robot].ranging
        rows = [
            (one.time, target, np.isfinite(bearing))
            for one in run.ranges(robot)
            for target, bearing in zip(one.targets, _bearings(one), strict=True)
        ] if sensor is not None else []  # fmt: skip
        for target in dict.fromkeys(target for _, target, _ in rows):
            times, seen = np.array([(time, seen) for time, to, seen in rows if to == target]).T
            used = (times >= stances[0].start) & (times <= stances[-1].end)
            unused[OUTSIDE] += int(np.count_nonzero(~used))
            for name in (one for one in (robot, target) if one in team.names):
                spans = np.array([(one.start, one.end) for one in standing.get(name, ())]).reshape(-1, 2)
                still = ((spans[:, 0] <= times[:, None]) & (times[:, None] <= spans[:, 1])).any(axis=1)
                if not run.topics.get(f"/{name}/odometry"):
                    unused[NO_ODOMETRY.format(name)] += int(np.count_nonzero(used & ~still))
                used &= still
            assert sensor is not None
            measures = sensor.bearing_sigma_deg > 0 or sensor.across_sigma > 0
            bearings += int(np.count_nonzero(seen.astype(bool) & ~(used & measures)))
    return StanceRanges((), {why: count for why, count in unused.items() if count}, bearings)


def with_outside(run: Run, found: StanceRanges) -> StanceRanges:
    """Return the ranges of a run's stances, counting those from before the first of these or after the last, too."""
    start, end, team = run.stances[0].start, run.stances[-1].end, run.team
    robots = [robot for robot in team.names if team.floor is not None and team[robot].ranging is not None]
    out = [one for robot in robots for one in run.ranges(robot) if not start <= one.time <= end]
    count, bearings = _count(out), sum(int(np.isfinite(_bearings(one)).sum()) for one in out)
    return merged([found, StanceRanges((), {OUTSIDE: count} if count else {}, bearings)])


def _bearings(one: Ranges) -> Any:
    return one.range * np.nan if one.bearing is None else one.bearing


def standing_of(
    stances: Sequence[Stance], poses: Mapping[int, Poses], instants: Mapping[tuple[str, int], float]
) -> dict[str, list[Standing]]:
    """Return the intervals in which robots have their poses of some stances, by robot.

    Parameters
    ----------
    stances : sequence of Stance
        In the order of time.
    poses : mapping of int to mapping of str to (4, 4)
        By stance and robot.
    instants : mapping of (str, int) to float
        Times [UTC s] at which moving robots were sighted.
    """
    found: dict[str, list[Standing]] = defaultdict(list)
    for stance, after in zip(stances, (*stances[1:], None), strict=True):
        for robot, T in poses.get(stance.index, {}).items():
            start, end = stance.start, stance.end
            if robot in stance.movers:
                start = end = instants[robot, stance.index]
            elif after is not None and PoseKeys.stays(robot, stance, after):
                end = after.start
            found[robot].append(Standing(stance.index, start, end, np.asarray(T)))
    return dict(found)


def instants_in(measurements: Iterable[object]) -> dict[tuple[str, int], float]:
    """Return the times [UTC s] at which robots were sighted, by robot and stance."""
    return {(one.seen, one.stance): one.time for one in measurements if isinstance(one, Sighting)}


def place_ranges(
    team: Team,
    standing: Mapping[str, Sequence[Standing]],
    odometry: Mapping[str, Sequence[OdometrySample]],
    recorded: Mapping[str, Sequence[Ranges]],
    stances: Sequence[Stance],
    landmarks: Mapping[str, Any],
) -> StanceRanges:
    """Average the ranges from the first of some stances to the last; count all others.

    `landmarks` are the known T_world_landmark (4, 4), by name; others are located by their ranges.
    """
    unused: Counter[str] = Counter()
    within: dict[str, list[Ranges]] = {}
    of_sensors: list[Sequence[Ranges]] = []
    for robot, records in recorded.items():
        if team.floor is None or team[robot].ranging is None:
            continue  # `contents.unused_in` names them
        of_sensors.append(records)
        within[robot] = [one for one in records if stances[0].start <= one.time <= stances[-1].end]
        unused[OUTSIDE] += _count(records) - _count(within[robot])
    wheels = {robot: WheelTrack(robot, samples) for robot, samples in odometry.items()}
    known = {name: T for name, T in landmarks.items() if T is not None}
    recorded_of = Counter(target for records in within.values() for one in records for target in one.targets)
    new = {one.name for one in team.landmarks if one.name in recorded_of} - known.keys()
    for name, located in locate_landmarks(team, standing, wheels, within).items() if new else ():
        if name in new and located.position is not None:
            known[name] = floor_pose(located.position[0], located.position[1], 0.0)
        elif name in new:
            unused[f"{name} is not located: {located.why}"] += recorded_of[name]
    standing = {**standing, **{name: [Standing(ALWAYS, -np.inf, np.inf, T)] for name, T in known.items()}}
    kept = {*team.names, *known}
    within = {robot: of_targets(records, kept) for robot, records in within.items()}
    found = ranges_of_stances(team, standing, wheels, within)
    unused.update(found.unused)
    of_records = (one.bearing for one in chain.from_iterable(of_sensors) if one.bearing is not None)
    bearings = sum(int(np.isfinite(one).sum()) for one in of_records)
    left_out = bearings - sum(one.bearings for one in found.ranges)
    return StanceRanges(found.ranges, {why: count for why, count in unused.items() if count}, left_out)


def of_targets(records: Iterable[Ranges], names: Set[str]) -> list[Ranges]:
    """Return the records of some targets, without the ranges of others."""
    found = []
    for one in records:
        kept = [n for n, name in enumerate(one.targets) if name in names]
        if len(kept) == len(one.targets):
            found.append(one)
        elif kept:
            bearing = None if one.bearing is None else one.bearing[kept]
            found.append(Ranges(one.robot, one.time, tuple(one.targets[n] for n in kept), one.range[kept], bearing))
    return found


def _count(records: Iterable[Ranges]) -> int:
    return sum(len(one.targets) for one in records)
