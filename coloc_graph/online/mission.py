"""Goals and limits of a mission, its start in the world, and its status for listeners."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.geometry.se2 import Planar, compose, inverse
from coloc_graph.online.formation import STAGGER, Formation
from coloc_graph.pipeline.options import SolveOptions
from coloc_graph.planning.course import Course
from coloc_graph.team import Team

MOVER_AHEAD = 1.28  # start of the mover ahead of the observers' middle [m]


@dataclass(frozen=True)
class MissionOptions:
    """Goals and limits of a mission.

    Attributes
    ----------
    goals
        Waypoints x, y [m] of the middle of the observers, from where it is at the beginning, x ahead. The mission ends
        at the last one.
    stances
        Number of stances after which it ends earlier; None for no limit.
    mover
        Name of the robot that drives before the others' cameras; None for the last one of the team, with formation
        "plan" for the one of which the others promise most.
    place_sigma, heading_sigma_deg, least_points
        A stance is long enough when it measures the relative pose of every pair with standard deviations below these
        [m], [deg], with at least this number of points.
    longest
        A stance ends after this time at the latest [s].
    speed
        Speed of the mover, and of leaps [m/s].
    clock_limit
        A stance does not begin while the standard deviation of a robot's clock is above this [s].
    attempts
        Number of attempts at one stance, after which the mission fails.
    formation
        "paper" for the paper's formation, "plan" for stances that are planned anew after each one.
    pace
        Seconds of the mission for each metre of the way, leaps included, with formation "plan".
    map_path
        YAML file of a ROS map_server map whose walls are kept clear of, with formation "plan"; None for no walls.
    solve
        Options of the estimator.
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
    formation: Literal["paper", "plan"] = "paper"
    pace: float = 25.0
    map_path: Path | None = None
    solve: SolveOptions = field(default_factory=SolveOptions)


@dataclass(frozen=True, eq=False)
class MissionStatus:
    """Status of a mission: time [UTC s], poses of all robots in the world (4, 4), and a line for people."""

    time: float
    T_world_body: dict[str, NDArray[np.float64]]
    text: str


def roles(team: Team, mover: str | None) -> tuple[str, tuple[str, ...]]:
    """Return the mover, by default the team's last robot, and the observers.

    Raises
    ------
    InputError
        If the mover has no markers, or there are fewer than two observers with the reference among them.
    """
    mover = mover or team.names[-1]
    if team[mover].markers is None:
        raise InputError(f"{mover} is to move and has no markers: give it some, or name another with --mover")
    observers = tuple(name for name in team.names if name != mover)
    if len(observers) < 2 or team.reference not in observers:
        raise InputError(
            f"a mission needs two robots that observe {mover}, and the reference {team.reference} among them"
        )
    return mover, observers


def in_world(
    team: Team, mover: str, goals: tuple[tuple[float, float], ...]
) -> tuple[dict[str, Planar], tuple[tuple[float, float], ...]]:
    """Return the start poses of all robots and the course's waypoints in the world.

    The world is the reference's body at the beginning. Goals and the team's start poses are given on a floor whose x
    axis is the direction of travel at the beginning and whose origin is the middle of the observers.
    """
    formation = Formation(Course(((0.0, 0.0), (10.0, 0.0))), tuple(n for n in team.names if n != mover))
    starts: dict[str, Planar] = {}
    for n, name in enumerate(formation.observers):
        left, turn = formation.lane(name)
        # the outer ones stand where they look at the mover, too
        starts[name] = formation.place(name, STAGGER * n if n < 2 else MOVER_AHEAD + left / math.tan(turn))
    starts[mover] = MOVER_AHEAD, 0.0, 0.0
    for robot in team.robots:
        if robot.devices is not None and robot.devices.start is not None:
            x, y, yaw_deg = robot.devices.start
            starts[robot.name] = x, y, math.radians(yaw_deg)
    T_world_floor = inverse(starts[team.reference])
    middle = np.mean([starts[name][:2] for name in formation.observers], axis=0)
    points = [compose(T_world_floor, (float(x), float(y), 0.0))[:2] for x, y in ((middle[0], 0.0), *goals)]
    return {name: compose(T_world_floor, place) for name, place in starts.items()}, tuple(points)
