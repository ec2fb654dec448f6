"""Interpolate tracks: the position at any instant as a linear combination of samples, so that noise propagates.

The interpolant is the cubic through the four samples about an instant (the parabola of three if there are no more). It
never bridges a gap longer than `MAX_GAP` or a jerk that the samples do not resolve, and never extrapolates.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MAX_GAP = 0.15  # s, between samples that are interpolated
EDGE_SHARE = 0.1  # of the samples' spacing: reach beyond the ends of a stretch of samples
EDGE = 5e-3  # s, upper bound of that reach
SLOPE_REACH = 0.1  # s to either side, over which the velocity is fitted
JERK_GATE = 25.0  # squared Mahalanobis distance of a sample from its neighbours' prediction that means a jerk
_APART = 1e5  # s between the tracks in one ascending series of times; longer than any stance


@dataclass(frozen=True, eq=False)
class Interpolated:
    """Linear maps from n samples to m instants.

    Attributes
    ----------
    position
        Map to positions, (m, n).
    derivative
        Exact derivative of `position` by time, (m, n) [1/s].
    slope
        Map to velocities smoothed over `SLOPE_REACH`, (m, n) [1/s].
    valid
        True where the samples allow interpolation, (m,); other rows are meaningless.
    """

    position: sparse.csr_array
    derivative: sparse.csr_array
    slope: sparse.csr_array
    valid: NDArray[np.bool_]


class Samples:
    """Samples of several tracks of one camera.

    Parameters
    ----------
    times
        Ascending times of each track [s].
    x, covariance
        Positions (n, 2) and covariances (n, 2, 2) of each track, in any unit.
    """

    def __init__(self, times: Sequence[Array], x: Sequence[Array], covariance: Sequence[Array]) -> None:
        self.origin = float(min(series[0] for series in times))
        self.x, self.covariance = np.concatenate(x), np.concatenate(covariance)
        self._key = np.concatenate([series - self.origin + _APART * k for k, series in enumerate(times)])
        breaks = np.flatnonzero(np.diff(self._key) > MAX_GAP) + 1
        firsts, ends = np.append(0, breaks), np.append(breaks, len(self._key))
        self._first, self._last = np.repeat(firsts, ends - firsts), np.repeat(ends - 1, ends - firsts)
        self._smooth = self._follows()

    def __len__(self) -> int:
        return len(self.x)

    def at(self, track: Indices, times: Array) -> Interpolated:
        """Interpolate the tracks of index `track` (m,) at `times` (m,) [s]."""
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
        """Slopes (m, n) of lines fitted to the samples about each instant."""
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
        """Mask (n,) of the samples that the cubic through four neighbours predicts within the noise."""
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
    """Columns (m, width) from `start` (m,) on, and a mask of the first `count` (m,) of them."""
    there = np.arange(width) < count[:, None]
    return np.where(there, start[:, None] + np.arange(width), start[:, None]), there


def _sparse(columns: Indices, values: Array, there: NDArray[np.bool_], shape: tuple[int, int]) -> sparse.csr_array:
    pointers = np.concatenate([[0], np.cumsum(there.sum(axis=1))])
    return sparse.csr_array((values[there], columns[there], pointers), shape=shape)


def _lagrange(nodes: Array, t: Array, there: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Lagrange weights (m, k) of values at `nodes` (m, k) for the polynomial at t (m,), and for its derivative."""
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
