"""Model of a camera's sensor: `render` draws LEDs as a PS3 Eye would see them, sub-pixel exact.

A field is an image before it is exposed: expected grey levels (height, width), float32, unclipped.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

Array = NDArray[np.float64]
Field = NDArray[np.float32]
Pixels = NDArray[np.uint8]


@dataclass(frozen=True)
class Sensor:
    """A camera's exposure and noise.

    `exposure` [s] is centred on the time stamp; `led_level` is the grey level that an LED's radiance gives to a
    pixel it fills (about 200 at the peak of a spot 1 m away, saturated with the background when near).
    The variance of a pixel is `read_noise`^2 + `shot_gain` * level.
    """

    exposure: float = 4e-3
    psf_sigma: float = 0.8
    led_level: float = 240.0
    read_noise: float = 2.0
    shot_gain: float = 0.1


@dataclass(frozen=True, eq=False)
class Spots:
    """Bright discs in an image: centres `uv` (n, 2) [px] in the middle of the exposure, `radius` (n,) [px].

    `level` (n,) is the grey level of a filled pixel, `motion` (n, 2) [px] how far the centre moves during the
    exposure, `psf_sigma` (n,) [px] the blur. Arrays of fewer dimensions are spread over all spots.
    """

    uv: Array
    radius: Array
    level: Array
    motion: Array
    psf_sigma: Array


def spots(
    uv: ArrayLike,
    radius: ArrayLike,
    level: ArrayLike,
    motion: ArrayLike = (0.0, 0.0),
    psf_sigma: ArrayLike = 0.8,
) -> Spots:
    """`Spots` of anything that can be spread to their shapes."""
    uv = np.asarray(uv, float).reshape(-1, 2)
    n = len(uv)
    of_all = (np.full(n, value, float) for value in (radius, level, psf_sigma))
    radius, level, psf_sigma = of_all
    return Spots(uv, radius, level, np.full((n, 2), motion, float), psf_sigma)


def render(
    lights: Spots,
    *,
    size: tuple[int, int] = (320, 240),
    background: float | Field = 0.0,
    sensor: Sensor | None = None,
    rng: np.random.Generator | None = None,
) -> Pixels:
    """An 8-bit grey image (height, width) of spots on a background [grey levels]; noise only if there is `rng`.

    `size` is (width, height) [px]. One LED: `render(spots((160.3, 99.8), radius=1.5, level=240))`.
    """
    field = np.empty((size[1], size[0]), np.float32)
    field[:] = background
    add_spots(field, lights)
    noise = None if rng is None else rng.standard_normal(field.shape, dtype=np.float32)
    return expose(field, sensor or Sensor(), noise)


def add_spots(field: Field, lights: Spots) -> None:
    """Add the light of spots to a field, in place.

    Each is a uniform disc, smeared along its motion, seen through a Gaussian PSF and integrated over every
    pixel in closed form: the centroid of its light is its `uv`. Outside the field there is nothing to draw.
    """
    columns = (lights.uv, lights.radius, lights.level, lights.motion, lights.psf_sigma)
    for (u, v), radius, level, motion, sigma in zip(*(column.tolist() for column in columns), strict=True):
        if radius > 0 and math.isfinite(u) and math.isfinite(v):
            _add_spot(field, u, v, radius, level, motion, sigma)


def _add_spot(
    field: Field, u: float, v: float, radius: float, level: float, motion: tuple[float, float], sigma: float
) -> None:
    reach = radius + 5.0 * sigma
    left, right = _window(u, reach + abs(motion[0]) / 2, field.shape[1])
    top, bottom = _window(v, reach + abs(motion[1]) / 2, field.shape[0])
    if right <= left or bottom <= top:
        return
    # point sources that stand for the disc and for its way, closer together than the PSF is wide
    disc = radius * _unit_disc(min(max(math.ceil(2 * radius / sigma) + 2, 4), 24))
    steps = math.ceil(math.hypot(*motion) / (0.5 * sigma)) + 1
    if steps > 1:
        way = ((np.arange(steps) + 0.5) / steps - 0.5)[:, None] * motion
        disc = (disc[:, None] + way).reshape(-1, 2)
    # how much of each source lies between the borders of pixels: of columns, then of rows
    borders = np.empty((len(disc), right - left + bottom - top + 2))
    middle = right - left + 1
    np.subtract(np.arange(left, right + 1) - 0.5, u + disc[:, :1], out=borders[:, :middle])
    np.subtract(np.arange(top, bottom + 1) - 0.5, v + disc[:, 1:], out=borders[:, middle:])
    borders /= sigma
    ndtr(borders, out=borders)
    share = borders[:, 1:] - borders[:, :-1]
    in_columns, in_rows = share[:, : middle - 1], share[:, middle:]
    light = level * np.pi * radius**2 / len(disc)
    field[top:bottom, left:right] += (light * in_rows.T @ in_columns).astype(np.float32)


def _window(centre: float, reach: float, size: int) -> tuple[int, int]:
    """First pixel, and one after the last, within reach of a centre [px]."""
    # far outside, a number may be too large to be whole
    if not -reach - 1 < centre < size + reach + 1:
        return 0, 0
    return max(math.floor(centre - reach), 0), min(math.ceil(centre + reach), size - 1) + 1


@lru_cache(maxsize=64)
def _unit_disc(n: int) -> Array:
    """A lattice of n points across in the unit disc, symmetric about its centre, (m, 2)."""
    axis = (np.arange(n) + 0.5) / n * 2 - 1
    x, y = np.meshgrid(axis, axis)
    inside = x**2 + y**2 <= 1
    return np.column_stack([x[inside], y[inside]])


def fill(field: Field, polygon: ArrayLike, level: float) -> None:
    """Paint a convex polygon (n, 2) [px] over a field at a grey level, in place; its border is smooth."""
    polygon = np.asarray(polygon, float)
    height, width = field.shape
    low = np.clip(np.floor(polygon.min(axis=0)) - 1, 0, (width, height)).astype(int)
    high = np.clip(np.ceil(polygon.max(axis=0)) + 2, 0, (width, height)).astype(int)
    if (high <= low).any():
        return
    mask = np.zeros((high[1] - low[1], high[0] - low[0]), np.uint8)
    corners = np.rint((polygon - low) * 16).astype(np.int32)  # 4 fractional bits
    cv2.fillConvexPoly(mask, corners, 255, lineType=cv2.LINE_AA, shift=4)
    patch = field[low[1] : high[1], low[0] : high[0]]
    patch += (level - patch) * (mask.astype(np.float32) / np.float32(255))


def expose(field: Field, sensor: Sensor, noise: Field | None) -> Pixels:
    """The 8-bit image of a field: shot and read noise, rounded, clipped to 0 and 255.

    `noise` (height, width) is normal with variance 1; without it there is none.
    """
    levels = field.copy()
    if noise is not None:
        sigma = np.maximum(field, 0)
        sigma *= np.float32(sensor.shot_gain)
        sigma += np.float32(sensor.read_noise**2)
        np.sqrt(sigma, out=sigma)
        sigma *= noise
        levels += sigma
    np.rint(levels, out=levels)
    np.clip(levels, 0, 255, out=levels)
    return levels.astype(np.uint8)
