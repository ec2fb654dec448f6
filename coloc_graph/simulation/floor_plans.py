"""Floors with walls for planned missions: corridors, halls with pillars, two rooms; `FLOOR_PLANS`."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coloc_graph.planning.floor_map import FloorMap

Array = NDArray[np.float64]

THICK = 0.3  # thickness of walls and pillars [m]
CORRIDOR = 2.0  # width of a corridor [m]
RESOLUTION = 0.05  # size of a map's cells [m]


@dataclass(frozen=True)
class FloorPlan:
    """Walls of a floor, and a way on it that begins at the origin along x.

    Attributes
    ----------
    walls
        Rectangles x0, y0, x1, y1 [m], the outer ones round all that is free.
    goals
        Waypoints of the middle of the observers [m].
    """

    walls: tuple[tuple[float, float, float, float], ...]
    goals: tuple[tuple[float, float], ...]

    def floor_map(self, resolution: float = RESOLUTION) -> FloorMap:
        """Draw the map of the floor."""
        walls = np.array(self.walls)
        low, high = walls[:, :2].min(axis=0), walls[:, 2:].max(axis=0)
        columns, rows = np.ceil((high - low) / resolution).astype(int)
        x = low[0] + (np.arange(columns) + 0.5) * resolution
        y = low[1] + (np.arange(rows) + 0.5) * resolution
        free = self.distance(np.stack(np.meshgrid(x, y), axis=-1)) > 0
        return FloorMap.of_cells(free, resolution, (float(low[0]), float(low[1])))

    def distance(self, places: ArrayLike) -> Array:
        """Distance (...) of places (..., 2) from the nearest wall [m], 0 in it."""
        p = np.asarray(places, float)[..., None, :]
        walls = np.array(self.walls)
        off = np.maximum(np.maximum(walls[:, :2] - p, p - walls[:, 2:]), 0.0)
        return np.asarray(np.hypot(off[..., 0], off[..., 1]).min(axis=-1))

    def blocked(self, eye: ArrayLike, places: ArrayLike) -> NDArray[np.bool_]:
        """Return which straight lines from an eye (2,) to places (..., 2) meet a wall."""
        a, p = np.asarray(eye, float)[:2], np.asarray(places, float)[..., None, :2]
        step = p - a
        walls = np.array(self.walls)
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = (walls[:, :2] - a) / step, (walls[:, 2:] - a) / step
        # where a line enters and leaves the slabs of each rectangle
        enters = np.nanmax(np.minimum(one, other), axis=-1)
        leaves = np.nanmin(np.maximum(one, other), axis=-1)
        return np.asarray(((enters <= leaves) & (leaves >= 0) & (enters <= 1)).any(axis=-1))


def _box(x0: float, y0: float, x1: float, y1: float) -> tuple[tuple[float, float, float, float], ...]:
    """Four walls round a rectangle that is free."""
    t = THICK
    return (x0 - t, y0 - t, x1 + t, y0), (x0 - t, y1, x1 + t, y1 + t), (x0 - t, y0, x0, y1), (x1, y0, x1 + t, y1)


def _corridor_l() -> FloorPlan:
    half = CORRIDOR / 2
    return FloorPlan((*_box(-1.5, -half, 4 + half, 5.5), (-1.5, half, 4 - half, 5.5)), ((4.0, 0.0), (4.0, 4.0)))


def _corridor_u() -> FloorPlan:
    half = CORRIDOR / 2
    inner = (-1.5, half, 4 - half, 3.5 - half)
    return FloorPlan((*_box(-1.5, -half, 4 + half, 3.5 + half), inner), ((4.0, 0.0), (4.0, 3.5), (0.5, 3.5)))


def _pillars() -> FloorPlan:
    pillars = tuple((x - THICK / 2, y - THICK / 2, x + THICK / 2, y + THICK / 2) for x in (2.0, 4.0, 6.0)
                    for y in (-1.1, 1.1))  # fmt: skip
    return FloorPlan((*_box(-1.5, -3.0, 10.0, 3.0), *pillars), ((7.2, 0.0),))


def _rooms() -> FloorPlan:
    door = 0.7
    middle = ((3.4, -2.0, 3.4 + THICK, -door), (3.4, door, 3.4 + THICK, 2.0))
    return FloorPlan((*_box(-1.5, -2.0, 10.0, 2.0), *middle), ((7.2, 0.0),))


def _slalom() -> FloorPlan:
    half = 0.3  # of a pillar [m]
    pillars = tuple((x - half, -half, x + half, half) for x in (2.4, 5.0))
    return FloorPlan((*_box(-1.5, -3.0, 10.0, 3.0), *pillars), ((2.4, -0.9), (5.0, 0.9), (7.2, 0.0)))


def _offset() -> FloorPlan:
    middle, door = 1.5, 0.7
    walls = (3.5, -2.0, 3.5 + THICK, middle - door), (3.5, middle + door, 3.5 + THICK, 3.0)
    return FloorPlan((*_box(-1.5, -2.0, 10.0, 3.0), *walls), ((2.8, middle), (4.5, middle), (7.2, 0.0)))


#: Floor plans, by name: an L and a U corridor 2 m wide; a hall with pillars beside the way, and two rooms with a
#: doorway of 1.4 m in it; a hall with two pillars 0.6 m wide on the line from start to goal, one passed on the right,
#: one on the left, and two rooms whose doorway of 1.4 m is 1.5 m beside that line.
FLOOR_PLANS = {
    "L": _corridor_l(),
    "U": _corridor_u(),
    "pillars": _pillars(),
    "rooms": _rooms(),
    "slalom": _slalom(),
    "offset": _offset(),
}
