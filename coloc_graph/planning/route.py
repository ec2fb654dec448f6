"""Ways of robots clear of others and of walls: `clear_way`, `route`, `reachable`, `from_way`, `polyline_length`."""

import itertools
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from coloc_graph.errors import InputError
from coloc_graph.planning.room import TO_ROBOT, TO_WALL, Room

Array = NDArray[np.float64]

#: Returns whether places (..., 2) [m] are free of walls by a distance [m].
Free = Callable[[Array, ArrayLike], NDArray[np.bool_]]

STEP = 0.05  # distance between places of a way that are checked [m]
GRID = 0.15  # distance between places through which a way round is sought [m]
NEIGHBOURS = 6  # places of the grid to which a start or goal is joined
ROUND = 2.5  # a way round goes this far beyond all robots [m]
SHORT = 0.5  # a straight way shorter than this may come nearer to robots, where there is no other [m]
MIN_TO_ROBOT = 0.37  # up to this distance [m]
SLACK = 0.01  # a robot that stands nearer to another than it may does not come nearer than this less [m]


def clear_way(
    points: ArrayLike,
    others: ArrayLike,
    free: Free | None = None,
    *,
    to_robot: ArrayLike = TO_ROBOT,
    to_wall: float = TO_WALL,
    room: Room | None = None,
) -> bool:
    """Return whether a polyline (n, 2) is clear of robots at `others` (m, 2) and of walls [m].

    It keeps a distance `to_robot` () or (m,) from robots, and `to_wall` from walls [m]. Where it begins it may be as
    near to them as it is. With `room` it keeps more, the further it has driven.
    """
    points, others = np.asarray(points, float), np.asarray(others, float).reshape(-1, 2)
    way = _sampled(points)
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way, axis=0).T))])
    robots, walls = (0.0, 0.0) if room is None else room.further(driven)
    if len(others):
        least = np.minimum(to_robot, np.hypot(*(points[0] - others).T) - SLACK) + np.reshape(robots, (-1, 1))
        if (np.hypot(*np.moveaxis(way[:, None] - others, -1, 0)) < least).any():
            return False
    if free is None:
        return True
    walled = free(way, to_wall + walls)
    # out of a place that is too near to a wall, but not through it
    outside = int(walled.argmax())
    return bool(walled[outside:].all() and free(way[:outside], 0.0).all() and walled.any())


def route(
    start: ArrayLike,
    goal: ArrayLike,
    others: ArrayLike,
    free: Free | None = None,
    *,
    to_robot: float = TO_ROBOT,
    rooms: Sequence[Room] = (),
) -> list[tuple[float, float]]:
    """Find a short way from start to goal (2,), clear of robots at `others` (m, 2) and of walls; without its start.

    It keeps the first of `rooms` that leaves a way, `to_robot` [m] alone if none does; steps aside may keep less.

    Raises
    ------
    InputError
        If there is none.
    """
    start, goal = np.asarray(start, float), np.asarray(goal, float)
    others = np.asarray(others, float).reshape(-1, 2)
    for room in rooms:
        if clear_way([start, goal], others, free, to_robot=to_robot, room=room):
            return [_pair(goal)]
        further = float(room.further(np.hypot(*(goal - start)))[0])
        roads = _Roads(start, goal[None], others, free, to_robot + further)
        if (way := roads.way(0)) is not None:
            return _pulled([start, *way, goal], others, free, to_robot + further)
    if clear_way([start, goal], others, free, to_robot=to_robot):
        return [_pair(goal)]
    roads = _Roads(start, goal[None], others, free, to_robot)
    if (way := roads.way(0)) is not None:
        return _pulled([start, *way, goal], others, free, to_robot)
    if np.hypot(*(goal - start)) < SHORT and clear_way([start, goal], others, free, to_robot=MIN_TO_ROBOT):
        return [_pair(goal)]
    raise InputError(
        f"there is no way for a robot from {start[0]:.1f}, {start[1]:.1f} to {goal[0]:.1f}, {goal[1]:.1f} that is "
        "clear of robots and walls: give them more room"
    )


def reachable(
    start: ArrayLike, goals: ArrayLike, others: ArrayLike, free: Free | None = None, to_robot: float = TO_ROBOT
) -> NDArray[np.bool_]:
    """Return to which goals (n, 2) a way from `start` (2,) is clear of robots at `others` (m, 2) and of walls.

    It keeps a distance `to_robot` from robots [m].
    """
    goals = np.asarray(goals, float).reshape(-1, 2)
    if not len(goals):
        return np.zeros(0, bool)
    others = np.asarray(others, float).reshape(-1, 2)
    places, which = np.unique(goals.round(6), axis=0, return_inverse=True)
    return _Roads(np.asarray(start, float), places, others, free, to_robot).reached[which.ravel()]


class _Roads:
    """Places of a grid that are clear, and the shortest ways from a start (2,) over them to goals (n, 2)."""

    def __init__(self, start: Array, goals: Array, others: Array, free: Free | None, to_robot: float) -> None:
        every = np.vstack([start, goals, others])
        low, high = every.min(axis=0) - ROUND, every.max(axis=0) + ROUND
        x, y = (np.arange(a, b, GRID) for a, b in zip(low, high, strict=True))
        places = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
        clear = np.ones(places.shape[:2], bool) if free is None else free(places, TO_WALL)
        if len(others):
            away = np.hypot(*np.moveaxis(places[:, :, None] - others, -1, 0))
            clear &= (away > to_robot).all(axis=-1)
        self._nodes = places[clear]
        number = np.cumsum(clear).reshape(clear.shape) - 1
        ends, lengths = [], []
        for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
            a = np.s_[: -dx or None, max(-dy, 0) : -dy if dy > 0 else None]
            b = np.s_[dx:, max(dy, 0) : dy if dy < 0 else None]
            both = clear[a] & clear[b]
            ends.append(np.stack([number[a][both], number[b][both]]))
            lengths.append(np.full(int(both.sum()), GRID * np.hypot(dx, dy)))
        total = len(self._nodes)
        for extra, point in enumerate((start, *goals)):  # which reach the places that they see
            near = np.argsort(np.hypot(*(self._nodes - point).T))[:NEIGHBOURS]
            # a start may be too near to others already, a goal may not
            ways = ((n, [point, self._nodes[n]] if extra == 0 else [self._nodes[n], point]) for n in near.tolist())
            seen = [n for n, way in ways if clear_way(way, others, free, to_robot=to_robot)]
            ends.append(np.array([[total + extra] * len(seen), seen], int).reshape(2, -1))
            lengths.append(np.hypot(*(self._nodes[seen] - point).T) if seen else np.zeros(0))
        (i, j), w = np.hstack(ends), np.concatenate(lengths)
        size = total + 1 + len(goals)
        graph = coo_array((w, (i, j)), shape=(size, size)).tocsr()
        distance, before = dijkstra(graph, directed=False, indices=np.array([total]), return_predecessors=True)
        self._before, self._start = before[0], total
        self.reached: NDArray[np.bool_] = np.isfinite(distance[0, total + 1 :])

    def way(self, goal: int) -> list[Array] | None:
        """Return the places between the start and a goal; None if it is not reached."""
        if not self.reached[goal]:
            return None
        at, back = self._start + 1 + goal, []
        while (at := int(self._before[at])) != self._start:
            back.append(self._nodes[at])
        return back[::-1]


def _pulled(points: list[Array], others: Array, free: Free | None, to_robot: float) -> list[tuple[float, float]]:
    """Leave out the points of a way between which it is clear; without its start."""
    kept, at = [], 0
    while at < len(points) - 1:
        beyond = (n for n in range(len(points) - 1, at, -1))
        at = next((n for n in beyond if clear_way([points[at], points[n]], others, free, to_robot=to_robot)), at + 1)
        kept.append(_pair(points[at]))
    return kept


def polyline_length(points: ArrayLike) -> float:
    """Length of a polyline (n, 2) [m]."""
    return float(np.hypot(*np.diff(np.asarray(points, float), axis=0).T).sum())


def from_way(points: ArrayLike, others: ArrayLike) -> Array:
    """Return the least distances (m,) of robots at `others` (m, 2) from a polyline (n, 2) [m]."""
    way = _sampled(np.asarray(points, float))
    return np.asarray(np.hypot(*np.moveaxis(way[:, None] - np.asarray(others, float), -1, 0)).min(axis=0))


def _sampled(points: Array) -> Array:
    """Places (m, 2) along a polyline (n, 2)."""
    parts = [points[:1]]
    for a, b in itertools.pairwise(points):
        count = max(int(np.ceil(float(np.hypot(*(b - a))) / STEP)), 1)
        parts.append(a + np.linspace(0.0, 1.0, count + 1)[1:, None] * (b - a))
    return np.concatenate(parts)


def _pair(point: Array) -> tuple[float, float]:
    return float(point[0]), float(point[1])
