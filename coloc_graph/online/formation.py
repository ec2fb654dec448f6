"""Who stands where next: the course of a team, the paper's formation along it, and where the mover drives."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.geometry.se2 import Planar
from coloc_graph.team.shared_view import View, places_in_view

Array = NDArray[np.float64]

#: The paper's formation: neighbours so far apart [m], their cameras turned towards each other by so much [rad].
APART = 0.8
BETWEEN = math.radians(34.0)
#: The front observer stands so far ahead of the next [m]; one that leaps goes twice as far.
STAGGER = 0.185
#: Where the mover drives, ahead of the front observer [m]; it keeps clear of whoever leaps to the front.
NEAR = 0.65
FAR = 1.9
#: Markers stay this far from the border of the images [px].
MARGIN = 12.0


@dataclass(frozen=True)
class Course:
    """The way of the team: a polyline (n, 2) [m] on the floor of the world, followed by its middle."""

    points: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        steps = [math.dist(a, b) for a, b in zip(self.points, self.points[1:], strict=False)]
        if not steps or min(steps) < 0.1 or not all(map(math.isfinite, steps)):
            raise InputError("a course goes from where the team stands to a goal at least 0.1 m away: give other goals")

    @property
    def length(self) -> float:
        """Its length [m]."""
        return sum(math.dist(a, b) for a, b in zip(self.points, self.points[1:], strict=False))

    def at(self, way: float) -> Planar:
        """The place and heading after so much `way` [m]; beyond its ends it goes straight on."""
        last = len(self.points) - 2
        for n, (a, b) in enumerate(zip(self.points, self.points[1:], strict=False)):
            step = math.dist(a, b)
            if way <= step or n == last:
                heading = math.atan2(b[1] - a[1], b[0] - a[0])
                return a[0] + way * math.cos(heading), a[1] + way * math.sin(heading), heading
            way -= step
        raise AssertionError("a course has a step")

    def way_of(self, place: Sequence[float]) -> float:
        """How much way is behind the point of the course that is nearest to a place [m]."""
        best, behind = (math.inf, 0.0), 0.0
        steps = list(zip(self.points, self.points[1:], strict=False))
        for n, (a, b) in enumerate(steps):
            step = math.dist(a, b)
            along = ((place[0] - a[0]) * (b[0] - a[0]) + (place[1] - a[1]) * (b[1] - a[1])) / step
            low, high = -math.inf if n == 0 else 0.0, math.inf if n == len(steps) - 1 else step
            along = min(max(along, low), high)
            x, y = (a[i] + along * (b[i] - a[i]) / step for i in (0, 1))
            best = min(best, (math.dist((x, y), place[:2]), behind + along))
            behind += step
        return best[1]


@dataclass(frozen=True)
class Formation:
    """How the observers stand: each in a lane of its own, in the team's order left and right of the course."""

    course: Course
    observers: tuple[str, ...]

    def lane(self, robot: str) -> tuple[float, float]:
        """How far left of the course a robot stands [m], and how its camera is turned from the course [rad]."""
        n = self.observers.index(robot)
        side = -1.0 if n % 2 else 1.0
        across = math.sqrt(APART**2 - STAGGER**2)
        return side * across * (0.5 + n // 2), -side * BETWEEN * (0.5 + n // 2)

    def place(self, robot: str, way: float) -> Planar:
        """Where a robot stands when it has so much way behind it."""
        x, y, heading = self.course.at(way)
        left, turn = self.lane(robot)
        return x - left * math.sin(heading), y + left * math.cos(heading), heading + turn

    def ways(self, places: Mapping[str, Planar]) -> dict[str, float]:
        """How much way each observer has behind it."""
        return {robot: self.course.way_of(places[robot]) for robot in self.observers}

    def next_leap(self, places: Mapping[str, Planar]) -> tuple[str, Planar]:
        """Who leaps next, the one furthest behind, and where to: a stagger ahead of the front."""
        ways = self.ways(places)
        robot = min(ways, key=lambda name: ways[name])
        return robot, self.place(robot, max(ways.values()) + STAGGER)

    def progress(self, places: Mapping[str, Planar]) -> float:
        """How much way the observers have behind them in the mean [m]."""
        ways = self.ways(places)
        return sum(ways.values()) / len(ways)

    def patrol(self, places: Mapping[str, Planar], views: Sequence[View], p_markers: Array, left: bool) -> Array:
        """Places (n, 2) [m] through which the mover drives, spread widely over what all observers see, the last one in
        the middle; with `left` the left far corner comes first. `InputError` where they see too little together."""
        front = max(self.ways(places).values())
        x, y, heading = self.course.at(front)
        for near in (NEAR, NEAR - 0.1):
            region = places_in_view(views, p_markers, (x, y), (near, FAR), MARGIN, heading)
            if len(region) >= 6:
                break
        else:
            raise InputError(
                f"the observers {', '.join(self.observers)} see too little of the floor together: stand them "
                f"{APART:g} m apart, turned towards each other by {math.degrees(BETWEEN):.0f} deg"
            )
        c, s = math.cos(heading), math.sin(heading)
        along = (region - (x, y)) @ np.array([[c, -s], [s, c]])  # ahead, left
        side = 1.0 if left else -1.0
        toward = np.array([[1.0, 1.5 * side], [1.0, -1.5 * side], [-1.0, -0.6 * side], [-1.0, 0.6 * side]])
        corners = region[np.argmax(along @ toward.T, axis=0)]
        ahead = along[:, 0] >= np.median(along[:, 0])
        return np.vstack([corners, region[ahead].mean(axis=0)])
