"""Scatter of single fits: a random effect on the variance of their points, with a log-normal distribution over a run.

The vibration of one image, or lights that one pose shows from the side, make all points of a fit worse. How much fits
differ is learnt from the run; the variance of each is then its own scatter, drawn towards the run's.

Source: Gelman et al., "Bayesian Data Analysis", 2013, chapter 5.
"""

import math

import numpy as np
from numpy.typing import NDArray

from coloc_graph.team import Camera

Array = NDArray[np.float64]

OUTLYING = 3.0  # standard deviations from the run's scatter beyond which a fit is judged by itself
STEPS = 121  # spreads that are tried
REACH = 4.0  # standard deviations of the prior within which they lie


def variance_factor(chi2: float, dof: float, spread: float) -> float:
    """Estimate the expected variance of the points of a fit, relative to what is stated.

    Parameters
    ----------
    chi2, dof
        Squared residuals of the fit in units of the stated noise, and their degrees of freedom.
    spread
        Standard deviation of the logarithms of fits' variances; 0 if all have the stated one.

    Returns
    -------
    float
        The factor: the fit's own chi2/dof where that is far above what chance and spread allow.
    """
    if chi2 <= 0 or dof <= 0:
        return 1.0
    chance = 2 / dof
    if chi2 > dof * math.exp(OUTLYING * math.hypot(math.sqrt(chance), spread)):
        return chi2 / dof
    share = spread**2 / (spread**2 + chance)
    return math.exp(share * (math.log(chi2 / dof) + 1 / dof) + share * chance / 2)


def spread_of(camera_i: Camera, camera_j: Camera) -> float:
    """Return the standard deviation of the logarithms of fits' variances; 0 where no camera's noise is known."""
    noises = camera_i.centre_noise, camera_j.centre_noise
    return math.sqrt(sum(one.spread**2 for one in noises if one is not None) / 2)


def learn_spread(chi2: Array, dof: Array, level: float, median: float, factor: float) -> tuple[float, float]:
    """Learn how much the variances of fits differ.

    Parameters
    ----------
    chi2, dof
        Of each fit, (m,), with the noise of the run.
    level
        Variance of the logarithm of the run's noise, before these fits.
    median, factor
        Prior of the standard deviation of the logarithms of their variances: its median, and the factor within which
        that is known.

    Returns
    -------
    tuple of float
        Median and factor of the posterior.
    """
    told = (chi2 > 0) & (dof > 0)
    chi2, dof = chi2[told], dof[told]
    width = math.log(factor)
    steps = np.linspace(-REACH, REACH, STEPS)
    spreads = median * np.exp(width * steps)[:, None]
    y = np.log(chi2 / dof) + 1 / dof
    weight = 1 / (spreads**2 + 2 / dof)
    total = weight.sum(axis=1) + 1 / level  # of the mean, which is unknown by `level`
    square = (weight * y**2).sum(axis=1) - (weight * y).sum(axis=1) ** 2 / total
    likelihood = 0.5 * (np.log(weight).sum(axis=1) - np.log(total) - square - steps**2)
    p = np.exp(likelihood - likelihood.max())
    p /= p.sum()
    mean = float(p @ steps)
    sigma = math.sqrt(float(p @ (steps - mean) ** 2))
    return median * math.exp(width * mean), math.exp(max(width * sigma, 1e-3))
