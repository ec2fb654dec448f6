"""Sightings and odometry as links between poses, of a graph or of a result on disk."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from coloc_graph.exchange.g2o import read_g2o
from coloc_graph.frontend import WheelTrack
from coloc_graph.measurements import Measurement, Node, Odometry, Sighting
from coloc_graph.run import Run, Stance
from coloc_graph.viewer.scene import Links

# sightings, and odometry
Ties = tuple[Links, Links]


def ties_in(measurements: Iterable[Measurement], robots: Sequence[str], stances: Sequence[Stance]) -> Ties:
    """Those of a graph's measurements."""
    every = list(measurements)
    sightings, odometry = ([m.ends for m in every if isinstance(m, kind)] for kind in (Sighting, Odometry))
    return links_of(sightings, robots, stances), links_of(odometry, robots, stances)


def ties_on_disk(
    path: Path, pairs: Collection[tuple[int, frozenset[str]]], robots: Sequence[str], stances: Sequence[Stance]
) -> tuple[Links, Links, list[tuple[str, int, str]]]:
    """Those of a `graph.g2o`, which does not say of what an edge was made, and sightings of landmarks as (observer,
    stance, landmark).

    What ties a robot to itself is odometry, unless it stayed put there, and what ties two that are not one of the
    `pairs` (stance, both robots) of `measurements.csv` is a sighting. Raises `InputError` where it is damaged.
    """
    graph = read_g2o(path)
    stayed = {stay.ends for stay in graph.stay_puts}
    sightings, odometry, landmarks = [], [], []
    for at in range(graph.factors.size()):
        keys = list(graph.factors.at(at).keys())
        if len(keys) == 2 and keys[0] in graph.names and keys[1] in graph.landmarks:
            landmarks += [(robot, stance, graph.landmarks[keys[1]]) for robot, stance in graph.names[keys[0]][:1]]
        if len(keys) != 2 or any(key not in graph.names for key in keys):
            continue
        i, j = (graph.names[key] for key in keys)
        if i[0][0] == j[0][0]:
            if (i[-1], j[0]) not in stayed:
                odometry.append((i[-1], j[0]))
        else:
            common = list(_at_once(i, j))
            if common and not any((a[1], frozenset((a[0], b[0]))) in pairs for a, b in common):
                sightings.append(common[0])
    return links_of(sightings, robots, stances), links_of(odometry, robots, stances), landmarks


def _at_once(i: Sequence[Node], j: Sequence[Node]) -> Iterator[tuple[Node, Node]]:
    """Nodes of two places that are of one stance."""
    return ((a, b) for a in i for b in j if a[1] == b[1])


def links_of(
    ends: Iterable[tuple[Node, Node]],
    robots: Sequence[str],
    stances: Sequence[Stance],
    seen: Sequence[str] | None = None,
) -> Links:
    """Links between robots, or from robots to what is `seen`, that are there."""
    number = {robot: n for n, robot in enumerate(robots)}
    of_seen = number if seen is None else {name: n for n, name in enumerate(seen)}
    row = {stance.index: n for n, stance in enumerate(stances)}
    known = [(a, b) for a, b in ends if a[0] in number and b[0] in of_seen and a[1] in row and b[1] in row]
    known.sort(key=lambda one: row[one[1][1]])
    table = np.array([(number[a[0]], row[a[1]], of_seen[b[0]], row[b[1]]) for a, b in known], np.int64).reshape(-1, 4)
    return Links(*table.T)


def wheels_of(run: Run | None) -> dict[str, WheelTrack]:
    """Wheel odometry of the robots that have any."""
    if run is None:
        return {}
    tracks = {robot: WheelTrack(robot, list(run.odometry(robot))) for robot in run.team.names}
    return {robot: track for robot, track in tracks.items() if len(track)}
