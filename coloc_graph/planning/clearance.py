"""Conflicts of a plan: robots and walls that its robots would touch; `conflicts`."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from coloc_graph.geometry.se2 import Planar
from coloc_graph.planning.plan import Plan, PlannedStance
from coloc_graph.planning.room import TO_ROBOT, Room
from coloc_graph.planning.route import Free, clear_way, from_way, reachable

TOLERANCE = 0.01  # distances are taken to be kept to this [m]
ROOM = Room()  # of missions that are planned as a whole


def leapt_to(leapt: Mapping[str, float], before: Mapping[str, Planar], stance: PlannedStance) -> dict[str, float]:
    """Return the distances of the leaps by which robots came to where they stand in a stance [m].

    `leapt` are those of the stance `before`, whose robots' poses are these.
    """
    now = {
        name: math.dist(before[name][:2], stance.standing[name][:2])
        for name in stance.leapers
        if name in before and before[name] != stance.standing[name]
    }
    return {**leapt, **now}


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
    before: dict[str, Planar] = {}
    leapt: dict[str, float] = {}
    for k, stance in enumerate(plan.stances):
        places = {name: pose[:2] for name, pose in stance.standing.items()}
        names = list(places)
        leapt = leapt_to(leapt, before, stance)
        slips = {name: leapt.get(name, 0.0) for name in names}
        for n, one in enumerate(names):
            room = float(ROOM.off_walls(slips[one]))
            if free is not None and not free(np.array(places[one]), room - TOLERANCE):
                found.append((k, f"{one} stands less than {room:.2f} m from a wall"))
            for other in names[n + 1 :]:
                distance, room = math.dist(places[one], places[other]), float(ROOM.apart(slips[one], slips[other]))
                if distance < room - TOLERANCE:
                    found.append((k, f"{one} and {other} stand {distance:.2f} m apart: they need {room:.2f} m"))
        for name in stance.leapers:
            if name in before:
                others = [place for other, place in places.items() if other != name]
                if not reaches(before[name][:2], places[name], others, free):
                    found.append((k, f"{name} cannot leap there: robots or walls are in its way"))
        near = from_way(stance.waypoints, list(places.values())) < ROOM.apart(list(slips.values())) - TOLERANCE
        if near.any() or not clear_way(stance.waypoints, (), free):
            found.append((k, f"the drive of {stance.mover} comes too near to a robot or a wall"))
        before = {**before, **stance.standing}
    return found


def reaches(
    start: tuple[float, float], goal: tuple[float, float], others: Sequence[tuple[float, float]], free: Free | None
) -> bool:
    """Return whether a robot comes from start to goal, straight or round what is in its way."""
    if clear_way([start, goal], others, free, to_robot=TO_ROBOT - TOLERANCE):
        return True
    return bool(reachable(start, [goal], others, free)[0])
