"""Variance components of marker centres by restricted maximum likelihood, from the residuals of homographies.

The residuals of a fit are smaller than the noise, since eight numbers were fitted to them; the restricted likelihood
counts that. The components are variances, estimated by Fisher scoring of their logarithms under a normal prior, so that
what points do not tell stays as the prior has it, and one stance after the other gives what all together do.

Source: Searle, Casella, McCulloch, "Variance Components", 1992, chapters 6 and 8.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_ITERATIONS = 50
MAX_STEP = 1.5  # of the logarithm of a variance in one iteration
CONVERGED = 1e-3  # step of the logarithms of variances, in posterior standard deviations, at which the search ends


@dataclass(frozen=True, eq=False)
class NoiseEvidence:
    """Residuals of one fit, and the components that their covariance is made of.

    Attributes
    ----------
    residual
        Residuals (n, 2).
    design
        Their derivatives by the p fitted unknowns, (n, 2, p).
    parts
        Covariance (c, n, 2, 2) of the residuals for a variance of 1 of each component.
    components
        Index (c,) of each component among all that are estimated.
    weight
        Share of the evidence that counts: less than 1 where errors of neighbouring points are alike, or points are
        evidence elsewhere, too.
    """

    residual: Array
    design: Array
    parts: Array
    components: NDArray[np.int64]
    weight: float = 1.0


def learn_components(evidence: Sequence[NoiseEvidence], mean: Array, covariance: Array) -> tuple[Array, Array]:
    """Estimate the logarithms of variance components.

    Parameters
    ----------
    evidence
        Residuals of fits that are independent of each other.
    mean, covariance
        Prior (k,), (k, k) of the logarithms of the variances.

    Returns
    -------
    tuple of numpy.ndarray
        Most likely logarithms (k,), and their covariance (k, k) by the expected information.
    """
    precision = np.linalg.inv(covariance)
    logs = mean.copy()
    for _ in range(MAX_ITERATIONS):
        score, information = _score(evidence, np.exp(logs))
        total = information + precision
        step = np.linalg.solve(total, score - precision @ (logs - mean))
        step *= min(1.0, MAX_STEP / max(float(np.abs(step).max()), 1e-12))
        logs = logs + step
        if step @ total @ step < CONVERGED**2 * len(step):
            break
    _, information = _score(evidence, np.exp(logs))
    return logs, np.linalg.inv(information + precision)


def _score(evidence: Sequence[NoiseEvidence], variances: Array) -> tuple[Array, Array]:
    """Derivative (k,) of the restricted log likelihood by the logarithms of variances, and its information (k, k)."""
    k = len(variances)
    score, information = np.zeros(k), np.zeros((k, k))
    for one in evidence:
        parts = variances[one.components, None, None, None] * one.parts
        inverse = np.linalg.inv(parts.sum(axis=0))
        weighted = inverse @ one.design
        normal = np.linalg.inv(np.einsum("nap,naq->pq", one.design, weighted))
        h = normal @ np.einsum("nap,na->p", weighted, one.residual)
        left = (inverse @ (one.residual - one.design @ h)[..., None])[..., 0]
        square = np.einsum("na,cnab,nb->c", left, parts, left)
        used = np.einsum("nap,cnab,nbq,pq->c", weighted, parts, weighted, normal)
        relative = inverse @ parts  # (c, n, 2, 2)
        trace = np.einsum("cnaa->c", relative) - used
        n, p = len(one.residual), one.design.shape[2]
        by_pair = np.einsum("cnab,dnba->cd", relative, relative) * (1 - p / (2 * n))
        np.add.at(score, one.components, 0.5 * one.weight * (square - trace))
        np.add.at(information, np.ix_(one.components, one.components), 0.5 * one.weight * by_pair)
    return score, information
