"""The shortest mission whose end is known to a wanted sigma; `least_time`."""

from collections.abc import Callable

from coloc_graph.errors import InputError
from coloc_graph.planning.formation import Gait
from coloc_graph.planning.gaits import MAX_MISSION_DURATION
from coloc_graph.planning.mission import Mission

TRIES = 5  # number of missions that are planned
CLOSE = 0.95  # a promise above this share of the wanted sigma is close enough
STEP = (0.6, 1.8)  # a duration is shortened and lengthened by these factors at most
SPARE = 1.02  # durations are lengthened by a little more than their promise asks for


def least_time(plan: Callable[[float], tuple[Gait, Mission]], sigma: float, start: float) -> tuple[Gait, Mission]:
    """Plan missions of different durations, and return the shortest that promises a sigma of its last positions.

    Parameters
    ----------
    plan
        Plans a mission of a duration [s].
    sigma
        Wanted standard deviation of the last positions [m].
    start
        Duration to begin with [s].

    Returns
    -------
    tuple
        The gait and the mission; if none promises the sigma within an hour, the best one.

    Raises
    ------
    InputError
        If no mission of these durations can be planned.
    """
    made: list[tuple[Gait, Mission]] = []
    time = start
    for _ in range(TRIES):
        try:
            made.append(plan(time))
        except InputError:
            if not made:
                raise
            break  # too short for any
        ratio = made[-1][1].end_sigma / sigma
        if CLOSE < ratio <= 1.0 or (ratio > 1.0 and time >= MAX_MISSION_DURATION):
            break
        # variances fall about as the reciprocal of the time
        time *= min(max(ratio**2 * (SPARE if ratio > 1.0 else 1.0), STEP[0]), STEP[1])
        time = min(time, MAX_MISSION_DURATION)
    good = [one for one in made if one[1].end_sigma <= sigma]
    if good:
        return min(good, key=lambda one: one[1].duration)
    return min(made, key=lambda one: one[1].end_sigma)
