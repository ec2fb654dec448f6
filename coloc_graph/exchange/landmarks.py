"""landmarks.csv: where landmarks, and the map that some are on, came out in the world."""

import csv
import io
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from coloc_graph.backend import Estimate
from coloc_graph.backend.landmarks import Placed
from coloc_graph.errors import InputError


@dataclass(frozen=True)
class LandmarkRow:
    """A landmark's place in the world, x, y [m] and yaw [deg], with standard deviations, the correlation of x and y,
    and how many sightings of it are in the estimate."""

    name: str
    x: float
    y: float
    yaw_deg: float
    x_sigma: float
    y_sigma: float
    xy_correlation: float
    yaw_sigma_deg: float
    sightings: int


def landmark_rows(estimate: Estimate) -> list[LandmarkRow]:
    """The landmarks of an estimate, in the team's order."""
    used = estimate.graph.without(one.measurement for one in estimate.refused).sighted
    return [row_of(name, placed, len(used.get(name, ()))) for name, placed in estimate.landmarks.items()]


def map_row(estimate: Estimate) -> LandmarkRow | None:
    """Where the map is in the world: T_world_map; its `sightings` are of all landmarks that are on it."""
    if estimate.map is None:
        return None
    on_it = {one.landmark for one in estimate.graph.on_map}
    return row_of("map", estimate.map, sum(row.sightings for row in landmark_rows(estimate) if row.name in on_it))


def row_of(name: str, placed: Placed, sightings: int) -> LandmarkRow:
    """A row of the file."""
    x, y, yaw = placed.planar
    C = placed.covariance_xy_yaw
    sx, sy, turn = np.sqrt(C.diagonal()).tolist()
    correlation = float(C[0, 1] / (sx * sy)) if sx > 0 and sy > 0 else 0.0
    return LandmarkRow(name, x, y, float(np.rad2deg(yaw)), sx, sy, correlation, float(np.rad2deg(turn)), sightings)


def landmarks_csv(rows: list[LandmarkRow]) -> str:
    """The text of the file; numbers read back to the bit."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [one.name for one in fields(LandmarkRow)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(map(asdict, rows))
    return text.getvalue()


def read_landmarks(path: Path) -> tuple[LandmarkRow, ...]:
    """The rows of a file, () where there is none; `InputError` naming the line where it is damaged."""
    if not path.exists():
        return ()
    rows = []
    with path.open(encoding="utf-8", newline="") as file:
        for line, cells in enumerate(csv.DictReader(file), start=2):
            try:
                rows.append(_read(cells))
            except (KeyError, TypeError, ValueError) as error:
                raise InputError(f"{path}, line {line}: is damaged ({error}); solve the run again") from error
    return tuple(rows)


def _read(cells: Mapping[str, str]) -> LandmarkRow:
    numbers = {one.name: float(cells[one.name]) for one in fields(LandmarkRow) if one.name not in ("name", "sightings")}
    if not np.isfinite(list(numbers.values())).all():
        raise ValueError("a number is not finite")
    return LandmarkRow(name=cells["name"], sightings=int(cells["sightings"]), **numbers)
