"""Model of a camera's sensor: `render` draws LEDs as a PS3 Eye would see them, sub-pixel exact.

A field is an image before it is exposed: expected grey levels (height, width), float32, unclipped.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr, ndtri

Array = NDArray[np.float64]
Field = NDArray[np.float32]
Pixels = NDArray[np.uint8]

PSF_REACH = 4.0  # standard deviations of the PSF up to which a spot is drawn: 6e-5 of the light are beyond


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
    return expose(field, sensor or Sensor(), None if rng is None else pixel_noise(rng, field.shape))


def pixel_noise(rng: np.random.Generator, shape: tuple[int, ...]) -> Field:
    """Draw normal noise of variance 1: quantiles of 16-bit numbers, four times as fast as exact ones."""
    numbers = rng.integers(0, 65536, shape, np.uint16)
    return np.asarray(_quantiles().take(numbers, mode="clip"))  # which checks no bounds


@lru_cache(maxsize=1)
def _quantiles() -> Field:
    """Return the quantiles of the normal distribution in the middles of 65536 equal parts, with variance 1."""
    middles = ndtri((np.arange(65536) + 0.5) / 65536)
    return np.asarray(middles / middles.std(), np.float32)


def add_spots(field: Field, lights: Spots) -> None:
    """Add the light of spots to a field, in place.

    Each is a uniform disc, smeared along its motion, seen through a Gaussian PSF and integrated over every
    pixel in closed form: the centroid of its light is its `uv`. Outside the field there is nothing to draw.
    """
    columns = (lights.uv, lights.radius, lights.level, lights.motion, lights.psf_sigma)
    for (u, v), radius, level, motion, sigma in zip(*(column.tolist() for column in columns), strict=True):
        add_spot(field, u, v, radius, level, motion, sigma)


def add_spot(
    field: Field, u: float, v: float, radius: float, level: float, motion: tuple[float, float], sigma: float
) -> None:
    """Add the light of one spot to a field, in place; see `Spots`."""
    if not (radius > 0 and math.isfinite(u) and math.isfinite(v)):
        return
    reach = radius + PSF_REACH * sigma
    left, right = _window(u, reach + abs(motion[0]) / 2, field.shape[1])
    top, bottom = _window(v, reach + abs(motion[1]) / 2, field.shape[0])
    if right <= left or bottom <= top:
        return
    # point sources on a lattice in the disc and along its way, closer together than the PSF is wide
    axis, inside, count = _unit_disc(min(max(math.ceil(2 * radius / sigma) + 2, 4), 24))
    steps = math.ceil(math.hypot(*motion) / (0.5 * sigma)) + 1
    way = ((np.arange(steps) + 0.5) / steps - 0.5)[:, None]
    # how much of each column and of each row of sources lies between the borders of pixels, (steps, lattice, pixels)
    middle = right - left + 1
    borders = np.empty((steps, len(axis), middle + bottom - top + 1))
    lattice = radius * axis[:, None]
    borders[..., :middle] = np.arange(left, right + 1) - (0.5 + u) - (way * motion[0])[:, None] - lattice
    borders[..., middle:] = np.arange(top, bottom + 1) - (0.5 + v) - (way * motion[1])[:, None] - lattice
    borders /= sigma
    ndtr(borders, out=borders)
    share = borders[..., 1:] - borders[..., :-1]
    in_columns, in_rows = inside @ share[..., : middle - 1], share[..., middle:]
    light = level * np.pi * radius**2 / (count * steps)
    rows, columns = in_rows.reshape(-1, bottom - top), in_columns.reshape(-1, right - left)
    field[top:bottom, left:right] += (light * rows.T @ columns).astype(np.float32)


def _window(centre: float, reach: float, size: int) -> tuple[int, int]:
    """First pixel, and one after the last, within reach of a centre [px]."""
    # far outside, a number may be too large to be whole
    if not -reach - 1 < centre < size + reach + 1:
        return 0, 0
    return max(math.floor(centre - reach), 0), min(math.ceil(centre + reach), size - 1) + 1


@lru_cache(maxsize=64)
def _unit_disc(n: int) -> tuple[Array, Array, int]:
    """A lattice of n points across, symmetric about its centre.

    Its axis (n,), which points are in the unit disc, 1 or 0 by row and column (n, n), and how many they are.
    """
    axis = (np.arange(n) + 0.5) / n * 2 - 1
    inside = np.asarray(axis[:, None] ** 2 + axis**2 <= 1, float)
    return axis, inside, int(inside.sum())


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
    if noise is None:
        return np.asarray(np.clip(np.rint(field), 0, 255), np.uint8)
    deviation = np.maximum(field, 0)
    deviation *= np.float32(sensor.shot_gain)
    deviation += np.float32(sensor.read_noise**2)
    np.sqrt(deviation, out=deviation)
    deviation *= noise
    return np.asarray(cv2.add(field, deviation, dtype=cv2.CV_8U))  # rounds, and clips to 0 and 255
