"""Offset of two clocks up to seconds, from one motion that both saw: a search without an initial value.

A marker drives on a plane, so that one homography takes its path in one image to its path in the other, or the path
that wheels measured to the path in an image. At a wrong offset no homography does, unless the motion repeats itself in
time. The likelihood of the offset, with the homography and the noise eliminated, tells its value and its sigma.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from coloc_graph.frontend.pairing.clock_offset import ClockOffset

Array = NDArray[np.float64]

REACH = 5.0  # offsets are searched up to this [s]
COARSE_STEP = 0.08  # in steps of this [s]
FINE_STEP = 0.004  # then about the best in steps of this [s]
MAX_GAP = 0.5  # samples further apart are not interpolated [s]
MAX_POINTS = 160  # points of a path that are compared, at most
MAX_COARSE_POINTS = 60  # and in the first search
MIN_POINTS = 20  # points that tell an offset
MIN_OVERLAP = 0.6  # share of the points that both saw, of the most at any offset
CLEAR = 16.0  # twice the log-likelihood by which the best offset exceeds those further off than `BASIN`
BASIN = 0.2  # half width of the neighbourhood of the best offset [s]
INDEPENDENT = 0.25  # share of the points that count: neighbours err alike
ROUNDS = 3  # rounds of robust weights
OUTLIER = 3.0  # residuals beyond this, in robust sigmas, count no more
INLIER_SHARE = 0.8  # share of points whose residuals state the noise; the rest may be outliers
INLIER_CHI2 = -2 * math.log(1 - INLIER_SHARE)  # quantile of chi2 of two degrees of freedom at that share
MIN_SIGMA = 2e-3  # an offset is known no better [s]


@dataclass(frozen=True, eq=False)
class TimedPath:
    """Positions `xy` (n, 2) of one marker at ascending `times` (n,) [s] of one clock, in any plane coordinates."""

    times: Array
    xy: Array

    def shared(self, other: "TimedPath", offset: float) -> "TimedPath":
        """Return the positions at whose times, and an offset [s], another path has positions, too."""
        which = np.flatnonzero(np.isfinite(other.at(self.times + offset)).all(axis=-1))
        return TimedPath(self.times[which], self.xy[which])

    def at(self, times: Array) -> Array:
        """Interpolated positions (..., 2); NaN where no samples are near."""
        found = np.full((*times.shape, 2), np.nan)
        cuts = np.flatnonzero(np.diff(self.times) > MAX_GAP) + 1
        for t, xy in zip(np.split(self.times, cuts), np.split(self.xy, cuts), strict=True):
            if len(t) >= 4:
                inside = (times >= t[0]) & (times <= t[-1])
                found[inside] = CubicSpline(t, xy)(times[inside])
        return found


def search_offset(
    pairs: Sequence[tuple[TimedPath, TimedPath]], reach: float = REACH, max_residual: float = np.inf
) -> ClockOffset | None:
    """Search for the offset clock_j - clock_i at which one homography explains all pairs of paths.

    Parameters
    ----------
    pairs : sequence of (TimedPath, TimedPath)
        The same markers' paths by clocks i and j.
    reach : float
        Largest offset that is looked for [s].
    max_residual : float
        Robust standard deviation of the second paths about the first that an offset may leave, in their coordinates.

    Returns
    -------
    ClockOffset or None
        None where no offset is clearly better than all others, or none explains the paths.
    """
    pairs = [(a, b) for a, b in pairs if len(a.times) >= 4 and len(b.times) >= 4]
    total = _count(pairs)
    if total < MIN_POINTS:
        return None
    spread = np.concatenate([b.xy for _, b in pairs])
    middle, unit = spread.mean(axis=0), max(float(spread.std()), 1e-12)

    def cost(pairs: Sequence[tuple[TimedPath, TimedPath]], offsets: Array, points: int) -> Array:
        count = _count(pairs)
        every = max(1, -(-count // points))
        times = [a.times[::every] for a, _ in pairs]
        x = _scaled(np.concatenate([a.xy[::every] for a, _ in pairs]))
        y = np.concatenate([b.at(t[None] + offsets[:, None]) for t, (_, b) in zip(times, pairs, strict=True)], axis=1)
        return _weight(count) * _log_variance(x, (y - middle) / unit)

    steps = round(reach / COARSE_STEP)
    offsets = np.asarray(COARSE_STEP * np.arange(-steps, steps + 1), float)
    coarse = cost(pairs, offsets, MAX_COARSE_POINTS)
    if not np.isfinite(coarse).any():
        return None
    best = float(offsets[np.nanargmin(coarse)])
    near = np.asarray(best + FINE_STEP * np.arange(-15, 16), float)
    fine = cost(pairs, near, MAX_POINTS)
    k = int(np.nanargmin(fine))
    if k in (0, len(near) - 1) or not np.isfinite(fine[k - 1 : k + 2]).all():
        return None
    further = np.abs(offsets - near[k]) > BASIN
    # it may be best only because points that are explained worse, such as near ones, are not compared there: it is to
    # be clearly the best among the points that both saw at this offset, too
    shared = [(a.shared(b, float(near[k])), b) for a, b in pairs]
    if not _is_clear(fine[k], coarse[further]) or not _is_clear(
        cost(shared, near[k : k + 1], MAX_POINTS)[0], cost(shared, offsets[further], MAX_COARSE_POINTS)
    ):
        return None
    if unit * np.exp(fine[k] / (2 * _weight(total))) > max_residual:
        return None
    low, here, high = fine[k - 1 : k + 2]
    curvature = low + high - 2 * here
    if curvature <= 0:
        return None
    value = float(near[k] + FINE_STEP * 0.5 * (low - high) / curvature)
    return ClockOffset(value, max(float(FINE_STEP * np.sqrt(2 / curvature)), MIN_SIGMA))


def _is_clear(best: float, others: Array) -> bool:
    """Return whether the cost of the best offset is clearly less than that of others, of which some are known."""
    return bool(np.isfinite(others).any() and float(np.nanmin(others)) - best >= CLEAR)


def _count(pairs: Sequence[tuple[TimedPath, TimedPath]]) -> int:
    """Return the number of points of the first paths."""
    return sum(len(a.times) for a, _ in pairs)


def _weight(count: int) -> float:
    """Return the weight of a log-variance of `count` points: neighbours err alike, so that not all of them count."""
    return INDEPENDENT * (2 * min(count, MAX_POINTS) - 9)


def _scaled(x: Array) -> Array:
    return np.asarray((x - x.mean(axis=0)) / max(float(x.std()), 1e-12))


def _log_variance(x: Array, y: Array) -> Array:
    """Logarithm of the variance (m,) of y (m, n, 2) about the best homography of x (n, 2), by offset.

    NaN in y is unseen; NaN is returned where too few points are seen.
    """
    seen = np.asarray(np.isfinite(y).all(axis=-1), bool)
    counts = seen.sum(axis=1)
    found = np.full(len(y), np.nan)
    enough = np.flatnonzero((counts >= MIN_POINTS) & (counts >= MIN_OVERLAP * counts.max(initial=0)))
    if not len(enough):
        return found
    seen, counts = np.asarray(seen[enough], bool), counts[enough]
    y = np.where(seen[..., None], y[enough], 0.0)
    x1 = np.concatenate([x, np.ones((len(x), 1))], axis=1)
    rows = np.zeros((*y.shape, 9))
    rows[..., 0, :3] = rows[..., 1, 3:6] = x1
    rows[..., 6:] = -y[..., None] * x1[:, None]
    flat, weights = rows.reshape(len(rows), -1, 9), seen.astype(float)
    for _ in range(ROUNDS):
        normal = (flat * np.repeat(weights, 2, axis=1)[..., None]).swapaxes(1, 2) @ flat
        H = np.linalg.eigh(normal)[1][..., 0].reshape(-1, 3, 3)
        p = x1 @ H.swapaxes(1, 2)
        with np.errstate(all="ignore"):
            off = np.nan_to_num(y - p[..., :2] / p[..., 2:], nan=1e3, posinf=1e3, neginf=-1e3)
        squared = np.minimum((off**2).sum(axis=-1), 1e6)
        # of most points, not of half: a homography fits half of a path at nearly any offset
        scale = _quantiles(np.where(seen, squared, np.inf), counts, INLIER_SHARE) / INLIER_CHI2 + 1e-12
        depth = np.abs(p[..., 2]) / np.maximum(np.median(np.abs(p[..., 2]), axis=1, keepdims=True), 1e-12)
        robust = 1 / (1 + squared / (OUTLIER**2 * scale[:, None]))
        weights = seen * robust**2 / np.maximum(depth**2, 1e-2)
    bounded = np.minimum(squared, OUTLIER**2 * scale[:, None])
    variance = (bounded * seen).sum(axis=1) / (2 * counts)
    # offsets with fewer points have less to explain: compared by the mean
    found[enough] = np.log(variance + 1e-12)
    return found


def _quantiles(values: Array, counts: NDArray[np.int64], share: float) -> Array:
    """Quantile (m,) of the finite values, `counts` (m,) of them, in each row (m, n); the others are infinite."""
    ordered, rows, at = np.sort(values, axis=1), np.arange(len(values)), share * (counts - 1)
    below = np.floor(at).astype(np.int64)
    low, high = ordered[rows, below], ordered[rows, np.minimum(below + 1, counts - 1)]
    return np.asarray(low + (at - below) * (high - low))
