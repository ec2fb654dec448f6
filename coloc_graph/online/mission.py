"""What a team is told to do, and what those who look on are told of it."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from coloc_graph.online.formation import STAGGER, Course, Formation, Planar
from coloc_graph.online.pose_tracker import compose, inverse
from coloc_graph.pipeline.incremental import SolveOptions
from coloc_graph.team import Team


@dataclass(frozen=True)
class MissionOptions:
    """What a team is to do.

    `goals` are x, y [m] of the way of the team's middle, on a floor whose x axis is the way ahead at the beginning;
    it ends at the last one or after so many `stances`. A stance goes on until it measures all pairs to within
    `place_sigma` [m] and `heading_sigma_deg`, with `least_points`, or for `longest` [s]. `speed` is the mover's and
    that of a leap [m/s]. A stance does not begin where a clock is known worse than `clock_limit` [s]. Of one stance
    `attempts` are made.
    """

    goals: tuple[tuple[float, float], ...] = ((7.2, 0.0),)
    stances: int | None = None
    mover: str | None = None
    place_sigma: float = 0.003
    heading_sigma_deg: float = 0.15
    least_points: int = 150
    longest: float = 40.0
    speed: float = 0.3
    clock_limit: float = 1e-3
    attempts: int = 20
    solve: SolveOptions = field(default_factory=SolveOptions)


@dataclass(frozen=True, eq=False)
class Heard:
    """What observers of a mission are told: the time [UTC s], all robots' places (4, 4), and a line for people."""

    time: float
    T_world_body: dict[str, NDArray[np.float64]]
    note: str


def in_world(
    team: Team, mover: str, goals: tuple[tuple[float, float], ...]
) -> tuple[dict[str, Planar], tuple[tuple[float, float], ...]]:
    """Where the robots begin, and the course, in the world, which is the reference's body at the beginning.

    Both are given on a floor whose x axis is the way ahead and whose origin is the observers' middle.
    """
    formation = Formation(Course(((0.0, 0.0), (10.0, 0.0))), tuple(n for n in team.names if n != mover))
    starts: dict[str, Planar] = {}
    for n, name in enumerate(formation.observers):
        starts[name] = formation.place(name, STAGGER * (n % 2))
    starts[mover] = 1.28, 0.0, 0.0
    for robot in team.robots:
        if robot.devices is not None and robot.devices.start is not None:
            x, y, yaw_deg = robot.devices.start
            starts[robot.name] = x, y, math.radians(yaw_deg)
    T_world_floor = inverse(starts[team.reference])
    middle = np.mean([starts[name][:2] for name in formation.observers], axis=0)
    points = [compose(T_world_floor, (float(x), float(y), 0.0))[:2] for x, y in ((middle[0], 0.0), *goals)]
    return {name: compose(T_world_floor, place) for name, place in starts.items()}, tuple(points)
