"""Slip of a robot at the end of a leap, and the margin that a view needs because of it."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

STOP_SIGMA = 0.01  # standard deviation of where a robot stops, per axis [m]
STOP_PER_METRE = 0.01  # the same for each metre that it has leapt [m]
HEADING_SIGMA = math.radians(1.0)  # standard deviation of the heading with which it stops [rad]
MIN_MARGIN = 4.0  # distance of markers from the borders of images without any slip [px]
SIGMAS = 2.0  # a view is kept clear by this number of standard deviations
DISTANCE = 1.5  # distance of the mover at which a slip turns the view [m]


def stop_sigma(leapt: ArrayLike) -> NDArray[np.float64]:
    """Return the standard deviation of where a robot stops after leaps (...) [m], per axis [m]."""
    return np.hypot(STOP_SIGMA, STOP_PER_METRE * np.asarray(leapt, float))


def view_margin(leapt: ArrayLike, focal_px: float) -> NDArray[np.float64]:
    """Return the distance of markers from the borders of images [px] at which a slip does not make the view miss.

    Parameters
    ----------
    leapt
        Distances (...) that the observer has leapt [m].
    focal_px
        Focal length of its camera [px].
    """
    turn = np.hypot(HEADING_SIGMA, stop_sigma(leapt) / DISTANCE)
    return np.asarray(MIN_MARGIN + SIGMAS * focal_px * turn)
