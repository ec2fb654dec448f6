"""Which pairs of observers are measured, and what several of them measure of the same pixels, which counts once."""

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from coloc_graph.frontend.correspondence import Correspondences, pair_by_time
from coloc_graph.frontend.tracking import Track

#: Of many observers each is measured with so many others at least: those with which it has most in common.
PARTNERS = 4

Pair = tuple[str, str]


def pairs_of(observers: Sequence[str], tracks: Mapping[str, Sequence[Track]], window: float) -> list[Pair]:
    """The pairs of observers that are measured: all, or of many those that have most samples in common."""
    every = list(itertools.combinations(observers, 2))
    if len(observers) <= PARTNERS + 1:
        return every
    common = {(i, j): _in_common(tracks[i], tracks[j], window) for i, j in every}
    best: set[Pair] = set()
    for one in observers:
        own = sorted((pair for pair in every if one in pair), key=lambda pair: -common[pair])
        best.update(own[:PARTNERS])
    return [pair for pair in every if pair in best]


def _in_common(tracks_i: Sequence[Track], tracks_j: Sequence[Track], window: float) -> int:
    return sum(
        len(pair_by_time(a.times, b.times, window))
        for a in tracks_i
        for b in tracks_j
        if a.marker == b.marker or not (a.marker and b.marker)
    )


def share(
    found: Correspondences,
    pair: Pair,
    pairs: Sequence[Pair],
    tracks: Mapping[str, Sequence[Track]],
    window: float,
) -> float:
    """The part of a pair's information that is its own, of all `pairs` that are measured.

    A point that n observers see is in up to n (n - 1) / 2 homographies, each made of two images' noise. What is known
    of it altogether is the sum of all of them times 2 / n: sum_i |x_i - mean|^2 = sum_{i<j} |x_i - x_j|^2 / n; of
    m of them, n - 1 images' worth. Markers without names may be any.
    """
    if len(pairs) < 2:
        return 1.0
    names = [name for name in tracks if name not in pair]
    seen = np.array([_sees(found, tracks[pair[0]], tracks[name], window) for name in names]).reshape(-1, len(found))
    sets = Counter(map(tuple, seen.T.tolist()))
    total = 0.0
    for there, count in sets.items():
        group = {*pair, *itertools.compress(names, there)}
        among = sum(i in group and j in group for i, j in pairs)
        total += count * min(1.0, (len(group) - 1) / max(among, 1))
    return total / len(found)


def _sees(
    found: Correspondences, tracks_i: Sequence[Track], others: Sequence[Track], window: float
) -> NDArray[np.bool_]:
    """Which points (n,) another observer sees too."""
    there = np.zeros(len(found), bool)
    for number in np.unique(found.markers):
        own = np.flatnonzero(found.markers == number)
        name = tracks_i[number].marker
        for track in others:
            if track.marker == name or not (track.marker and name):
                there[own[pair_by_time(found.times[own], track.times, window)[:, 0]]] = True
    return there
