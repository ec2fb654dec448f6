"""Does a measurement agree with all the others? Standardised residuals, and the gate they must pass.

Source: W. Baarda, "A Testing Procedure for Use in Geodetic Networks", 1968.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, gammaln

Array = NDArray[np.float64]

#: A measurement that noise alone puts this far off less often than this is rejected.
LEAST_CHANCE = 1e-6
#: Of a whitened residual, the directions that others check by less than this share of its variance are unchecked.
LEAST_CHECKED = 1e-3


@dataclass(frozen=True)
class Agreement:
    """How far a measurement is from what all others say of it: `chi2` with `dof` degrees of freedom.

    `dof` is 0 where nothing can contradict it.
    """

    chi2: float
    dof: int

    def chance(self, scale: float = 1.0) -> float:
        """How often noise alone does that, where variances are `scale` times what is stated."""
        return float(chdtrc(self.dof, self.chi2 / scale)) if self.dof else 1.0

    def log_chance(self) -> float:
        """The natural logarithm of that chance, also where it is too small for a number."""
        x, a = self.chi2 / 2, self.dof / 2
        if self.chance() > 1e-290:
            return float(np.log(self.chance()))
        return -x + (a - 1) * float(np.log(x)) - float(gammaln(a))  # the upper incomplete gamma function far out

    @property
    def sigmas(self) -> float:
        """The distance in standard deviations, if all of it lay in one direction."""
        return float(np.sqrt(self.chi2))


#: Of what nothing can contradict.
UNCHECKED = Agreement(0.0, 0)


def agreement(factors: Sequence[gtsam.NonlinearFactor], values: gtsam.Values, joint: Array) -> Agreement:
    """The standardised residual of factors that are in a fit, by the joint covariance of their `keys_of`.

    The covariance of a whitened residual e = A x - b after the fit is I - A P A^T: e^T (I - A P A^T)^-1 e is chi2
    distributed, and is what the sum of squares falls by when they are left out.
    """
    A, b = _whitened(factors, values)
    checked, directions = np.linalg.eigh(np.eye(len(b)) - A @ joint @ A.T)
    kept = checked > LEAST_CHECKED
    along = directions.T @ b
    return Agreement(float((along[kept] ** 2 / checked[kept]).sum()), int(kept.sum()))


def innovation(factors: Sequence[gtsam.NonlinearFactor], values: gtsam.Values, joint: Array) -> Agreement:
    """The same of factors that are not in the fit: e^T (I + A P A^T)^-1 e."""
    A, b = _whitened(factors, values)
    return Agreement(float(b @ np.linalg.solve(np.eye(len(b)) + A @ joint @ A.T, b)), len(b))


def keys_of(factors: Iterable[gtsam.NonlinearFactor]) -> list[int]:
    """What factors are on, each once, as it first comes."""
    return list(dict.fromkeys(int(key) for factor in factors for key in factor.keys()))  # noqa: SIM118


def _whitened(factors: Sequence[gtsam.NonlinearFactor], values: gtsam.Values) -> tuple[Array, Array]:
    """Whitened Jacobian (m, n) by all of their keys, and residual (m,), of the rows that weigh."""
    linear = gtsam.GaussianFactorGraph()
    for factor in factors:
        linear.push_back(factor.linearize(values))
    ordering = gtsam.Ordering()
    for key in keys_of(factors):
        ordering.push_back(key)
    A, b = linear.jacobian(ordering)
    weighing = np.abs(A).max(axis=1) > 0
    return A[weighing], np.asarray(b)[weighing]
