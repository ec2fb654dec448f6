"""Breaks in odometry: jumps that no wheel can make, as of a driver that restarts, found and joined."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coloc_graph.geometry.se2 import wrap

Array = NDArray[np.float64]

SPEED_FACTOR = 3.0  # a jump is faster than the robot's usual top speed by this factor
USUAL = 0.95  # quantile of the speeds while moving that is called usual
LEAST_SPEED = 1.0  # and faster than this [m/s]
LEAST_TURN_RATE = 6.0  # or turns faster than this [rad/s]
LEAST_STEP = 0.03  # shorter jumps do no harm [m]
LEAST_TURN = 0.15  # nor do smaller turns [rad]
UNSURE_M = 0.01  # standard deviation of a way across a break, besides what the robot may have driven [m]
UNSURE_RAD = 0.02  # the same of its turn [rad]


@dataclass(frozen=True)
class OdometryBreak:
    """A jump at sample `index` (`time` [UTC s]): `distance` [m] and `turn` [rad] within `interval` [s].

    `to_origin` says that the samples begin anew at exactly (0, 0, 0). `sigmas` are how far the robot may have gone
    in the interval: x, y [m], yaw [rad].
    """

    index: int
    time: float
    distance: float
    turn: float
    interval: float
    to_origin: bool
    sigmas: tuple[float, float, float]

    def __str__(self) -> str:
        anew = ": it began anew, at the origin" if self.to_origin else ""
        what = f"by {self.distance:.2f} m" + (f" and {np.rad2deg(self.turn):.0f} deg" if self.turn > LEAST_TURN else "")
        return f"jumped {what} within {self.interval:.2f} s at {self.time:.3f} s{anew}"


def find_breaks(times: ArrayLike, poses: ArrayLike) -> list[OdometryBreak]:
    """Find jumps in odometry that the wheels cannot have made.

    Parameters
    ----------
    times
        Ascending times (n,) [UTC s].
    poses
        x [m], y [m], yaw [rad] (n, 3) in the odometry frame.

    Returns
    -------
    list of OdometryBreak
        Breaks in the order of time. A jump is a single step that is far faster than the robot ever drives or turns.
    """
    t, p = np.asarray(times, float), np.asarray(poses, float).reshape(-1, 3)
    if len(t) < 2:
        return []
    steps = np.diff(p, axis=0)
    way, turn = np.hypot(steps[:, 0], steps[:, 1]), np.abs(wrap(steps[:, 2]))
    # two samples that come at once have not driven for no time
    lasted = np.maximum(np.diff(t), np.median(np.diff(t)))
    speed, rate = way / lasted, turn / lasted
    usual_speed, usual_rate = _usual(speed), _usual(rate)
    jumped = (speed > max(SPEED_FACTOR * usual_speed, LEAST_SPEED)) & (way > LEAST_STEP)
    jumped |= (rate > max(SPEED_FACTOR * usual_rate, LEAST_TURN_RATE)) & (turn > LEAST_TURN)
    found = []
    for k in np.flatnonzero(jumped).tolist():
        interval = float(t[k + 1] - t[k])
        drove = UNSURE_M + usual_speed * interval
        found.append(
            OdometryBreak(
                index=k + 1,
                time=float(t[k + 1]),
                distance=float(way[k]),
                turn=float(turn[k]),
                interval=interval,
                to_origin=not p[k + 1].any(),
                sigmas=(drove, drove, UNSURE_RAD + usual_rate * interval),
            )
        )
    return found


def _usual(speeds: Array) -> float:
    """Speed that the robot usually drives at most; 0 where it hardly ever moves."""
    moving = np.sort(speeds[speeds > 0])
    # a few jumps are not what is usual
    kept = moving[: max(len(moving) - 3, 0)]
    return float(np.quantile(kept, USUAL)) if len(kept) else 0.0


def joined(poses: ArrayLike, breaks: Sequence[OdometryBreak]) -> Array:
    """Poses (n, 3) in one frame: after each break they go on from where the robot was before it."""
    p = np.array(poses, float).reshape(-1, 3)
    for one in breaks:
        before, first = p[one.index - 1].copy(), p[one.index].copy()
        turned = before[2] - first[2]
        c, s = np.cos(turned), np.sin(turned)
        off = p[one.index :, :2] - first[:2]
        p[one.index :, 0] = before[0] + c * off[:, 0] - s * off[:, 1]
        p[one.index :, 1] = before[1] + s * off[:, 0] + c * off[:, 1]
        p[one.index :, 2] = wrap(p[one.index :, 2] + turned)
    return p
