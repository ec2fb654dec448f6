"""Ranges from a CSV file: `read_ranges`."""

from collections import defaultdict
from pathlib import Path

import numpy as np

from coloc_graph.errors import TracksError
from coloc_graph.exchange.csv_table import first, read_table
from coloc_graph.run import Ranges
from coloc_graph.team import Team

HEADER = ("time", "robot", "target", "range")


def read_ranges(path: str | Path, team: Team, start: float, end: float) -> list[Ranges]:
    """Read ranges, in the order of time.

    Parameters
    ----------
    path
        CSV with time [UTC s], robot (that measured), target (another robot, or a landmark of the team), range [m], and
        bearing [rad, positive to the left] where the sensors measure it.
    team
        The team; robots that measure have a `Ranging`.
    start, end
        Time span of the run [UTC s].

    Returns
    -------
    list of Ranges
        One for each robot and time.

    Raises
    ------
    TracksError
        A row is wrong, or none is of the run's time. The sentence names file and line.
    """
    table = read_table(Path(path), "ranges", HEADER, optional=("bearing",))
    robots, times, ranges = table.robots(team), table.numbers("time"), table.numbers("range")
    targets = table.columns["target"]
    known = {*team.names, *(one.name for one in team.landmarks)}
    for row, (robot, target) in enumerate(zip(robots.tolist(), targets, strict=True)):
        if target == team.names[robot]:
            raise table.error(row, f"{target} ranges itself; name another robot, or a landmark")
        if target not in known:
            raise table.error(row, f"target `{target}` is neither a robot nor a landmark of the team; add it there")
        if team.robots[robot].ranging is None:
            raise table.error(row, f"the team states no noise of {team.names[robot]}'s ranges; add [robots.ranging]")
    if (wrong := first(ranges <= 0)) is not None:
        raise table.error(wrong, f"`range` is {ranges[wrong]:g}; give metres above 0, or leave it out")
    if len(table) and not ((times >= start) & (times <= end)).any():
        raise TracksError(
            f"{path}: no range is of the run's time, {start:.3f} to {end:.3f} s; give UTC seconds by the robots' clocks"
        )
    bearings = table.numbers("bearing") if "bearing" in table.columns else None
    found: dict[tuple[float, int], list[int]] = defaultdict(list)
    for row, key in enumerate(zip(times.tolist(), robots.tolist(), strict=True)):
        found[key].append(row)
    return [
        Ranges(
            team.names[robot],
            time,
            tuple(targets[row] for row in rows),
            np.array(ranges[rows]),
            None if bearings is None else np.array(bearings[rows]),
        )
        for (time, robot), rows in sorted(found.items())
    ]
