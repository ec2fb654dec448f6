"""The way of a team: a polyline on the floor; `Course`."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from coloc_graph.errors import InputError
from coloc_graph.geometry.se2 import Planar

MAX_LENGTH = 200.0  # longest way that is planned at once [m]


@dataclass(frozen=True)
class Course:
    """Path of the team: a polyline (n, 2) [m] on the floor of the world, followed by the middle of the observers."""

    points: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        steps = [math.dist(a, b) for a, b in zip(self.points, self.points[1:], strict=False)]
        if not steps or min(steps) < 0.1 or not all(map(math.isfinite, steps)):
            raise InputError("a course goes from where the team stands to a goal at least 0.1 m away: give other goals")
        if sum(steps) > MAX_LENGTH:
            raise InputError(f"a course of {sum(steps):g} m is too long for one plan: give up to {MAX_LENGTH:g} m")

    @property
    def length(self) -> float:
        """Length of the path [m]."""
        return sum(math.dist(a, b) for a, b in zip(self.points, self.points[1:], strict=False))

    def at(self, way: float) -> Planar:
        """Return the pose after a distance `way` [m] along the path, which goes straight on beyond its ends."""
        last = len(self.points) - 2
        for n, (a, b) in enumerate(zip(self.points, self.points[1:], strict=False)):
            step = math.dist(a, b)
            if way <= step or n == last:
                heading = math.atan2(b[1] - a[1], b[0] - a[0])
                return a[0] + way * math.cos(heading), a[1] + way * math.sin(heading), heading
            way -= step
        raise AssertionError("a course has a step")

    def way_of(self, place: Sequence[float]) -> float:
        """Return the distance along the path of its point nearest to a place x, y [m]."""
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
