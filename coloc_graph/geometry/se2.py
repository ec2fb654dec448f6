"""Poses on the floor, (x [m], y [m], yaw [rad]), and angles."""

import math
from typing import overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Pose on the floor: x [m], y [m], yaw [rad].
Planar = tuple[float, float, float]


@overload
def wrap(angle: float, period: float = ...) -> float: ...
@overload
def wrap(angle: ArrayLike, period: float = ...) -> NDArray[np.float64]: ...
def wrap(angle: ArrayLike, period: float = math.tau) -> float | NDArray[np.float64]:
    """Bring an angle, or angles (...), to within half a period of 0 [rad]."""
    if isinstance(angle, float):
        return math.remainder(angle, period)
    angles = np.asarray(angle, float)
    return np.asarray(angles - period * np.round(angles / period))


def compose(a: Planar, b: Planar) -> Planar:
    """Compose two poses: `T_world_b = compose(T_world_a, T_a_b)`; the yaw is not wrapped."""
    c, s = math.cos(a[2]), math.sin(a[2])
    return a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], a[2] + b[2]


def inverse(a: Planar) -> Planar:
    """Invert a pose."""
    c, s = math.cos(a[2]), math.sin(a[2])
    return -c * a[0] - s * a[1], s * a[0] - c * a[1], -a[2]


def between(a: Planar, b: Planar) -> Planar:
    """Pose of b in a, both in one frame; the yaw is not wrapped."""
    c, s = math.cos(a[2]), math.sin(a[2])
    x, y = b[0] - a[0], b[1] - a[1]
    return c * x + s * y, -s * x + c * y, b[2] - a[2]
