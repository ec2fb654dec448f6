"""Maps of walls, as ROS's map_server has them: `FloorMap`, `read_floor_map`."""

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray

from coloc_graph.errors import InputError
from coloc_graph.image_file import read_image, to_8_bits, to_grey
from coloc_graph.input_file import read_text

Array = NDArray[np.float64]

MAX_FILE_SIZE = 100_000  # size of a map's YAML above which it is none [bytes]
MAX_CELLS = 50_000_000  # cells above which a map is refused
STEP = 0.03  # least step along a line of sight [m]
REMEDY = "give the YAML file of a ROS map_server map"


@dataclass(frozen=True, eq=False)
class FloorMap:
    """Occupancy of the floor.

    Attributes
    ----------
    distance
        Distance (rows, columns) from each cell to the nearest one that is not free [m]; row 0 is the lowest y.
    resolution
        Size of a cell [m].
    origin
        x, y of the lower left corner in the world [m].
    """

    distance: Array
    resolution: float
    origin: tuple[float, float]

    @classmethod
    def of_cells(cls, free: NDArray[np.bool_], resolution: float, origin: tuple[float, float]) -> "FloorMap":
        """Make a map of cells (rows, columns) that are free; row 0 is the lowest y, and beyond the map nothing is."""
        padded = np.pad(free.astype(np.uint8), 1)
        distance = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
        return cls(np.asarray(distance, float) * resolution, resolution, origin)

    def clear(self, places: Array, distance: ArrayLike) -> NDArray[np.bool_]:
        """Return which places (..., 2) [m] are further than a distance (...) [m] from all that is not free.

        Cells count with their corners, so that no place is taken to be further from them than it is.
        """
        at = (np.asarray(places, float) - np.array(self.origin)) / self.resolution + 0.5  # in cells of the padded map
        with np.errstate(invalid="ignore"):
            inside = ((at >= 0.5) & (at < np.array(self.distance.shape[::-1]) + 0.5)).all(-1)
        at = np.where(np.asarray(inside)[..., None], at, 0.0)
        cell = at.astype(int)
        column, row = np.moveaxis(cell, -1, 0)
        (x, y), padded = np.moveaxis(at - cell, -1, 0), self._padded
        low = (1 - x) * padded[row, column] + x * padded[row, column + 1]
        high = (1 - x) * padded[row + 1, column] + x * padded[row + 1, column + 1]
        away = (1 - y) * low + y * high - math.sqrt(0.5) * self.resolution
        return np.asarray(inside & (away > np.asarray(distance)))

    @cached_property
    def _padded(self) -> Array:
        """Distances (rows + 2, columns + 2) with those of the cells around the map, which are not free [m]."""
        return np.pad(self.distance, 1)

    def _distance(self, places: Array) -> Array:
        """Distance (...) from the cells of places (..., 2) to the nearest wall's [m], 0 in it and beyond the map."""
        cell = np.floor((places - np.array(self.origin)) / self.resolution)
        with np.errstate(invalid="ignore"):
            inside = ((cell >= 0) & (cell < np.array(self.distance.shape[::-1]))).all(-1)
        column, row = np.moveaxis(np.where(np.asarray(inside)[..., None], cell, 0).astype(int), -1, 0)
        return np.asarray(np.where(inside, self.distance[row, column], 0.0))

    def blocked(self, eyes: Array, points: Array) -> NDArray[np.bool_]:
        """Return which lines (...) on the floor from `eyes` to `points` (..., 2) [m] meet a wall."""
        at, points = np.broadcast_arrays(eyes[..., :2], points[..., :2])
        ray = (points - at).reshape(-1, 2)
        at = at.reshape(-1, 2)
        length = np.hypot(*ray.T)
        direction = ray / np.maximum(length, 1e-9)[:, None]
        gone, blocked = np.zeros(len(at)), np.zeros(len(at), bool)
        active = np.arange(len(at))
        # nothing is within the distance to the nearest wall: the line is free up to there
        while len(active):
            away = self._distance(at[active] + gone[active, None] * direction[active])
            blocked[active] = away <= 0
            gone[active] += np.maximum(away, STEP)
            active = active[(away > 0) & (gone[active] < length[active])]
        return blocked.reshape(points.shape[:-1])


def read_floor_map(path: str | Path) -> FloorMap:
    """Read a map: a YAML file and the image (PGM or PNG) that it names.

    Cells that are occupied or unknown are not free. Source: ROS, "map_server", map format.

    Raises
    ------
    InputError
        If the file is no map; the message says what is wrong.
    """
    path = Path(path)
    try:
        fields = yaml.safe_load(read_text(path, REMEDY, limit=MAX_FILE_SIZE))
    except yaml.YAMLError as error:
        raise InputError(f"{path} is not a map: its YAML cannot be read; {REMEDY}") from error
    if not isinstance(fields, dict) or not isinstance(fields.get("image"), str):
        raise InputError(f"{path} is not a map: it names no `image`; {REMEDY}")
    resolution = _number(path, fields, "resolution", 1e-4, 10.0)
    origin = fields.get("origin")
    if not isinstance(origin, list) or len(origin) != 3 or not all(map(_is_number, origin)):
        raise InputError(f"{path}: `origin` is {origin!r}; give x, y and yaw, as in [-10.0, -5.0, 0.0]")
    if abs(origin[2]) > 1e-6:
        raise InputError(f"{path}: the map is turned by {origin[2]} rad; give one with an origin of yaw 0")
    free_below = _number(path, fields, "free_thresh", 0.0, 1.0)
    grey = to_grey(to_8_bits(read_image(path.parent / fields["image"]))).astype(float)
    if grey.size > MAX_CELLS:
        raise InputError(f"{path}: a map of {grey.size} cells is too large; give one of at most {MAX_CELLS}")
    occupied = grey / 255 if fields.get("negate") in (1, True) else 1 - grey / 255
    free = (occupied < free_below)[::-1]
    if not free.any():
        raise InputError(f"{path} has no free cell: check `negate` and `free_thresh`")
    return FloorMap.of_cells(free, resolution, (float(origin[0]), float(origin[1])))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _number(path: Path, fields: dict[str, Any], name: str, low: float, high: float) -> float:
    if name not in fields:
        raise InputError(f"{path} is not a map: it has no `{name}`; {REMEDY}")
    value: Any = fields[name]
    if not _is_number(value) or not low <= float(value) <= high:
        raise InputError(f"{path}: `{name}` is {value!r}; give a number from {low:g} to {high:g}")
    return float(value)
