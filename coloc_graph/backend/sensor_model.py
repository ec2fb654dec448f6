"""Models of wheel odometry and of range and bearing on the floor, with derivatives, vectorised.

Poses are (x [m], y [m], heading [rad]). Calibration errors are relative to the team's values: of wheels (scale, turn
scale, delay [s]), of ranging (offset [m], scale, bearing [rad], x, y of the sensor [m], depth, offset of robots [m]).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.se2 import Planar
from coloc_graph.measurements import Steps
from coloc_graph.team import Ranging, Wheels

Array = NDArray[np.float64]
Pose = Planar

WHEELS = 3  # number of calibration errors of wheels
RANGING = 7  # number of calibration errors of a range and bearing sensor
STRAIGHT = 1e-6  # rad, turn of a step up to which it is straight
MIN_DEPTH = 0.1  # depth relative to distance: a camera does not see targets beside it


class WheelsModel:
    """Odometry of one robot as a function of its errors (scale, turn scale, delay)."""

    def __init__(self, steps: Steps, wheels: Wheels) -> None:
        self.wheels = wheels
        self._delays, self._twists = steps.delays, steps.twists
        self.covariances = steps.covariances

    def __len__(self) -> int:
        return int(self._twists.shape[1])

    def steps(self, k: NDArray[np.int64] | slice, errors: Array) -> tuple[Array, Array]:
        """Return poses (n, 3) of keyframes k + 1 in k, and their derivatives (n, 3, 3) by the errors."""
        twists, slopes = self._twist(k, self.wheels.delay + float(errors[2]))
        scales = np.array([self.wheels.scale + errors[0]] * 2 + [self.wheels.turn_scale + errors[1]])
        x, y, w = (scales * twists).T
        turns = np.where(np.abs(w) > STRAIGHT, w, 1.0)
        curved = turns == w
        a = np.where(curved, np.sin(turns) / turns, 1.0)
        b = np.where(curved, (1 - np.cos(turns)) / turns, w / 2)
        a_by_w = np.where(curved, (np.cos(turns) - a) / turns, -w / 3)
        b_by_w = np.where(curved, (np.sin(turns) - b) / turns, 0.5)
        steps = np.stack([a * x - b * y, b * x + a * y, w], axis=-1)
        by_twist = np.zeros((len(w), 3, 3))
        by_twist[:, 0, 0], by_twist[:, 0, 1], by_twist[:, 0, 2] = a, -b, a_by_w * x - b_by_w * y
        by_twist[:, 1, 0], by_twist[:, 1, 1], by_twist[:, 1, 2] = b, a, b_by_w * x + a_by_w * y
        by_twist[:, 2, 2] = 1.0
        twist_by_errors = np.zeros((len(w), 3, 3))
        twist_by_errors[:, :2, 0], twist_by_errors[:, 2, 1] = twists[:, :2], twists[:, 2]
        twist_by_errors[:, :, 2] = scales * slopes
        return steps, by_twist @ twist_by_errors

    def step(self, k: int, errors: Array) -> tuple[Pose, Array]:
        """Return the pose of keyframe k + 1 in k, and its derivative (3, 3) by the errors."""
        steps, by_errors = self.steps(slice(k, k + 1), errors)
        x, y, yaw = steps[0].tolist()
        return (x, y, yaw), by_errors[0]

    def _twist(self, k: NDArray[np.int64] | slice, delay: float) -> tuple[Array, Array]:
        """Return the twists of the odometry at a delay, and their derivatives by it."""
        delays, twists = self._delays, self._twists[:, k]
        if len(delays) == 1:
            return twists[0], np.zeros_like(twists[0])
        n = int(np.clip(np.searchsorted(delays, delay, side="right"), 1, len(delays) - 1))
        share = (delay - delays[n - 1]) / (delays[n] - delays[n - 1])
        if not 0 <= share <= 1:  # constant beyond the range of evaluated delays
            return twists[n - 1 if share < 0 else n], np.zeros_like(twists[0])
        slopes = (twists[n] - twists[n - 1]) / (delays[n] - delays[n - 1])
        return twists[n - 1] + (delay - delays[n - 1]) * slopes, slopes


class Expected(NamedTuple):
    """Predicted measurements: `values` (n, 2) of range [m] and bearing [rad], not wrapped.

    With their derivatives by the target's x and y in the body, (n, 2, 2), and by the errors, (n, 2, 7).
    """

    values: Array
    by_xy: Array
    by_errors: Array


class Linearised(NamedTuple):
    """Predicted measurements between poses of the floor: `values` (n, 2) as of `Expected`.

    With their derivatives by the observer's x, y and heading in the world (n, 2, 3), by the target's (n, 2, 3), and by
    the errors of the observer's sensor (n, 2, 7) and of the target's (n, 2, 7), None where no range is two-way.
    """

    values: Array
    by_pose: Array
    by_target: Array
    by_errors: Array
    by_target_errors: Array | None


class Sensors:
    """Range and bearing sensors of a team as functions of their errors; `robots` (n,) are observers by number."""

    def __init__(self, ranging: Sequence[Ranging]) -> None:
        self.ranging = tuple(ranging)

        def column(*names: str) -> Array:
            return np.array([[getattr(one, name) for name in names] for one in ranging], float)

        self._noise = column("range_sigma", "range_sigma_per_m2", "bearing_sigma_deg", "across_sigma")
        self._noise[:, 2] = np.deg2rad(self._noise[:, 2])
        self._stated = column("offset", "scale", "bearing_offset_deg", "x", "y", "depth", "robot_offset")
        self._stated[:, 2] = np.deg2rad(self._stated[:, 2])
        self.tolerances = column(
            *("offset_sigma", "scale_sigma", "bearing_offset_sigma_deg", "place_sigma", "place_sigma"),
            *("depth_sigma", "robot_offset_sigma"),
        )
        self.tolerances[:, 2] = np.deg2rad(self.tolerances[:, 2])
        self.two_way = np.array([one.two_way for one in ranging], bool)
        #: True of the sensors that measure bearings.
        self.has_bearings = np.array([one.has_bearings for one in ranging], bool)

    def sigmas(self, robots: NDArray[np.int64], ranges: Array) -> Array:
        """Return standard deviations (n, 2) of ranges [m] and bearings [rad] at measured `ranges` (n,).

        That of a bearing is infinite where none is measured.
        """
        range_sigma, per_m2, bearing_sigma, across = self._noise[robots].T
        bearing = np.where(self.has_bearings[robots], np.hypot(bearing_sigma, across / ranges), np.inf)
        return np.stack([range_sigma + per_m2 * ranges**2, bearing], axis=-1)

    def expected(self, robots: NDArray[np.int64], xy: Array, errors: Array, of_robot: NDArray[np.bool_]) -> Expected:
        """Predict the measurements of targets at xy (n, 2) in the body, robots or landmarks, with errors (n, 7)."""
        offset, scale, turned, x0, y0, depth, more = (self._stated[robots] + errors).T
        x, y = xy[:, 0] - x0, xy[:, 1] - y0
        distance = np.maximum(np.hypot(x, y), 1e-6)
        bearing = np.arctan2(y, x) + turned
        c, s = np.cos(bearing), np.sin(bearing)
        part = 1 - depth * (1 - c)
        across = -scale * depth * s  # by the bearing, of a metre of distance
        values = np.stack([offset + more * of_robot + scale * distance * part, bearing], axis=-1)
        ux, uy = x / distance, y / distance
        by_xy = np.empty((len(xy), 2, 2))
        by_xy[:, 0, 0], by_xy[:, 0, 1] = scale * part * ux - across * uy, scale * part * uy + across * ux
        by_xy[:, 1, 0], by_xy[:, 1, 1] = -uy / distance, ux / distance
        by_errors = np.zeros((len(xy), 2, RANGING))
        by_errors[:, 0, 0], by_errors[:, 0, 1], by_errors[:, 0, 2] = 1.0, distance * part, across * distance
        by_errors[:, 0, 5], by_errors[:, 0, 6] = -scale * distance * (1 - c), of_robot
        by_errors[:, 1, 2] = 1.0
        by_errors[:, :, 3:5] = -by_xy
        return Expected(values, by_xy, by_errors)

    def between(
        self,
        robots: NDArray[np.int64],
        poses: Array,
        targets: NDArray[np.int64] | None,
        there: Array,
        errors: Array,
        of_robot: NDArray[np.bool_],
    ) -> Linearised:
        """Predict measurements between poses (n, 3) and targets at `there` (n, 3); a landmark's heading is nothing.

        `targets` (n,) are the robots whose antennas are ranged, -1 where a range is that to the origin of a body or to
        a landmark; None where all are. `errors` (robots, 7) are those of all sensors.
        """
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        dx, dy = (there[:, :2] - poses[:, :2]).T
        if targets is not None:
            two_way = targets >= 0
            other = (self._stated[targets] + errors[targets]) * two_way[:, None]
            C, S = np.cos(there[:, 2]), np.sin(there[:, 2])
            ax, ay = C * other[:, 3] - S * other[:, 4], S * other[:, 3] + C * other[:, 4]
            dx, dy = dx + ax, dy + ay
        xy = np.stack([c * dx + s * dy, -s * dx + c * dy], axis=-1)
        expected = self.expected(robots, xy, errors[robots], of_robot)
        by_target, by_pose = np.zeros((len(xy), 2, 3)), np.empty((len(xy), 2, 3))
        by_target[:, :, 0] = c[:, None] * expected.by_xy[:, :, 0] - s[:, None] * expected.by_xy[:, :, 1]
        by_target[:, :, 1] = s[:, None] * expected.by_xy[:, :, 0] + c[:, None] * expected.by_xy[:, :, 1]
        by_pose[:, :, :2] = -by_target[:, :, :2]
        by_pose[:, :, 2] = expected.by_xy[:, :, 0] * xy[:, None, 1] - expected.by_xy[:, :, 1] * xy[:, None, 0]
        if targets is None:
            return Linearised(expected.values, by_pose, by_target, expected.by_errors, None)
        expected.values[:, 0] += other[:, 0]
        by_target[:, :, 2] = by_target[:, :, 1] * ax[:, None] - by_target[:, :, 0] * ay[:, None]
        by_other = np.zeros((len(xy), 2, RANGING))
        by_other[:, 0, 0] = two_way
        by_other[:, :, 3] = (by_target[:, :, 0] * C[:, None] + by_target[:, :, 1] * S[:, None]) * two_way[:, None]
        by_other[:, :, 4] = (by_target[:, :, 1] * C[:, None] - by_target[:, :, 0] * S[:, None]) * two_way[:, None]
        return Linearised(expected.values, by_pose, by_target, expected.by_errors, by_other)

    def distance(self, robot: int, range_: float, target: int | None) -> float:
        """Return the distance [m] that a range says, without calibration errors; `target` is the robot measured."""
        offset, scale, *_, more = self._stated[robot].tolist()
        delay = self._stated[target, 0] if target is not None and self.two_way[robot] else 0.0
        return float((range_ - offset - more * (target is not None) - delay) / scale)

    def antenna(self, robot: int) -> tuple[float, float]:
        """Return the stated position of a robot's sensor on its body [m]."""
        x, y = self._stated[robot, 3:5].tolist()
        return x, y

    def place(self, robot: int, range_: float, bearing: float, of_robot: bool) -> tuple[float, float]:
        """Return the position in the body of a measured target, without calibration errors."""
        offset, scale, turned, x0, y0, depth, more = self._stated[robot].tolist()
        part = max(1 - depth * (1 - math.cos(bearing)), MIN_DEPTH)
        distance = (range_ - offset - more * of_robot) / (scale * part)
        return x0 + distance * math.cos(bearing - turned), y0 + distance * math.sin(bearing - turned)
