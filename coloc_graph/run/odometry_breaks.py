"""Detection and joining of breaks in odometry: jumps that no wheel can make, as of a driver that restarts."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coloc_graph.geometry.se2 import wrap

Array = NDArray[np.float64]

USUAL_QUANTILE = 0.95  # quantile of the speeds while moving that is the usual top speed
SPEED_FACTOR = 3.0  # speed of a jump relative to the usual top speed
MIN_SPEED = 1.0  # m/s, of a jump
MIN_TURN_RATE = 6.0  # rad/s, of a jump
MIN_STEP = 0.03  # m: shorter jumps do no harm
MIN_TURN = 0.15  # rad: smaller turns do no harm
BREAK_SIGMA = 0.01  # m: sigma of the distance across a break, besides the motion in it
BREAK_YAW_SIGMA = 0.02  # rad: the same of its turn


@dataclass(frozen=True)
class OdometryBreak:
    """A jump in odometry.

    Parameters
    ----------
    index : int
        First sample after it.
    time : float
        Time of that sample [UTC s].
    distance, turn : float
        Size of the jump [m], [rad].
    interval : float
        Time since the sample before [s].
    to_origin : bool
        The samples restart at exactly (0, 0, 0).
    sigmas : (float, float, float)
        Standard deviations of the motion in the interval: x, y [m], yaw [rad].
    """

    index: int
    time: float
    distance: float
    turn: float
    interval: float
    to_origin: bool
    sigmas: tuple[float, float, float]

    def __str__(self) -> str:
        anew = ": it restarted at the origin" if self.to_origin else ""
        what = f"by {self.distance:.2f} m" + (f" and {np.rad2deg(self.turn):.0f} deg" if self.turn > MIN_TURN else "")
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
    # samples with (almost) the same time would give infinite speeds
    lasted = np.maximum(np.diff(t), np.median(np.diff(t)))
    speed, rate = way / lasted, turn / lasted
    usual_speed, usual_rate = _usual(speed), _usual(rate)
    jumped = (speed > max(SPEED_FACTOR * usual_speed, MIN_SPEED)) & (way > MIN_STEP)
    jumped |= (rate > max(SPEED_FACTOR * usual_rate, MIN_TURN_RATE)) & (turn > MIN_TURN)
    found = []
    for k in np.flatnonzero(jumped).tolist():
        interval = float(t[k + 1] - t[k])
        drove = BREAK_SIGMA + usual_speed * interval
        found.append(
            OdometryBreak(
                index=k + 1,
                time=float(t[k + 1]),
                distance=float(way[k]),
                turn=float(turn[k]),
                interval=interval,
                to_origin=not p[k + 1].any(),
                sigmas=(drove, drove, BREAK_YAW_SIGMA + usual_rate * interval),
            )
        )
    return found


def _usual(speeds: Array) -> float:
    """Usual top speed of a robot; 0 where it hardly ever moves."""
    moving = np.sort(speeds[speeds > 0])
    # without the few fastest, which may be jumps
    kept = moving[: max(len(moving) - 3, 0)]
    return float(np.quantile(kept, USUAL_QUANTILE)) if len(kept) else 0.0


def join_breaks(poses: ArrayLike, breaks: Sequence[OdometryBreak]) -> Array:
    """Return poses (n, 3) in one frame: after each break they continue from the pose before it."""
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
