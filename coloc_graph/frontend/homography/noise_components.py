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
MIN_CLUSTERS = 5  # from which on their scatter is judged
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
    clusters
        Numbers (n,), from 0 on, of what may have noise of its own, such as images that one fit is made to; None if that
        is all of it.
    """

    residual: Array
    design: Array
    parts: Array
    components: NDArray[np.int64]
    weight: float = 1.0
    clusters: NDArray[np.int64] | None = None


def learn_components(evidence: Sequence[NoiseEvidence], mean: Array, covariance: Array) -> tuple[Array, Array]:
    """Estimate the logarithms of variance components.

    The covariance allows for clusters (fits, or their `clusters`) whose noise differs.

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
    scores, information = _scores(evidence, np.exp(logs))
    return logs, np.linalg.inv(information / _dispersion(scores, information) + precision)


def _dispersion(scores: Array, information: Array) -> float:
    """Factor (at least 1) by which scores (m, k) of m clusters scatter more than their information (k, k) says.

    Clusters whose noise differs, as that of images which were shaken more or less, tell less of the next one than
    their points would alone.

    Source: Liang and Zeger, "Longitudinal Data Analysis Using Generalized Linear Models", 1986.
    """
    if len(scores) < MIN_CLUSTERS:
        return 1.0
    return max(1.0, float((scores**2).sum() / max(np.trace(information), 1e-300)))


def _score(evidence: Sequence[NoiseEvidence], variances: Array) -> tuple[Array, Array]:
    """Derivative (k,) of the restricted log likelihood by the logarithms of variances, and its information (k, k)."""
    scores, information = _scores(evidence, variances)
    return scores.sum(axis=0), information


def scatter_of(evidence: Sequence[NoiseEvidence], variances: Array, covariance: Array) -> tuple[Array, Array, float]:
    """Compare the residuals of each fit with variance components.

    Parameters
    ----------
    evidence
        Residuals of m fits.
    variances, covariance
        Variance components (k,), and the covariance (k, k) of their logarithms, as it is to be judged.

    Returns
    -------
    tuple
        chi2 (m,), degrees of freedom (m,), and the variance of the logarithm of a typical point's variance.
    """
    chi2, dof, levels = [], [], []
    for one in evidence:
        parts = variances[one.components, None, None, None] * one.parts
        C = parts.sum(axis=0)
        inverse = np.linalg.inv(C)
        left, _, _ = _whitened(one, inverse)
        chi2.append(one.weight * float(np.einsum("na,nab,nb->", left, C, left)))
        dof.append(one.weight * float(2 * len(one.residual) - one.design.shape[2]))
        share = np.zeros(len(variances))
        np.add.at(share, one.components, np.einsum("nab,cnba->c", inverse, parts) / (2 * len(one.residual)))
        levels.append(float(share @ covariance @ share))
    return np.array(chi2), np.array(dof), float(np.mean(levels))


def _whitened(one: NoiseEvidence, inverse: Array) -> tuple[Array, Array, Array]:
    """Residuals (n, 2) that a fit leaves, times `inverse` (n, 2, 2); `inverse` times the design; its covariance."""
    weighted = inverse @ one.design
    normal = np.linalg.inv(np.einsum("nap,naq->pq", one.design, weighted))
    h = normal @ np.einsum("nap,na->p", weighted, one.residual)
    return (inverse @ (one.residual - one.design @ h)[..., None])[..., 0], weighted, normal


def _scores(evidence: Sequence[NoiseEvidence], variances: Array) -> tuple[Array, Array]:
    """Derivatives (m, k) of the restricted log likelihood of each cluster, and the information of all (k, k)."""
    k = len(variances)
    scores, information = [np.zeros((0, k))], np.zeros((k, k))
    for one in evidence:
        parts = variances[one.components, None, None, None] * one.parts
        inverse = np.linalg.inv(parts.sum(axis=0))
        left, weighted, normal = _whitened(one, inverse)
        square = np.einsum("na,cnab,nb->nc", left, parts, left)
        spread = weighted @ np.linalg.cholesky(normal)  # so that what the fit explains is a sum of squares
        used = np.einsum("nap,cnab,nbp->nc", spread, parts, spread)
        relative = inverse @ parts  # (c, n, 2, 2)
        trace = np.einsum("cnaa->nc", relative) - used
        n, p = len(one.residual), one.design.shape[2]
        by_pair = np.einsum("cnab,dnba->cd", relative, relative) * (1 - p / (2 * n))
        clusters = np.zeros(n, np.int64) if one.clusters is None else one.clusters
        own = np.zeros((int(clusters.max(initial=0)) + 1, k))
        np.add.at(own, (clusters[:, None], one.components), 0.5 * one.weight * (square - trace))
        scores.append(own)
        np.add.at(information, np.ix_(one.components, one.components), 0.5 * one.weight * by_pair)
    return np.concatenate(scores), information
