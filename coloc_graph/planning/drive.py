"""The mover's drive through waypoints in time, as its controller drives it: `Drive`, `drive_through`, `leap_time`."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coloc_graph.geometry.se2 import Planar, between, wrap

Array = NDArray[np.float64]

SPEED = 0.2  # speed of the mover [m/s]
TURN_RATE = 1.0  # turn rate of a robot that turns on the spot [rad/s]
SETTLE = 2.0  # time that all robots stand before a stance [s]
COVERED = 0.84  # drive that brings half of what evenly spread images would bring in its time [m]
MIN_WAYPOINT_DISTANCE = 1e-6  # waypoints closer to each other are one [m]


@dataclass(frozen=True, eq=False)
class Drive:
    """Drive of a robot: `knots` (n, 3) of x, y [m], yaw [rad, unwrapped] at `times` (n,) [s] from its start."""

    times: Array
    knots: Array

    def at(self, t: ArrayLike) -> Array:
        """Return poses (m, 3) at times (m,) [s]; the robot rests at the last knot."""
        return np.stack([np.interp(np.asarray(t, float), self.times, column) for column in self.knots.T], axis=-1)


def leap_time(start: Planar, target: Planar, speed: float) -> float:
    """Return the time for a robot to turn, drive straight and turn to its target, and to stand [s]."""
    D = between(start, target)
    first = math.atan2(D[1], D[0])
    return math.hypot(*D[:2]) / speed + (abs(first) + abs(wrap(D[2] - first))) / TURN_RATE + SETTLE


def effective_seconds(seconds: ArrayLike, speed: float) -> Array:
    """Return the seconds (...) of evenly spread images that bring as much as the best drive of `seconds` does.

    A short drive sees little of the common view. Found by comparing drives of 2 s to 35 s in four formations, at 0.2
    and 0.4 m/s: within 15 % from 1 m on.
    """
    seconds = np.asarray(seconds, float)
    length = speed * seconds
    return np.asarray(seconds * length**2 / (length**2 + COVERED**2))


def there_and_back(waypoints: ArrayLike, duration: float, speed: float = SPEED) -> Array:
    """Waypoints (n, 2) of a drive back and forth through `waypoints` that lasts at least `duration` [s]."""
    once = np.asarray(waypoints, float).reshape(-1, 2)
    length = float(np.hypot(*np.diff(once, axis=0).T).sum())
    rounds = max(1, math.ceil(duration * speed / max(length, 1e-3))) if length > MIN_WAYPOINT_DISTANCE else 1
    legs = [once if n % 2 == 0 else once[::-1] for n in range(min(rounds, 1000))]
    return np.concatenate([legs[0], *(leg[1:] for leg in legs[1:])])


def drive_through(waypoints: ArrayLike, speed: float = SPEED, turn_rate: float = TURN_RATE) -> Drive:
    """Drive through waypoints (n, 2) [m] in straight lines, turning on the spot, backwards if that means less turning.

    The first heading is that of the first line.
    """
    at = np.asarray(waypoints, float)
    step = np.diff(at, axis=0)
    distance = np.hypot(*step.T)
    moved = distance > MIN_WAYPOINT_DISTANCE
    at, step, distance = np.vstack([at[:1], at[1:][moved]]), step[moved], distance[moved]
    if not len(step):
        return Drive(np.zeros(1), np.array([[*at[0], 0.0]]))
    heading = np.arctan2(step[:, 1], step[:, 0])
    turned = np.concatenate([[0.0], wrap(np.diff(heading), math.pi)])
    yaw = heading[0] + np.cumsum(turned)
    knots = np.empty((2 * len(step) + 1, 3))
    knots[0] = (*at[0], yaw[0])
    knots[1::2, :2], knots[2::2, :2] = at[:-1], at[1:]
    knots[1::2, 2] = knots[2::2, 2] = yaw
    taken = np.stack([np.abs(turned) / turn_rate, distance / speed], axis=1).ravel()
    return Drive(np.concatenate([[0.0], np.cumsum(taken)]), knots)
