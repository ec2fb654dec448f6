"""Subtract the background of light spots from image windows.

The dark rim of a robot often passes right behind its marker: with a constant background that edge biases the centre by
0.04 px. A Coons patch between the borders of a window is exact for any sum of a profile in x and one in y; an edge that
crosses the window aslant, as in the image of a tilted camera or of a fisheye, is a step of its own.

`kernel/spots.c` computes the same, and is changed along with it: `tests/frontend/test_kernel.py` compares them.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Counts = NDArray[np.int64]

STEP_CONTRAST = 4.0  # least height of a step, in standard deviations of a pixel's noise
STEP_SHARE = 8  # a step leaves at least one in this many of the border's pixels on either side
SATURATED = 250.0  # grey level from which a light is saturated
REACH = 2  # px around a spot's bright pixels that its light may reach


def without_background(light: Array, size: Counts, inner: NDArray[np.bool_], levels: float) -> tuple[Array, Array]:
    """Subtract the background under spots.

    Parameters
    ----------
    light, size, inner, levels
        As in `centroid.measure_spots`.

    Returns
    -------
    tuple of numpy.ndarray
        Light less background, (n, s, s), 0 where it is padded, and the standard deviation of a pixel's noise, (n,)
        [grey levels].
    """
    side = light.shape[2]
    if (size == side).all():
        return _subtract(light, inner, levels)
    signal, noise = np.zeros_like(light), np.empty(len(light))
    code = size[:, 0] * (side + 1) + size[:, 1]
    for one in np.unique(code).tolist():
        width, height = divmod(one, side + 1)
        rows = np.flatnonzero(code == one)
        own = light[rows, :height, :width]
        signal[rows, :height, :width], noise[rows] = _subtract(own, inner[rows, :height, :width], levels)
    return signal, noise


def _subtract(light: Array, inner: NDArray[np.bool_], levels: float) -> tuple[Array, Array]:
    """Light less background (n, h, w), and the standard deviation of a pixel's noise (n,)."""
    signal, noise, sides = _without_coons_patch(light, levels)
    rows, step = _steps(sides, noise, light.shape[1:])
    # the halo of a saturated light reaches the border of its window, and is no step
    dim = light[rows].max(axis=(1, 2), initial=0.0) < SATURATED
    rows, step = rows[dim], step[dim]
    if len(rows):
        stepped, without_step, _ = _without_coons_patch(light[rows] - step, levels)
        around = _around(inner[rows])
        better = ((signal[rows] ** 2 - stepped**2) * around).sum(axis=(1, 2)) > 0
        signal[rows[better]], noise[rows[better]] = stepped[better], without_step[better]
    return signal, noise


class _Border(NamedTuple):
    """Border of a window, side after side: left, right, top, bottom.

    Flat indices of its pixels, `outer`, and of those `beside` them, both (2h + 2w,), and where the first three sides
    end; the weights of top and bottom in each row, `down` (2, h), and of left and right in each column, `across`
    (2, w). `ring` (r,) are the border's elements in turn around the window, at `points` (r, 2) [px].
    """

    outer: Counts
    beside: Counts
    ends: Counts
    down: Array
    across: Array
    ring: Counts
    points: Array


@cache
def _border(height: int, width: int) -> _Border:
    pixel = np.arange(height * width).reshape(height, width)
    outer = np.concatenate([pixel[:, 0], pixel[:, -1], pixel[0], pixel[-1]])
    beside = np.concatenate([pixel[:, 1], pixel[:, -2], pixel[1], pixel[-2]])
    down, across = np.linspace(0, 1, height), np.linspace(0, 1, width)
    number = np.arange(len(outer))
    left, right, top, bottom = np.split(number, [height, 2 * height, 2 * height + width])
    ring = np.concatenate([top, right[1:-1], bottom[::-1], left[-2:0:-1]])
    v, u = np.divmod(outer[ring], width)
    points = np.stack([np.clip(u, 0.5, width - 1.5), np.clip(v, 0.5, height - 1.5)], axis=1)
    ends = np.array([left[-1], right[-1], top[-1]])
    return _Border(outer, beside, ends, np.stack([1 - down, down]), np.stack([1 - across, across]), ring, points)


def _without_coons_patch(light: Array, levels: float) -> tuple[Array, Array, Array]:
    """Light less a Coons patch (n, h, w), the standard deviation of a pixel's noise (n,), and the border (n, 2h + 2w).

    The border is two pixels wide, and at most `levels` from its median.
    """
    n, height, width = light.shape
    border = _border(height, width)
    flat = light.reshape(n, -1)
    outer = flat[:, border.outer]
    steps = np.abs(np.diff(outer, axis=1))
    steps[:, border.ends] = np.inf
    sides = (outer + flat[:, border.beside]) / 2
    middle = _middle(sides, sides.shape[1])[:, None]
    sides = np.minimum(np.maximum(sides, middle - levels), middle + levels)
    rows, columns = sides[:, : 2 * height].reshape(n, 2, height), sides[:, 2 * height :].reshape(n, 2, width)
    # rows and columns less the corners' share that both contain
    corners = (rows[:, :, :: height - 1] + columns[:, :, :: width - 1].mT) / 2
    signal = light - (rows - corners @ border.down).mT @ border.across - border.down.T @ columns
    noise = 1.4826 / np.sqrt(2) * _middle(steps, steps.shape[1] - len(border.ends))
    return signal, np.maximum(noise, 12**-0.5), sides


def _steps(sides: Array, noise: Array, shape: tuple[int, ...]) -> tuple[Counts, Array]:
    """Windows, by index (k,), whose border (n, 2h + 2w) is bright in one piece and dark in the rest, and their steps.

    A step (k, h, w) is straight between the two places where the border passes from one to the other.
    """
    rows = np.flatnonzero(sides.max(axis=1) - sides.min(axis=1) > STEP_CONTRAST * noise)
    if not len(rows):
        return rows, np.zeros((0, *shape))
    border = _border(*shape)
    around = sides[rows][:, border.ring]
    ordered = np.sort(around, axis=1)
    share = around.shape[1] // STEP_SHARE
    low, high = ordered[:, share], ordered[:, -1 - share]
    middle = (low + high)[:, None] / 2
    bright = around > middle
    turns = bright != np.roll(bright, -1, axis=1)
    good = (turns.sum(axis=1) == 2) & (high - low > STEP_CONTRAST * noise[rows])
    rows, around, bright, middle, turns = rows[good], around[good], bright[good], middle[good], turns[good]
    if not len(rows):
        return rows, np.zeros((0, *shape))
    at = np.nonzero(turns)[1].reshape(-1, 2)
    after = (at + 1) % around.shape[1]
    each = np.arange(len(rows))[:, None]
    first, second = around[each, at], around[each, after]
    share_of = ((middle - first) / (second - first))[:, :, None]
    ends = border.points[at] * (1 - share_of) + border.points[after] * share_of
    along = ends[:, 1] - ends[:, 0]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.maximum(np.linalg.norm(along, axis=1), 1.0)[:, None]
    offset = (normal * ends[:, 0]).sum(axis=1)[:, None]
    sign = np.where(((normal @ border.points.T - offset) * (bright - 0.5)).sum(axis=1) > 0, 1.0, -1.0)[:, None]
    normal, offset = sign * normal, sign * offset
    count = bright.sum(axis=1)
    level = (around * bright).sum(axis=1) / count
    height = level - (around * ~bright).sum(axis=1) / (around.shape[1] - count)
    v, u = np.arange(shape[0])[:, None], np.arange(shape[1])
    beyond = normal[:, 0, None, None] * u + normal[:, 1, None, None] * v - offset[:, :, None]
    return rows, height[:, None, None] * (np.minimum(np.maximum(beyond + 0.5, 0.0), 1.0))


def _around(inner: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels (n, h, w) that the light of spots with bright pixels `inner` does not reach."""
    reached = []
    for axis in (1, 2):
        lit = np.asarray(inner.any(axis=axis))
        grown = lit.copy()
        for step in range(1, REACH + 1):
            grown[:, step:] |= lit[:, :-step]
            grown[:, :-step] |= lit[:, step:]
        reached.append(grown)
    columns, rows = reached
    return ~(rows[:, :, None] & columns[:, None, :])


def _middle(values: Array, count: int) -> Array:
    """Medians (n,) of the `count` least values in each row."""
    ordered = np.sort(values, axis=1)
    return np.asarray((ordered[:, (count - 1) // 2] + ordered[:, count // 2]) / 2)
