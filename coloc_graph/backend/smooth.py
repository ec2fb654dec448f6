"""The pose graph optimised: Levenberg-Marquardt with QR from the chained estimate, and checked afterwards."""

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.chain import compose
from coloc_graph.backend.estimate import Estimate, make_estimate
from coloc_graph.backend.graph import PoseGraph
from coloc_graph.errors import EstimationError

Array = NDArray[np.float64]


def smooth(graph: PoseGraph) -> Estimate:
    """The most likely poses given all measurements, the floor and the stay-put constraints.

    Raises `EstimationError` where the optimiser's answer does not pass its check.
    """
    chained, _ = compose(graph)
    factors = graph.factors(chained)
    initial = gtsam.Values()
    for key, pose in chained.items():
        initial.insert(key, pose)
    values, iterations = optimise(factors, initial)
    covariances = marginals(factors, values)
    return make_estimate(
        "smooth",
        graph,
        {key: values.atPose3(key) for key in chained},
        covariances,
        chi2=2 * factors.error(values),
        dof=_degrees_of_freedom(graph, factors, len(chained)),
        iterations=iterations,
    )


def _degrees_of_freedom(graph: PoseGraph, factors: gtsam.NonlinearFactorGraph, poses: int) -> int:
    """Rows less unknowns; the height prior has three rows of which one weighs."""
    rows = sum(
        1 if isinstance(factors.at(i), gtsam.PoseTranslationPrior3D) else factors.at(i).dim()
        for i in range(factors.size())
    )
    return int(rows - 6 * poses)


def optimise(factors: gtsam.NonlinearFactorGraph, initial: gtsam.Values) -> tuple[gtsam.Values, int]:
    """Levenberg-Marquardt with QR; values and iterations, or `EstimationError`.

    GTSAM's optimiser returns the initial values without a word when it fails, so the answer is checked: the
    errors are finite, the error did not rise, and it iterated wherever there was something to gain.
    """
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")  # Cholesky throws on healthy chains
    parameters.setRelativeErrorTol(1e-10)
    parameters.setAbsoluteErrorTol(1e-10)
    before = factors.error(initial)
    if not np.isfinite(before):
        raise EstimationError("the graph's error is not finite at the chained estimate: a measurement holds no number")
    optimiser = gtsam.LevenbergMarquardtOptimizer(factors, initial, parameters)
    values = optimiser.optimize()
    after = factors.error(values)
    if not np.isfinite(after) or after > before * (1 + 1e-9) + 1e-9:
        raise EstimationError(f"the optimiser did not lower the graph's error ({before:.6g} to {after:.6g})")
    if optimiser.iterations() == 0 and before > 1e-6:
        raise EstimationError(f"the optimiser gave up at the chained estimate (error {before:.6g})")
    return values, int(optimiser.iterations())


def marginals(factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> dict[int, Array]:
    """Covariances (6, 6) of all poses, by one bulk ISAM2 elimination with QR at the optimum."""
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")
    isam = gtsam.ISAM2(parameters)
    isam.update(factors, values)
    return {int(key): np.asarray(isam.marginalCovariance(key)) for key in values.keys()}  # noqa: SIM118  GTSAM's own
