"""Chi-squared tests of a measurement against all others, by standardised residuals.

Source: W. Baarda, "A Testing Procedure for Use in Geodetic Networks", 1968.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space
from scipy.special import chdtrc, gammaln

Array = NDArray[np.float64]

REJECTION_P_VALUE = 1e-6  # probability by noise below which a measurement is rejected
MIN_REDUNDANCY = 1e-3  # redundancy (share of variance) below which a direction of a residual is unchecked
RANK_TOLERANCE = 1e-10  # singular value relative to the largest, of columns of length 1, below which it is zero


@dataclass(frozen=True, slots=True)
class Agreement:
    """Test statistic of a measurement against all others: `chi2` with `dof` degrees of freedom.

    `dof` is 0 where nothing can contradict it.
    """

    chi2: float
    dof: int

    def p_value(self, scale: float = 1.0) -> float:
        """Probability of a larger chi2 by noise alone, with variances `scale` times those stated."""
        return float(chdtrc(self.dof, self.chi2 / scale)) if self.dof else 1.0

    def log_p_value(self) -> float:
        """Natural logarithm of the p-value, also where that underflows."""
        x, a = self.chi2 / 2, self.dof / 2
        if self.p_value() > 1e-290:
            return float(np.log(self.p_value()))
        return -x + (a - 1) * float(np.log(x)) - float(gammaln(a))  # asymptote of the upper incomplete gamma function

    @property
    def sigmas(self) -> float:
        """Distance in standard deviations, if all of it lies in one direction."""
        return float(np.sqrt(self.chi2))

    @property
    def reason(self) -> str:
        """Reason of a rejection in words."""
        return f"an outlier: {self.sigmas:.0f} sigmas from the other measurements"


def p_values(tested: Iterable[Agreement], scale: float = 1.0) -> Array:
    """Return the p-values (n,) of tests, see `Agreement.p_value`."""
    chi2, dof = np.array([(one.chi2, one.dof) for one in tested], float).reshape(-1, 2).T
    return np.where(dof > 0, chdtrc(np.maximum(dof, 1), chi2 / scale), 1.0)


UNCHECKED = Agreement(0.0, 0)  # of a measurement that nothing can contradict


def agreement(factors: Sequence[gtsam.NonlinearFactor], values: gtsam.Values, root: Array) -> Agreement:
    """Test factors that are in a fit, by a root S of the joint covariance P = S S^T of their `keys_of`.

    The covariance of a whitened residual e = A x - b after the fit is I - A P A^T: e^T (I - A P A^T)^-1 e is chi2
    distributed, and is the decrease of the sum of squares when they are left out.
    """
    A, b = _whitened(factors, values)
    spread = A @ root
    known, directions = np.linalg.eigh(spread @ spread.T)
    kept = known < 1.0 - MIN_REDUNDANCY
    along = (b @ directions)[kept]
    return Agreement(float(along @ (along / (1.0 - known[kept]))), int(np.count_nonzero(kept)))


def agreement_by_covariance(factors: Sequence[gtsam.NonlinearFactor], values: gtsam.Values, joint: Array) -> Agreement:
    """Test factors that are in a fit, as `agreement`, by the joint covariance of their `keys_of`."""
    A, b = _whitened(factors, values)
    return _tested(A[None], b[None], joint[None])[0]


def agreements(
    factors: Sequence[gtsam.NonlinearFactor], values: gtsam.Values, joint: Callable[[Sequence[int]], Array]
) -> list[Agreement]:
    """Test each of some factors that are in a fit, as `agreement`; `joint` gives the joint covariance of keys."""
    return _each(factors, values, joint, _tested)


def _each(
    factors: Sequence[gtsam.NonlinearFactor],
    values: gtsam.Values,
    joint: Callable[[Sequence[int]], Array],
    test: Callable[[Array, Array, Array], list[Agreement]],
) -> list[Agreement]:
    """Test each of some factors by its whitened Jacobian, residual and joint covariance, those of one shape at once."""
    alike: dict[tuple[int, ...], list[tuple[int, Array, Array, Array]]] = defaultdict(list)
    for n, factor in enumerate(factors):
        A, b = _weighing(*factor.linearize(values).jacobian())
        alike[A.shape].append((n, A, b, joint(list(factor.keys()))))
    found = dict[int, Agreement]()
    for some in alike.values():
        numbers, *stacks = zip(*some, strict=True)
        found.update(zip(numbers, test(*map(np.array, stacks)), strict=True))
    return [found[n] for n in range(len(factors))]


def _innovative(A: Array, b: Array, joint: Array) -> list[Agreement]:
    """Tests of n whitened residuals that are not in a fit, as `_tested`."""
    weighed = np.linalg.solve(np.eye(b.shape[1]) + A @ joint @ A.mT, b[..., None])[..., 0]
    return [Agreement(chi2, b.shape[1]) for chi2 in (b * weighed).sum(axis=1).tolist()]


def _tested(A: Array, b: Array, joint: Array) -> list[Agreement]:
    """Tests of n whitened residuals (n, m) in a fit, with Jacobians (n, m, k) and joint covariances (n, k, k)."""
    checked, directions = np.linalg.eigh(np.eye(b.shape[1]) - A @ joint @ A.mT)
    kept = checked > MIN_REDUNDANCY
    along = (directions.mT @ b[..., None])[..., 0]
    squares = np.where(kept, along**2 / np.where(kept, checked, 1.0), 0.0)
    return [Agreement(*one) for one in zip(squares.sum(axis=1).tolist(), kept.sum(axis=1).tolist(), strict=True)]


def innovations(
    factors: Sequence[gtsam.NonlinearFactor], values: gtsam.Values, joint: Callable[[Sequence[int]], Array]
) -> list[Agreement]:
    """Test each of some factors that are not in a fit, as `innovation`; `joint` gives the joint covariance of keys."""
    return _each(factors, values, joint, _innovative)


def innovation(
    factors: Sequence[gtsam.NonlinearFactor], values: gtsam.Values, root: Array, keys: Sequence[int] | None = None
) -> Agreement:
    """Test factors that are not in the fit, as `agreement`: e^T (I + A P A^T)^-1 e.

    `keys` are given where the fit lacks some, which come last and are unknown: what determines them is then no part of
    the test. It is `UNCHECKED` where nothing is left.
    """
    A, b = _whitened(factors, values, keys)
    spread, unknown = A[:, : len(root)] @ root, A[:, len(root) :]
    if unknown.shape[1]:
        lengths = np.linalg.norm(unknown, axis=0)
        beyond = null_space((unknown / np.where(lengths > 0.0, lengths, 1.0)).T, rcond=RANK_TOLERANCE)
        spread, b = beyond.T @ spread, beyond.T @ b
    return Agreement(float(b @ np.linalg.solve(np.eye(len(b)) + spread @ spread.T, b)), len(b))


def keys_of(factors: Iterable[gtsam.NonlinearFactor]) -> list[int]:
    """Return the keys of factors, each once, in the order of their first appearance."""
    return list(dict.fromkeys(int(key) for factor in factors for key in factor.keys()))  # noqa: SIM118


def _whitened(
    factors: Sequence[gtsam.NonlinearFactor], values: gtsam.Values, keys: Sequence[int] | None = None
) -> tuple[Array, Array]:
    """Whitened Jacobian (m, n) by all of their keys, and residual (m,), of the rows that are not zero."""
    graph, ordering = gtsam.NonlinearFactorGraph(), gtsam.Ordering()
    for factor in factors:
        graph.add(factor)
    for key in keys_of(factors) if keys is None else keys:
        ordering.push_back(key)
    return _weighing(*graph.linearize(values).jacobian(ordering))


def _weighing(A: Array, b: Array) -> tuple[Array, Array]:
    """Return the rows of a Jacobian and a residual that are not zero."""
    weighing = A.any(axis=1)
    return A[weighing], b[weighing]
