"""Slip of a robot at the end of a leap, and the margin that a view needs because of it."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

STOP_SIGMA = 0.01  # standard deviation of where a robot stops, per axis [m]
STOP_PER_METRE = 0.01  # the same for each metre that it has leapt [m]
HEADING_SIGMA = math.radians(1.0)  # standard deviation of the heading with which it stops [rad]
MIN_MARGIN = 4.0  # distance of markers from the borders of images without any slip [px]
SIGMAS = 2.0  # a view is kept clear by this number of standard deviations
DISTANCE = 1.5  # distance of the mover at which a slip turns the view [m]


@dataclass(frozen=True)
class WheelErrors:
    """Standard deviations of wheel odometry, which grow with the root of the way; where a leap ends is off by them.

    Attributes
    ----------
    along
        Of the distance, after one metre [m].
    turned, veer
        Of the heading, after turning by one radian and after driving one metre [rad].
    """

    along: float = 0.01
    turned: float = 0.01
    veer: float = 0.005

    @classmethod
    def of_wheels(cls, metre: float, base: float) -> "WheelErrors":
        """Return those of two wheels `base` [m] apart, each of which is off by `metre` [m] after one metre."""
        return cls(metre / math.sqrt(2), metre / math.sqrt(base), math.sqrt(2) * metre / base)


def stop_sigma(leapt: ArrayLike, wheels: WheelErrors | None = None) -> NDArray[np.float64]:
    """Return the standard deviation of where a robot stops after leaps (...) [m], across its way [m].

    With `wheels`, a heading that is off by their errors turns the way, too.
    """
    leapt = np.asarray(leapt, float)
    stop = np.hypot(STOP_SIGMA, STOP_PER_METRE * leapt)
    if wheels is None:
        return np.asarray(stop)
    return np.asarray(np.sqrt(stop**2 + (wheels.turned**2 / 2 + wheels.veer**2 * leapt / 3) * leapt**2))


def view_margins(
    leapt: ArrayLike, focal_px: float, wheels: WheelErrors, observers: int, *, known: bool
) -> NDArray[np.float64]:
    """Return the distances of markers from the borders of images at which slips do not make a view miss.

    Parameters
    ----------
    leapt
        Distances (...) that the last of the observers has leapt [m].
    focal_px
        Focal length of its camera [px].
    wheels
        Errors of its wheels.
    observers
        Number of observers.
    known
        True if the others are known to stand where they stand.

    Returns
    -------
    ndarray
        Distances (..., r, 2) of each observer from the left and right, and from the upper and lower borders [px].
    """
    leapt = np.asarray(leapt, float)
    stop = stop_sigma(leapt)
    turn = np.sqrt(HEADING_SIGMA**2 + wheels.turned**2 + wheels.veer**2 * leapt)
    off = np.stack([np.hypot(turn, stop_sigma(leapt, wheels) / DISTANCE), stop / DISTANCE], axis=-1)
    margins = np.repeat((MIN_MARGIN + SIGMAS * focal_px * off)[..., None, :], observers, axis=-2)
    if known:
        margins[..., :-1, :] = MIN_MARGIN
    return np.asarray(margins)
