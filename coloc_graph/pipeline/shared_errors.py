"""Size of the errors of marker centres that all samples of a marker share, by an estimate."""

import math
from dataclasses import replace

import numpy as np

from coloc_graph.backend import Estimate
from coloc_graph.backend.shared_noise import SharedNoise, learn_shared_noise, shared_part
from coloc_graph.frontend.learnt_noise import NoiseBelief

MIN_SHARED = 0.02  # part of homographies' covariance by shared errors below which their size is not looked for
UNEXPLAINED = 2.0  # chi2/dof from which on a few wrong measurements are not the cause


def shared_noise_of(estimate: Estimate, noise: NoiseBelief) -> SharedNoise | None:
    """The size of shared errors relative to that of an estimate's measurements; None where they hardly count."""
    factor = float(np.median(noise.bias_factor))
    explained = estimate.chi2 < UNEXPLAINED * estimate.dof
    used = estimate.graph
    if explained:
        used = used.without(one.measurement for one in estimate.rejected)
    # else the rejected ones do not explain it: noise is the likelier cause of all of it
    if estimate.dof <= 0 or (explained and shared_part(used) < MIN_SHARED):
        return None
    # the measurements were made with what is expected of the prior, which is more than its median
    expected = math.exp(math.log(factor) ** 2)
    learnt = learn_shared_noise(used, estimate.values, factor, 1 / expected)
    return replace(learnt, size=learnt.size * expected)
