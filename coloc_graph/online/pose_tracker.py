"""Where a robot is in the world at any instant: its last pose that was estimated, and its wheels since."""

import math
from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coloc_graph.online.formation import Planar
from coloc_graph.run import OdometrySample

Array = NDArray[np.float64]

#: A robot whose wheels have told of less than this has not moved [m], [rad].
STILL = 2e-3
STILL_TURN = 4e-3
#: Where a robot may be that somebody pushed or carried [m], [m], [rad]; a sample that is known no better says that.
CARRIED = (0.5, 0.5, 1.0)
#: So much of the past is remembered [s].
MEMORY = 600.0


def compose(a: Planar, b: Planar) -> Planar:
    """The pose b, given in a."""
    c, s = math.cos(a[2]), math.sin(a[2])
    return a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], a[2] + b[2]


def inverse(a: Planar) -> Planar:
    """The inverse of a pose."""
    c, s = math.cos(a[2]), math.sin(a[2])
    return -c * a[0] - s * a[1], s * a[0] - c * a[1], -a[2]


@dataclass(frozen=True)
class Fix:
    """A pose in the world at an instant [s]."""

    time: float
    place: Planar


class PoseTracker:
    """One robot's; `start` is where it is said to stand at the beginning."""

    def __init__(self, start: Planar) -> None:
        self._times: list[float] = []
        self._poses: list[Planar] = []
        self._fix = Fix(-math.inf, start)
        self._T_world_odom: Planar | None = None
        self._carried = -math.inf

    def take(self, sample: OdometrySample) -> None:
        """Take in what the wheels say; samples come in the order of time."""
        x, y, yaw = map(float, sample.pose)
        self._times.append(sample.time)
        self._poses.append((x, y, yaw))
        if sample.covariance[0, 0] >= 0.99 * CARRIED[0] ** 2:
            self._carried = sample.time
        if self._T_world_odom is None:
            self._tie()
        if len(self._times) > 2 and self._times[-1] - self._times[0] > 1.2 * MEMORY:
            keep = bisect_right(self._times, self._times[-1] - MEMORY)
            del self._times[:keep], self._poses[:keep]

    def fix(self, time: float, place: Planar) -> None:
        """Its pose at an instant is known now."""
        self._fix = Fix(time, place)
        self._tie()

    def carry(self, time: float, place: Planar) -> None:
        """It was moved before an instant by what its wheels do not know, to a place."""
        self._carried = time
        self.fix(time, place)

    def _tie(self) -> None:
        if self._times:
            self._T_world_odom = compose(self._fix.place, inverse(self.odometry_at(self._fix.time)))

    def odometry_at(self, time: float) -> Planar:
        """Its pose in the odometry frame; at rest before and after the samples."""
        n = bisect_right(self._times, time)
        if n == 0 or n == len(self._times):
            return self._poses[max(n - 1, 0)]
        (t0, a), (t1, b) = ((self._times[i], self._poses[i]) for i in (n - 1, n))
        share = (time - t0) / (t1 - t0) if t1 > t0 else 1.0
        turn = (b[2] - a[2] + math.pi) % (2 * math.pi) - math.pi
        return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), a[2] + share * turn

    @property
    def known(self) -> bool:
        """Whether its wheels have said anything yet."""
        return self._T_world_odom is not None

    def place(self, time: float = math.inf) -> Planar:
        """x [m], y [m], yaw [rad] in the world at an instant, by default the newest."""
        if self._T_world_odom is None:
            return self._fix.place
        return compose(self._T_world_odom, self.odometry_at(time))

    def in_odometry(self, place: Planar) -> Planar:
        """A pose in the world as the robot's own odometry counts it."""
        if self._T_world_odom is None:
            raise LookupError("its wheels have said nothing yet")
        return compose(inverse(self._T_world_odom), place)

    def moved_since(self, time: float) -> bool:
        """Whether its wheels have turned, or it was carried, since an instant [s]."""
        if self._carried > time:
            return True
        if not self._times:
            return False
        then = self.odometry_at(time)
        first = bisect_right(self._times, time)
        return any(
            math.dist(pose[:2], then[:2]) > STILL
            or abs((pose[2] - then[2] + math.pi) % (2 * math.pi) - math.pi) > STILL_TURN
            for pose in self._poses[first:]
        )
