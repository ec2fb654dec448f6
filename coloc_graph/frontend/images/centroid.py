"""Measure sub-pixel centres of light spots with their covariance, for many image windows at once.

The centre is the fixed point of a Gaussian window that takes the spot's own shape (adaptive moments; Bernstein
and Jarvis, "Shapes and Shears, Stars and Smears", 2002). For a Gaussian spot this is the matched filter, so it
loses little against the Cramer-Rao bound, and being centred on the spot it has no bias from cut-off tails.

`kernel/spots.c` computes the same, and is changed along with it: `tests/frontend/test_kernel.py` compares them.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from coloc_graph.frontend.compiled import kernel
from coloc_graph.frontend.images.background import without_background
from coloc_graph.frontend.images.sharp_spots import centres_of_mass, sharp_spots

Array = NDArray[np.float64]
Counts = NDArray[np.int64]

MAX_ITERATIONS = 12
CONVERGED = 1e-3  # px, step of the centre below which the search ends
MIN_VARIANCE = 0.25  # px^2, of a spot along its short axis; lens and pixel blur as much
MAX_VARIANCE = 400.0  # px^2, of a spot along its long axis


@dataclass(frozen=True, eq=False)
class Spots:
    """Spots measured in n windows.

    Attributes
    ----------
    centre
        Centres, (n, 2) [px in the window: u, v].
    covariance
        Covariances of the centres, (n, 2, 2) [px^2].
    shape
        Second moments of the spots, (n, 2, 2) [px^2].
    flux
        Sums of their light, (n,) [grey levels].
    signal
        Windows without background, (n, s, s) [grey levels].
    peak
        Brightest light without background of the spots' bright pixels, (n,) [grey levels].
    noise
        Standard deviation of a dark pixel, (n,) [grey levels].
    found
        False where there is no spot to measure, (n,).
    """

    centre: Array
    covariance: Array
    shape: Array
    flux: Array
    signal: Array
    peak: Array
    noise: Array
    found: NDArray[np.bool_]


def measure_spots(
    light: Array,
    size: Counts,
    inner: NDArray[np.bool_],
    levels: float,
    shot_gain: float,
    begin: tuple[Array, Array] | None = None,
) -> Spots:
    """Measure one spot in each window.

    Parameters
    ----------
    light
        Windows, (n, s, s) [grey levels], padded at the right and at the bottom.
    size
        Size of each window without padding, (n, 2) [px: u, v].
    inner
        Bright pixels of the spot, (n, s, s).
    levels
        Bound on the background's deviation from its median [grey levels].
    shot_gain
        Variance that one grey level of light adds to a pixel [grey levels].
    begin
        Initial centres (n, 2) [px] and shapes (n, 2, 2) [px^2]; by default from `inner`.

    Returns
    -------
    Spots
        Centre, covariance and shape of each spot.
    """
    n, side = len(light), light.shape[2]
    if kernel is not None:
        first = None if begin is None else np.concatenate([begin[0], begin[1].reshape(n, 4)], axis=1)
        signal, out, inner = np.empty((n, side, side)), np.empty((n, 14)), np.ascontiguousarray(inner)
        light, size = np.ascontiguousarray(light, np.float64), np.ascontiguousarray(size, np.int64)
        kernel.measure_spots(n, side, light, size, inner, first, signal, out, levels, shot_gain)
        matrix = out[:, 2:10].reshape(n, 2, 2, 2)
        flux, noise, peak, found = out[:, 10:].T
        return Spots(out[:, :2], matrix[:, 0], matrix[:, 1], flux, signal, peak, noise, found > 0)
    signal, noise = without_background(light, size, inner, levels)
    inner_signal = signal * inner
    start = rough_shape(inner)
    # in rows: x and y of centres, xx, xy and yy of shapes, matrices row by row
    if begin is None:
        centre, shape = rough_centre(inner_signal), start.copy()
    else:
        centre, shape = begin[0].T.copy(), begin[1].reshape(n, 4).T[[0, 1, 3]]
    gain, total = np.zeros((4, n)), np.ones(n)
    gain[::3] = 2.0
    going: Counts | None = None
    lit, at, spot, otherwise = signal, centre, shape, start
    for _ in range(MAX_ITERATIONS):
        profiles = _profiles(at, spot, side)
        m = (profiles[1] @ lit @ profiles[0].mT).reshape(-1, 9).T
        flux = m[0]
        m = m / np.maximum(flux, 1e-9)
        shift = m[1::2][:2]
        square = shift * shift
        # the precisions of a Gaussian spot and of a Gaussian window add up: subtract the window's
        spot, more = _unwindowed(m[2:7:4] - square, m[4] - shift[0] * shift[1], spot, otherwise)
        step = more[::3] * shift + more[1:3] * shift[::-1]
        at = at + np.minimum(np.maximum(step, -1.0), 1.0)
        if going is None:
            centre, shape, gain, total = at, spot, more, flux
        else:
            centre[:, going], shape[:, going], gain[:, going], total[going] = at, spot, more, flux
        on = np.abs(step).max(axis=0) >= CONVERGED
        on &= flux > 0
        left = np.count_nonzero(on)
        if not left:
            break
        if left < len(on):
            going = np.flatnonzero(on) if going is None else going[on]
            lit, at, spot, otherwise = lit[on], at[:, on], spot[:, on], otherwise[:, on]

    covariance = _covariances(signal, noise, centre, shape, size, shot_gain)
    gains = gain.T.reshape(n, 2, 2)
    covariance = gains @ covariance @ gains.mT / np.maximum(total * total, 1e-9)[:, None, None]
    sharp, fits = sharp_spots(shape, start)
    if len(sharp):
        mass, own = centres_of_mass(signal[sharp], size[sharp], inner[sharp], noise[sharp], shot_gain)
        centre[:, sharp] = np.where(fits, (centre[:, sharp] + mass) / 2, mass)
        covariance[sharp] = np.where(fits[:, None, None], (covariance[sharp] + own) / 2, own)
    found = (total > 0) & np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(centre).all(axis=0)
    # undo the share of a Gaussian spot that a Gaussian window passes
    xx, xy, yy = shape
    flux = total * np.sqrt((4 * xx * yy - xy * xy) / (xx * yy))
    return Spots(centre.T, covariance, matrices(shape), flux, signal, inner_signal.max(axis=(1, 2)), noise, found)


def _covariances(signal: Array, noise: Array, centre: Array, shape: Array, size: Counts, shot_gain: float) -> Array:
    """Covariances (n, 2, 2) of the first moments of windowed light, from the noise of its pixels."""
    side = signal.shape[2]
    profiles = _profiles(centre, shape, side)
    profiles *= (np.arange(side) < size.T[:, :, None])[:, :, None]
    window, first = profiles[:, :, 0], profiles[:, :, 1]
    squares = np.empty_like(profiles)
    np.multiply(window, window, out=squares[:, :, 0])
    np.multiply(window, first, out=squares[:, :, 1])
    np.multiply(first, first, out=squares[:, :, 2])
    shot = shot_gain * (squares[1] @ np.maximum(signal, 0.0) @ squares[0].mT)
    # every pixel has the dark noise; so has the background, a row (column) of which is the mean of four pixels and
    # errs as a whole
    dark, sums, whole = noise * noise, squares.sum(axis=3), window.sum(axis=2)
    xx, yy = sums[:, :, 2] * (sums[::-1, :, 0] + whole[::-1] ** 2 / 4) * dark
    xy = sums[0, :, 1] * sums[1, :, 1] * dark
    return matrices((xx + shot[:, 0, 2], xy + shot[:, 1, 1], yy + shot[:, 2, 0]))


def matrices(entries: Array | tuple[Array, Array, Array]) -> Array:
    """Symmetric matrices (n, 2, 2) from their entries xx, xy, yy."""
    xx, xy, yy = entries
    out = np.empty((len(xx), 2, 2))
    out[:, 0, 0], out[:, 0, 1], out[:, 1, 0], out[:, 1, 1] = xx, xy, xy, yy
    return out


@cache
def _powers(side: int) -> Array:
    """Powers 0 to 2 of pixel coordinates, (3, side)."""
    return np.arange(side, dtype=float) ** np.arange(3)[:, None]


def rough_centre(light: Array) -> Array:
    """Centroids (2, n) of light (n, s, s)."""
    linear = _powers(light.shape[2])[:2]
    m = linear @ light @ linear.T
    return m[:, [0, 1], [1, 0]].T / np.maximum(m[:, 0, 0], 1e-9)


def rough_shape(inner: NDArray[np.bool_]) -> Array:
    """Second moments (3, n: xx, xy, yy) of spots from their bright pixels (n, s, s)."""
    powers = _powers(inner.shape[2])
    m = (powers @ inner @ powers.T).reshape(-1, 9).T
    x, xx, y, xy, _, yy = m[1:7] / np.maximum(m[0], 1.0)
    # the part of a Gaussian above a third of its peak has half the moments of the whole; one or two pixels have none
    out = np.array([xx - x * x, xy - x * y, yy - y * y])
    out *= 2
    out[::2] += 0.4
    return out


def _profiles(centre: Array, shape: Array, side: int) -> Array:
    """Factors along x and y of separable Gaussian windows, times powers 0 to 2 of the distance, (2, n, 3, side).

    The windows have `centre` (2, n), are as wide as spots of `shape` (3, n: xx, xy, yy), and have the image's axes.
    """
    off = _powers(side)[1] - centre[:, :, None]
    out = np.empty((2, centre.shape[1], 3, side))
    window, first = out[:, :, 0], out[:, :, 1]
    np.multiply(off, off, out=window)
    window *= (-0.5 / shape[::2])[:, :, None]
    np.exp(window, out=window)
    np.multiply(window, off, out=first)
    np.multiply(first, off, out=out[:, :, 2])
    return out


def _unwindowed(squares: Array, xy: Array, window: Array, otherwise: Array) -> tuple[Array, Array]:
    """Moments of spots (3, n: xx, xy, yy) from those seen through a `window`, or `otherwise` if they are no spot's.

    Also returns the gain from a centroid's shift in the window to that of the spot, (4, n), a matrix row by row.

    Parameters
    ----------
    squares, xy
        Moments xx and yy (2, n), and xy (n,), seen through the window.
    window, otherwise
        Moments of the windows, which have their axes along the image's, and of spots, (3, n).

    Notes
    -----
    For the moments S of a spot, C of what is seen, and W of the window: S^-1 = C^-1 - W^-1, and the gain is
    I + S W^-1 = (I - C W^-1)^-1 = S C^-1.
    """
    inverse = 1 / window[::2]
    share = squares * inverse
    less = 1 - share
    cross = xy * inverse
    scale = 1 / (less[0] * less[1] - cross[0] * cross[1])
    spot = np.empty_like(window)
    np.subtract(squares, (squares[0] * squares[1] - xy * xy) * inverse[::-1], out=spot[::2])
    spot[1] = xy
    spot *= scale
    # both variances and the determinant of what exceeds the least spot are positive, and the largest is not reached
    half, apart = (spot[0] + spot[2]) / 2, np.hypot((spot[0] - spot[2]) / 2, spot[1])
    good = half - apart >= MIN_VARIANCE
    good &= half + apart < MAX_VARIANCE
    if not good.all():
        spot = np.where(good, spot, otherwise)
    gain = np.empty((4, len(xy)))
    np.multiply(spot[::2], inverse, out=gain[::3])
    gain[::3] += 1
    np.multiply(spot[1], inverse[::-1], out=gain[1:3])
    return spot, gain


def axes(shape: Array) -> tuple[Array, Array]:
    """Standard deviations along the short and the long axis, (2, n) [px]."""
    xx, xy, yy = shape[:, 0, 0], shape[:, 0, 1], shape[:, 1, 1]
    half, apart = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    short, long = np.sqrt(np.maximum((half - apart, half + apart), 1e-6))
    return short, long


def long_axis(shape: Array) -> Array:
    """Directions (n, 2) of the long axes."""
    angle = np.arctan2(2 * shape[:, 0, 1], shape[:, 0, 0] - shape[:, 1, 1]) / 2
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def at_points(signal: Array, window: Counts, points: Array, size: Counts) -> Array:
    """Interpolate windows (n, h, w) of `size` (n, 2) bilinearly at points (m, 2) [px: u, v] in windows of index (m,).

    Points outside a window are moved to its border.
    """
    points = np.maximum(np.minimum(points, size[window] - 1.001), 0.0)
    corner = points.astype(int)
    j, i = corner.T
    b, a = (points - corner).T
    upper = signal[window, i, j] * (1 - b) + signal[window, i, j + 1] * b
    lower = signal[window, i + 1, j] * (1 - b) + signal[window, i + 1, j + 1] * b
    return np.asarray(upper * (1 - a) + lower * a)
