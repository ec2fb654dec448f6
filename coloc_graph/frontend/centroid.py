"""Sub-pixel centres of spots with their covariance, of many windows at once.

The centre is the fixed point of a Gaussian window that takes the spot's own shape (adaptive moments; Bernstein
and Jarvis, "Shapes and Shears, Stars and Smears", 2002). For a Gaussian spot this is the matched filter, so it
loses little against the Cramer-Rao bound, and being centred on the spot it has no bias from cut-off tails.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_ITERATIONS = 12
#: The search ends when centres move by less than this [px].
CONVERGED = 1e-3
#: No spot is narrower than this [px^2]: a lens and a pixel blur as much.
LEAST_VARIANCE = 0.25
#: Several spots in a window are measured in so many turns at most, until none moves by more than this [px].
TURNS, SETTLED = 6, 4e-3
#: Nor wider than this [px^2].
MOST_VARIANCE = 400.0


@dataclass(frozen=True, eq=False)
class Spots:
    """Spots in n windows: `centre` (n, 2) [px in the window: u, v], `covariance` (n, 2, 2) [px^2].

    `shape` (n, 2, 2) [px^2] are the spot's own second moments, `flux` (n,) all its light [grey levels], `signal`
    (n, h, w) the light without background, `noise` (n,) that of a pixel [grey levels]. `found` (n,) is False where
    there is no spot to measure.
    """

    centre: Array
    covariance: Array
    shape: Array
    flux: Array
    signal: Array
    noise: Array
    found: NDArray[np.bool_]


def gaussians(centre: Array, shape: Array, flux: Array, size: tuple[int, ...]) -> Array:
    """The light (n, h, w) of n Gaussian spots in windows of a size (h, w)."""
    dx = (np.arange(size[1]) - centre[:, :1])[:, None, :]
    dy = (np.arange(size[0]) - centre[:, 1:])[:, :, None]
    a, b, c = (shape[:, i, j, None, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    det = a * c - b * b
    square = (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / det
    return np.asarray(flux[:, None, None] / (2 * np.pi * np.sqrt(det)) * np.exp(-0.5 * square))


def measure_first(
    light: Array, inner: NDArray[np.bool_], levels: float, shot_gain: float
) -> tuple[Spots, NDArray[np.bool_]]:
    """Measure the first of k spots a window: `inner` (n, k, h, w) are the pixels that each was found by.

    Each is measured in what the others, as Gaussian spots, leave of the light, in turns. Also says which (n,) are so
    near another that they do not settle. Otherwise as `measure_spots`.
    """
    n, k = inner.shape[:2]
    if k == 1:
        return measure_spots(light, inner[:, 0], levels, shot_gain), np.zeros(n, bool)
    centre, shape, models = _rough_models(light, inner)
    others = models.sum(axis=1, keepdims=True) - models
    begin, going = None, np.arange(n)
    for _ in range(TURNS):
        left = (light[going, None] - others[going]).reshape(-1, *light.shape[1:])
        spots = measure_spots(left, inner[going].reshape(left.shape), levels, shot_gain, begin)
        flux = np.where(spots.found, spots.flux, 0.0)
        models = gaussians(spots.centre, spots.shape, flux, light.shape[1:]).reshape(len(going), *inner.shape[1:])
        others[going] = models.sum(axis=1, keepdims=True) - models
        moved = np.abs(spots.centre.reshape(-1, k, 2) - centre[going]).max(axis=(1, 2))
        centre[going], shape[going] = spots.centre.reshape(-1, k, 2), spots.shape.reshape(-1, k, 2, 2)
        going = going[moved >= SETTLED]
        if not len(going):
            break
        begin = centre[going].reshape(-1, 2), shape[going].reshape(-1, 2, 2)
    first = measure_spots(light - others[:, 0], inner[:, 0], levels, shot_gain)
    touching = np.zeros(n, bool)
    touching[going] = True
    return first, touching


def measure_spots(
    light: Array,
    inner: NDArray[np.bool_],
    levels: float,
    shot_gain: float,
    begin: tuple[Array, Array] | None = None,
) -> Spots:
    """Measure one spot a window: `light` (n, h, w) [grey levels], `inner` the pixels that it was found by.

    `levels` bounds how far the background may differ from its median; `shot_gain` is the variance that a grey
    level of light adds to a pixel. The search may `begin` with centres (n, 2) and shapes (n, 2, 2) that are nearly
    right.
    """
    background, noise = coons_background(light, levels)
    signal = light - background
    n, height, width = light.shape
    x, y = np.arange(width, dtype=float), np.arange(height, dtype=float)

    start = _rough_shape(inner, x, y)
    centre, shape = (_rough_centre(signal * inner, x, y), start.copy()) if begin is None else begin
    found = np.ones(n, bool)
    gain = np.broadcast_to(2 * np.eye(2), (n, 2, 2)).copy()
    total = np.ones(n)
    going = np.arange(n)
    for _ in range(MAX_ITERATIONS):
        window = shape[going][:, [0, 1], [0, 1]]
        moments = _moments(signal[going], *_windows(centre[going], window, x, y))
        total[going] = moments[:, 0, 0]
        inside = np.maximum(moments[:, 0, 0], 1e-9)
        mean = np.stack([moments[:, 0, 1], moments[:, 1, 0]], axis=1) / inside[:, None]
        spread = np.stack([moments[:, 0, 2], moments[:, 1, 1], moments[:, 1, 1], moments[:, 2, 0]], axis=1)
        seen = (spread / inside[:, None]).reshape(-1, 2, 2) - mean[:, :, None] * mean[:, None, :]
        # of a Gaussian spot in a Gaussian window their precisions add up, and so what is seen is undone
        shape[going], gain[going] = _undone(seen, window, start[going])
        step = (gain[going] @ mean[:, :, None])[:, :, 0]
        centre[going] += np.clip(step, -1.0, 1.0)
        going = going[(np.abs(step).max(axis=1) >= CONVERGED) & (total[going] > 0)]
        if not len(going):
            break

    wx, wy, dx, dy = _windows(centre, shape[:, [0, 1], [0, 1]], x, y)
    shot = _moments(np.maximum(signal, 0.0), wx * wx, wy * wy, dx, dy)
    even = _moments(np.ones((1, height, width)), wx * wx, wy * wy, dx, dy)
    variance = (noise**2)[:, None, None] * even + shot_gain * shot
    # the background's own noise: a row (column) of it is the mean of four pixels, and off as a whole
    xx = variance[:, 0, 2] + noise**2 / 4 * wy.sum(1) ** 2 * ((wx * dx) ** 2).sum(1)
    yy = variance[:, 2, 0] + noise**2 / 4 * wx.sum(1) ** 2 * ((wy * dy) ** 2).sum(1)
    of_mean = np.stack([xx, variance[:, 1, 1], variance[:, 1, 1], yy], axis=1).reshape(-1, 2, 2)
    covariance = gain @ of_mean @ gain.mT / np.maximum(total**2, 1e-9)[:, None, None]
    found &= (total > 0) & np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(centre).all(axis=1)
    # what a Gaussian window lets through of a Gaussian spot
    window = shape[:, [0, 1], [0, 1]]
    both = (shape[:, 0, 0] + window[:, 0]) * (shape[:, 1, 1] + window[:, 1]) - shape[:, 0, 1] ** 2
    flux = total * np.sqrt(both / window.prod(axis=1))
    return Spots(centre, covariance, shape, flux, signal, noise, found)


def _rough_models(light: Array, inner: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
    """Centres (n, k, 2), shapes (n, k, 2, 2) and light (n, k, h, w) of spots, roughly, by their bright pixels."""
    n, k, height, width = inner.shape
    x, y = np.arange(width, dtype=float), np.arange(height, dtype=float)
    dark = np.nanmedian(np.where(inner.any(axis=1), np.nan, light), axis=(1, 2))
    lit = np.where(inner, (light - dark[:, None, None])[:, None], 0.0).reshape(-1, height, width)
    centre, shape = _rough_centre(lit, x, y), _rough_shape(inner.reshape(lit.shape), x, y)
    flux = lit.max(axis=(1, 2)) * 2 * np.pi * np.sqrt(np.linalg.det(shape))
    models = gaussians(centre, shape, flux, (height, width))
    return centre.reshape(n, k, 2), shape.reshape(n, k, 2, 2), models.reshape(inner.shape)


def _rough_centre(light: Array, x: Array, y: Array) -> Array:
    """The centroids (n, 2) of light (n, h, w)."""
    total = np.maximum(light.sum(axis=(1, 2)), 1e-9)
    return np.stack([(light.sum(axis=1) @ x) / total, (light.sum(axis=2) @ y) / total], axis=1)


def _rough_shape(inner: NDArray[np.bool_], x: Array, y: Array) -> Array:
    """Second moments (n, 2, 2) of the spots that these pixels are the bright part of."""
    lit = inner.astype(float)
    area = np.maximum(lit.sum(axis=(1, 2)), 1.0)[:, None]
    dx, dy = x - lit.sum(axis=1) @ x[:, None] / area, y - lit.sum(axis=2) @ y[:, None] / area
    m = _moments(lit, np.ones_like(dx), np.ones_like(dy), dx, dy) / area[:, :, None]
    moments = np.stack([m[:, 0, 2], m[:, 1, 1], m[:, 1, 1], m[:, 2, 0]], axis=1).reshape(-1, 2, 2)
    # the part of a Gaussian above a third of its peak has half the moments of the whole; one or two pixels have none
    return np.asarray(2 * moments + 0.4 * np.eye(2))


def _windows(centre: Array, variances: Array, x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """A Gaussian window's factors (n, w) and (n, h), and the distances from its centre along x and y.

    Its axes are the image's: it is then a product, and moments are two small matrix products.
    """
    dx, dy = x - centre[:, :1], y - centre[:, 1:]
    return np.exp(-0.5 / variances[:, :1] * dx * dx), np.exp(-0.5 / variances[:, 1:] * dy * dy), dx, dy


def _moments(light: Array, wx: Array, wy: Array, dx: Array, dy: Array) -> Array:
    """Moments (n, 3, 3) of windowed light: [i, j] is the sum over the window of wy dy^i light wx dx^j."""
    in_y = np.stack([wy, wy * dy, wy * dy * dy], axis=1)
    in_x = np.stack([wx, wx * dx, wx * dx * dx], axis=2)
    return np.asarray(in_y @ light @ in_x)


def _undone(seen: Array, window: Array, otherwise: Array) -> tuple[Array, Array]:
    """A spot's own moments (n, 2, 2) from those seen through a window with variances (n, 2), and by how much a
    shift of the spot is more than is seen of it (n, 2, 2); `otherwise` where the moments are no spot's."""
    det = seen[:, 0, 0] * seen[:, 1, 1] - seen[:, 0, 1] ** 2
    det = np.where(det > 1e-6, det, np.inf)
    a, c = seen[:, 1, 1] / det - 1 / window[:, 0], seen[:, 0, 0] / det - 1 / window[:, 1]
    b = -seen[:, 0, 1] / det
    det = a * c - b * b
    spot = np.stack([c, -b, -b, a], axis=1).reshape(-1, 2, 2) / np.where(det > 0, det, np.inf)[:, None, None]
    half, apart = (spot[:, 0, 0] + spot[:, 1, 1]) / 2, np.hypot((spot[:, 0, 0] - spot[:, 1, 1]) / 2, spot[:, 0, 1])
    good = (a > 0) & (det > 0) & (half - apart >= LEAST_VARIANCE) & (half + apart < MOST_VARIANCE)
    shape = np.where(good[:, None, None], spot, otherwise)
    return shape, np.eye(2) + shape / window[:, None, :]


def axes(shape: Array) -> tuple[Array, Array, Array]:
    """Lengths of the short and the long half axis (n,) [px], and the long one's direction (n, 2)."""
    values, vectors = np.linalg.eigh(shape)
    short, long = np.sqrt(np.maximum(values, 1e-6)).T
    return short, long, vectors[:, :, 1]


def at_points(signal: Array, points: Array) -> Array:
    """Bilinear values (n,) of windows (n, h, w) at points (n, 2) [px: u, v], held inside."""
    height, width = signal.shape[1:]
    u = np.clip(points[:, 0], 0, width - 1.001)
    v = np.clip(points[:, 1], 0, height - 1.001)
    i, j, n = v.astype(int), u.astype(int), np.arange(len(points))
    a, b = v - i, u - j
    upper = signal[n, i, j] * (1 - b) + signal[n, i, j + 1] * b
    lower = signal[n, i + 1, j] * (1 - b) + signal[n, i + 1, j + 1] * b
    return np.asarray(upper * (1 - a) + lower * a)


def coons_background(light: Array, levels: float) -> tuple[Array, Array]:
    """The light (n, h, w) that would be there without the spot, and the noise (n,) of a pixel [grey levels].

    Between the window's borders (two pixels wide) rows and columns are interpolated (a Coons patch), which is
    exact for whatever is a sum of a profile in x and one in y. A marker stands on a robot whose dark rim often
    passes right behind it: with a constant background that edge pulls the centre by 0.04 px.
    """
    left, right = light[:, :, :2].mean(axis=2), light[:, :, -2:].mean(axis=2)
    top, bottom = light[:, :2].mean(axis=1), light[:, -2:].mean(axis=1)
    middle = np.median(np.concatenate([left, right, top, bottom], axis=1), axis=1)[:, None]
    left, right, top, bottom = (np.clip(side, middle - levels, middle + levels) for side in (left, right, top, bottom))
    x = np.linspace(0, 1, light.shape[2])
    y = np.linspace(0, 1, light.shape[1])[:, None]
    rows = left[:, :, None] * (1 - x) + right[:, :, None] * x
    columns = top[:, None, :] * (1 - y) + bottom[:, None, :] * y
    corner = [(left[:, 0] + top[:, 0]) / 2, (right[:, 0] + top[:, -1]) / 2]
    corner += [(left[:, -1] + bottom[:, 0]) / 2, (right[:, -1] + bottom[:, -1]) / 2]
    a, b, c, d = (value[:, None, None] for value in corner)
    corners = (1 - y) * (a * (1 - x) + b * x) + y * (c * (1 - x) + d * x)
    along = [np.diff(light[:, [0, -1]], axis=2), np.diff(light[:, :, [0, -1]], axis=1)]
    steps = np.concatenate([np.abs(part).reshape(len(light), -1) for part in along], axis=1)
    noise = 1.4826 / np.sqrt(2) * np.median(steps, axis=1)
    return rows + columns - corners, np.maximum(noise, 12**-0.5)
