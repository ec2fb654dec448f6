"""Select the pairs of observers to measure, and weight pairs that measure the same pixels, which count once."""

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.sparse.csgraph import minimum_spanning_tree

from coloc_graph.frontend.pairing.correspondence import Correspondences, pair_each_by_time
from coloc_graph.frontend.tracks.track import Track

MIN_PARTNERS = 3  # pairs of each of many observers that are measured: with those that share most samples

Pair = tuple[str, str]


def pairs_of(observers: Sequence[str], tracks: Mapping[str, Sequence[Track]], window: float) -> list[Pair]:
    """Select the pairs of observers to measure: all, or of many those that share most samples.

    Of many, each has `MIN_PARTNERS`, and a spanning tree of most shared samples ties all that are tied by any samples.
    """
    every = list(itertools.combinations(observers, 2))
    if len(observers) <= MIN_PARTNERS + 1:
        return every
    series, of = [], []
    for number, (i, j) in enumerate(every):
        for a, b in itertools.product(tracks[i], tracks[j]):
            if a.marker == b.marker or not (a.marker and b.marker):
                series.append((a.times, b.times))
                of.append(number)
    which, _ = pair_each_by_time(series, window)
    counts = np.bincount(np.array(of, np.int64)[which], minlength=len(every))
    common = dict(zip(every, counts.tolist(), strict=True))
    best = _spanning(observers, common)
    for one in observers:
        own = sorted((pair for pair in every if one in pair), key=lambda pair: -common[pair])
        best.update(own[:MIN_PARTNERS])
    return [pair for pair in every if pair in best]


def _spanning(observers: Sequence[str], common: Mapping[Pair, int]) -> set[Pair]:
    """Return the pairs of a spanning tree of most shared samples, or of a tree of each group that shares any."""
    shared = np.zeros((len(observers), len(observers)))
    shared[np.triu_indices(len(observers), 1)] = list(common.values())  # in the order of `combinations`
    tree = minimum_spanning_tree(-shared).toarray()
    return {(observers[i], observers[j]) for i, j in np.argwhere(tree).tolist()}


def information_weight(
    found: Correspondences,
    pair: Pair,
    pairs: Sequence[Pair],
    tracks: Mapping[str, Sequence[Track]],
    window: float,
) -> float:
    """Weight of a pair's information, since the pixels of one image enter the homographies of several pairs.

    Parameters
    ----------
    found, pair
        Correspondences of a pair of observers.
    pairs
        All pairs that are measured in the stance.
    tracks
        Tracks of all observers by name; unnamed tracks may be any marker.
    window
        Time difference up to which two samples are of one instant [s].

    Returns
    -------
    float
        Weight in (0, 1].

    Notes
    -----
    A point that n observers see is in up to n (n - 1) / 2 homographies, each with the noise of two images. Their total
    information is that of n - 1 images: sum_i |x_i - mean|^2 = sum_{i<j} |x_i - x_j|^2 / n.
    """
    if len(pairs) < 2:
        return 1.0
    names = [*pair, *(name for name in tracks if name not in pair)]
    seen = np.zeros((len(names), len(found)), bool)
    seen[:2] = True
    series, of = [], []
    for number in np.unique(found.markers):
        own = np.flatnonzero(found.markers == number)
        marker, times = tracks[pair[0]][number].marker, found.times[own]
        for there, name in zip(seen[2:], names[2:], strict=True):
            for track in tracks[name]:
                if track.marker == marker or not (track.marker and marker):
                    series.append((times, track.times))
                    of.append((there, own))
    which, indices = pair_each_by_time(series, window)
    ends = np.searchsorted(which, np.arange(len(series) + 1))
    for (there, own), begin, end in zip(of, ends[:-1], ends[1:], strict=True):
        there[own[indices[begin:end, 0]]] = True
    measured = np.zeros((len(names), len(names)))
    places = {name: place for place, name in enumerate(names)}
    for i, j in pairs:
        measured[places[i], places[j]] = 1.0
    among = ((measured @ seen) * seen).sum(axis=0)
    return float(np.minimum(1.0, (seen.sum(axis=0) - 1) / np.maximum(among, 1.0)).mean())
