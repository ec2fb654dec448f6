"""Distances that a plan keeps, or does not, between robots and to walls; `conflicts`."""

import math
from collections.abc import Sequence

import numpy as np

from coloc_graph.planning.plan import Plan
from coloc_graph.planning.route import TO_ROBOT, TO_WALL, Free, clear_way, reachable

TOLERANCE = 0.01  # distances are taken to be kept to this [m]


def conflicts(plan: Plan, free: Free | None = None) -> list[tuple[int, str]]:
    """Find what robots of a plan would touch where they stand, leap and drive.

    Parameters
    ----------
    plan
        The plan.
    free
        Returns which places are free of walls by a distance; None where there are none.

    Returns
    -------
    list of (int, str)
        Number of the stance, and one sentence.
    """
    found: list[tuple[int, str]] = []
    before: dict[str, tuple[float, float]] = {}
    for k, stance in enumerate(plan.stances):
        places = {name: pose[:2] for name, pose in stance.standing.items()}
        names = list(places)
        for n, one in enumerate(names):
            if free is not None and not free(np.array(places[one]), TO_WALL - TOLERANCE):
                found.append((k, f"{one} stands less than {TO_WALL:g} m from a wall"))
            for other in names[n + 1 :]:
                apart = math.dist(places[one], places[other])
                if apart < TO_ROBOT - TOLERANCE:
                    found.append((k, f"{one} and {other} stand {apart:.2f} m apart: they need {TO_ROBOT:g} m"))
        for name in stance.leapers:
            if name in before:
                others = [place for other, place in places.items() if other != name]
                if not reaches(before[name], places[name], others, free):
                    found.append((k, f"{name} cannot leap there: robots or walls are in its way"))
        if not clear_way(stance.waypoints, list(places.values()), free, to_robot=TO_ROBOT - TOLERANCE):
            found.append((k, f"the drive of {stance.mover} comes too near to a robot or a wall"))
        before = {**before, **places}
    return found


def reaches(
    start: tuple[float, float], goal: tuple[float, float], others: Sequence[tuple[float, float]], free: Free | None
) -> bool:
    """Return whether a robot comes from start to goal, straight or round what is in its way."""
    if clear_way([start, goal], others, free, to_robot=TO_ROBOT - TOLERANCE):
        return True
    return bool(reachable(start, [goal], others, free)[0])
