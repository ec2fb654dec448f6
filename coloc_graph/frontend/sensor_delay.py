"""Delay of a robot's ranges and bearings against its own odometry, from how bearings change while it turns."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.se2 import wrap

Array = NDArray[np.float64]

LONGEST_DELAY = 3.0  # delays are looked for up to this [s]
STEP = 0.05  # in steps of this [s]
LONGEST_PAIR = 1.5  # two bearings of one target no further apart tell a turn [s]
FEWEST_PAIRS = 30  # pairs that tell a delay
LEAST_TURN = 0.05  # pairs with a smaller turn tell nothing [rad]
OUTLIER = 3.0  # residuals beyond this, in robust sigmas, count no more
CLEAR = 25.0  # a delay lowers the robust cost by this (5 sigma)


@dataclass(frozen=True)
class SensorDelay:
    """Measurements are stamped `value` [s] later than odometry, with a standard deviation `sigma` [s]."""

    value: float
    sigma: float


def sensor_delay(
    times: Array, targets: NDArray[np.int64], ranges: Array, bearings: Array, pose_at: Callable[[Array], Array]
) -> SensorDelay | None:
    """Estimate by how much a robot's measurements are stamped late against its odometry.

    While the robot turns, the bearing of a landmark turns the other way; the delay is where the two agree best.

    Parameters
    ----------
    times, targets, ranges, bearings
        Measurements (n,) of landmarks that stand still, in the order of time: UTC [s], number, [m], [rad].
    pose_at
        Odometry: x [m], y [m], heading [rad] (m, 3) at times (m,) [UTC s].

    Returns
    -------
    SensorDelay or None
        None where the robot turned too little to tell, or no delay explains the bearings clearly better than none.
    """
    order = np.lexsort((times, targets))
    first, second = order[:-1], order[1:]
    close = (targets[first] == targets[second]) & (times[second] - times[first] <= LONGEST_PAIR)
    first, second = first[close], second[close]
    if len(first) < FEWEST_PAIRS:
        return None
    point = ranges[first, None] * np.stack([np.cos(bearings[first]), np.sin(bearings[first])], axis=1)
    count = round(LONGEST_DELAY / STEP)
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
    turning = np.max(turns, axis=0) > LEAST_TURN
    if turning.sum() < FEWEST_PAIRS:
        return None
    e = np.array(residuals)[:, turning]
    best = int(np.argmin(np.median(np.abs(e), axis=1)))
    scale = max(1.4826 * float(np.median(np.abs(e[best]))), 1e-4)
    cost = np.minimum((e / scale) ** 2, OUTLIER**2).sum(axis=1)
    best = int(np.argmin(cost))
    if best in (0, len(delays) - 1) or cost[count] - cost[best] < CLEAR:
        return None
    low, here, high = cost[best - 1 : best + 2]
    curvature = max(low + high - 2 * here, 1e-9)
    value = float(delays[best] + STEP * 0.5 * (low - high) / curvature)
    return SensorDelay(value, float(STEP * np.sqrt(2 / curvature)))
