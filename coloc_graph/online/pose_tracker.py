"""Pose of a robot in the world at any instant; `PoseTracker`."""

import math
from bisect import bisect_right

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.se2 import Planar, compose, inverse, wrap
from coloc_graph.run import OdometrySample

Array = NDArray[np.float64]

STILL = 2e-3  # a robot whose odometry changed by less has not moved [m]
STILL_TURN = 4e-3  # the same for its heading [rad]
CARRIED = (0.5, 0.5, 1.0)  # sigmas of the pose of a robot that was pushed or carried [m], [m], [rad]
MEMORY = 600.0  # odometry that is kept [s]


class PoseTracker:
    """Pose of one robot in the world: its last estimated pose, composed with its odometry since.

    This is the transform map -> odom of REP-105. `start` is the pose at the beginning (x [m], y [m], yaw [rad]).
    """

    def __init__(self, start: Planar) -> None:
        self._times: list[float] = []
        self._poses: list[Planar] = []
        self._fix_time, self._fix_pose = -math.inf, start
        self._T_world_odom: Planar | None = None
        self._displaced = -math.inf

    def add(self, sample: OdometrySample) -> None:
        """Add an odometry sample, in the order of time."""
        x, y, yaw = map(float, sample.pose)
        self._times.append(sample.time)
        self._poses.append((x, y, yaw))
        if sample.covariance[0, 0] >= 0.99 * CARRIED[0] ** 2:
            self._displaced = sample.time
        if self._T_world_odom is None:
            self._tie()
        if len(self._times) > 2 and self._times[-1] - self._times[0] > 1.2 * MEMORY:
            keep = bisect_right(self._times, self._times[-1] - MEMORY)
            del self._times[:keep], self._poses[:keep]

    def fix(self, time: float, pose: Planar) -> None:
        """Set the pose in the world at an instant [s], as it was estimated."""
        self._fix_time, self._fix_pose = time, pose
        self._tie()

    def displace(self, time: float, pose: Planar) -> None:
        """Set the pose of a robot that was moved before an instant [s], which its wheels cannot tell."""
        self._displaced = time
        self.fix(time, pose)

    def _tie(self) -> None:
        if self._times:
            self._T_world_odom = compose(self._fix_pose, inverse(self.odometry_at(self._fix_time)))

    def odometry_at(self, time: float) -> Planar:
        """Return its pose in the odometry frame at an instant [s], constant before and after the samples."""
        n = bisect_right(self._times, time)
        if n == 0 or n == len(self._times):
            return self._poses[max(n - 1, 0)]
        (t0, a), (t1, b) = ((self._times[i], self._poses[i]) for i in (n - 1, n))
        share = (time - t0) / (t1 - t0) if t1 > t0 else 1.0
        turn = wrap(b[2] - a[2])
        return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), a[2] + share * turn

    @property
    def known(self) -> bool:
        """True if odometry has been received."""
        return self._T_world_odom is not None

    def pose(self, time: float = math.inf) -> Planar:
        """Return x [m], y [m], yaw [rad] in the world at an instant [s], by default the newest."""
        if self._T_world_odom is None:
            return self._fix_pose
        return compose(self._T_world_odom, self.odometry_at(time))

    def in_odometry(self, pose: Planar) -> Planar:
        """Convert a pose in the world to the robot's odometry frame.

        Raises
        ------
        LookupError
            If no odometry has been received.
        """
        if self._T_world_odom is None:
            raise LookupError("no odometry received yet")
        return compose(inverse(self._T_world_odom), pose)

    def moved_since(self, time: float) -> bool:
        """Return whether the robot has moved since an instant [s], by its wheels or otherwise."""
        if self._displaced > time:
            return True
        if not self._times:
            return False
        then = self.odometry_at(time)
        first = bisect_right(self._times, time)
        return any(
            math.dist(pose[:2], then[:2]) > STILL or abs(wrap(pose[2] - then[2])) > STILL_TURN
            for pose in self._poses[first:]
        )
