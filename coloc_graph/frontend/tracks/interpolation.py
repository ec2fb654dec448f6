"""Tracks between their samples: position at any instant as a linear combination of samples, and its noise.

The cubic through the four samples about an instant (the parabola of three where there are no more), never over a
gap longer than `LONGEST_GAP`, never outside a stretch of samples, never across a jerk that the samples cannot follow.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

#: Samples further apart than this are not joined [s].
LONGEST_GAP = 0.15
#: How far beyond the ends of a stretch an instant may lie: a share of the samples' spacing, and at most [s].
EDGE_SHARE = 0.1
EDGE = 5e-3
#: The speed is the slope over this long to either side [s].
SLOPE_REACH = 0.1
#: A sample that its neighbours predict worse than this (chi2, 2 degrees of freedom) is where the motion jerks.
JERK_GATE = 25.0

# keeps the tracks' times apart in one ascending series [s]; a stance is shorter
_APART = 1e5


@dataclass(frozen=True, eq=False)
class Interpolated:
    """Tracks at m instants, as combinations of n samples: `position` and `slope` (m, n) take samples to positions
    and to speeds smoothed over `SLOPE_REACH` [1/s]; `derivative` (m, n) is the exact one of `position` by time.

    `valid` (m,) says where the samples allow it; the other rows mean nothing.
    """

    position: sparse.csr_array
    derivative: sparse.csr_array
    slope: sparse.csr_array
    valid: NDArray[np.bool_]


class Samples:
    """The samples of several tracks of one camera: `x` (n, 2) with `covariance` (n, 2, 2), in any units.

    `times` has an ascending series [s] for each track; `x` and `covariance` likewise.
    """

    def __init__(self, times: Sequence[Array], x: Sequence[Array], covariance: Sequence[Array]) -> None:
        self.origin = float(min(series[0] for series in times))
        self.x, self.covariance = np.concatenate(x), np.concatenate(covariance)
        self._key = np.concatenate([series - self.origin + _APART * k for k, series in enumerate(times)])
        breaks = np.flatnonzero(np.diff(self._key) > LONGEST_GAP) + 1
        firsts, ends = np.append(0, breaks), np.append(breaks, len(self._key))
        self._first, self._last = np.repeat(firsts, ends - firsts), np.repeat(ends - 1, ends - firsts)
        self._smooth = self._follows()

    def __len__(self) -> int:
        return len(self.x)

    def at(self, track: Indices, times: Array) -> Interpolated:
        """All at instants `times` (m,) [s] of the tracks numbered `track` (m,)."""
        key = times - self.origin + _APART * track
        after = np.clip(np.searchsorted(self._key, key), 1, max(len(self) - 1, 1))
        nearest = np.where(
            key - self._key[after - 1] <= self._key[np.minimum(after, len(self) - 1)] - key, after - 1, after
        )
        nearest = np.minimum(nearest, len(self) - 1)
        first, last = self._first[nearest], self._last[nearest]
        count = np.minimum(last - first + 1, 4)
        edge = np.minimum(EDGE, EDGE_SHARE * (self._key[last] - self._key[first]) / np.maximum(last - first, 1))
        within = (key >= self._key[first] - edge) & (key <= self._key[last] + edge)
        start = np.clip(np.searchsorted(self._key, key, side="right") - 2, first, last - count + 1)
        columns, there = _window(start, count, 4)
        key = np.clip(key, self._key[first] - edge, self._key[last] + edge)
        weights, slopes = _lagrange(self._key[columns], key, there)
        followed = (self._smooth[columns] | ~there).all(axis=1)
        shape = (len(key), len(self))
        return Interpolated(
            position=_sparse(columns, weights, there, shape),
            derivative=_sparse(columns, slopes, there, shape),
            slope=self._slope(key, start, count, first, last),
            valid=within & (count >= 3) & followed,
        )

    def _slope(self, key: Array, start: Indices, count: Indices, first: Indices, last: Indices) -> sparse.csr_array:
        """Slopes (m, n) of straight lines through the samples about each instant."""
        low = np.minimum(np.maximum(np.searchsorted(self._key, key - SLOPE_REACH), first), start)
        high = np.maximum(
            np.minimum(np.searchsorted(self._key, key + SLOPE_REACH, side="right") - 1, last), start + count - 1
        )
        columns, there = _window(low, high - low + 1, int((high - low).max(initial=0)) + 1)
        t = np.where(there, self._key[columns], 0.0)
        centred = np.where(there, t - (t.sum(axis=1) / there.sum(axis=1))[:, None], 0.0)
        square = (centred**2).sum(axis=1)
        weights = centred / np.where(square > 0, square, 1.0)[:, None]
        return _sparse(columns, weights, there, (len(key), len(self)))

    def _follows(self) -> NDArray[np.bool_]:
        """Which samples (n,) the cubic through four neighbours predicts, as far as the noise lets it."""
        own = np.arange(len(self))
        good = np.ones(len(self), bool)
        enough = self._last - self._first >= 4
        start = np.clip(own - 2, self._first, np.maximum(self._last - 4, self._first))[enough]
        five = start[:, None] + np.arange(5)
        others = five[five != own[enough, None]].reshape(-1, 4)
        weights, _ = _lagrange(self._key[others], self._key[enough], np.ones(others.shape, bool))
        off = self.x[enough] - np.einsum("nk,nkc->nc", weights, self.x[others])
        C = self.covariance[enough] + np.einsum("nk,nkcd->ncd", weights**2, self.covariance[others])
        good[enough] = np.einsum("nc,nc->n", off, np.linalg.solve(C, off[..., None])[..., 0]) < JERK_GATE
        return good


def _window(start: Indices, count: Indices, width: int) -> tuple[Indices, NDArray[np.bool_]]:
    """Columns (m, width) from `start` (m,) on, and which of them are among the `count` (m,)."""
    there = np.arange(width) < count[:, None]
    return np.where(there, start[:, None] + np.arange(width), start[:, None]), there


def _sparse(columns: Indices, values: Array, there: NDArray[np.bool_], shape: tuple[int, int]) -> sparse.csr_array:
    pointers = np.concatenate([[0], np.cumsum(there.sum(axis=1))])
    return sparse.csr_array((values[there], columns[there], pointers), shape=shape)


def _lagrange(nodes: Array, t: Array, there: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Weights (m, k) of values at `nodes` (m, k) for the polynomial at t (m,), and for its derivative."""
    k = nodes.shape[1]
    used = there[:, :, None] & there[:, None, :] & ~np.eye(k, dtype=bool)
    between = np.where(used, nodes[:, :, None] - nodes[:, None, :], 1.0)
    factors = np.where(used, (t[:, None] - nodes)[:, None, :], 1.0) / between
    weights = np.where(there, factors.prod(axis=2), 0.0)
    slopes = np.zeros_like(weights)
    for c in range(k):
        others = np.delete(factors, c, axis=2).prod(axis=2)
        slopes += np.where(used[:, :, c], others / between[:, :, c], 0.0)
    return weights, slopes
