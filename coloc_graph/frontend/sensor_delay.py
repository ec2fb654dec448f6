"""Estimate the delay of a robot's ranges and bearings against its odometry, from bearings while it turns."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.se2 import wrap

Array = NDArray[np.float64]

MAX_DELAY = 3.0  # s, range of the search
STEP = 0.05  # s, step of the search
MAX_PAIR_INTERVAL = 1.5  # s between two bearings of one target that are compared
MIN_PAIRS = 30  # pairs of bearings needed for an estimate
MIN_TURN = 0.05  # rad, of the robot between the bearings of a pair
OUTLIER = 3.0  # robust standard deviations at which the cost of a residual saturates
MIN_GAIN = 25.0  # decrease of the robust cost that a delay must bring (5 sigma)


@dataclass(frozen=True)
class SensorDelay:
    """Delay of measurements against odometry, positive if they are stamped late, and its standard deviation [s]."""

    value: float
    sigma: float


def sensor_delay(
    times: Array, targets: NDArray[np.int64], ranges: Array, bearings: Array, pose_at: Callable[[Array], Array]
) -> SensorDelay | None:
    """Estimate the delay of a robot's measurements against its odometry.

    While the robot turns, the bearing of a landmark turns the other way; at the delay the two agree best.

    Parameters
    ----------
    times, targets, ranges, bearings
        Measurements (n,) of landmarks that stand still, in the order of time: UTC [s], number, [m], [rad].
    pose_at
        Odometry: x [m], y [m], heading [rad] (m, 3) at times (m,) [UTC s].

    Returns
    -------
    SensorDelay or None
        None if the robot turned too little, or no delay explains the bearings clearly better than none.
    """
    order = np.lexsort((times, targets))
    first, second = order[:-1], order[1:]
    close = (targets[first] == targets[second]) & (times[second] - times[first] <= MAX_PAIR_INTERVAL)
    first, second = first[close], second[close]
    if len(first) < MIN_PAIRS:
        return None
    point = ranges[first, None] * np.stack([np.cos(bearings[first]), np.sin(bearings[first])], axis=1)
    count = round(MAX_DELAY / STEP)
    delays = STEP * np.arange(-count, count + 1)
    residuals, turns = [], []
    for delay in delays:
        before, after = pose_at(times[first] - delay), pose_at(times[second] - delay)
        c, s = np.cos(before[:, 2]), np.sin(before[:, 2])
        world = before[:, :2] + np.stack([c * point[:, 0] - s * point[:, 1], s * point[:, 0] + c * point[:, 1]], axis=1)
        off = world - after[:, :2]
        expected = np.arctan2(off[:, 1], off[:, 0]) - after[:, 2]
        residuals.append(wrap(bearings[second] - expected))
        turns.append(np.abs(after[:, 2] - before[:, 2]))
    turning = np.max(turns, axis=0) > MIN_TURN
    if turning.sum() < MIN_PAIRS:
        return None
    e = np.array(residuals)[:, turning]
    best = int(np.argmin(np.median(np.abs(e), axis=1)))
    scale = max(1.4826 * float(np.median(np.abs(e[best]))), 1e-4)
    cost = np.minimum((e / scale) ** 2, OUTLIER**2).sum(axis=1)
    best = int(np.argmin(cost))
    if best in (0, len(delays) - 1) or cost[count] - cost[best] < MIN_GAIN:
        return None
    low, here, high = cost[best - 1 : best + 2]
    curvature = max(low + high - 2 * here, 1e-9)
    value = float(delays[best] + STEP * 0.5 * (low - high) / curvature)
    return SensorDelay(value, float(STEP * np.sqrt(2 / curvature)))
