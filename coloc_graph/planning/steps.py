"""Covariance after several leaps and stances as a function of that before them; `Steps`."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Steps:
    """Covariance after some leaps and stances: P -> C + A P (I + B P)^-1 A^T, (..., d, d) each."""

    A: Array
    B: Array
    C: Array

    def then(self, later: "Steps") -> "Steps":
        """Return these steps followed by later ones.

        Notes
        -----
        Sarkka and Garcia-Fernandez, "Temporal parallelization of Bayesian smoothers", 2021.
        """
        back = np.linalg.inv(np.eye(self.A.shape[-1]) + self.C @ later.B)
        through = later.A @ back
        return Steps(
            through @ self.A,
            self.B + self.A.mT @ later.B @ back @ self.A,
            later.C + through @ self.C @ later.A.mT,
        )

    def variance(self, P: Array, weights: Array) -> Array:
        """Return the weighted sum (...) of the variances after the steps; of covariances (..., d, d), weights (d,)."""
        used = np.flatnonzero(weights)
        left = np.linalg.solve(np.eye(P.shape[-1]) + P @ self.B, P)
        a, c = self.A[..., used, :], self.C[..., used, used]
        return np.asarray(((a @ left * a).sum(axis=-1) + c) @ weights[used])
