"""Subtract the background of light spots from image windows: a Coons patch between the borders of each."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Counts = NDArray[np.int64]


def without_background(light: Array, size: Counts, levels: float) -> tuple[Array, Array]:
    """Subtract the background under spots, a Coons patch.

    Rows and columns are interpolated between the window's borders, two pixels wide, which is exact for any sum of a
    profile in x and one in y. The dark rim of a robot often passes right behind its marker: with a constant background
    that edge biases the centre by 0.04 px.

    Parameters
    ----------
    light, size, levels
        As in `centroid.measure_spots`.

    Returns
    -------
    tuple of numpy.ndarray
        Light less background, (n, s, s), 0 where it is padded, and the standard deviation of a pixel's noise, (n,)
        [grey levels].
    """
    if (size == light.shape[2]).all():
        return _without_coons_patch(light, levels)
    signal, noise = np.zeros_like(light), np.empty(len(light))
    code = size[:, 0] * (light.shape[2] + 1) + size[:, 1]
    for one in np.unique(code).tolist():
        width, height = divmod(one, light.shape[2] + 1)
        rows = np.flatnonzero(code == one)
        signal[rows, :height, :width], noise[rows] = _without_coons_patch(light[rows, :height, :width], levels)
    return signal, noise


@cache
def _border(height: int, width: int) -> tuple[Counts, Counts, Counts, Array, Array]:
    """Border of a window, side after side: left, right, top, bottom.

    Returns the flat indices of its pixels and of those beside them, both (2h + 2w,); where the first three sides end;
    and the weights of top and bottom in each row, (2, h), and of left and right in each column, (2, w).
    """
    pixel = np.arange(height * width).reshape(height, width)
    outer = np.concatenate([pixel[:, 0], pixel[:, -1], pixel[0], pixel[-1]])
    beside = np.concatenate([pixel[:, 1], pixel[:, -2], pixel[1], pixel[-2]])
    ends = np.array([height, 2 * height, 2 * height + width]) - 1
    down, across = np.linspace(0, 1, height), np.linspace(0, 1, width)
    return outer, beside, ends, np.stack([1 - down, down]), np.stack([1 - across, across])


def _without_coons_patch(light: Array, levels: float) -> tuple[Array, Array]:
    """Light less background (n, h, w), and the standard deviation of a pixel's noise (n,)."""
    n, height, width = light.shape
    outer, beside, ends, down, across = _border(height, width)
    flat = light.reshape(n, -1)
    border = flat[:, outer]
    steps = np.abs(np.diff(border, axis=1))
    steps[:, ends] = np.inf
    sides = (border + flat[:, beside]) / 2
    middle = _middle(sides, sides.shape[1])[:, None]
    sides = np.minimum(np.maximum(sides, middle - levels), middle + levels)
    rows, columns = sides[:, : 2 * height].reshape(n, 2, height), sides[:, 2 * height :].reshape(n, 2, width)
    # rows and columns less the corners' share that both contain
    corners = (rows[:, :, :: height - 1] + columns[:, :, :: width - 1].mT) / 2
    signal = light - (rows - corners @ down).mT @ across - down.T @ columns
    noise = 1.4826 / np.sqrt(2) * _middle(steps, steps.shape[1] - len(ends))
    return signal, np.maximum(noise, 12**-0.5)


def _middle(values: Array, count: int) -> Array:
    """Medians (n,) of the `count` least values in each row."""
    ordered = np.sort(values, axis=1)
    return np.asarray((ordered[:, (count - 1) // 2] + ordered[:, count // 2]) / 2)
