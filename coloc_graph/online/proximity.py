"""Robots that come too near to others or to walls, by their tracked poses; `require_clear_way`, `too_near`."""

import math
from collections.abc import Collection, Iterable, Sequence

import numpy as np

from coloc_graph.errors import RobotError
from coloc_graph.online.robot_registry import RobotRegistry
from coloc_graph.planning.route import Free, clear_way

TO_ROBOT = 0.36  # a robot that drives stops where its middle comes nearer than this to another's, 0.34 m wide [m]
TO_WALL = 0.2  # the same of walls [m]
LOOK_BACK = 0.3  # a robot comes nearer if it was further away this long ago [s]
CLOSER = 0.005  # robots come nearer if their distance shrinks by more than this meanwhile [m]
LEVELS = np.linspace(0.01, TO_WALL, 20)  # distances from walls that are told apart [m]


def require_clear_way(
    registry: RobotRegistry,
    robot: str,
    waypoints: Iterable[Sequence[float]],
    others: Collection[str],
    free: Free | None,
) -> None:
    """Require that the way of a robot, from where it is now, is clear of others, where they are now, and of walls.

    Raises
    ------
    RobotError
        If it is not. A robot that is too near already may drive away.
    """
    poses = registry.poses()
    way = [poses[robot][:2], *((float(x), float(y)) for x, y in waypoints)]
    for other in others:
        if not clear_way(way, [poses[other][:2]], to_robot=TO_ROBOT):
            raise RobotError(f"{robot} is not sent off: {other} stands in its way")
    if free is not None and _off_walls(way[0], free) >= TO_WALL and not clear_way(way, (), free, to_wall=TO_WALL):
        raise RobotError(f"{robot} is not sent off: a wall is in its way")


def too_near(registry: RobotRegistry, free: Free | None) -> str | None:
    """Describe which of the robots that drive comes too near to another or to a wall; None if none does."""
    now = registry.poses()
    before = {name: registry[name].tracker.pose(registry.utc() - LOOK_BACK) for name in now}
    for name in (name for name, robot in registry.robots.items() if not robot.arrived):
        for other in now:
            if other == name:
                continue
            distance, earlier = (math.dist(at[name][:2], at[other][:2]) for at in (now, before))
            if distance < min(TO_ROBOT, earlier - CLOSER):
                return f"{name} came to {distance:.2f} m from {other}"
        if free is not None and _off_walls(now[name], free) < min(TO_WALL, _off_walls(before[name], free) - CLOSER):
            return f"{name} came nearer than {TO_WALL:g} m to a wall"
    return None


def _off_walls(place: Sequence[float], free: Free) -> float:
    """Distance of a place from walls, at most `TO_WALL` [m]."""
    return float(LEVELS[free(np.broadcast_to(place[:2], (len(LEVELS), 2)), LEVELS)].max(initial=0.0))
