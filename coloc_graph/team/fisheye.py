"""Fisheye lens of Kannala and Brandt, as OpenCV's `fisheye` and ROS's `equidistant`: rays to the image and back.

A ray at an angle theta from the optical axis is seen at the radius theta (1 + k1 theta^2 + ... + k4 theta^8), in focal
lengths, however far beyond 90 deg it is.

Source: Kannala and Brandt, "A Generic Camera Model and Calibration Method for Conventional, Wide-Angle, and Fish-Eye
Lenses", 2006.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ANGLES = 2001  # number of angles from 0 to pi by which the lens is inverted and checked
NEWTON_STEPS = 8  # at most; three are usual
INVERTED = 1e-14  # rad, step below which an angle is found


def radius(k: tuple[float, ...], theta: Array) -> Array:
    """Return the radius in the image of rays at angles theta [rad] from the axis, in focal lengths."""
    k1, k2, k3, k4 = k or (0.0,) * 4
    t = theta * theta
    return np.asarray(theta * (1 + t * (k1 + t * (k2 + t * (k3 + t * k4)))))


def radius_derivative(k: tuple[float, ...], theta: Array) -> Array:
    """Return the derivative of `radius` by theta."""
    k1, k2, k3, k4 = k or (0.0,) * 4
    t = theta * theta
    return np.asarray(1 + t * (3 * k1 + t * (5 * k2 + t * (7 * k3 + t * 9 * k4))))


@lru_cache(maxsize=100)
def _table(k: tuple[float, ...]) -> tuple[Array, Array]:
    """Angles and radii up to the angle at which the radius no longer grows."""
    theta = np.linspace(0.0, math.pi, ANGLES)
    grows = radius_derivative(k, theta) > 0
    end = len(theta) if grows.all() else max(int(np.argmin(grows)), 2)
    return theta[:end], radius(k, theta[:end])


def largest_angle(k: tuple[float, ...]) -> float:
    """Return the angle from the axis up to which the radius grows [rad], pi at most."""
    return float(_table(k)[0][-1])


def largest_radius(k: tuple[float, ...]) -> float:
    """Return the radius of rays at the largest angle, in focal lengths: pixels beyond have no ray."""
    return float(_table(k)[1][-1])


def image_of(k: tuple[float, ...], points: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Project points (..., 3) in the camera frame.

    Returns
    -------
    m : (..., 2) float
        Positions in the image, in focal lengths from the principal point; NaN for a point at the optical centre.
    seen : (...) bool
        False for points at angles that the lens folds back.
    """
    x, y, z = np.moveaxis(points, -1, 0)
    r = np.hypot(x, y)
    theta = np.arctan2(r, z)
    with np.errstate(all="ignore"):
        scale = np.where(r > 1e-9 * np.abs(z), radius(k, theta) / r, np.where(z > 0, 1 / z, np.nan))
    seen = (theta <= largest_angle(k)) & np.isfinite(scale)
    return np.stack([x * scale, y * scale], axis=-1), np.asarray(seen)


def rays_of(k: tuple[float, ...], m: Array) -> Array:
    """Return the unit rays (n, 3) of positions (n, 2) in the image [focal lengths]; NaN beyond the largest radius."""
    r = np.hypot(m[:, 0], m[:, 1])
    angles, radii = _table(k)
    theta = np.interp(r, radii, angles)
    for _ in range(NEWTON_STEPS):
        step = (radius(k, theta) - r) / np.maximum(radius_derivative(k, theta), 1e-6)
        theta = np.clip(theta - step, 0.0, angles[-1])
        if not np.abs(step).max(initial=0.0) > INVERTED:
            break
    with np.errstate(all="ignore"):
        across = np.where(r > 1e-12, np.sin(theta) / r, 1.0)
    rays = np.column_stack([m * across[:, None], np.cos(theta)])
    return np.where((r <= radii[-1])[:, None], rays, np.nan)


def derivative(k: tuple[float, ...], points: Array) -> Array:
    """Return the derivative (n, 2, 3) of the positions in the image by points (n, 3) in the camera frame."""
    x, y, z = points.T
    r = np.hypot(x, y)
    square = r * r + z * z
    theta = np.arctan2(r, z)
    on_axis = r < 1e-9 * np.abs(z)
    with np.errstate(all="ignore"):
        u = np.where(on_axis[:, None], (1.0, 0.0), points[:, :2] / np.where(on_axis, 1.0, r)[:, None])
        around = np.where(on_axis, 1 / z, radius(k, theta) / np.where(on_axis, 1.0, r))
    outward = radius_derivative(k, theta) / square
    uu = u[:, :, None] * u[:, None, :]
    out = np.empty((len(points), 2, 3))
    out[:, :, :2] = (outward * z)[:, None, None] * uu + around[:, None, None] * (np.eye(2) - uu)
    out[:, :, 2] = -(outward * r)[:, None] * u
    return out
