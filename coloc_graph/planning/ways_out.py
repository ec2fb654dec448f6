"""Why a team cannot go on: which robot stands in which robot's way; `stuck`, `in_the_way`, `require_way`."""

from collections.abc import Sequence

import numpy as np

from coloc_graph.errors import InputError
from coloc_graph.planning.belief import Belief
from coloc_graph.planning.course import Course
from coloc_graph.planning.formation import Gait
from coloc_graph.planning.leaps import possible_leaps
from coloc_graph.planning.plan import PlannedStance
from coloc_graph.planning.prediction import Predictor
from coloc_graph.planning.route import clear_way, reachable

NARROW = "the way is too narrow for the robots, or their cameras share no view there"


def stuck(gone: float, why: str = NARROW) -> InputError:
    """Return the error of a team that cannot go on from `gone` along the course [m]."""
    return InputError(f"no observer can leap on from where the team stands, {gone:.1f} m along the course: {why}")


def in_the_way(belief: Belief, course: Course, gait: Gait, observers: Sequence[str], predictor: Predictor) -> str:
    """Return which robot stands in the way of one that has to leap, or that none does, in words.

    The hindmost robot is looked at first; the arguments are those of `possible_leaps`.
    """

    def leaps(leaper: str, *absent: str) -> bool:
        found = possible_leaps(belief, leaper, course, gait, observers, predictor, roomy=False, absent=absent)
        return len(found.targets) > 0

    names = sorted(observers, key=lambda name: course.way_of(belief.poses[name]))
    for leaper in names:
        if leaps(leaper):
            continue  # it shares no view anywhere
        for other in names:
            if other != leaper and leaps(leaper, other):
                return f"{other} stands in the way of {leaper}: set {other} aside"
    return NARROW


def require_way(belief: Belief, stance: PlannedStance, observers: Sequence[str], predictor: Predictor) -> None:
    """Require that the mover comes from where it is to an end of its drive, before anybody leaps.

    Raises
    ------
    InputError
        If it does not; the message names a robot that stands in its way.
    """
    start, ends = np.array(belief.poses[stance.mover][:2]), np.array([stance.waypoints[0], stance.waypoints[-1]])
    places, free = {name: belief.poses[name][:2] for name in observers}, predictor.free
    if any(clear_way(np.array([start, end]), list(places.values()), free) for end in ends):
        return
    if reachable(start, ends, list(places.values()), free).any():
        return
    blocking = [
        name
        for name in places
        if reachable(start, ends, [place for other, place in places.items() if other != name], free).any()
    ]
    who = f"{blocking[0]} stands in its way" if blocking else "walls or several robots are in its way"
    raise InputError(
        f"{stance.mover} finds no way to where it is to drive: {who}; clear it, or set {stance.mover} there"
    )
