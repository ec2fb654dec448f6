"""Import a ranging run from CSV files of ranges and of wheel odometry: `import_ranges`."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import TracksError
from coloc_graph.exchange.csv_table import first, read_table, require_other_file
from coloc_graph.exchange.ranges_csv import read_ranges
from coloc_graph.geometry.se2 import wrap
from coloc_graph.run import OdometrySample, atomic_run
from coloc_graph.team import Team, read_team

Array = NDArray[np.float64]

ODOMETRY_HEADER = ("time", "robot", "x", "y", "yaw")
ALONG = 0.02  # m per root of a metre driven
TURN = 0.02  # rad per root of a radian turned, and of a metre driven
FLOOR = 1e-5  # m, rad: least standard deviation of a step


@dataclass(frozen=True)
class ImportedRanges:
    """Summary of an import: numbers of ranges and of odometry samples, duration [s], and robots with odometry."""

    ranges: int
    samples: int
    seconds: float
    robots: tuple[str, ...]


def import_ranges(
    team_path: str | Path,
    ranges_path: str | Path,
    odometry_path: str | Path,
    out: str | Path,
    *,
    along: float = ALONG,
    turn: float = TURN,
) -> ImportedRanges:
    """Write a ranging run.

    Parameters
    ----------
    team_path
        team.toml; robots that measure have a `Ranging`.
    ranges_path
        CSV of `read_ranges`.
    odometry_path
        CSV with time [UTC s], robot, x [m], y [m], yaw [rad]: each robot's pose in a frame of its own.
    out
        The run.
    along, turn
        Noise of odometry: standard deviation along and across the way [m per root of a metre], and of the heading
        [rad per root of a radian turned, and of a metre].

    Raises
    ------
    TracksError
        A row is wrong; the sentence names file and line.
    """
    for name, value in {"along": along, "turn": turn}.items():
        if not 0 < value < np.inf:
            raise TracksError(f"the noise of odometry `{name}` is {value}; give a number above 0")
    require_other_file(Path(out), team_path, ranges_path, odometry_path)
    team = read_team(team_path)
    samples = _read_odometry(Path(odometry_path), team, along, turn)
    ranges = read_ranges(ranges_path, team, -np.inf, np.inf)
    if not samples or not ranges:
        raise TracksError(f"{ranges_path if samples else odometry_path}: holds no row; record ranges and odometry")
    times = [one.time for one in samples] + [one.time for one in ranges]
    with atomic_run(out, team) as writer:
        for one in samples:
            writer.write(one)
        for record in ranges:
            writer.write(record)
    robots = tuple(name for name in team.names if any(one.robot == name for one in samples))
    count = sum(len(one.targets) for one in ranges)
    return ImportedRanges(count, len(samples), max(times) - min(times), robots)


def _read_odometry(path: Path, team: Team, along: float, turn: float) -> list[OdometrySample]:
    table = read_table(path, "odometry", ODOMETRY_HEADER)
    robots, times = table.robots(team), table.numbers("time")
    poses = np.column_stack([table.numbers(name) for name in ("x", "y", "yaw")])
    samples = []
    for number, name in enumerate(team.names):
        rows = np.flatnonzero(robots == number)
        if (wrong := first(np.diff(times[rows]) <= 0)) is not None:
            raise table.error(int(rows[wrong + 1]), f"the time of {name} does not increase; sort rows, each time once")
        way = np.linalg.norm(np.diff(poses[rows, :2], axis=0, prepend=poses[rows[:1], :2]), axis=1)
        turned = np.abs(wrap(np.diff(poses[rows, 2], prepend=poses[rows[:1], 2])))
        variances = np.stack([along**2 * way, along**2 * way, turn**2 * (turned + way)], axis=1) + FLOOR**2
        for row, variance in zip(rows.tolist(), variances, strict=True):
            samples.append(OdometrySample(name, float(times[row]), poses[row], np.diag(variance)))
    return samples
