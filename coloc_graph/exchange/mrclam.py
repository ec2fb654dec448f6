"""Import UTIAS Multi-Robot Cooperative Localization and Mapping (MR.CLAM) datasets: `import_mrclam`.

Five iRobot Creates, each with a camera that gives range and bearing to barcodes on robots and landmarks; wheel
commands; ground truth by motion capture. Source: Leung, Halpern, Barfoot, Liu, "The UTIAS multi-robot cooperative
localization and mapping dataset", IJRR 30(8), 2011.
"""

import heapq
import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.exchange.dat_table import DatTable, read_dat
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.run import OdometrySample, Ranges, RunWriter, atomic_run
from coloc_graph.team import Floor, Landmark, Ranging, Robot, Team, Wheels

Array = NDArray[np.float64]

#: Sensor of these robots: a range follows from a barcode's height in the image and is a depth along the optical axis;
#: its error grows with its square, and persists while the view stays the same.
RANGING = Ranging(
    range_sigma=0.012,
    range_sigma_per_m2=0.0012,
    bearing_sigma_deg=0.3,
    across_sigma=0.0145,
    range_memory=5.0,
    bearing_memory=2.0,
    depth=1.0,
    offset_sigma=0.1,
    scale_sigma=0.05,
    bearing_offset_sigma_deg=2.0,
    depth_sigma=0.1,
    robot_offset_sigma=0.05,
    place_sigma=0.05,
)
#: Their odometry is made of commands, which the wheels carry out a moment later and not fully.
#: A body's x axis is that of the reflectors on it, which are put there by eye.
WHEELS = Wheels(delay=0.1, scale_sigma=0.1, turn_scale_sigma=0.1, delay_sigma=0.1, direction_sigma_deg=0.6)
LANDMARK_SIGMA = 0.02  # m, of the middle of the barcode that cameras see from the point that was surveyed
# accumulated errors of ten seconds; those of a single step are smaller, since errors are correlated
ALONG = (0.08, 0.004)  # m per root of a metre, of a second: odometry noise along the path
ACROSS = (0.012, 0.002)  # m per root of a metre, of a second: across the path
TURN = (0.1, 0.08, 0.006)  # rad per root of a radian, of a metre, of a second: of the heading
KEPT_EVERY = 0.2  # s, period at which commands that stay the same are kept
TRUTH_EVERY = 0.045  # s, period at which truth is kept: all 100 a second would be most of the run
MAX_COMMAND = 2.0  # s, for which a command is followed


@dataclass(frozen=True)
class MrclamSummary:
    """Summary of an import: robots, landmarks, number of measurements, duration [s], and `warnings`."""

    robots: tuple[str, ...]
    landmarks: tuple[str, ...]
    measurements: int
    seconds: float
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Odometry:
    """Odometry as poses: `times` (n,), `poses` (n, 3) x, y, yaw, `covariances` (n, 3, 3) of each increment."""

    times: Array
    poses: Array
    covariances: Array


def import_mrclam(
    folder: str | Path,
    out: str | Path,
    *,
    map_known: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> MrclamSummary:
    """Write a run from the .dat files of one MR.CLAM dataset.

    Robots are called R1, R2, ..., landmarks by their subject's number, L6, L7, ... Commands are integrated to odometry.

    Parameters
    ----------
    folder
        Folder of the dataset.
    out
        Run to write.
    map_known
        False to leave the landmarks' positions out of the team; they are then in the truth only.
    progress
        Called with (measurements written, their number).

    Raises
    ------
    InputError
        A file is missing or wrong, in one sentence that names file and line; nothing is written then.
    """
    folder = Path(folder)
    subjects = _robots(folder)
    codes, twice = _barcodes(folder, subjects)
    positions = _landmarks(folder, codes, subjects)
    names = {**{n: f"R{n}" for n in subjects}, **{n: f"L{n}" for n in positions}}
    warnings = list(twice)

    ranges: dict[int, list[Ranges]] = {}
    odometry: dict[int, _Odometry] = {}
    truth: dict[int, DatTable] = {}
    for subject in subjects:
        measured = _table(folder, f"Robot{subject}_Measurement.dat", 4, warnings)
        ranges[subject] = _ranges(measured, subject, codes, names, warnings)
        odometry[subject] = _odometry(_table(folder, f"Robot{subject}_Odometry.dat", 3, warnings))
        truth[subject] = _table(folder, f"Robot{subject}_Groundtruth.dat", 4, warnings)
    true_team = _team(subjects, positions, names)
    team = true_team if map_known else _without_map(true_team)

    count = sum(len(one.targets) for each in ranges.values() for one in each)
    if not count:
        raise InputError(f"{folder}: no measurement is of a robot or a landmark in Barcodes.dat; give a whole dataset")
    with atomic_run(out, team) as writer:
        if not map_known:
            writer.write_true_team(true_team)
        _write(writer, names, ranges, odometry, truth, lambda done: progress(done, count) if progress else None)
    times = np.concatenate([one.times for one in odometry.values()])
    return MrclamSummary(
        robots=tuple(names[n] for n in subjects),
        landmarks=tuple(names[n] for n in positions),
        measurements=count,
        seconds=float(times.max() - times.min()),
        warnings=tuple(warnings),
    )


def _robots(folder: Path) -> list[int]:
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder; give the one that holds Barcodes.dat and Robot1_Odometry.dat")
    found = [re.fullmatch(r"Robot(\d+)_Measurement\.dat", path.name) for path in folder.iterdir()]
    subjects = sorted(int(match[1]) for match in found if match)
    if len(subjects) < 1:
        raise InputError(f"{folder}: holds no Robot1_Measurement.dat; give the folder of one MR.CLAM dataset")
    return subjects


def _table(folder: Path, name: str, columns: int, warnings: list[str]) -> DatTable:
    """Read a table whose first column is time, and sort it by time."""
    table = read_dat(folder / name, columns)
    order = np.argsort(table.values[:, 0], kind="stable")
    out_of_order = int((np.diff(table.values[:, 0]) < 0).sum())
    if out_of_order:
        line = table.lines[int((np.diff(table.values[:, 0]) < 0).argmax()) + 1]
        warnings.append(f"{table.path}: time runs backwards {out_of_order} times, first in line {line}; sorted by time")
    return DatTable(table.path, table.values[order], table.lines[order])


def _barcodes(folder: Path, robots: list[int]) -> tuple[dict[int, int], list[str]]:
    """Map barcodes to subjects; a code that two subjects share is ignored, with a warning."""
    table = read_dat(folder / "Barcodes.dat", 2)
    codes: dict[int, int] = {}
    shared: dict[int, list[int]] = {}
    for subject, code in table.values.astype(int).tolist():
        if code in codes:
            shared.setdefault(code, [codes[code]]).append(subject)
        codes[code] = subject
    for code in shared:
        del codes[code]
    missing = [n for n in robots if n not in table.values[:, 0]]
    if missing:
        raise InputError(f"{table.path}: has no barcode of robot {missing[0]}, whose files are there; add its row")
    return codes, [
        f"{table.path}: barcode {code} belongs to subjects {', '.join(map(str, of))}; its measurements are not used"
        for code, of in shared.items()
    ]


def _landmarks(folder: Path, codes: dict[int, int], robots: list[int]) -> dict[int, Array]:
    """Map subjects to (x, y, sigma) of the landmarks [m]."""
    table = read_dat(folder / "Landmark_Groundtruth.dat", 5)
    positions = {}
    for row, line in zip(table.values, table.lines.tolist(), strict=True):
        subject = int(row[0])
        if subject in positions or subject in robots:
            raise InputError(f"{table.path}, line {line}: subject {subject} appears twice; give each subject once")
        positions[subject] = np.array([row[1], row[2], max(float(np.hypot(row[3], row[4])), 1e-4)])
    return positions


def _team(subjects: list[int], positions: dict[int, Array], names: dict[int, str]) -> Team:
    robots = tuple(Robot(name=names[n], ranging=RANGING, wheels=WHEELS) for n in subjects)
    landmarks = tuple(
        Landmark(name=names[n], position=(float(x), float(y)), position_sigma=math.hypot(sigma, LANDMARK_SIGMA))
        for n, (x, y, sigma) in positions.items()
    )
    return Team(reference=robots[0].name, robots=robots, floor=Floor(), landmarks=landmarks)


def _without_map(team: Team) -> Team:
    landmarks = tuple(Landmark(name=one.name) for one in team.landmarks)
    return Team(reference=team.reference, robots=team.robots, floor=team.floor, landmarks=landmarks)


def _ranges(
    table: DatTable, subject: int, codes: dict[int, int], names: dict[int, str], warnings: list[str]
) -> list[Ranges]:
    """Measurements of a robot, one record for each time; unknown barcodes and its own are ignored, with a warning."""
    seen = np.array([codes.get(code, -1) for code in table.values[:, 1].astype(int).tolist()], int)
    known = np.array([one in names and one != subject for one in seen.tolist()], bool)
    if not known.all():
        of = sorted(set(table.values[~known, 1].astype(int).tolist()))
        warnings.append(
            f"{table.path}: {int((~known).sum())} measurements are of unknown barcodes ({', '.join(map(str, of))}) and "
            "are not used"
        )
    bad = known & ~(table.values[:, 2] > 0)
    if bad.any():
        raise InputError(
            f"{table.path}, line {table.lines[bad][0]}: the range is not above 0; correct or remove the row"
        )
    rows = table.values[known]
    if not len(rows):
        return []
    cuts = np.flatnonzero(np.diff(rows[:, 0])) + 1
    return [
        Ranges(names[subject], float(part[0, 0]), tuple(names[n] for n in who.tolist()), part[:, 2], part[:, 3])
        for part, who in zip(np.split(rows, cuts), np.split(seen[known], cuts), strict=True)
    ]


def _odometry(table: DatTable) -> _Odometry:
    """Dead reckoning of the commands, each of which holds until the next; equal ones are merged."""
    times, commands = table.values[:, 0], table.values[:, 1:]
    # a row that changes nothing is kept so that time goes on
    keep = np.r_[True, (np.diff(commands, axis=0) != 0).any(axis=1)] | _every(times, KEPT_EVERY)
    times, commands = times[keep], commands[keep]
    dt = np.minimum(np.diff(times), MAX_COMMAND)
    way, turn = commands[:-1].T * dt
    yaw = np.r_[0.0, np.cumsum(turn)]
    # an arc's chord, in the direction half way
    chord = way * np.sinc(turn / (2 * np.pi))
    towards = yaw[:-1] + turn / 2
    x, y = (np.r_[0.0, np.cumsum(chord * part)] for part in (np.cos(towards), np.sin(towards)))
    along, across = (a**2 * np.abs(way) + t**2 * dt for a, t in (ALONG, ACROSS))
    turned = TURN[0] ** 2 * np.abs(turn) + TURN[1] ** 2 * np.abs(way) + TURN[2] ** 2 * dt
    covariances = np.zeros((len(times), 3, 3))
    covariances[1:, [0, 1, 2], [0, 1, 2]] = np.stack([along, across, turned], axis=-1)
    return _Odometry(times, np.stack([x, y, yaw], axis=-1), covariances)


def _every(times: Array, period: float) -> NDArray[np.bool_]:
    """True for the first of ascending times in each period, and for the last of all."""
    periods = np.floor((times - times[0]) / period)
    first: NDArray[np.bool_] = np.r_[True, np.diff(periods) > 0]
    first[-1] = True
    return first


def _write(
    writer: RunWriter,
    names: dict[int, str],
    ranges: dict[int, list[Ranges]],
    odometry: dict[int, _Odometry],
    truth: dict[int, DatTable],
    progress: Callable[[int], None],
) -> None:
    """Write all records in order of time."""

    def of_truth(robot: str, table: DatTable) -> Iterator[tuple[float, str, Array]]:
        kept = table.values[_every(table.values[:, 0], TRUTH_EVERY)]
        poses = floor_pose(*kept[:, 1:].T)
        yield from ((time, robot, T) for time, T in zip(kept[:, 0].tolist(), poses, strict=True))

    def of_wheels(robot: str, one: _Odometry) -> Iterator[tuple[float, str, OdometrySample]]:
        for time, pose, C in zip(one.times.tolist(), one.poses, one.covariances, strict=True):
            yield time, robot, OdometrySample(robot, time, pose, C)

    rows: list[Iterator[tuple[float, str, Array | OdometrySample | Ranges]]] = []
    for n, each in ranges.items():
        rows.append(iter([(one.time, names[n], one) for one in each]))
        rows.append(of_wheels(names[n], odometry[n]))
        rows.append(of_truth(names[n], truth[n]))
    done = 0
    for time, robot, record in heapq.merge(*rows, key=lambda row: row[0]):
        if isinstance(record, np.ndarray):
            writer.write_truth(robot, time, record)
        else:
            writer.write(record)
        if isinstance(record, Ranges):
            done += len(record.targets)
            progress(done)
