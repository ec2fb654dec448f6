"""Measure sub-pixel centres of light spots with their covariance, for many image windows at once.

The centre is the fixed point of a Gaussian window that takes the spot's own shape (adaptive moments; Bernstein
and Jarvis, "Shapes and Shears, Stars and Smears", 2002). For a Gaussian spot this is the matched filter, so it
loses little against the Cramer-Rao bound, and being centred on the spot it has no bias from cut-off tails.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Counts = NDArray[np.int64]

MAX_ITERATIONS = 12
CONVERGED = 1e-3  # px, step of the centre below which the search ends
MIN_VARIANCE = 0.25  # px^2, of a spot along its short axis; lens and pixel blur as much
MAX_VARIANCE = 400.0  # px^2, of a spot along its long axis
DEBLENDING_ROUNDS = 6  # at most, when several spots of a window are measured in turn
DEBLENDED = 4e-3  # px, step of a centre from round to round below which deblending ends


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
        Windows without background, (n, h, w) [grey levels].
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
    noise: Array
    found: NDArray[np.bool_]


def gaussians(centre: Array, shape: Array, flux: Array, size: tuple[int, ...]) -> Array:
    """Render n Gaussian spots, each in a window of `size` (h, w): (n, h, w) [grey levels]."""
    dx = (np.arange(size[1]) - centre[:, :1])[:, None, :]
    dy = (np.arange(size[0]) - centre[:, 1:])[:, :, None]
    a, b, c = (shape[:, i, j, None, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    det = a * c - b * b
    square = (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / det
    return np.asarray(flux[:, None, None] / (2 * np.pi * np.sqrt(det)) * np.exp(-0.5 * square))


def measure_first(
    light: Array, size: Counts, inner: NDArray[np.bool_], window: Counts, levels: float, shot_gain: float
) -> tuple[Spots, NDArray[np.bool_]]:
    """Measure the first spot of each window, deblending spots that share a window.

    Each of several spots is measured in what remains of the light when Gaussian models of the others are subtracted,
    in turns, until the centres converge.

    Parameters
    ----------
    light
        Windows, (n, h, w) [grey levels], padded at the right and at the bottom.
    size
        Size of each window without padding, (n, 2) [px: u, v].
    inner
        Bright pixels of each of m spots, (m, h, w).
    window
        Index of the window in which each spot lies, (m,), ascending.
    levels, shot_gain
        As in `measure_spots`.

    Returns
    -------
    tuple
        The `Spots`, and a mask (n,) of the windows whose spots overlap too much to converge.
    """
    first = np.flatnonzero(np.diff(window, prepend=-1))
    touching = np.zeros(len(light), bool)
    spots = np.flatnonzero(np.bincount(window)[window] > 1)
    if len(spots):
        window = window[spots]
        centre, shape, models = _rough_models(light[window], size[window], inner[spots])
        others = _of_others(models, window)
        begin, going = None, np.arange(len(spots))
        for _ in range(DEBLENDING_ROUNDS):
            own = window[going]
            found = measure_spots(light[own] - others[going], size[own], inner[spots[going]], levels, shot_gain, begin)
            flux = np.where(found.found, found.flux, 0.0)
            others[going] = _of_others(gaussians(found.centre, found.shape, flux, light.shape[1:]), own)
            moved = np.zeros(len(light))
            np.maximum.at(moved, own, np.abs(found.centre - centre[going]).max(axis=1))
            centre[going], shape[going] = found.centre, found.shape
            going = going[moved[own] >= DEBLENDED]
            if not len(going):
                break
            begin = centre[going], shape[going]
        touching[window[going]] = True
        light = light.copy()
        own = np.flatnonzero(np.isin(spots, first))
        light[window[own]] -= others[own]
    return measure_spots(light, size, inner[first], levels, shot_gain), touching


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
        Windows, (n, h, w) [grey levels], padded at the right and at the bottom.
    size
        Size of each window without padding, (n, 2) [px: u, v].
    inner
        Bright pixels of the spot, (n, h, w).
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
    background, noise = coons_background(light, size, levels)
    signal = light - background
    grid = _Grid.of(size, light.shape[1:])

    start = _rough_shape(inner, grid)
    if begin is None:
        centre, shape = _rough_centre(signal * inner, grid), start.copy()
    else:
        centre, shape = begin[0].copy(), begin[1][:, [0, 0, 1], [0, 1, 1]]
    gain = np.broadcast_to([2.0, 0.0, 0.0, 2.0], (len(light), 4)).copy()
    total = np.ones(len(light))
    going, lit, there = np.arange(len(light)), signal, grid
    for _ in range(MAX_ITERATIONS):
        window = shape[going]
        m = _moments(lit, *_windows(centre[going], window, there))
        flux = m[:, 0, 0]
        scale = 1 / np.maximum(flux, 1e-9)
        x, y = m[:, 0, 1] * scale, m[:, 1, 0] * scale
        seen = m[:, 0, 2] * scale - x * x, m[:, 1, 1] * scale - x * y, m[:, 2, 0] * scale - y * y
        # the precisions of a Gaussian spot and of a Gaussian window add up: subtract the window's
        spot, more = _unwindowed(seen, window, start[going])
        step = np.empty((len(going), 2))
        step[:, 0], step[:, 1] = more[:, 0] * x + more[:, 1] * y, more[:, 2] * x + more[:, 3] * y
        shape[going], gain[going], total[going] = spot, more, flux
        centre[going] += np.minimum(np.maximum(step, -1.0), 1.0)
        on = (np.abs(step).max(axis=1) >= CONVERGED) & (flux > 0)
        if not on.all():
            going = going[on]
            if not len(going):
                break
            lit, there = lit[on], there[on]

    wx, wy, dx, dy = _windows(centre, shape, grid)
    shot = _moments(np.maximum(signal, 0.0), wx * wx, wy * wy, dx, dy)
    # every pixel has the dark noise; so has the background, a row (column) of which is the mean of four pixels and
    # errs as a whole
    square_x, square_y, x2, y2 = wx * wx, wy * wy, (wx * dx) ** 2, (wy * dy) ** 2
    even, dark = (square_x * dx).sum(1) * (square_y * dy).sum(1), noise**2
    xx = x2.sum(1) * (square_y.sum(1) + wy.sum(1) ** 2 / 4) * dark + shot_gain * shot[:, 0, 2]
    yy = y2.sum(1) * (square_x.sum(1) + wx.sum(1) ** 2 / 4) * dark + shot_gain * shot[:, 2, 0]
    xy = even * dark + shot_gain * shot[:, 1, 1]
    gain = gain.reshape(-1, 2, 2)
    covariance = gain @ _matrices(xx, xy, yy) @ gain.mT / np.maximum(total**2, 1e-9)[:, None, None]
    found = (total > 0) & np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(centre).all(axis=1)
    # undo the share of a Gaussian spot that a Gaussian window passes
    a, b, c = shape.T
    flux = total * np.sqrt((4 * a * c - b * b) / (a * c))
    return Spots(centre, covariance, _matrices(a, b, c), flux, signal, noise, found)


@dataclass(frozen=True, eq=False)
class _Grid:
    """Pixel coordinates of windows, `x` (w,) and `y` (h,), and which are not padded, `in_x` (n, w), `in_y` (n, h)."""

    x: Array
    y: Array
    in_x: NDArray[np.bool_]
    in_y: NDArray[np.bool_]

    @classmethod
    def of(cls, size: Counts, shape: tuple[int, ...]) -> "_Grid":
        x, y = np.arange(shape[1], dtype=float), np.arange(shape[0], dtype=float)
        return cls(x, y, x < size[:, :1], y < size[:, 1:])

    def __getitem__(self, which: NDArray[np.bool_]) -> "_Grid":
        return _Grid(self.x, self.y, self.in_x[which], self.in_y[which])


def _of_others(models: Array, window: Counts) -> Array:
    """Sum of the models (m, h, w) of the other spots in each spot's window, given as indices (m,), ascending."""
    begins = np.flatnonzero(np.diff(window, prepend=-1))
    counts = np.diff(begins, append=len(window))
    return np.asarray(np.repeat(np.add.reduceat(models, begins, axis=0), counts, axis=0) - models)


def _rough_models(light: Array, size: Counts, inner: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
    """Approximate centres (m, 2), shapes (m, 2, 2) and light (m, h, w) of spots from their bright pixels."""
    grid = _Grid.of(size, light.shape[1:])
    dark = _median(
        light.reshape(len(light), -1), (grid.in_y[:, :, None] & grid.in_x[:, None, :]).reshape(len(light), -1)
    )
    lit = np.where(inner, light - dark[:, None, None], 0.0)
    shape = _matrices(*_rough_shape(inner, grid).T)
    centre = _rough_centre(lit, grid)
    flux = lit.max(axis=(1, 2)) * 2 * np.pi * np.sqrt(np.linalg.det(shape))
    return centre, shape, gaussians(centre, shape, flux, light.shape[1:])


def _matrices(xx: Array, xy: Array, yy: Array) -> Array:
    """Symmetric matrices (n, 2, 2)."""
    out = np.empty((len(xx), 2, 2))
    out[:, 0, 0], out[:, 0, 1], out[:, 1, 0], out[:, 1, 1] = xx, xy, xy, yy
    return out


def _median(values: Array, real: NDArray[np.bool_]) -> Array:
    """Medians (n,) of the `real` values in each row (n, m), at least one a row."""
    ordered, counts = np.sort(np.where(real, values, np.inf), axis=1), real.sum(axis=1)
    rows = np.arange(len(values))
    return np.asarray((ordered[rows, (counts - 1) // 2] + ordered[rows, counts // 2]) / 2)


def _rough_centre(light: Array, grid: _Grid) -> Array:
    """Centroids (n, 2) of light (n, h, w)."""
    total = np.maximum(light.sum(axis=(1, 2)), 1e-9)
    return np.stack([(light.sum(axis=1) @ grid.x) / total, (light.sum(axis=2) @ grid.y) / total], axis=1)


def _rough_shape(inner: NDArray[np.bool_], grid: _Grid) -> Array:
    """Second moments (n, 3: xx, xy, yy) of spots from their bright pixels (n, h, w)."""
    lit = inner.astype(float)
    area = np.maximum(lit.sum(axis=(1, 2)), 1.0)[:, None]
    dx, dy = grid.x - lit.sum(axis=1) @ grid.x[:, None] / area, grid.y - lit.sum(axis=2) @ grid.y[:, None] / area
    m = _moments(lit, np.ones_like(dx), np.ones_like(dy), dx, dy) / area[:, :, None]
    # the part of a Gaussian above a third of its peak has half the moments of the whole; one or two pixels have none
    return np.asarray(2 * m[:, [0, 1, 2], [2, 1, 0]] + (0.4, 0.0, 0.4))


def _windows(centre: Array, shape: Array, grid: _Grid) -> tuple[Array, Array, Array, Array]:
    """Factors (n, w) and (n, h) of separable Gaussian windows, and the distances from their centres along x and y.

    The windows are as wide as spots of `shape` (n, 3: xx, xy, yy), with axes along the image's.
    """
    dx, dy = grid.x - centre[:, :1], grid.y - centre[:, 1:]
    wx, wy = np.exp(-0.5 / shape[:, :1] * dx * dx), np.exp(-0.5 / shape[:, 2:] * dy * dy)
    return wx * grid.in_x, wy * grid.in_y, dx, dy


def _moments(light: Array, wx: Array, wy: Array, dx: Array, dy: Array) -> Array:
    """Moments (n, 3, 3) of windowed light: [i, j] is the sum over the window of wy dy^i light wx dx^j."""
    in_y, in_x = np.empty((len(wy), 3, wy.shape[1])), np.empty((len(wx), wx.shape[1], 3))
    in_y[:, 0], in_x[:, :, 0] = wy, wx
    np.multiply(wy, dy, out=in_y[:, 1])
    np.multiply(in_y[:, 1], dy, out=in_y[:, 2])
    np.multiply(wx, dx, out=in_x[:, :, 1])
    np.multiply(in_x[:, :, 1], dx, out=in_x[:, :, 2])
    return np.asarray(in_y @ light @ in_x)


def _unwindowed(seen: tuple[Array, Array, Array], window: Array, otherwise: Array) -> tuple[Array, Array]:
    """Moments of a spot (n, 3: xx, xy, yy) from those `seen` through a `window`, or `otherwise` if they are no spot's.

    Also returns the gain from a centroid's shift in the window to that of the spot, (n, 4), a matrix row by row.
    """
    xx, xy, yy = seen
    det = xx * yy - xy * xy
    scale = np.where(det > 1e-6, 1 / np.where(det > 1e-6, det, 1.0), 0.0)
    wx, wy = 1 / window[:, 0], 1 / window[:, 2]
    a, b, c = yy * scale - wx, -xy * scale, xx * scale - wy
    det = a * c - b * b
    scale = np.where(det > 0, 1 / np.where(det > 0, det, 1.0), 0.0)
    spot = np.empty_like(window)
    spot[:, 0], spot[:, 1], spot[:, 2] = c * scale, -b * scale, a * scale
    half, apart = (spot[:, 0] + spot[:, 2]) / 2, np.hypot((spot[:, 0] - spot[:, 2]) / 2, spot[:, 1])
    good = (a > 0) & (det > 0) & (half - apart >= MIN_VARIANCE) & (half + apart < MAX_VARIANCE)
    if not good.all():
        spot = np.where(good[:, None], spot, otherwise)
    gain = np.empty((len(window), 4))
    gain[:, 0], gain[:, 1] = 1 + spot[:, 0] * wx, spot[:, 1] * wy
    gain[:, 2], gain[:, 3] = spot[:, 1] * wx, 1 + spot[:, 2] * wy
    return spot, gain


def axes(shape: Array) -> tuple[Array, Array, Array]:
    """Standard deviations along the short and the long axis, (n,) [px], and the long axis's direction (n, 2)."""
    values, vectors = np.linalg.eigh(shape)
    short, long = np.sqrt(np.maximum(values, 1e-6)).T
    return short, long, vectors[:, :, 1]


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


def coons_background(light: Array, size: Counts, levels: float) -> tuple[Array, Array]:
    """Estimate the background under spots by a Coons patch.

    Rows and columns are interpolated between the window's borders, two pixels wide, which is exact for any sum of a
    profile in x and one in y. The dark rim of a robot often passes right behind its marker: with a constant background
    that edge biases the centre by 0.04 px.

    Parameters
    ----------
    light, size, levels
        As in `measure_spots`.

    Returns
    -------
    tuple of numpy.ndarray
        Background, (n, h, w), and the standard deviation of a pixel's noise, (n,) [grey levels].
    """
    n, height, width = light.shape
    each, end_x, end_y = np.arange(n), size[:, 0] - 1, size[:, 1] - 1
    u, v = np.arange(width), np.arange(height)
    in_x, in_y = u <= end_x[:, None], v <= end_y[:, None]
    outer_left, outer_right = light[:, :, 0], light[each, :, end_x]
    outer_top, outer_bottom = light[:, 0], light[each, end_y]
    sides = [
        (outer_left + light[:, :, 1]) / 2,
        (outer_right + light[each, :, end_x - 1]) / 2,
        (outer_top + light[:, 1]) / 2,
        (outer_bottom + light[each, end_y - 1]) / 2,
    ]
    real = np.concatenate([in_y, in_y, in_x, in_x], axis=1)
    middle = _median(np.concatenate(sides, axis=1), real)[:, None]
    left, right, top, bottom = (np.minimum(np.maximum(side, middle - levels), middle + levels) for side in sides)
    x, y = (u / end_x[:, None])[:, None, :], (v / end_y[:, None])[:, :, None]
    a, b = (left[:, 0] + top[:, 0]) / 2, (right[:, 0] + top[each, end_x]) / 2
    c, d = (left[each, end_y] + bottom[:, 0]) / 2, (right[each, end_y] + bottom[each, end_x]) / 2
    a, b, c, d = (value[:, None, None] for value in (a, b, c, d))
    # rows and columns less the corners' share that both contain
    left, right = left[:, :, None] - a - (c - a) * y, right[:, :, None] - b - (d - b) * y
    background = left + (right - left) * x + top[:, None, :] * (1 - y) + bottom[:, None, :] * y
    steps = [np.abs(np.diff(side, axis=1)) for side in (outer_left, outer_right, outer_top, outer_bottom)]
    real = np.concatenate([in_y[:, 1:], in_y[:, 1:], in_x[:, 1:], in_x[:, 1:]], axis=1)
    noise = 1.4826 / np.sqrt(2) * _median(np.concatenate(steps, axis=1), real)
    return background, np.maximum(noise, 12**-0.5)
