"""Integrate a robot's wheel odometry between two instants, with a covariance."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.lie import floor_pose, se3_between
from coloc_graph.measurements import Odometry
from coloc_graph.run import OdometrySample

Array = NDArray[np.float64]

MIN_SIGMAS = (1e-3, 5e-4, 5e-4)  # lower bounds of odometry between two stances: heading [rad], x, y [m]
MAX_GAP = 1.0  # s between samples, above which the speed is unknown


class WheelTrack:
    """Wheel odometry of one robot over a run.

    Parameters
    ----------
    robot
        Name of the robot.
    samples
        Odometry samples in order of time.
    """

    def __init__(self, robot: str, samples: Sequence[OdometrySample]) -> None:
        self.robot = robot
        self.times = np.array([one.time for one in samples])
        poses = np.array([one.pose for one in samples]).reshape(-1, 3)
        self._poses = np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])])
        self._covariances = np.array([one.covariance for one in samples]).reshape(-1, 3, 3)

    def __len__(self) -> int:
        return len(self.times)

    def pose_at(self, times: Array) -> Array:
        """Interpolate x [m], y [m], yaw [rad] (n, 3) at times (n,), odometry frame; constant outside the samples."""
        return np.stack([np.interp(times, self.times, column) for column in self._poses.T], axis=1)

    def speed_at(self, time: float) -> float:
        """Speed between the samples about an instant [m/s]; 0 if there are none near."""
        after = int(np.searchsorted(self.times, time))
        if not 0 < after < len(self.times) or self.times[after] - self.times[after - 1] > MAX_GAP:
            return 0.0
        distance = np.hypot(*(self._poses[after, :2] - self._poses[after - 1, :2]))
        return float(distance / max(self.times[after] - self.times[after - 1], 1e-6))

    def between(self, before: int, after: int, start: float, end: float, clock_sigma: float = 0.0) -> Odometry | None:
        """Integrate odometry from one stance to another.

        Parameters
        ----------
        before, after
            Indices of the stances.
        start, end
            Times of the poses in them [UTC s].
        clock_sigma
            Standard deviation of these times by the robot's clock [s], which matters if the robot drives then.

        Returns
        -------
        Odometry or None
            Relative pose with its covariance (3, 3) of heading, x, y in the body at the end; None if the samples begin
            after `end`.
        """
        if not len(self) or self.times[0] >= end:
            return None
        inside = np.flatnonzero((self.times > start) & (self.times < end))
        nodes = np.concatenate([[start], self.times[inside], [end]])
        x, y, yaw = self.pose_at(nodes).T
        # each increment's covariance is of the sample that ends it; of one that is cut, the share within
        ends = np.append(inside, [min(int(np.searchsorted(self.times, end)), len(self) - 1)])
        C = self._covariances[ends].copy()
        for n, (low, high) in ((0, nodes[:2]), (-1, nodes[-2:])):
            whole = self.times[ends[n]] - (self.times[ends[n] - 1] if ends[n] else low)
            C[n] *= np.clip((high - low) / whole, 0, 1) if whole > 0 else 1.0
        if self.times[-1] < end:
            C[-1] = 0.0  # at rest since the last sample
        # in the body at the end: an error (dx, dy, dyaw) in the body where its increment began
        turned, at = yaw[:-1] - yaw[-1], np.stack([x[-1] - x[1:], y[-1] - y[1:]], axis=1)
        c, s = np.cos(turned), np.sin(turned)
        ce, se = np.cos(yaw[-1]), np.sin(yaw[-1])
        arm = np.stack([ce * at[:, 0] + se * at[:, 1], -se * at[:, 0] + ce * at[:, 1]], axis=1)
        J = np.zeros((len(C), 3, 3))  # rows heading, x, y
        J[:, 0, 2] = 1.0
        J[:, 1, 0], J[:, 1, 1], J[:, 1, 2] = c, -s, -arm[:, 1]
        J[:, 2, 0], J[:, 2, 1], J[:, 2, 2] = s, c, arm[:, 0]
        covariance = (J @ C @ J.mT).sum(axis=0) + np.diag(np.square(MIN_SIGMAS))
        late = clock_sigma * np.array([self.speed_at(start), self.speed_at(end)])
        covariance[1:, 1:] += (late**2).sum() * np.eye(2)
        T_odom = floor_pose(x[[0, -1]], y[[0, -1]], yaw[[0, -1]])
        T_before_after = se3_between(*T_odom)
        return Odometry(self.robot, before, after, T_before_after, (covariance + covariance.T) / 2)
