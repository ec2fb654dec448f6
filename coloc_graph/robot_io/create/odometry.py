"""Odometry of a Create: from encoder counts to pose increments with covariances.

A Create 2 has encoders that count on and wrap. A Create 1 only reports distance and angle since the last request, in
whole millimetres and degrees, and loses the remainder (AutonomyLab/create_robot#28: requested every 15 ms, a turn
slower than 67 deg/s reads as 0). It is therefore asked seldom, and in between its requested speeds are integrated.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import copysign, cos, hypot, pi, radians, sin

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.se2 import compose, wrap
from coloc_graph.robot_io.create.protocol import MAX_WHEEL_SPEED, Packet
from coloc_graph.run.messages import OdometrySample

Array = NDArray[np.float64]

SLIP = 0.008  # m, standard deviation of a wheel's slip after one metre, growing with the root of the distance
ENCODER = 0.006  # m, the same of the encoder's noise
FLOOR_METRES = 1e-5  # m, least standard deviation of an increment's position
FLOOR_RADIANS = 1e-5  # rad, least standard deviation of an increment's heading
REQUEST_SHARE = 0.03  # standard deviation of a Create 1's speed, as a fraction of the requested one
REQUEST_LATE = 0.05  # s, delay with which a Create 1 takes a requested speed
LATE = 0.1  # s between two frames above which the second one was held up
HELD_UP = 1.0  # s after such a gap during which further frames may have been held up too


@dataclass(frozen=True)
class Wheels:
    """Dimensions of a model: wheel `base` [m], distance a tick `metres` [m], `baud` rate of its serial line."""

    base: float
    metres: float
    baud: int


WHEELS = {1: Wheels(0.258, 1e-3, 57600), 2: Wheels(0.235, pi * 0.072 / 508.8, 115200)}


def ticks_between(before: int, after: int) -> int:
    """Difference of two readings of a uint16 counter, the short way round: -32768 to 32767."""
    return (after - before + 0x8000) % 0x10000 - 0x8000


def arc(left: float, right: float, base: float) -> tuple[float, float, float]:
    """Pose increment (x [m], y [m], yaw [rad], start's body frame) of wheels that rolled `left` and `right` [m]."""
    forward, turned = (left + right) / 2, (right - left) / base
    chord = forward * (sin(turned / 2) / (turned / 2) if abs(turned) > 1e-9 else 1.0)
    return chord * cos(turned / 2), chord * sin(turned / 2), turned


def arc_covariance(left: float, right: float, base: float) -> Array:
    """Covariance (3, 3) of `arc`, with independent errors `SLIP` and `ENCODER` of each wheel."""
    if not (left or right):
        return np.zeros((3, 3))
    per_metre = SLIP**2 + ENCODER**2
    var_left, var_right = per_metre * abs(left), per_metre * abs(right)
    forward, turned = (left + right) / 2, (right - left) / base
    c, s = cos(turned / 2), sin(turned / 2)
    chord = s / (turned / 2) if abs(turned) > 1e-6 else 1.0
    shrinks = (c - chord) / turned if abs(turned) > 1e-6 else 0.0
    # columns: forward, turned
    J = np.array([
        [chord * c, forward * (shrinks * c - chord * s / 2)],
        [chord * s, forward * (shrinks * s + chord * c / 2)],
        [0.0, 1.0],
    ])  # fmt: skip
    W = np.array([[0.5, 0.5], [-1 / base, 1 / base]])  # of left, right
    A = J @ W
    covariance: Array = A @ np.diag([var_left, var_right]) @ A.T
    return covariance


class Odometer:
    """Sums increments to samples: one every `period` while moving, one every `REST` while standing.

    The pose is in the odometry frame, the body at the first increment. A sample is closed before a movement begins, so
    that interpolation between samples shows the robot standing until then. No sample ends within a gap.

    Parameters
    ----------
    robot
        Name of the robot.
    period
        Time between two samples while moving [s].
    late
        Time between two increments from which it is a gap [s].
    """

    REST = 1.0  # s between two samples while standing

    def __init__(self, robot: str, period: float = 0.05, late: float = LATE) -> None:
        self.robot, self.period, self.late = robot, period, late
        self.pose = np.zeros(3)
        self._way = np.zeros(3)
        self._covariance = np.zeros((3, 3))
        self._moved = False
        self._opened: float | None = None
        self._last = self._open_until = 0.0

    def add(self, time: float, way: tuple[float, float, float], covariance: Array) -> list[OdometrySample]:
        """Add an increment that ends at `time` [UTC s]; return the samples that it completes."""
        moved = any(way)
        uncertain = moved or bool(covariance.any())
        if self._opened is None:
            self._opened = time - 1e-3
            self._last = time
            return [self._close(time)]
        samples = []
        late = time - self._last > self.late
        sets_off = moved and not self._moved and time > self._open_until
        if (late or sets_off) and self._last > self._opened:
            samples.append(self._close(self._last))
        if late:
            self._open_until = time + self.period
        if uncertain:
            x, y, yaw = compose((float(self.pose[0]), float(self.pose[1]), float(self.pose[2])), way)
            self.pose = np.array([x, y, wrap(yaw)])
            # an error of the heading rotates the increments that follow
            c, s = cos(self._way[2]), sin(self._way[2])
            R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            dx, dy = c * way[0] - s * way[1], s * way[0] + c * way[1]
            F = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
            self._covariance = F @ self._covariance @ F.T + R @ covariance @ R.T
            self._way += (dx, dy, way[2])
            self._moved = bool(self._way.any())
        self._last = time
        after = max(self._opened + (self.period if self._moved else self.REST), self._open_until)
        if time >= after - 1e-6:
            samples.append(self._close(time))
        return samples

    def _close(self, time: float) -> OdometrySample:
        floor = np.diag(np.square([FLOOR_METRES, FLOOR_METRES, FLOOR_RADIANS]))
        covariance = (self._covariance + self._covariance.T) / 2 + floor
        sample = OdometrySample(self.robot, time, self.pose.copy(), covariance)
        self._way, self._covariance, self._opened, self._moved = np.zeros(3), np.zeros((3, 3)), time, False
        return sample


class EncoderOdometry:
    """Increments of a Create 2 from its encoders (packets 43, 44).

    Counts that no wheel can have reached are ignored: those of a damaged frame whose checksum fits by chance. After
    three in a row the encoders have restarted, and the increment is only known to be within its bounds.
    """

    def __init__(self) -> None:
        self._before: tuple[int, int] | None = None
        self._elapsed = self._gap = self._since_gap = 0.0
        self._left_out = 0

    def step(self, frame: Mapping[int, int], elapsed: float) -> tuple[tuple[float, float, float], Array] | None:
        """Return the increment of the last `elapsed` [s] and its covariance; None if the counts are impossible."""
        after = frame[Packet.LEFT_TICKS], frame[Packet.RIGHT_TICKS]
        wheels, before = WHEELS[2], self._before or after
        self._elapsed += elapsed
        self._since_gap = 0.0 if elapsed > LATE else self._since_gap + elapsed
        # after a gap, a frame from before it may come first, and then one with all of the way
        self._gap = elapsed if elapsed > LATE else self._gap if self._since_gap < HELD_UP else 0.0
        left, right = (ticks_between(b, a) * wheels.metres for b, a in zip(before, after, strict=True))
        unknown = 0.0
        if max(abs(left), abs(right)) > 2e-3 * MAX_WHEEL_SPEED * (self._elapsed + LATE + self._gap):
            self._left_out += 1
            if self._left_out < 3:
                return None
            left = right = 0.0
            unknown = 1e-3 * MAX_WHEEL_SPEED * self._elapsed
        self._before, self._elapsed, self._left_out = after, 0.0, 0
        covariance = arc_covariance(left, right, wheels.base)
        if unknown:
            covariance += np.diag(np.square([unknown, unknown, 2 * unknown / wheels.base]))
        return arc(left, right, wheels.base), covariance


class DeltaOdometry:
    """Increments of a Create 1: its requested speeds, bounded by packets 19 and 20 when they come.

    A packet counts whole units (mm, deg); the true distance is up to one unit longer, the remainder is lost.
    """

    def __init__(self) -> None:
        self._forward = self._turned = self._swept = 0.0
        self._asked = False

    def step(self, frame: Mapping[int, int], elapsed: float) -> tuple[tuple[float, float, float], Array] | None:
        """Return the increment since packets 19 and 20 last came; None for a frame without them. `elapsed` [s]."""
        base = WHEELS[1].base
        left, right = (frame[i] * 1e-3 * elapsed for i in (Packet.REQUESTED_LEFT, Packet.REQUESTED_RIGHT))
        self._forward += (left + right) / 2
        self._turned += (right - left) / base
        self._swept = max(self._swept, abs(left), abs(right))
        if Packet.DISTANCE not in frame:
            return None
        forward, sigma_forward = _held(self._forward, frame[Packet.DISTANCE], 1e-3)
        turned, sigma_turned = _held(self._turned, frame[Packet.ANGLE], radians(1.0))
        way = arc(forward - turned * base / 2, forward + turned * base / 2, base)
        moved = bool(self._swept or frame[Packet.DISTANCE] or frame[Packet.ANGLE])
        asked, self._asked = self._asked, True
        self._forward = self._turned = self._swept = 0.0
        if not (moved and asked):  # the first answer counts from before we listened
            return (0.0, 0.0, 0.0), np.zeros((3, 3))
        slip = (SLIP**2 + ENCODER**2) * (hypot(way[0], way[1]) + abs(turned) * base / 2)
        var_turned = sigma_turned**2 + 2 * slip / base**2
        # within the interval the way may first have been straight and then a turn, or the other way round
        var_across = (forward * turned / 4) ** 2 + (forward / 2) ** 2 * var_turned
        return way, np.diag([sigma_forward**2 + slip, var_across, var_turned])


def _held(requested: float, units: int, unit: float) -> tuple[float, float]:
    """Distance and its sigma: as requested if the truncated count allows it, else the middle of what it allows."""
    low, high = sorted((units * unit, (units + copysign(1, units)) * unit)) if units else (-unit, unit)
    if not low <= requested <= high:
        return (low + high) / 2, (high - low) / 12**0.5
    return requested, min(REQUEST_SHARE * abs(requested) + REQUEST_LATE * unit, unit / 12**0.5)
