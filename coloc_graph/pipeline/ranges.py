"""Ranges of a run with stances, placed by an estimate of the stances alone."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from coloc_graph.backend import Estimate
from coloc_graph.backend.graph import PoseKeys
from coloc_graph.frontend import WheelTrack
from coloc_graph.frontend.stance_ranges import StanceRanges, Standing, ranges_of_stances
from coloc_graph.measurements import Sighting
from coloc_graph.run import OdometrySample, Ranges, Run, Stance
from coloc_graph.team import Team

#: T_world_body (4, 4) by robot, of the robots that have a pose at a stance.
Poses = Mapping[str, Any]


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
    return place_ranges(run.team, standing, wheels, recorded, graph.stances)


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
) -> StanceRanges:
    """Average the ranges between robots from the first of some stances to the last; count all others."""
    unused: Counter[str] = Counter()
    within: dict[str, list[Ranges]] = {}
    for robot, records in recorded.items():
        if team.floor is None or team[robot].ranging is None:
            continue  # `contents.unused_in` names them
        within[robot] = [one for one in records if stances[0].start <= one.time <= stances[-1].end]
        unused["they are from before the first stance, or after the last"] += _count(records) - _count(within[robot])
    wheels = {robot: WheelTrack(robot, samples) for robot, samples in odometry.items()}
    found = ranges_of_stances(team, standing, wheels, within)
    unused.update(found.unused)
    return StanceRanges(found.ranges, {why: count for why, count in unused.items() if count})


def _count(records: Iterable[Ranges]) -> int:
    return sum(len(one.targets) for one in records)
