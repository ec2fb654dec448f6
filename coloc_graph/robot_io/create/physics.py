"""Physics of an emulated Create: two wheels with inertia, slip and noisy encoders, walls, pushes."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import islice
from math import atan2, cos, hypot, pi, sin

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coloc_graph.robot_io.create.odometry import ENCODER, SLIP, WHEELS
from coloc_graph.robot_io.deadlines import DECELERATION

Array = NDArray[np.float64]

RADIUS = 0.17  # m, of the body


@dataclass(frozen=True)
class Wall:
    """A solid rectangle in the world [m]."""

    x_low: float
    y_low: float
    x_high: float
    y_high: float


@dataclass(frozen=True)
class Physics:
    """Parameters of the emulated body.

    Attributes
    ----------
    acceleration
        Acceleration and deceleration of a wheel [m/s^2].
    slip, encoder
        Standard deviations [m] after one metre rolled, growing with the square root of the distance.
    step
        Time step [s].
    seed
        Seed of all noise.
    walls
        Solid rectangles.
    start
        x [m], y [m], yaw [rad] at the start.
    """

    acceleration: float = DECELERATION
    slip: float = SLIP
    encoder: float = ENCODER
    step: float = 0.0025
    seed: int = 0
    walls: Sequence[Wall] = ()
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass
class Body:
    """True state of the robot; wheels are (left, right).

    Attributes
    ----------
    trace
        The last minutes, one row a step while a wheel turns: time [s], x, y [m], yaw [rad], left and right speed [m/s].
    """

    model: int
    physics: Physics
    time: float
    wanted: tuple[float, float] = (0.0, 0.0)
    bump_left: bool = False
    bump_right: bool = False
    trace: deque[tuple[float, ...]] = field(default_factory=lambda: deque(maxlen=100_000))

    def __post_init__(self) -> None:
        self.base = WHEELS[self.model].base
        self.x, self.y, self.yaw = self.physics.start
        self.speeds = [0.0, 0.0]
        #: Distance that the encoders have counted since the start [m].
        self.counted = [0.0, 0.0]
        #: Time since which both wheels have stood [s]; None while one turns.
        self.still_since: float | None = self.time
        self._rng = np.random.default_rng(self.physics.seed)
        self._noise: list[float] = []
        self._pushes = 0
        self._record()

    def advance(self, to: float) -> None:
        """Advance to the time `to` [s] in whole steps."""
        step = self.physics.step
        while self.time + step <= to:
            if any(self.speeds) or any(self.wanted):
                self._step(step)
            else:
                self._stand(max(int((to - self.time) / step), 1) * step)

    def poses_at(self, times: ArrayLike) -> Array:
        """True poses (n, 3) at times (n,) [s] of the last minutes: x, y [m], yaw [rad, unwrapped]."""
        times = np.asarray(times, float)
        back = int((self.time - times.min(initial=self.time)) / self.physics.step) + self._pushes + 2
        rows = np.array(list(islice(reversed(self.trace), back)))[::-1]
        columns = rows[:, 1], rows[:, 2], np.unwrap(rows[:, 3])
        return np.stack([np.interp(times, rows[:, 0], column) for column in columns], axis=1)

    def push(self, dx: float, dy: float, dyaw: float) -> None:
        """Displace the body in the world [m], [rad]; the encoders count nothing."""
        self.x, self.y, self.yaw = self.x + dx, self.y + dy, (self.yaw + dyaw + pi) % (2 * pi) - pi
        self._pushes += 1
        self._record()

    def _step(self, dt: float) -> None:
        self.time += dt
        self.still_since = None
        reach = self.physics.acceleration * dt
        ground = [0.0, 0.0]
        for i in (0, 1):
            before = self.speeds[i]
            self.speeds[i] += max(-reach, min(reach, self.wanted[i] - before))
            rolled = (before + self.speeds[i]) / 2 * dt
            root = abs(rolled) ** 0.5
            self.counted[i] += rolled + self.physics.encoder * root * self._normal()
            ground[i] = rolled + self.physics.slip * root * self._normal()
        forward, turned = (ground[0] + ground[1]) / 2, (ground[1] - ground[0]) / self.base
        middle = self.yaw + turned / 2
        self.yaw = (self.yaw + turned + pi) % (2 * pi) - pi
        self._move(self.x + forward * cos(middle), self.y + forward * sin(middle))
        self._record()

    def _stand(self, seconds: float) -> None:
        """Stand for some steps: the trace has the first and the last instant."""
        if self.still_since is None:
            self.still_since = self.time
        elif len(self.trace) > 1 and self.trace[-2][1:] == self.trace[-1][1:]:
            self.trace.pop()
        self.time += seconds
        self._record()

    def _normal(self) -> float:
        if not self._noise:
            self._noise = self._rng.standard_normal(1000).tolist()
        return self._noise.pop()

    def _move(self, x: float, y: float) -> None:
        """Move unless a wall is in the way; then the wheels slip and the bumper is pressed."""
        self.bump_left = self.bump_right = blocked = False
        for wall in self.physics.walls:
            dx = min(max(x, wall.x_low), wall.x_high) - x
            dy = min(max(y, wall.y_low), wall.y_high) - y
            if hypot(dx, dy) >= RADIUS:
                continue
            nearer = hypot(dx, dy) < hypot(dx + x - self.x, dy + y - self.y)
            bearing = (atan2(dy, dx) - self.yaw + pi) % (2 * pi) - pi
            self.bump_left |= -0.3 < bearing < pi / 2
            self.bump_right |= -pi / 2 < bearing < 0.3
            blocked |= nearer
        if not blocked:
            self.x, self.y = x, y

    def _record(self) -> None:
        self.trace.append((self.time, self.x, self.y, self.yaw, *self.speeds))
