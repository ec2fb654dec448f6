"""Gauss-Newton and Levenberg-Marquardt, with a check of the result; parameters of ISAM2."""

import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from coloc_graph.backend.calibration import SIZES
from coloc_graph.errors import EstimationError

Array = NDArray[np.float64]
T = TypeVar("T")
State = TypeVar("State")

# GTSAM walks its trees by recursion: with 8 MiB of stack a chain of 50,000 poses ends the process
DEEP_RECURSION_POSES = 3000  # poses above which the solver runs in a thread with a larger stack
STACK_SIZE = 1 << 30  # bytes of that stack; only the part in use takes memory

MAX_GAUSS_NEWTON = 20  # iterations of Gauss-Newton, most of which converge in five to eight
MAX_HALVINGS = 6  # of a step that does not lower the cost, where steps are halved
MAX_RISES = 2  # steps of Gauss-Newton that may raise the error, as the first ones of a bent chain do
MAX_RISE = 1e5  # error, relative to the initial one, above which it has diverged; 2e4 in a chain of 10,000 stances
MAX_ITERATIONS = 500  # of Levenberg-Marquardt; no search that needs more converges
COST_TOLERANCE = 1e-9  # half chi2 below which there is nothing to optimise

# ISAM2 linearises a pose anew when its estimate has changed by more than these. Errors of linearisation come from
# rotations; a distant pose moves by centimetres whenever the heading of an early one changes by 1e-4 rad, and with
# GTSAM's single threshold of 0.01 the whole chain would be linearised anew at every step
RELINEARIZE_ROTATION = 0.03  # rad
RELINEARIZE_TRANSLATION = 1e9  # m: never
# where mounts are calibrated: the residual of a homography grows with the square of a tilt times distance over height,
# and half a milliradian is then a fifth of its noise; the pixels of a sighting tell a tenth of a millimetre
RELINEARIZE_TILT_JOINT = 5e-4  # rad, roll and pitch
RELINEARIZE_HEADING_JOINT = 5e-3  # rad
# in a mission of a kilometre all poses of the lag shift by a metre at once; with a tilt of half a milliradian that
# lifts a body by a quarter of a millimetre, which a floor even to a tenth of that contradicts
RELINEARIZE_TRANSLATION_JOINT = 0.1  # m
RELINEARIZE_CALIBRATION = 3e-4  # change of a calibration variable [m, rad, relative, s]

# each fit of graduated non-convexity begins where the one before it ended
ROBUST_TOLERANCE = 1e-3  # change of half the squared error, relative and absolute
ROBUST_ITERATIONS = 10  # iterations of a fit
ROUGH_ITERATIONS = 50  # iterations of Levenberg-Marquardt where the error stays larger than a fit has without outliers


def with_stack(poses: int, work: Callable[[], T]) -> T:
    """Return the result of `work`, done in a thread with a larger stack where the graph has many `poses`."""
    if poses <= DEEP_RECURSION_POSES:
        return work()
    results: list[T] = []
    failures: list[BaseException] = []

    def body() -> None:
        try:
            results.append(work())
        except BaseException as failure:  # handed to the caller
            failures.append(failure)

    before = threading.stack_size(STACK_SIZE)
    try:
        thread = threading.Thread(target=body)
        thread.start()
    finally:
        threading.stack_size(before)
    thread.join()
    if failures:
        raise failures[0]
    return results[0]


def lm_parameters() -> gtsam.LevenbergMarquardtParams:
    """Return the parameters of Levenberg-Marquardt: QR, since Cholesky throws on healthy chains."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    parameters.setRelativeErrorTol(1e-10)
    parameters.setAbsoluteErrorTol(1e-10)
    # our information reaches 1e12, of which GTSAM's bound of 1e5 is no damping: with wrong measurements it gave up
    parameters.setlambdaUpperBound(1e15)
    parameters.setMaxIterations(MAX_ITERATIONS)
    return parameters


def robust_parameters() -> gtsam.LevenbergMarquardtParams:
    """Return the parameters of a fit between two updates of robust weights, of which only residuals are wanted.

    With `lm_parameters` the search for outliers takes 2 to 14 times as long and rejects the same measurements
    (9 teams of 3 to 8 robots, 10 to 35 % of their homographies wrong).
    """
    parameters = lm_parameters()
    parameters.setLinearSolverType("MULTIFRONTAL_CHOLESKY")
    parameters.setRelativeErrorTol(ROBUST_TOLERANCE)
    parameters.setAbsoluteErrorTol(ROBUST_TOLERANCE)
    parameters.setMaxIterations(ROBUST_ITERATIONS)
    return parameters


def isam_parameters(*, calibrates: bool = False) -> gtsam.ISAM2Params:
    """Return the parameters of ISAM2: QR, and thresholds of relinearisation by the kind of key (x is a pose)."""
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")
    parameters.relinearizeSkip = 1
    tilt = RELINEARIZE_TILT_JOINT if calibrates else RELINEARIZE_ROTATION
    heading = RELINEARIZE_HEADING_JOINT if calibrates else RELINEARIZE_ROTATION
    thresholds = gtsam.ISAM2ThresholdMap()
    moved = RELINEARIZE_TRANSLATION_JOINT if calibrates else RELINEARIZE_TRANSLATION
    thresholds.insert(("x", np.array([tilt, tilt, heading] + [moved] * 3)))
    for kind, size in SIZES.items():
        thresholds.insert((chr(kind), np.full(size, RELINEARIZE_CALIBRATION)))
    parameters.setRelinearizeThreshold(thresholds)
    return parameters


class Problem(Protocol[State]):
    """Least squares problem: half chi2 of a state, its linear factors, and the state after a step."""

    def cost(self, state: State, /) -> float:
        """Return half chi2 of a state."""

    def linear(self, state: State, /) -> gtsam.GaussianFactorGraph:
        """Return the factors, linearised at a state."""

    def moved(self, state: State, step: gtsam.VectorValues, /) -> State:
        """Return the state after a step."""


@dataclass(frozen=True, eq=False)
class Optimum(Generic[State]):
    """Optimum of a problem: its state, its last linear factors with the order of elimination, and iterations."""

    state: State
    linear: gtsam.GaussianFactorGraph
    ordering: gtsam.Ordering
    iterations: int


def eliminated(
    linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering, *, by_qr: bool = False
) -> tuple[gtsam.GaussianBayesTree, bool]:
    """Return the Bayes tree of linear factors, and whether it is by QR: if asked for, or if Cholesky fails.

    Raises
    ------
    EstimationError
        The factors leave a variable open.
    """
    if not by_qr:
        with suppress(RuntimeError):  # GTSAM's indeterminate system
            return linear.eliminateMultifrontal(ordering), False
    try:
        return linear.eliminateMultifrontal(ordering, gtsam.EliminateQR), True
    except RuntimeError as failure:
        raise EstimationError(
            "what was measured does not determine where everything is: let the robots see more landmarks, or each "
            "other more often"
        ) from failure


def gauss_newton(
    problem: Problem[State], start: State, tolerance: Callable[[float], float], *, rises: int = 0
) -> Optimum[State]:
    """Return the optimum of a problem near a state by Gauss-Newton.

    Steps are by QR from where Cholesky finds the system too ill conditioned. What Cholesky loses of a step the next one
    makes up: both end within 1e-6 standard deviations of each other (6 teams of 3 to 20 robots).

    Parameters
    ----------
    problem
        The problem.
    start
        Initial state.
    tolerance
        Half chi2, given the present one, by which an iteration must lower it; the search ends where one does not.
    rises
        Steps that may raise the cost. With 0, one that does is halved until it does not.

    Raises
    ------
    EstimationError
        The search does not end, or the factors leave a variable open.
    """
    state, cost, ordering, by_qr, halves = start, problem.cost(start), None, False, not rises
    first = cost
    for iteration in range(1, MAX_GAUSS_NEWTON + 1):
        linear, allowed = problem.linear(state), cost + tolerance(cost) + COST_TOLERANCE * (1 + cost)
        ordering = ordering or gtsam.Ordering.ColamdGaussianFactorGraph(linear)
        tree, by_qr = eliminated(linear, ordering, by_qr=by_qr)
        step, halvings = tree.optimize(), 0
        tried = problem.moved(state, step)
        while (after := problem.cost(tried)) > allowed and halves and halvings < MAX_HALVINGS:
            halvings += 1
            tried = problem.moved(state, step.scale(0.5**halvings))
        rises -= after > allowed
        if rises < 0 or not np.isfinite(after) or after > MAX_RISE * first:
            raise EstimationError(f"the optimisation does not converge (half chi2 {cost:.6g} after {iteration} steps)")
        gained = abs(cost - after)
        if gained <= tolerance(cost) and not halvings:
            return Optimum(tried if after < cost else state, linear, ordering, iteration)
        state, cost = tried, after
    raise EstimationError(f"the optimisation did not end in {MAX_GAUSS_NEWTON} steps (half chi2 {cost:.6g})")


class Nonlinear:
    """Problem of GTSAM's nonlinear factors, which are evaluated within the context `held`, given the values.

    GTSAM's own optimiser hands a copy of all values to every factor in Python: ten times slower at 1,000 stances.
    """

    def __init__(
        self,
        factors: gtsam.NonlinearFactorGraph,
        held: Callable[[gtsam.Values], AbstractContextManager[object]] = nullcontext,
    ) -> None:
        self._factors, self._held = factors, held

    def cost(self, values: gtsam.Values) -> float:
        """Return half chi2 at some values."""
        with self._held(values):
            return float(self._factors.error(values))

    def linear(self, values: gtsam.Values) -> gtsam.GaussianFactorGraph:
        """Return the factors, linearised at some values."""
        with self._held(values):
            return self._factors.linearize(values)

    def moved(self, values: gtsam.Values, step: gtsam.VectorValues) -> gtsam.Values:
        """Return the values after a step in their tangents."""
        return values.retract(step)


def optimise(
    factors: gtsam.NonlinearFactorGraph,
    initial: gtsam.Values,
    *,
    roughly_first: bool = False,
    rough_above: float = np.inf,
    negligible: float = 0.0,
    held: Callable[[gtsam.Values], AbstractContextManager[object]] = nullcontext,
) -> tuple[gtsam.Values, int]:
    """Optimise by Gauss-Newton, or by Levenberg-Marquardt with QR where that fails; return values and iterations.

    Gauss-Newton evaluates all factors at some values within the context `held`, given these values.
    `roughly_first` begins Levenberg-Marquardt with Cholesky, which takes a thirtieth of the time where cliques are
    large, and may get stuck; QR continues from there. Where the error stays `rough_above` this, the search ends once a
    step lowers it by less than `ROBUST_TOLERANCE` of it, and Levenberg-Marquardt after `ROUGH_ITERATIONS`; in any case
    once one lowers it by less than `negligible`.

    Raises
    ------
    EstimationError
        The optimiser failed. GTSAM's returns the initial values silently then, so the result is checked: the error is
        finite, did not rise, and fell wherever a step lowers it.
    """
    with held(initial):
        before = factors.error(initial)
    if before < COST_TOLERANCE:
        return initial, 0  # nothing to optimise; LM would only try out its dampings
    if not np.isfinite(before):
        raise EstimationError("the graph's error is not finite at the initial values: a measurement is not finite")
    limits = lm_parameters()
    limits.setAbsoluteErrorTol(max(limits.getAbsoluteErrorTol(), negligible))
    absolute, relative = limits.getAbsoluteErrorTol(), limits.getRelativeErrorTol()

    def tolerance(cost: float) -> float:
        return max(absolute, (ROBUST_TOLERANCE if cost > rough_above else relative) * cost)

    with suppress(EstimationError):
        found = gauss_newton(Nonlinear(factors, held), initial, tolerance, rises=MAX_RISES)
        return found.state, found.iterations
    among_outliers = 0 < rough_above < before  # with 0, a robust cost, outliers have their weights
    if roughly_first or among_outliers:
        parameters = lm_parameters()
        if roughly_first:
            parameters.setLinearSolverType("MULTIFRONTAL_CHOLESKY")
        if before > rough_above:
            parameters.setRelativeErrorTol(ROBUST_TOLERANCE)
            parameters.setMaxIterations(ROUGH_ITERATIONS if among_outliers else MAX_ITERATIONS)
        rough = gtsam.LevenbergMarquardtOptimizer(factors, initial, parameters)
        there, used = rough.optimize(), int(rough.iterations())
        after = factors.error(there)
        if after < before:
            if after > rough_above and among_outliers and not roughly_first:
                return there, used
            values, more = optimise(factors, there, rough_above=rough_above, negligible=negligible, held=held)
            return values, used + more
    optimiser = gtsam.LevenbergMarquardtOptimizer(factors, initial, limits)
    values = optimiser.optimize()
    after = optimiser.error()
    if optimiser.iterations() >= MAX_ITERATIONS:
        raise EstimationError(f"the optimiser did not converge in {MAX_ITERATIONS} iterations (error {after:.6g})")
    if not np.isfinite(after) or after > before * (1 + 1e-9) + 1e-9:
        raise EstimationError(f"the optimiser did not lower the graph's error ({before:.6g} to {after:.6g})")
    if (
        optimiser.iterations() == 0
        and before > 1e-6
        and factors.error(_one_step(Nonlinear(factors, held), initial)) < before * (1 - 1e-6)
    ):
        raise EstimationError(f"the optimiser gave up at the initial values (error {before:.6g})")
    return values, int(optimiser.iterations())


def _one_step(problem: Nonlinear, values: gtsam.Values) -> gtsam.Values:
    """Take one Gauss-Newton step with QR."""
    linear = problem.linear(values)
    tree, _ = eliminated(linear, gtsam.Ordering.ColamdGaussianFactorGraph(linear), by_qr=True)
    return problem.moved(values, tree.optimize())


def covariance_root(isam: gtsam.ISAM2, keys: Sequence[int]) -> Array:
    """Return a root S of the joint covariance S S^T of different variables, in the order given.

    In the covariance itself, by GTSAM the inverse of the information, too few digits are left of relative poses: after
    600 stances with a position known to metres they came out a thousand times too uncertain.

    Raises
    ------
    EstimationError
        A variable is undetermined.
    """
    net = isam.jointBayesNet(list(keys), gtsam.EliminateQR)
    S, singular = lapack.dtrtri(net.matrix()[0])
    if singular:
        raise EstimationError("a variable of the graph is undetermined: it has neither measurement nor prior")
    # the order of elimination is GTSAM's own
    rows, end = dict[int, Array](), 0
    for n in range(net.size()):
        one = net.at(n)
        begin, end = end, end + one.R().shape[0]
        rows[one.firstFrontalKey()] = S[begin:end]
    return np.concatenate([rows[key] for key in keys])
