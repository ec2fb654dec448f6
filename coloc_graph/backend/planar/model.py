"""What wheels and a sensor of range and bearing measure of poses on the floor, with derivatives.

Poses are (x [m], y [m], heading [rad]). Calibration errors are what is off what the team states: of wheels (scale, turn
scale, delay [s]), of ranging (offset [m], scale, bearing [rad], x, y of the sensor [m]). In plain floats, since there
are tens of thousands of them.
"""

import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coloc_graph.keyframes import Steps
from coloc_graph.team import Ranging, Wheels

Array = NDArray[np.float64]
Pose = tuple[float, float, float]

#: Nothing is off.
NO_ERRORS, NOTHING_OFF = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0)


def wrapped(angle: float) -> float:
    """The same angle [rad] from -pi to pi."""
    return math.remainder(angle, math.tau)


def compose(a: Pose, b: Pose) -> Pose:
    """The pose of c in the frame of a, of that of b in a and of c in b."""
    c, s = math.cos(a[2]), math.sin(a[2])
    return a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], a[2] + b[2]


def between(a: Pose, b: Pose) -> Pose:
    """The pose of b in a, both in one frame; its heading is not wrapped."""
    c, s = math.cos(a[2]), math.sin(a[2])
    x, y = b[0] - a[0], b[1] - a[1]
    return c * x + s * y, -s * x + c * y, b[2] - a[2]


class WheelsModel:
    """One robot's steps as its wheels say them, which are off by errors (scale, turn scale, delay)."""

    def __init__(self, steps: Steps, wheels: Wheels) -> None:
        self.wheels = wheels
        self._delays = steps.delays.tolist()
        self._twists = steps.twists.transpose(1, 0, 2).tolist()  # of each step, at each delay
        self.covariances = steps.covariances

    def __len__(self) -> int:
        return len(self._twists)

    def step(self, k: int, errors: Sequence[float] | Array) -> tuple[Pose, tuple[Pose, Pose, Pose]]:
        """The pose of keyframe k + 1 in k, and by how much it changes with each error."""
        twist, slope = self._twist(k, self.wheels.delay + errors[2])
        scale, turn_scale = self.wheels.scale + errors[0], self.wheels.turn_scale + errors[1]
        x, y, w = scale * twist[0], scale * twist[1], turn_scale * twist[2]
        if abs(w) > 1e-6:
            sine, cosine = math.sin(w), math.cos(w)
            a, b = sine / w, (1 - cosine) / w
            a_by_w, b_by_w = (cosine - a) / w, (sine - b) / w
        else:
            a, b, a_by_w, b_by_w = 1.0, w / 2, -w / 3, 0.5
        by_w = (a_by_w * x - b_by_w * y, b_by_w * x + a_by_w * y)
        by_scale = (a * twist[0] - b * twist[1], b * twist[0] + a * twist[1], 0.0)
        by_turn = (twist[2] * by_w[0], twist[2] * by_w[1], twist[2])
        dx, dy, dw = scale * slope[0], scale * slope[1], turn_scale * slope[2]
        by_delay = (a * dx - b * dy + by_w[0] * dw, b * dx + a * dy + by_w[1] * dw, dw)
        return (a * x - b * y, b * x + a * y, w), (by_scale, by_turn, by_delay)

    def units(self, errors: Sequence[float] | Array) -> tuple[float, float]:
        """What a metre of the way, and a radian of a turn, are as the wheels say them."""
        return 1 / (self.wheels.scale + errors[0]), 1 / (self.wheels.turn_scale + errors[1])

    def _twist(self, k: int, delay: float) -> tuple[Sequence[float], Sequence[float]]:
        """The twist that odometry says at a delay, and by how much it changes with it."""
        delays, twists = self._delays, self._twists[k]
        if len(delays) == 1:
            return twists[0], NO_ERRORS
        n = min(max(bisect_right(delays, delay), 1), len(delays) - 1)
        before, after = twists[n - 1], twists[n]
        width = delays[n] - delays[n - 1]
        share = (delay - delays[n - 1]) / width
        if not 0 <= share <= 1:  # beyond what was looked at it stays as it is at the end
            return (before if share < 0 else after), NO_ERRORS
        slope = tuple((q - p) / width for p, q in zip(before, after, strict=True))
        return tuple(p + share * (q - p) for p, q in zip(before, after, strict=True)), slope


class Expected(NamedTuple):
    """What a sensor is expected to say: `range` [m], `bearing` [rad], of a `distance` [m]; and by how much both change
    with the target's x and y in the body."""

    range: float
    bearing: float
    distance: float
    range_by_xy: tuple[float, float]
    bearing_by_xy: tuple[float, float]

    def range_by_errors(self) -> tuple[float, ...]:
        """By how much the range changes with each error."""
        return 1.0, self.distance, 0.0, -self.range_by_xy[0], -self.range_by_xy[1]

    def bearing_by_errors(self) -> tuple[float, ...]:
        """By how much the bearing changes with each error."""
        return 0.0, 0.0, 1.0, -self.bearing_by_xy[0], -self.bearing_by_xy[1]


class RangingModel:
    """What a sensor says of a target at a place, which is off by errors (offset, scale, bearing, x, y)."""

    def __init__(self, ranging: Ranging) -> None:
        self.ranging = ranging
        self._bearing = math.radians(ranging.bearing_offset_deg)
        self._bearing_variance = math.radians(ranging.bearing_sigma_deg) ** 2

    def sigmas(self, distance: float) -> tuple[float, float]:
        """Standard deviations of a range [m] and a bearing [rad] that were measured at a distance."""
        one = self.ranging
        return (
            one.range_sigma + one.range_sigma_per_m2 * distance**2,
            math.sqrt(self._bearing_variance + (one.across_sigma / distance) ** 2),
        )

    def expected(self, x: float, y: float, errors: Sequence[float] | Array) -> Expected:
        """What is expected of a target at (x, y) in the body."""
        one = self.ranging
        x, y = x - one.x - errors[3], y - one.y - errors[4]
        distance = max(math.hypot(x, y), 1e-6)
        scale = one.scale + errors[1]
        return Expected(
            one.offset + errors[0] + scale * distance,
            math.atan2(y, x) + self._bearing + errors[2],
            distance,
            (scale * x / distance, scale * y / distance),
            (-y / distance**2, x / distance**2),
        )

    def place(self, range_: float, bearing: float) -> tuple[float, float]:
        """Where in the body a target is that was measured so, if nothing is off."""
        one = self.ranging
        distance, angle = (range_ - one.offset) / one.scale, bearing - self._bearing
        return one.x + distance * math.cos(angle), one.y + distance * math.sin(angle)
