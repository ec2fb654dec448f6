"""What a camera's sensor makes of light: `render` draws LEDs as a PS3 Eye would see them, sub-pixel exact.

A field is an image before it is exposed: expected grey levels (height, width), float32, unclipped.
"""

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

    def spread(value: ArrayLike) -> Array:
        return np.broadcast_to(np.asarray(value, float), (n,))

    moved = np.broadcast_to(np.asarray(motion, float), (n, 2))
    return Spots(uv, spread(radius), spread(level), moved, spread(psf_sigma))


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
    return expose(field, sensor or Sensor(), rng)


def add_spots(field: Field, lights: Spots) -> None:
    """Add the light of spots to a field, in place.

    Each is a uniform disc, smeared along its motion, seen through a Gaussian PSF and integrated over every
    pixel in closed form: the centroid of its light is its `uv`. Outside the field there is nothing to draw.
    """
    for uv, radius, level, motion, sigma in zip(
        lights.uv, lights.radius, lights.level, lights.motion, lights.psf_sigma, strict=True
    ):
        if radius > 0 and np.isfinite(uv).all():
            _add_spot(field, uv, float(radius), float(level), motion, float(sigma))


def _add_spot(field: Field, uv: Array, radius: float, level: float, motion: Array, sigma: float) -> None:
    reach = radius + 5.0 * sigma + np.abs(motion) / 2
    low = np.maximum(np.floor(uv - reach), 0).astype(int)
    high = np.minimum(np.ceil(uv + reach), (field.shape[1] - 1, field.shape[0] - 1)).astype(int)
    if (high < low).any():
        return
    # point sources that stand for the disc and for its way, closer together than the PSF is wide
    disc = radius * _unit_disc(int(np.clip(np.ceil(2 * radius / sigma) + 2, 4, 24)))
    steps = int(np.ceil(np.hypot(*motion) / (0.5 * sigma))) + 1
    way = ((np.arange(steps) + 0.5) / steps - 0.5)[:, None] * motion
    sources = uv + (disc[:, None] + way).reshape(-1, 2)
    columns = np.arange(low[0], high[0] + 2) - 0.5
    rows = np.arange(low[1], high[1] + 2) - 0.5
    in_columns = np.diff(ndtr((columns - sources[:, :1]) / sigma), axis=1)
    in_rows = np.diff(ndtr((rows - sources[:, 1:]) / sigma), axis=1)
    light = level * np.pi * radius**2 / len(sources)
    field[low[1] : high[1] + 1, low[0] : high[0] + 1] += (light * in_rows.T @ in_columns).astype(np.float32)


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


def expose(field: Field, sensor: Sensor, rng: np.random.Generator | None) -> Pixels:
    """The 8-bit image of a field: shot and read noise (none without `rng`), rounded, clipped to 0 and 255."""
    levels = field
    if rng is not None:
        sigma = np.sqrt(np.float32(sensor.read_noise**2) + np.float32(sensor.shot_gain) * np.maximum(field, 0))
        levels = field + sigma * rng.standard_normal(field.shape, dtype=np.float32)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)
