"""One value from many that share errors: generalised least squares, and which of them contradict the others."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Said:
    """Estimates of one value of m numbers from n images.

    `values` (n, m), the `own` covariance of each (n, m, m), and the covariance of what they share, `common`
    (n, m, n, m).
    """

    values: Array
    own: Array
    common: Array

    def of(self, kept: Sequence[int]) -> "Said":
        """Those of some images."""
        at = list(kept)
        return Said(self.values[at], self.own[at], self.common[at][:, :, at])

    def covariance(self, scale: float = 1.0) -> Array:
        """Of all they say (nm, nm); their own errors larger by `scale`, in variance."""
        n, m = self.values.shape
        V = self.common.copy()
        V[np.arange(n), :, np.arange(n), :] += scale * self.own
        return V.reshape(n * m, n * m)


@dataclass(frozen=True, eq=False)
class Fused:
    """The most likely value (m,), its covariance, how they agree (`chi2` over `dof`), and the scale of own errors.

    `weights` (m, nm) are those of what each image says.
    """

    value: Array
    covariance: Array
    chi2: float
    dof: int
    scale: float
    weights: Array


def fuse(said: Said, scale: float = 1.0) -> Fused:
    """The value that all say, most likely."""
    n, m = said.values.shape
    V = said.covariance(scale)
    X = np.tile(np.eye(m), (n, 1))
    of_X = np.linalg.solve(V, X)
    weights = np.linalg.solve(X.T @ of_X, of_X.T)
    value = weights @ said.values.ravel()
    r = (said.values - value).ravel()
    chi2 = float(r @ np.linalg.solve(V, r))
    return Fused(value, weights @ V @ weights.T, chi2, m * (n - 1), scale, weights)


def fuse_scaled(said: Said, chance: float) -> Fused:
    """`fuse`, with own errors larger where the values disagree by more than this chance; chi2 is that of the first."""
    first = fuse(said)
    if not first.dof or first.chi2 <= chdtri(first.dof, chance):
        return first
    again = fuse(said, first.chi2 / first.dof)
    return Fused(again.value, again.covariance, first.chi2, first.dof, again.scale, again.weights)


def disagreement(said: Said) -> Array:
    """The chi-square of each image's value against what all the others say (n,); m degrees of freedom each."""
    n, m = said.values.shape
    out = np.zeros(n)
    for index in range(n):
        others = [one for one in range(n) if one != index]
        fused = fuse(said.of(others))
        # what is shared says little about a difference
        cross = fused.weights @ said.common[others][:, :, index].reshape((n - 1) * m, m)
        apart = said.values[index] - fused.value
        V = said.own[index] + said.common[index, :, index] + fused.covariance - cross - cross.T
        out[index] = apart @ np.linalg.solve(V, apart)
    return out
