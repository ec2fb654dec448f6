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
MAX_CHANGE = 0.01  # m, rad: change of the pose in such a gap above which the robot drove in it


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

    def rates_at(self, time: float) -> tuple[float, float]:
        """Yaw rate [rad/s] and speed [m/s] between the samples about an instant; 0 if there are none near."""
        after = int(np.searchsorted(self.times, time))
        if not 0 < after < len(self.times) or self.times[after] - self.times[after - 1] > MAX_GAP:
            return 0.0, 0.0
        period = max(self.times[after] - self.times[after - 1], 1e-6)
        dx, dy, dyaw = (self._poses[after] - self._poses[after - 1]) / period
        return float(dyaw), float(np.hypot(dx, dy))

    def covers(self, times: Array) -> NDArray[np.bool_]:
        """Return at which times (n,) the pose is known: not in a gap between samples in which it changed."""
        after = np.clip(np.searchsorted(self.times, times), 1, max(len(self) - 1, 1))
        if len(self) < 2:
            return np.ones(len(times), bool)
        change = np.abs(np.diff(self._poses, axis=0)).max(axis=1)
        lost = (np.diff(self.times) > MAX_GAP) & (change > MAX_CHANGE)
        inside = (times > self.times[0]) & (times < self.times[-1])
        return np.asarray(~(inside & lost[after - 1]))

    def moved(self, start: Array, end: Array) -> Array:
        """Pose x [m], y [m], yaw [rad] (n, 3) of the body at times `end` (n,) in the body at `start` (n,)."""
        before, after = self.pose_at(start), self.pose_at(end)
        c, s = np.cos(before[:, 2]), np.sin(before[:, 2])
        x, y, yaw = (after - before).T
        return np.stack([c * x + s * y, -s * x + c * y, yaw], axis=1)

    def place_errors(self, start: Array, end: Array, points: Array) -> Array:
        """Square root of the joint covariance of points on the body at times `end`, in the body at `start`.

        Parameters
        ----------
        start, end : (n,) float
            Times [UTC s], in either order.
        points : (n, 2) float
            Points on the body [m].

        Returns
        -------
        (n, 2, q) float
            Errors of x and y [m] by q independent errors of unit variance, which the n points share.
        """
        low, high = np.minimum(start, end), np.maximum(start, end)
        first = int(np.searchsorted(self.times, low.min(), side="right"))
        last = int(np.searchsorted(self.times, high.max()))
        steps = np.arange(max(first, 1), min(last, len(self) - 1) + 1)
        if not len(steps):
            return np.zeros((len(start), 2, 1))
        begins, ends = self.times[steps - 1], self.times[steps]
        overlap = np.minimum(high[:, None], ends) - np.maximum(low[:, None], begins)
        part = np.sqrt(np.clip(overlap / np.maximum(ends - begins, 1e-9), 0.0, 1.0))  # (n, steps)
        before, yaw = self.pose_at(start), self._poses[steps - 1, 2]
        at = self.pose_at(end)
        c, s = np.cos(at[:, 2]), np.sin(at[:, 2])
        p = at[:, :2] + np.stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]], axis=1)
        arm = p[:, None] - self._poses[steps, :2]
        J = np.zeros((len(p), len(steps), 2, 3))
        J[..., 0, 0] = J[..., 1, 1] = np.cos(yaw)
        J[..., 1, 0], J[..., 0, 1] = np.sin(yaw), -np.sin(yaw)
        J[..., 0, 2], J[..., 1, 2] = -arm[..., 1], arm[..., 0]
        variances, axes = np.linalg.eigh(self._covariances[steps])
        J = part[:, :, None, None] * (J @ (axes * np.sqrt(variances.clip(min=0.0))[:, None, :]))
        c, s = np.cos(before[:, 2]), np.sin(before[:, 2])
        into = np.stack([np.stack([c, s], axis=1), np.stack([-s, c], axis=1)], axis=1)
        return np.asarray((into[:, None] @ J).transpose(0, 2, 1, 3).reshape(len(p), 2, -1))

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
        turned_late, late = clock_sigma**2 * np.square([self.rates_at(start), self.rates_at(end)]).sum(axis=0)
        covariance += np.diag([turned_late, late, late])
        T_odom = floor_pose(x[[0, -1]], y[[0, -1]], yaw[[0, -1]])
        T_before_after = se3_between(*T_odom)
        return Odometry(self.robot, before, after, T_before_after, (covariance + covariance.T) / 2)
