"""Control of a robot that drives through waypoints by its odometry: turn, drive straight, turn; `Follower`."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from coloc_graph.geometry.se2 import wrap

NEAR = 0.01  # a waypoint is reached within this distance [m]
ALIGNED = 0.02  # a heading is reached within this angle [rad]
SET_OFF = 0.06  # the robot drives straight once it heads at the waypoint to within this [rad]
BRAKE = 2.0  # speed per distance to the waypoint [1/s]
STEER = 2.5  # turn rate per heading error [1/s]
MIN_SPEED = 0.02  # slowest speed [m/s]
MIN_TURN_RATE = 0.08  # slowest turn rate [rad/s]


@dataclass(frozen=True)
class Twist:
    """Speed ahead `v` [m/s] and turn rate to the left `w` [rad/s]."""

    v: float
    w: float


class Follower:
    """Controller of one drive, to be asked ten times a second or more.

    Parameters
    ----------
    places
        Waypoints (x, y) [m] in the odometry frame.
    yaw
        Heading at the end [rad]; None for any.
    speed, turn
        Largest speed [m/s] and turn rate [rad/s].
    backwards
        Drive backwards where that means less turning.
    """

    def __init__(
        self,
        places: Sequence[tuple[float, float]],
        yaw: float | None,
        speed: float,
        turn: float = 1.2,
        *,
        backwards: bool = True,
    ) -> None:
        self._places, self._yaw = deque(places), yaw
        self._speed, self._turn, self._backwards = speed, turn, backwards
        self._going = False
        self._from: tuple[float, float] | None = None

    def step(self, x: float, y: float, yaw: float) -> Twist | None:
        """Return the motion at a pose x, y [m], yaw [rad] in the odometry frame; None at the end."""
        while self._places:
            to = self._places[0]
            if self._from is None:
                self._from = x, y
            away = math.dist((x, y), to)
            if away < NEAR or (self._going and self._passed(x, y)):
                self._places.popleft()
                self._going, self._from = False, None
                continue
            off = wrap(math.atan2(to[1] - y, to[0] - x) - yaw)
            ahead = 1.0
            if self._backwards and abs(off) > math.pi / 2:
                off, ahead = wrap(off + math.pi), -1.0
            if not self._going and abs(off) > SET_OFF:
                return Twist(0.0, self._turning(off))
            self._going = True
            v = min(self._speed, max(BRAKE * away, MIN_SPEED)) * max(math.cos(2 * off), 0.0)
            return Twist(ahead * v, max(-self._turn, min(self._turn, STEER * off)) if away > 3 * NEAR else 0.0)
        if self._yaw is not None and abs(off := wrap(self._yaw - yaw)) > ALIGNED:
            return Twist(0.0, self._turning(off))
        return None

    def _passed(self, x: float, y: float) -> bool:
        """Return whether the robot has passed its waypoint."""
        (ax, ay), (bx, by) = self._from or (x, y), self._places[0]
        return (x - bx) * (bx - ax) + (y - by) * (by - ay) >= 0

    def _turning(self, off: float) -> float:
        return math.copysign(min(self._turn, max(STEER * abs(off), MIN_TURN_RATE)), off)
