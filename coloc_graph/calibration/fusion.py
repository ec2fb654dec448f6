"""Fuse estimates with shared errors by generalised least squares, and test which contradict the others."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Estimates:
    """Estimates of one vector (m,) from n images.

    Attributes
    ----------
    values
        Estimates, (n, m).
    own
        Covariances of their independent errors, (n, m, m).
    common
        Covariance of their shared errors, (n, m, n, m).
    """

    values: Array
    own: Array
    common: Array

    def of(self, kept: Sequence[int]) -> "Estimates":
        """Select the estimates of some images by index."""
        at = list(kept)
        return Estimates(self.values[at], self.own[at], self.common[at][:, :, at])

    def covariance(self, scale: float = 1.0) -> Array:
        """Joint covariance of all estimates, (nm, nm), with the variances of independent errors scaled."""
        n, m = self.values.shape
        V = self.common.copy()
        V[np.arange(n), :, np.arange(n), :] += scale * self.own
        return V.reshape(n * m, n * m)


@dataclass(frozen=True, eq=False)
class Fused:
    """Fused estimate.

    Attributes
    ----------
    value, covariance
        Maximum-likelihood value, (m,), and its covariance, (m, m).
    chi2, dof
        Agreement of the estimates.
    scale
        Factor by which the variances of independent errors were scaled.
    weights
        Weights of the estimates, (m, nm).
    """

    value: Array
    covariance: Array
    chi2: float
    dof: int
    scale: float
    weights: Array


def fuse(said: Estimates, scale: float = 1.0) -> Fused:
    """Fuse estimates by generalised least squares."""
    n, m = said.values.shape
    V = said.covariance(scale)
    X = np.tile(np.eye(m), (n, 1))
    of_X = np.linalg.solve(V, X)
    weights = np.linalg.solve(X.T @ of_X, of_X.T)
    value = weights @ said.values.ravel()
    r = (said.values - value).ravel()
    chi2 = float(r @ np.linalg.solve(V, r))
    return Fused(value, weights @ V @ weights.T, chi2, m * (n - 1), scale, weights)


def fuse_scaled(said: Estimates, chance: float) -> Fused:
    """Fuse estimates, with independent errors enlarged if they disagree at this p-value; chi2 is that before."""
    first = fuse(said)
    if not first.dof or first.chi2 <= chdtri(first.dof, chance):
        return first
    again = fuse(said, first.chi2 / first.dof)
    return Fused(again.value, again.covariance, first.chi2, first.dof, again.scale, again.weights)


def disagreement(said: Estimates) -> Array:
    """Chi-square (n,) of each estimate against the fusion of all others, with m degrees of freedom."""
    n, m = said.values.shape
    out = np.zeros(n)
    for index in range(n):
        others = [one for one in range(n) if one != index]
        fused = fuse(said.of(others))
        # shared errors cancel in the difference
        cross = fused.weights @ said.common[others][:, :, index].reshape((n - 1) * m, m)
        apart = said.values[index] - fused.value
        V = said.own[index] + said.common[index, :, index] + fused.covariance - cross - cross.T
        out[index] = apart @ np.linalg.solve(V, apart)
    return out
