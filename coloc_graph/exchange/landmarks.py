"""Read and write landmarks.csv: estimated poses of landmarks, and of the map that some are on, in the world frame."""

import csv
import io
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from coloc_graph.backend import Estimate
from coloc_graph.backend.landmarks import StaticPose
from coloc_graph.errors import InputError
from coloc_graph.input_file import read_text
from coloc_graph.measurements import Range, Sighting

REMEDY = "solve the run again"  # of a file that is damaged


@dataclass(frozen=True)
class LandmarkRow:
    """Pose of a landmark in the world frame, x, y [m] and yaw [deg], with sigmas and the correlation of x and y.

    The yaw of a landmark that is a point (in ranging runs) is NaN, and empty in the file. `stated` is True if the team
    states its position; `measurements` is the number of its measurements in the estimate.
    """

    name: str
    x: float
    y: float
    yaw_deg: float
    x_sigma: float
    y_sigma: float
    xy_correlation: float
    yaw_sigma_deg: float
    stated: bool
    measurements: int

    def as_json(self) -> dict[str, Any]:
        """Return the row with null for numbers that do not exist."""
        return {name: None if value != value else value for name, value in asdict(self).items()}


def landmark_rows(estimate: Estimate) -> list[LandmarkRow]:
    """Return the landmarks of an estimate, in the team's order."""
    if estimate.is_ranging:
        counts, found = estimate.ranging.counts, estimate.calibration.landmarks
        return [row_of(name, one, name not in found, counts[name]) for name, one in estimate.landmarks.items()]
    used, on_map = estimate.graph.without(one.measurement for one in estimate.rejected), _on_map(estimate)
    count = Counter(one.seen for one in used.measurements if isinstance(one, Sighting))
    count.update(one.target for one in used.measurements if isinstance(one, Range))
    return [row_of(name, one, name in on_map, count[name]) for name, one in estimate.landmarks.items()]


def map_row(estimate: Estimate) -> LandmarkRow | None:
    """Return the pose T_world_map of the map; its `measurements` are those of all landmarks on it."""
    if estimate.map is None:
        return None
    on_it = _on_map(estimate)
    count = sum(row.measurements for row in landmark_rows(estimate) if row.name in on_it)
    return row_of("map", estimate.map, False, count)


def _on_map(estimate: Estimate) -> set[str]:
    return {one.landmark for one in estimate.graph.on_map}


def row_of(name: str, placed: StaticPose, stated: bool, measurements: int) -> LandmarkRow:
    """Make a row of the file."""
    x, y, yaw = placed.planar
    C = placed.covariance_xy_yaw
    sx, sy, turn = np.sqrt(C.diagonal()).tolist()
    correlation = float(C[0, 1] / (sx * sy)) if sx > 0 and sy > 0 else 0.0
    yaw, turn = (yaw, turn) if placed.has_heading else (np.nan, np.nan)
    degrees = float(np.rad2deg(yaw)), float(np.rad2deg(turn))
    return LandmarkRow(name, x, y, degrees[0], sx, sy, correlation, degrees[1], stated, measurements)


def landmarks_csv(rows: list[LandmarkRow]) -> str:
    """Format rows as CSV; numbers are read back bit for bit."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [one.name for one in fields(LandmarkRow)], lineterminator="\n")
    writer.writeheader()
    for row in rows:
        cells = asdict(row) | {"stated": "yes" if row.stated else "no"}
        writer.writerow({name: "" if value != value else value for name, value in cells.items()})
    return text.getvalue()


def read_landmarks(path: Path) -> tuple[LandmarkRow, ...]:
    """Read the rows of a file, () if there is none; `InputError` names the line if it is damaged."""
    if not path.exists():
        return ()
    reader = csv.DictReader(io.StringIO(read_text(path, REMEDY), newline=""))
    try:
        return tuple(map(_read, reader))
    except (KeyError, TypeError, ValueError, OverflowError, csv.Error) as error:
        raise InputError(f"{path}, line {max(reader.line_num, 1)}: is damaged ({error}); {REMEDY}") from error


def _read(cells: Mapping[str, str]) -> LandmarkRow:
    yaw, sigma = (float(cells[name] or "nan") for name in ("yaw_deg", "yaw_sigma_deg"))
    numbers = {name: float(cells[name]) for name in ("x", "y", "x_sigma", "y_sigma", "xy_correlation")}
    if not np.isfinite(list(numbers.values())).all() or np.isfinite(yaw) != np.isfinite(sigma):
        raise ValueError("a number is not finite")
    stated = {"yes": True, "no": False}[cells["stated"]]
    count = int(cells["measurements"])
    return LandmarkRow(
        name=cells["name"], yaw_deg=yaw, yaw_sigma_deg=sigma, stated=stated, measurements=count, **numbers
    )
