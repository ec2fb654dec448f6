"""The numerical work: Levenberg-Marquardt with QR, and its answer checked."""

import threading
from collections.abc import Callable, Sequence
from typing import TypeVar

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.calibration import SIZES
from coloc_graph.errors import EstimationError

Array = NDArray[np.float64]
T = TypeVar("T")

#: GTSAM walks its trees by recursion: a chain of more than this many poses gets a stack of its own.
DEEP = 3000
#: That stack [bytes]: at 8 MiB a chain of 50,000 poses ends the process. Only what is used of it takes memory.
STACK = 1 << 30

#: A search that goes on for longer is not going to end. With less error than this there is none to begin.
MOST_ITERATIONS = 500
NOTHING_TO_GAIN = 1e-9

#: Over more poses than this each iteration gains a little for hundreds of them, since GTSAM's between-factors leave
#: the derivative of the logarithm out: there the search ends where one gains less than `NOISE` a pose in half chi2,
#: of which a pose has about 3.
LONG = 2000
NOISE = 1e-5

#: A pose of ours is linearised anew where it has turned by more than this [rad], or shifted by that [m]: never. Errors
#: of linearisation come from turns; a far pose shifts by centimetres whenever the heading of an early one changes by
#: 1e-4 rad, and with GTSAM's single threshold of 0.01 the whole chain is then redone at every step (with turns of
#: 0.01 from stance 2,600 on).
TURNED = 0.03
SHIFTED = 1e9
#: Where mounts are calibrated, also where it has tilted by this [rad]: a homography's residual grows with the square of
#: a tilt times that of distance over height, and half a milliradian is then a fifth of its noise. And where it has
#: turned by a sixth as much as otherwise: a sighting's pixels tell a tenth of a millimetre.
TILTED = 5e-4
AIMED = 5e-3
#: A calibration variable is linearised anew where it has changed by more than this [m, rad, relative, s].
CALIBRATED = 3e-4


def with_stack(poses: int, work: Callable[[], T]) -> T:
    """The result of `work`, done where a graph of so many poses does not overflow the stack."""
    if poses <= DEEP:
        return work()
    results: list[T] = []
    failures: list[BaseException] = []

    def body() -> None:
        try:
            results.append(work())
        except BaseException as failure:  # handed to the caller
            failures.append(failure)

    before = threading.stack_size(STACK)
    try:
        thread = threading.Thread(target=body)
        thread.start()
    finally:
        threading.stack_size(before)
    thread.join()
    if failures:
        raise failures[0]
    return results[0]


def lm_parameters(poses: int) -> gtsam.LevenbergMarquardtParams:
    """QR, since Cholesky throws on healthy chains, and down to rounding; in `LONG` runs to far below what is noise."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    parameters.setRelativeErrorTol(1e-10)
    parameters.setAbsoluteErrorTol(1e-10 if poses <= LONG else NOISE * poses)
    # our information reaches 1e12, of which GTSAM's bound of 1e5 is no damping: with wrong measurements it gave up
    parameters.setlambdaUpperBound(1e15)
    parameters.setMaxIterations(MOST_ITERATIONS)
    return parameters


def isam_parameters(*, calibrates: bool = False) -> gtsam.ISAM2Params:
    """QR for the same reason, and what is linearised anew: by the kind of key, as that of poses is x."""
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")
    parameters.relinearizeSkip = 1
    tilted, turned = (TILTED, AIMED) if calibrates else (TURNED, TURNED)
    thresholds = gtsam.ISAM2ThresholdMap()
    thresholds.insert(("x", np.array([tilted, tilted, turned] + [SHIFTED] * 3)))
    for kind, size in SIZES.items():
        thresholds.insert((chr(kind), np.full(size, CALIBRATED)))
    parameters.setRelinearizeThreshold(thresholds)
    return parameters


def optimise(
    factors: gtsam.NonlinearFactorGraph, initial: gtsam.Values, *, roughly_first: bool = False
) -> tuple[gtsam.Values, int]:
    """Levenberg-Marquardt with QR; values and iterations, or `EstimationError`.

    `roughly_first` goes most of the way with Cholesky, which takes a thirtieth of the time where cliques are large, and
    may get stuck: QR goes on from there.

    GTSAM's optimiser returns the initial values without a word when it fails, so the answer is checked: the
    errors are finite, the error did not rise, and it iterated wherever there was something to gain.
    """
    optimiser = gtsam.LevenbergMarquardtOptimizer(factors, initial, lm_parameters(initial.size()))
    before = optimiser.error()
    if before < NOTHING_TO_GAIN:
        return initial, 0  # nothing contradicts anything; LM would only try out its dampings
    if not np.isfinite(before):
        raise EstimationError("the graph's error is not finite where the search starts: a measurement holds no number")
    if roughly_first:
        parameters = lm_parameters(initial.size())
        parameters.setLinearSolverType("MULTIFRONTAL_CHOLESKY")
        rough = gtsam.LevenbergMarquardtOptimizer(factors, initial, parameters)
        there = rough.optimize()
        if factors.error(there) < before:
            values, used = optimise(factors, there)
            return values, used + int(rough.iterations())
    values = optimiser.optimize()
    after = optimiser.error()
    if optimiser.iterations() >= MOST_ITERATIONS:
        raise EstimationError(f"the optimiser did not converge in {MOST_ITERATIONS} iterations (error {after:.6g})")
    if not np.isfinite(after) or after > before * (1 + 1e-9) + 1e-9:
        raise EstimationError(f"the optimiser did not lower the graph's error ({before:.6g} to {after:.6g})")
    if (
        optimiser.iterations() == 0
        and before > 1e-6
        and factors.error(_one_step(factors, initial)) < before * (1 - 1e-6)
    ):
        raise EstimationError(f"the optimiser gave up where the search starts (error {before:.6g})")
    return values, int(optimiser.iterations())


def _one_step(factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    """One Gauss-Newton step with QR: it leads down from everywhere but the optimum."""
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")
    isam = gtsam.ISAM2(parameters)
    isam.update(factors, values)
    return isam.calculateEstimate()


def joint_covariance(isam: gtsam.ISAM2, keys: Sequence[int]) -> Array:
    """Joint covariance of different variables, in the order given: (6 n, 6 n) of n poses."""
    joint = isam.jointMarginalCovariance(list(keys))
    return np.block([[joint.at(a, b) for b in keys] for a in keys])
