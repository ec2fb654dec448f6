"""Durations of a stance that are compared, by the way that it brings the team on; `durations`."""

import numpy as np
from numpy.typing import NDArray

from coloc_graph.planning.gaits import MIN_STANCE_DURATION

SHARES = (0.6, 1.0, 1.7)  # durations of a stance that are compared, relative to the pace of the mission
MAX_STANCE_DURATION = 60.0  # longest duration of a stance [s]


def durations(
    seconds: float, gain: float, left: float, leapt: float, leap: float, *, last: float
) -> NDArray[np.float64]:
    """Return the durations of a stance that are compared, (3,) [s].

    Parameters
    ----------
    seconds
        Seconds that are left for the mission.
    gain, left
        Way by which the stance brings the middle of the team on, and the way that is left [m].
    leapt
        Time of its leap that counts [s].
    leap
        Advance of the gait by which the rest goes [m].
    last
        Way that may be left at the goal [m].
    """
    spare = seconds - leapt
    if gain > left - last:
        return np.full(len(SHARES), min(max(spare, MIN_STANCE_DURATION), MAX_STANCE_DURATION))
    # the leaps of the way that remains after this one
    share = min(max(gain, 0.3 * leap) / left, 1.0)
    share *= max(spare - (1 / share - 1) * leapt, 0.0)
    longest = min(MAX_STANCE_DURATION, max(spare, MIN_STANCE_DURATION))
    return np.asarray(np.clip(share * np.array(SHARES), MIN_STANCE_DURATION, longest))
