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
LEAST_VARIANCE = 0.1


@dataclass(frozen=True, eq=False)
class Spots:
    """Spots in n windows: `centre` (n, 2) [px in the window: u, v], `covariance` (n, 2, 2) [px^2].

    `shape` (n, 2, 2) [px^2] are the spot's own second moments, `signal` (n, h, w) the light without background,
    `noise` (n,) that of a pixel [grey levels]. `found` (n,) is False where there is no spot to measure.
    """

    centre: Array
    covariance: Array
    shape: Array
    signal: Array
    noise: Array
    found: NDArray[np.bool_]


def measure_spots(light: Array, inner: NDArray[np.bool_], levels: float, shot_gain: float) -> Spots:
    """Measure one spot a window: `light` (n, h, w) [grey levels], `inner` the pixels that it was found by.

    `levels` bounds how far the background may differ from its median; `shot_gain` is the variance that a grey
    level of light adds to a pixel.
    """
    background, noise = coons_background(light, levels)
    signal = light - background
    n, height, width = light.shape
    x, y = np.arange(width, dtype=float), np.arange(height, dtype=float)

    first = np.where(inner, signal, 0.0)
    total = np.maximum(first.sum(axis=(1, 2)), 1e-9)
    centre = np.stack([(first.sum(axis=1) @ x) / total, (first.sum(axis=2) @ y) / total], axis=1)
    round_shape = np.maximum(inner.sum(axis=(1, 2)) / (2 * np.pi), 0.6)[:, None, None] * np.eye(2)
    shape, found = round_shape.copy(), np.ones(n, bool)
    going = np.arange(n)
    for _ in range(MAX_ITERATIONS):
        w, dx, dy = _window(centre[going], shape[going], x, y)
        ws = w * signal[going]
        total = ws.sum(axis=(1, 2))
        found[going[total <= 0]] = False
        total = np.maximum(total, 1e-9)
        columns, rows = ws.sum(axis=1), ws.sum(axis=2)
        # a Gaussian spot in a window of its own shape: half its shift and half its moments are seen
        step = 2 * np.stack([(columns * dx).sum(-1), (rows * dy).sum(-1)], axis=1) / total[:, None]
        xx, yy = (columns * dx * dx).sum(-1), (rows * dy * dy).sum(-1)
        xy = ((ws @ dx[..., None])[..., 0] * dy).sum(-1)
        seen = 2 * np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2) / total[:, None, None]
        narrow = ~(_least_eigenvalue(seen) >= LEAST_VARIANCE)
        shape[going] = np.where(narrow[:, None, None], round_shape[going], seen)
        centre[going] += np.clip(step, -1.0, 1.0)
        going = going[np.abs(step).max(axis=1) >= CONVERGED]
        if not len(going):
            break

    w, dx, dy = _window(centre, shape, x, y)
    total = np.maximum((w * signal).sum(axis=(1, 2)), 1e-9)
    weight = w * w * (noise[:, None, None] ** 2 + shot_gain * np.maximum(signal, 0.0))
    columns, rows = weight.sum(axis=1), weight.sum(axis=2)
    xx, yy = (columns * dx * dx).sum(-1), (rows * dy * dy).sum(-1)
    xy = ((weight @ dx[..., None])[..., 0] * dy).sum(-1)
    # the background's own noise: a row (column) of it is the mean of four pixels, and off as a whole
    xx += noise**2 / 4 * ((w.sum(axis=1) * dx) ** 2).sum(-1)
    yy += noise**2 / 4 * ((w.sum(axis=2) * dy) ** 2).sum(-1)
    covariance = 4 * np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2) / (total**2)[:, None, None]
    found &= np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(centre).all(axis=1)
    return Spots(centre, covariance, shape, signal, noise, found)


def _window(centre: Array, shape: Array, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Gaussian windows (n, h, w), and the distances dx (n, w), dy (n, h) from their centres."""
    dx, dy = x - centre[:, :1], y - centre[:, 1:]
    a, b, c = shape[:, 0, 0], shape[:, 0, 1], shape[:, 1, 1]
    det = a * c - b * b
    exponent = (-0.5 * c / det)[:, None, None] * (dx * dx)[:, None, :]
    exponent = exponent + (-0.5 * a / det)[:, None, None] * (dy * dy)[:, :, None]
    exponent += (b / det)[:, None, None] * dx[:, None, :] * dy[:, :, None]
    return np.exp(exponent), dx, dy


def _least_eigenvalue(M: Array) -> Array:
    half = (M[:, 0, 0] + M[:, 1, 1]) / 2
    return np.asarray(half - np.hypot((M[:, 0, 0] - M[:, 1, 1]) / 2, M[:, 0, 1]))


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
