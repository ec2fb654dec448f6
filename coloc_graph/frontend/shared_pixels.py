"""What several pairs of observers measure of the same pixels, which must not count more than once."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from coloc_graph.frontend.correspondence import Correspondences, pair_by_time
from coloc_graph.frontend.tracking import Track

Array = NDArray[np.float64]


def share(found: Correspondences, tracks_i: Sequence[Track], others: Sequence[Sequence[Track]], window: float) -> float:
    """The part of a pair's information that is its own, where `others` saw the same markers within `window` [s].

    A point that n observers see is in n (n - 1) / 2 homographies, each made of two images' noise. What is known of it
    altogether is the sum of all of them times 2 / n: sum_i |x_i - mean|^2 = sum_{i<j} |x_i - x_j|^2 / n. Markers
    without names may be any.
    """
    seen = np.full(len(found), 2)
    for tracks in others:
        there = np.zeros(len(found), bool)
        for number in np.unique(found.markers):
            own = np.flatnonzero(found.markers == number)
            name = tracks_i[number].marker
            for track in tracks:
                if track.marker == name or not (track.marker and name):
                    there[own[pair_by_time(found.times[own], track.times, window)[:, 0]]] = True
        seen += there
    return float((2 / seen).mean())
