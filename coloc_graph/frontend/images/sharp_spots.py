"""Measure spots that pixels undersample, by two estimators.

The centre in a window of such a spot's own shape depends on where in a pixel the spot lies, and so does a centre of
mass, in another way. Sharp spots get the mean of both, and those too sharp for a window the centre of mass.

`kernel/spots.c` computes the same, and is changed along with it: `tests/frontend/test_kernel.py` compares them.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SHARP = 0.8  # px, half short axis of a spot below which pixels undersample it
TOO_SHARP = 1.2  # px, the same of its bright pixels, where no window fits


def sharp_spots(shape: Array, rough: Array) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Find the spots that pixels undersample.

    Parameters
    ----------
    shape, rough
        Second moments (3, n: xx, xy, yy) of spots by a window, and of their bright pixels, which stand where no window
        fits [px^2].

    Returns
    -------
    tuple
        Their indices (m,), and True for each of them that has a window (m,).
    """
    fits = (shape != rough).any(axis=0)
    xx, xy, yy = shape
    short = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
    sharp = np.flatnonzero(short < np.where(fits, SHARP, TOO_SHARP) ** 2)
    return sharp, fits[sharp]


def centres_of_mass(
    light: Array, size: NDArray[np.int64], inner: NDArray[np.bool_], noise: Array, shot_gain: float
) -> tuple[Array, Array]:
    """Compute the centres of mass of bright pixels and those beside them.

    Parameters
    ----------
    light, size, inner
        Windows without background (n, s, s) [grey levels], their sizes without padding (n, 2) [px: u, v], and their
        bright pixels.
    noise
        Standard deviation of a dark pixel, (n,) [grey levels].
    shot_gain
        Variance that one grey level of light adds to a pixel [grey levels].

    Returns
    -------
    tuple of numpy.ndarray
        Centres (2, n) [px], and their covariances (n, 2, 2) [px^2].
    """
    near = inner.copy()
    near[:, 1:] |= inner[:, :-1]
    near[:, :-1] |= inner[:, 1:]
    column = near.copy()
    near[:, :, 1:] |= column[:, :, :-1]
    near[:, :, :-1] |= column[:, :, 1:]
    at = np.arange(light.shape[2], dtype=float)
    near &= (at < size[:, 1:])[:, :, None] & (at < size[:, :1])[:, None, :]
    lit = np.maximum(light, 0.0) * near
    total = np.maximum(lit.sum(axis=(1, 2)), 1e-9)
    centre = np.array([lit.sum(axis=1) @ at, lit.sum(axis=2) @ at]) / total
    x, y = (at - one[:, None] for one in centre)
    variance = near * (noise * noise)[:, None, None] + shot_gain * lit
    covariance = np.empty((len(light), 2, 2))
    covariance[:, 0, 0] = (variance.sum(axis=1) * x * x).sum(axis=1)
    covariance[:, 1, 1] = (variance.sum(axis=2) * y * y).sum(axis=1)
    covariance[:, 0, 1] = covariance[:, 1, 0] = np.einsum("nij,ni,nj->n", variance, y, x)
    return centre, covariance / (total * total)[:, None, None]
