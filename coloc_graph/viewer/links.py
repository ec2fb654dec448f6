"""Sightings and odometry as links between poses."""

from collections.abc import Iterable, Sequence

import numpy as np

from coloc_graph.frontend import WheelTrack
from coloc_graph.measurements import Measurement, Node, Odometry, Range, Sighting
from coloc_graph.run import Run, Stance
from coloc_graph.viewer.scene import Links


def links_in(
    measurements: Iterable[Measurement], robots: Sequence[str], stances: Sequence[Stance]
) -> tuple[Links, Links]:
    """Return the links of measurements: sightings with ranges, and odometry."""
    every = list(measurements)
    sightings, odometry = ([m.ends for m in every if isinstance(m, kind)] for kind in (Sighting | Range, Odometry))
    return links_of(sightings, robots, stances), links_of(odometry, robots, stances)


def links_of(
    ends: Iterable[tuple[Node, Node]],
    robots: Sequence[str],
    stances: Sequence[Stance],
    seen: Sequence[str] | None = None,
) -> Links:
    """Make links between robots, or from robots to the landmarks `seen`; unknown ends are skipped."""
    number = {robot: n for n, robot in enumerate(robots)}
    of_seen = number if seen is None else {name: n for n, name in enumerate(seen)}
    row = {stance.index: n for n, stance in enumerate(stances)}
    known = [(a, b) for a, b in ends if a[0] in number and b[0] in of_seen and a[1] in row and b[1] in row]
    known.sort(key=lambda one: row[one[1][1]])
    table = np.array([(number[a[0]], row[a[1]], of_seen[b[0]], row[b[1]]) for a, b in known], np.int64).reshape(-1, 4)
    return Links(*table.T)


def wheels_of(run: Run | None) -> dict[str, WheelTrack]:
    """Read the wheel odometry of the robots that have any."""
    if run is None:
        return {}
    tracks = {robot: WheelTrack(robot, list(run.odometry(robot))) for robot in run.team.names}
    return {robot: track for robot, track in tracks.items() if len(track)}
