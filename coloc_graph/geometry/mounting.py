"""Kinematics of a camera's mount: the optical frame in the body, by yaw, tilt and roll.

The camera looks along the body's x axis, then rolls about it, tilts about y (down is positive) and turns about z.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coloc_graph.geometry.lie import rotation_x, rotation_y, rotation_z

Array = NDArray[np.float64]

#: Rotation of an optical frame (z forward, x right, y down) in a body (x forward, y left, z up).
R_BODY_OPTICAL: Array = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def camera_rotation(yaw: ArrayLike, tilt: ArrayLike, roll: ArrayLike) -> Array:
    """Rotations R_body_camera (..., 3, 3) of mounts by their angles (...) [rad]."""
    return np.asarray(rotation_z(yaw) @ rotation_y(tilt) @ (rotation_x(roll) @ R_BODY_OPTICAL))


def tilt_axis(roll: ArrayLike) -> Array:
    """Axes (..., 3), in the camera frame, about which cameras turn when their tilt changes, by roll (...) [rad]."""
    return np.asarray((rotation_x(roll) @ R_BODY_OPTICAL)[..., 1, :])


def roll_axis() -> Array:
    """Axis (3,), in the camera frame, about which a camera turns when its roll changes."""
    return np.asarray(R_BODY_OPTICAL[0])


def tilt_and_roll(up: ArrayLike) -> tuple[float, float]:
    """Tilt and roll [rad] of a camera in whose frame the body's vertical is the unit vector `up` (3,).

    Raises `ValueError` where the camera is upside down.
    """
    # R_body_camera.T @ z is (-sin t, sin r cos t, cos r cos t) in axes of the body
    x, y, z = R_BODY_OPTICAL @ np.asarray(up, float)
    if z <= 0:
        raise ValueError("upside down")
    return math.asin(-x), math.atan2(y, z)
