"""Plans of stances as data, and their CSV file: `PlannedStance`, `Plan`, `write_plan`, `read_plan`."""

import csv
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from coloc_graph.errors import InputError
from coloc_graph.geometry.se2 import Planar
from coloc_graph.input_file import read_text

COLUMNS = ("stance", "robot", "role", "order", "x", "y", "yaw_deg", "duration")
ROLES = ("anchor", "observer", "mover")
MAX_PLAN_SIZE = 20_000_000  # size of a plan above which it is no plan [bytes]


@dataclass(frozen=True)
class PlannedStance:
    """Plan of one stance.

    Attributes
    ----------
    standing
        Poses of the observers in the world (x [m], y [m], yaw [rad]), by name.
    anchors
        Observers that have stood there since the stance before.
    mover
        Robot that drives before the others' cameras.
    waypoints
        Places x, y [m] that it drives through, there and back, until the stance ends.
    duration
        Duration of the drive [s].
    watching
        Observers that are to see the whole drive, and whose images alone count; () where all count that see it.
    """

    standing: Mapping[str, Planar]
    anchors: tuple[str, ...]
    mover: str
    waypoints: tuple[tuple[float, float], ...]
    duration: float
    watching: tuple[str, ...] = ()

    @property
    def leapers(self) -> tuple[str, ...]:
        """Observers that drive to where they stand before the stance."""
        return tuple(name for name in self.standing if name not in self.anchors)


@dataclass(frozen=True)
class Plan:
    """Stances in their order.

    Raises
    ------
    InputError
        If a stance has fewer than two observers or, after the first one, no anchor that stands where it stood.
    """

    stances: tuple[PlannedStance, ...]

    def __post_init__(self) -> None:
        if not self.stances:
            raise InputError("a plan has no stances: give at least one")
        for k, stance in enumerate(self.stances):
            where = f"stance {k} of the plan"
            if len(stance.standing) < 2:
                raise InputError(f"{where} has {len(stance.standing)} observers: give at least two")
            if stance.mover in stance.standing:
                raise InputError(f"{where}: {stance.mover} both stands and moves; give it one role")
            if len(stance.waypoints) < 2 or stance.duration <= 0:
                raise InputError(f"{where}: {stance.mover} needs at least two waypoints and a duration above 0 s")
            if k == 0:
                continue
            if not stance.anchors:
                raise InputError(f"{where} has no anchor: let one observer stay where it stood in stance {k - 1}")
            before = self.stances[k - 1].standing
            for name in stance.anchors:
                if name not in before or math.dist(before[name], stance.standing[name]) > 1e-6:
                    raise InputError(f"{where}: anchor {name} does not stand where it stood in stance {k - 1}")

    @property
    def observers(self) -> tuple[str, ...]:
        """Robots that observe in some stance, in the order in which they first do."""
        return tuple(dict.fromkeys(name for stance in self.stances for name in stance.standing))


def write_plan(plan: Plan, path: str | Path) -> None:
    """Write a plan as CSV: one row an observer with its pose, and one row a waypoint of the mover.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(COLUMNS)
    for k, stance in enumerate(plan.stances):
        for name, (x, y, yaw) in stance.standing.items():
            role = "anchor" if name in stance.anchors else "observer"
            rows.writerow([k, name, role, 0, f"{x:.6f}", f"{y:.6f}", f"{math.degrees(yaw):.5f}", ""])
        for order, (x, y) in enumerate(stance.waypoints):
            rows.writerow([k, stance.mover, "mover", order, f"{x:.6f}", f"{y:.6f}", "", f"{stance.duration:.3f}"])
    try:
        Path(path).write_text(text.getvalue(), encoding="utf-8")
    except OSError as error:
        raise InputError(f"the plan cannot be written to {path}: {error.strerror}") from error


def read_plan(path: str | Path) -> Plan:
    """Read a plan that `write_plan` wrote, or that has the same columns.

    Raises
    ------
    InputError
        If the file is no plan; the message names the line.
    """
    path = Path(path)
    text = read_text(path, "give a plan, as `coloc plan --out` writes it", limit=MAX_PLAN_SIZE)
    rows = csv.DictReader(io.StringIO(text))
    if rows.fieldnames is None or set(COLUMNS) - set(rows.fieldnames):
        raise InputError(f"{path} is not a plan: its first line must name the columns {', '.join(COLUMNS)}")
    found: dict[int, list[dict[str, str]]] = {}
    for line, row in enumerate(rows, start=2):
        if None in row.values() or None in row or row["role"] not in ROLES:
            raise InputError(f"{path}, line {line}: give a value for each column, and a role of {', '.join(ROLES)}")
        found.setdefault(int(_number(path, line, row["stance"])), []).append({**row, "line": str(line)})
    if sorted(found) != list(range(len(found))):
        raise InputError(f"{path}: its stances are not numbered 0 to {max(len(found) - 1, 0)} without gaps")
    return Plan(tuple(_stance(path, found[k]) for k in range(len(found))))


def _stance(path: str | Path, rows: list[dict[str, str]]) -> PlannedStance:
    standing: dict[str, Planar] = {}
    drive: list[tuple[float, tuple[float, float]]] = []
    movers, durations = set(), set()
    for row in rows:
        line = int(row["line"])
        x, y = (_number(path, line, row[name]) for name in ("x", "y"))
        if row["role"] != "mover":
            if row["robot"] in standing:
                raise InputError(f"{path}, line {line}: {row['robot']} stands in two places in one stance")
            standing[row["robot"]] = x, y, math.radians(_number(path, line, row["yaw_deg"]))
            continue
        drive.append((_number(path, line, row["order"]), (x, y)))
        movers.add(row["robot"])
        durations.add(_number(path, line, row["duration"]))
    if len(movers) != 1 or len(durations) != 1:
        raise InputError(f"{path}, line {rows[0]['line']}: give each stance one mover with one duration")
    anchors = tuple(row["robot"] for row in rows if row["role"] == "anchor")
    return PlannedStance(standing, anchors, movers.pop(), tuple(xy for _, xy in sorted(drive)), durations.pop())


def _number(path: str | Path, line: int, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{path}, line {line}: `{text}` is not a number; give one")
    return value
