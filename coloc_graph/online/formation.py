"""The paper's formation along a course, and the mover's waypoints; `Formation`."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.geometry.se2 import Planar
from coloc_graph.planning.course import Course
from coloc_graph.team.shared_view import View, positions_in_view

Array = NDArray[np.float64]

APART = 0.8  # distance between neighbouring observers, as in the paper [m]
BETWEEN = math.radians(34.0)  # angle between their cameras, which are turned towards each other [rad]
STAGGER = 0.185  # the front observer stands this far ahead of the next; a leap is twice as long [m]
NEAR = 0.65  # the mover drives from this far ahead of the front observer, clear of one that leaps [m]
FAR = 1.9  # and up to this far [m]
MARGIN = 12.0  # distance of markers from the borders of images [px]


@dataclass(frozen=True)
class Formation:
    """Formation of the observers: each in a lane of its own, in the team's order left and right of the course."""

    course: Course
    observers: tuple[str, ...]

    def lane(self, robot: str) -> tuple[float, float]:
        """Return a robot's offset to the left of the course [m] and its heading relative to the course [rad]."""
        n = self.observers.index(robot)
        side = -1.0 if n % 2 else 1.0
        across = math.sqrt(APART**2 - STAGGER**2)
        return side * across * (0.5 + n // 2), -side * BETWEEN * (0.5 + n // 2)

    def place(self, robot: str, way: float) -> Planar:
        """Return the pose of a robot at a distance `way` [m] along the course."""
        x, y, heading = self.course.at(way)
        left, turn = self.lane(robot)
        return x - left * math.sin(heading), y + left * math.cos(heading), heading + turn

    def ways(self, places: Mapping[str, Planar]) -> dict[str, float]:
        """Return the distance of each observer along the course [m]."""
        return {robot: self.course.way_of(places[robot]) for robot in self.observers}

    def next_leap(self, places: Mapping[str, Planar]) -> tuple[str, Planar]:
        """Return the observer furthest behind, which leaps next, and its target, a stagger ahead of the front."""
        ways = self.ways(places)
        robot = min(ways, key=lambda name: ways[name])
        return robot, self.place(robot, max(ways.values()) + STAGGER)

    def progress(self, places: Mapping[str, Planar]) -> float:
        """Return the mean distance of the observers along the course [m]."""
        ways = self.ways(places)
        return sum(ways.values()) / len(ways)

    def patrol(self, places: Mapping[str, Planar], views: Sequence[View], p_markers: Array, left: bool) -> Array:
        """Choose the mover's waypoints, spread over what all observers see.

        Parameters
        ----------
        places
            Poses of the observers.
        views
            Their views.
        p_markers
            Markers of the mover in its body (m, 3) [m].
        left
            Begin with the left far corner instead of the right one.

        Returns
        -------
        ndarray
            Waypoints (n, 2) [m] in the world, the last one in the middle.

        Raises
        ------
        InputError
            If the observers see too little of the floor together.
        """
        front = max(self.ways(places).values())
        x, y, heading = self.course.at(front)
        for near in (NEAR, NEAR - 0.1):
            region = positions_in_view(views, p_markers, (x, y), (near, FAR), MARGIN, heading)
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
