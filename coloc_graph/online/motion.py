"""A robot drives through places by its own odometry: turn, go straight, turn; one step of control at a time."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from coloc_graph.geometry.se2 import wrap

#: Nearer than this a place is reached [m], and a heading [rad].
NEAR = 0.01
ALIGNED = 0.02
#: It sets off when it heads at the place to within this [rad].
SET_OFF = 0.06
#: How hard it slows down before a place [1/s] and steers [1/s], the least that still moves [m/s], [rad/s].
BRAKE = 2.0
STEER = 2.5
LEAST_SPEED = 0.02
LEAST_TURN = 0.08


@dataclass(frozen=True)
class Twist:
    """Drive at `v` [m/s] and turn at `w` [rad/s]."""

    v: float
    w: float


class Follower:
    """Drives through `places` (x, y) [m] of the odometry frame, then turns to `yaw` [rad], if there is one.

    It goes backwards where that means less turning and `backwards` allows it. `step` is asked ten times a second or
    more with where the robot is, and says how to drive; None when it is there.
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
        """How to drive from a place [m] and heading [rad]."""
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
            v = min(self._speed, max(BRAKE * away, LEAST_SPEED)) * max(math.cos(2 * off), 0.0)
            return Twist(ahead * v, max(-self._turn, min(self._turn, STEER * off)) if away > 3 * NEAR else 0.0)
        if self._yaw is not None and abs(off := wrap(self._yaw - yaw)) > ALIGNED:
            return Twist(0.0, self._turning(off))
        return None

    def _passed(self, x: float, y: float) -> bool:
        """Whether it has gone by the place that it drives to."""
        (ax, ay), (bx, by) = self._from or (x, y), self._places[0]
        return (x - bx) * (bx - ax) + (y - by) * (by - ay) >= 0

    def _turning(self, off: float) -> float:
        return math.copysign(min(self._turn, max(STEER * abs(off), LEAST_TURN)), off)
