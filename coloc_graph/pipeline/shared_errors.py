"""Size of the errors of marker centres that all samples of a marker share, by an estimate."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from coloc_graph.backend import Estimate
from coloc_graph.backend.shared_noise import SharedNoise, learn_shared_noise, shared_part
from coloc_graph.frontend import PairMeasurement
from coloc_graph.frontend.learnt_noise import NoiseBelief, measured_again
from coloc_graph.team import Team

MIN_SHARED = 0.02  # part of homographies' covariance by shared errors below which their size is not looked for
UNEXPLAINED = 2.0  # chi2/dof from which on a few wrong measurements are not the cause
ROUNDS = 4  # at most, of estimating and learning
GROWN = 1.5  # factor of the shared errors above which the estimate that they were learnt from was bent by them

#: Joint estimate of measurements with a noise, started at an estimate.
Again = Callable[[NoiseBelief, Sequence[PairMeasurement], Estimate], Estimate]


def learn_shared_errors(
    estimate: Estimate, noise: NoiseBelief, measured: tuple[PairMeasurement, ...], team: Team, again: Again
) -> tuple[Estimate, NoiseBelief, tuple[PairMeasurement, ...]]:
    """Learn the shared errors from a joint estimate, and estimate again with them.

    Homographies that are trusted too much bend planes and mounts to fit them. The errors that such an estimate leaves
    are too small, and are learnt again from the better one.

    Parameters
    ----------
    estimate, noise, measured
        Joint estimate, and the noise with which its homographies were measured.
    team
        The team as stated.
    again
        Function that estimates again.

    Returns
    -------
    tuple
        Estimate, noise and measurements; those given where shared errors hardly count.
    """
    prior = noise
    for _ in range(ROUNDS):
        shared = shared_noise_of(estimate, prior, noise)
        if shared is None:
            break
        noisier = prior.with_bias(shared.size, shared.factor)
        noisy = measured_again(measured, noisier.used(team))
        # errors so large that a pair tells nothing any more are none of the cameras'
        if _usable(noisy) != _usable(measured):
            break
        grown = _expected(noisier) / _expected(noise)
        estimate, noise, measured = again(noisier, noisy, estimate), noisier, noisy
        if grown < GROWN:
            break
    return estimate, noise, measured


def _usable(measured: Sequence[PairMeasurement]) -> int:
    return sum(one.relative_pose is not None for one in measured)


def _expected(noise: NoiseBelief) -> float:
    """Mean of the expected shared errors of the cameras [px]."""
    return float(np.mean(noise.bias_px * np.exp(np.log(noise.bias_factor) ** 2)))


def shared_noise_of(estimate: Estimate, prior: NoiseBelief, noise: NoiseBelief) -> SharedNoise | None:
    """Size of shared errors relative to a prior; None where they hardly count.

    `noise` is that with which the estimate's homographies were measured.
    """
    factor = float(np.median(prior.bias_factor))
    explained = estimate.chi2 < UNEXPLAINED * estimate.dof
    used = estimate.graph
    if explained:
        used = used.without(one.measurement for one in estimate.rejected)
    # else the rejected ones do not explain it: noise is the likelier cause of all of it
    if estimate.dof <= 0 or (explained and shared_part(used) < MIN_SHARED):
        return None
    # the measurements were made with what is expected, which is more than the median
    expected = _expected(noise) / float(np.mean(prior.bias_px))
    learnt = learn_shared_noise(used, estimate.values, factor, 1 / expected)
    return replace(learnt, size=learnt.size * expected)
