"""Errors that all samples of a marker share in a stance, learnt from how stances contradict each other.

The residuals of one homography do not show what is the same in all its points: the next stances do. Its size is a
variance component of the whole graph, by restricted maximum likelihood under a log-normal prior with an
exponential tail: they can be far larger than is usual, and homographies trusted too much bend planes and mounts.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from coloc_graph.backend.factors import factors_for, poses_in
from coloc_graph.backend.graph import PoseGraph
from coloc_graph.backend.homography_model import HomographyModel, StatedPlaneModel
from coloc_graph.measurements import RelativePose

Array = NDArray[np.float64]

MAX_STANCES = 60  # of a longer run, whose first part tells as much as is needed; the search takes their square
COARSE = (-4.0, -2.0, 0.0, 2.0, 4.0)  # sizes that are tried, in standard deviations of the prior
REACH = 12.0  # standard deviations beyond which no size is tried
RESOLVED = 1.0  # decrease of the log posterior between neighbouring sizes below which the search ends
MIN_STEP = 0.05  # standard deviations of the prior, smallest step of the search
TAIL = 2.0  # standard deviations above which the logarithm of the prior falls no faster


@dataclass(frozen=True)
class SharedNoise:
    """Size of the shared errors relative to what is stated: a median, known within a factor."""

    size: float
    factor: float


def shared_part(graph: PoseGraph) -> float:
    """Return the mean part of the covariance of homographies that is by shared errors; 0 where there are none."""
    used = [one.homography for one in graph.measurements if isinstance(one, RelativePose) and one.homography]
    parts = [0.0 if one.shared is None else float((one.information * one.shared).sum()) / 8 for one in used]
    return float(np.mean(parts)) if parts else 0.0


def learn_shared_noise(graph: PoseGraph, values: gtsam.Values, factor: float, median: float = 1.0) -> SharedNoise:
    """Learn the size of shared errors from a graph at its optimum.

    Parameters
    ----------
    graph
        The graph, without outliers; robots are known to it (`PoseGraph.of`).
    values
        Its joint estimate.
    factor, median
        Prior of the size, relative to the measurements': its median, and the factor within which that is known.

    Returns
    -------
    SharedNoise
        The size relative to what is stated.
    """
    graph = graph.up_to(MAX_STANCES)
    sigma = math.log(factor)
    prior = math.log(median)
    tried: dict[float, float] = {}

    def likeliest(steps: Iterable[float]) -> float:
        """Try some sizes; return the likeliest so far."""
        for step in steps:
            if step not in tried:
                likelihood = restricted_log_likelihood(_at_size(graph, math.exp(prior + sigma * step)), values)
                inner = min(step, TAIL)
                tried[step] = likelihood - inner * (step - inner / 2)
        return max(tried, key=tried.__getitem__)

    best = likeliest(COARSE)
    while best == max(tried) and best < REACH:
        best = likeliest([best + 2.0])
    width = 2.0
    while width > MIN_STEP and max(tried[best] - tried[one] for one in _beside(best, tried)) > RESOLVED:
        width /= 2
        best = likeliest([max(best - width, COARSE[0]), best + width])
    steps = np.array(sorted(tried))
    # between the sizes that were tried it is smooth
    fine = np.linspace(steps[0], steps[-1], 801)
    smooth = PchipInterpolator(steps, [tried[step] for step in steps.tolist()])(fine)
    weights = np.exp(smooth - smooth.max())
    weights /= weights.sum()
    mean = float(weights @ fine)
    spread = sigma * math.sqrt(float(weights @ (fine - mean) ** 2))
    mean = prior + sigma * mean
    return SharedNoise(math.exp(mean), math.exp(max(spread, 1e-3)))


def _beside(best: float, tried: Iterable[float]) -> list[float]:
    """Return the nearest sizes below and above the best one."""
    below, above = [one for one in tried if one < best], [one for one in tried if one > best]
    return [*([max(below)] if below else []), *([min(above)] if above else [])]


def _at_size(graph: PoseGraph, size: float) -> PoseGraph:
    measurements = (one.at_shared(size) if isinstance(one, RelativePose) else one for one in graph.measurements)
    return replace(graph, measurements=tuple(measurements))


def restricted_log_likelihood(graph: PoseGraph, values: gtsam.Values) -> float:
    """Return the restricted log likelihood of a graph's noise, but for a constant, linearised at its joint estimate."""
    factors_of = factors_for("joint", graph, values)
    factors, _, batched = factors_of.of_graph(graph, poses_in(values))
    keys = set(map(int, factors.keyVector()))
    at = gtsam.Values()
    for key in poses_in(values):
        if key in keys:
            at.insert(key, values.atPose3(key))
    for key in sorted(keys - set(map(int, at.keys()))):
        at.insert(key, values.atVector(key) if values.exists(key) else factors_of.nominal(key))
    with batched:
        A, b = factors.linearize(at).jacobian()
    R = np.asarray(np.linalg.qr(np.column_stack([A, b]), mode="r"))
    n = A.shape[1]
    models = (one.model for one in batched.members)
    noise = sum(one.log_det for one in models if isinstance(one, HomographyModel | StatedPlaneModel))
    return float(noise - 0.5 * R[n, n] ** 2 - np.log(np.abs(R.diagonal()[:n])).sum())
