"""Initial positions of landmarks by ranges from known places: trilateration that says where it is ambiguous."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Array = NDArray[np.float64]

STARTS = 8  # directions about the middle of the places from which the search begins
MAX_SAMPLES = 120  # samples that are used, evenly spread
PLACE_SIGMA = 0.05  # m, uncertainty of the places
MIN_PLACES = 0.3  # m, extent of the places below which nothing is located
MAX_SIGMA = 0.5  # m, uncertainty of a position above which it is none
APART = 0.3  # m, distance from which on two positions differ
SAME_COST = 6.0  # half chi2 by which the best position must be better than another


@dataclass(frozen=True, eq=False)
class Located:
    """Position x, y [m] of a landmark, or the reason why the ranges give none."""

    position: Array | None
    why: str = ""


def locate(places: Array, ranges: Array, sensors: Sequence[int], sigma: float, offset_sigma: float) -> Located:
    """Locate a landmark.

    Parameters
    ----------
    places : (n, 2) float
        Places of the antennas that measured [m].
    ranges : (n,) float
        Ranges [m].
    sensors : (n,) int
        Number of the sensor of each, which has an offset of its own.
    sigma, offset_sigma : float
        Standard deviations of a range and of the sensors' offsets [m].

    Returns
    -------
    Located
        The position, if only one fits.
    """
    every = np.unique(np.linspace(0, len(ranges) - 1, min(MAX_SAMPLES, len(ranges))).round().astype(int))
    p, r, who = places[every], ranges[every], np.unique(np.asarray(sensors)[every], return_inverse=True)[1]
    middle = p.mean(axis=0)
    if np.linalg.norm(np.ptp(p, axis=0)) < MIN_PLACES:
        return Located(None, "the places from which it was ranged are too close to each other")
    scale, prior = float(np.hypot(sigma, PLACE_SIGMA)), max(offset_sigma, 1e-6)
    count = int(who.max()) + 1

    def off(x: Array) -> Array:
        return np.asarray((np.hypot(*(p - x[:2]).T) + x[2:][who] - r) / scale)

    def residuals(x: Array) -> Array:
        # of a heavy tail: ranges without line of sight are too long
        e = off(x)
        return np.concatenate([np.sign(e) * np.sqrt(np.log1p(e**2)), x[2:] / prior])

    found = []
    for angle in np.linspace(0, 2 * np.pi, STARTS, endpoint=False):
        start = middle + float(np.median(r)) * np.array([np.cos(angle), np.sin(angle)])
        fit = least_squares(residuals, np.concatenate([start, np.zeros(count)]), method="lm", max_nfev=300)
        found.append((float(fit.cost), np.asarray(fit.x), np.asarray(fit.jac)))
    found.sort(key=lambda one: one[0])
    cost, x, J = found[0]
    if any(other - cost < SAME_COST and np.linalg.norm(y[:2] - x[:2]) > APART for other, y, _ in found[1:]):
        return Located(None, "its ranges fit a second position as well, as mirrored at a straight path")
    variances = np.linalg.pinv(J.T @ J).diagonal()[:2]
    if np.sqrt(variances.max()) > MAX_SIGMA:
        return Located(None, "its ranges leave its position open")
    return Located(x[:2])
