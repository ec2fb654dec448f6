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


def segment_distance(a: ArrayLike, b: ArrayLike, c: ArrayLike, d: ArrayLike) -> float:
    """Least distance between two segments on the floor, from a to b and from c to d (2,) [m]."""
    a, b, c, d = (np.asarray(point, float) for point in (a, b, c, d))
    u, v, w = b - a, d - c, c - a
    cross = u[0] * v[1] - u[1] * v[0]
    if abs(cross) > 1e-12:
        along = (w[0] * v[1] - w[1] * v[0]) / cross, (w[0] * u[1] - w[1] * u[0]) / cross
        if all(0 <= share <= 1 for share in along):
            return 0.0
    return min(_to_segment(a, c, d), _to_segment(b, c, d), _to_segment(c, a, b), _to_segment(d, a, b))


def _to_segment(point: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Distance of a point from the segment from a to b, (2,) each [m]."""
    step = b - a
    share = float(np.clip((point - a) @ step / max(float(step @ step), 1e-12), 0.0, 1.0))
    return float(np.hypot(*(point - a - share * step)))
