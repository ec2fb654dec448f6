"""Maximum-likelihood poses, landmarks and sensor errors of a whole ranging run."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.estimate import Estimate
from coloc_graph.backend.floor_poses import in_body
from coloc_graph.backend.linear_system import Rows
from coloc_graph.backend.marginals import Marginals
from coloc_graph.backend.planar.factors import KeyframeFactors, State, robust
from coloc_graph.backend.planar.filter import INITIAL_PERIOD, NONE_LOCATED, Filtered, Models, filter_forward
from coloc_graph.backend.planar.summary import OUTLIER, Found, measured_off, ranging_estimate
from coloc_graph.backend.sensor_calibration import SensorErrors
from coloc_graph.backend.solver import Optimum, gauss_newton
from coloc_graph.errors import EstimationError
from coloc_graph.measurements import Keyframes
from coloc_graph.team import Team

Array = NDArray[np.float64]
Index = NDArray[np.int64]

CHECK = (
    "the measurements contradict each other, and it is not known which are wrong; check each robot's clock and "
    "odometry, who is called who, and the positions of the landmarks"
)
COST_TOLERANCE_PER_POSE = 1e-4  # half chi2; its expected value is about 3
MIN_REDUNDANCY = 0.3  # share of squared residuals that the fit leaves, for an estimate of noise
NOISE_RANGE = (0.2, 5.0)  # estimated noise relative to that stated


def optimise_keyframes(team: Team, keyframes: Keyframes, *, calibrate_noise: bool = True) -> Estimate:
    """Estimate everything together, given all odometry and measurements; a filter gives the initial values.

    Parameters
    ----------
    team : Team
        The team.
    keyframes : Keyframes
        Keyframes, odometry and measurements.
    calibrate_noise : bool
        Scale the stated noise of ranges and bearings to the residuals, by robot and kind. That of odometry is as
        stated.

    Raises
    ------
    EstimationError
        No robot can be localised, or the optimisation does not converge.
    """
    filtered = filter_forward(team, keyframes, period=INITIAL_PERIOD)
    models = Models(team, keyframes)
    if not filtered.placed_at:
        raise EstimationError(NONE_LOCATED)
    factors = KeyframeFactors(keyframes, models)
    seen = np.flatnonzero(np.isfinite(filtered.landmarks[:, 0])).tolist()
    fit = _fitted(factors, _start(filtered, factors), seen)
    iterations, absorbed = fit.optimum.iterations, None
    if calibrate_noise:
        noise, absorbed = _noise(factors, fit)
        factors = KeyframeFactors(keyframes, models, noise)
        fit = _fitted(factors, fit.state, seen)
        iterations += fit.optimum.iterations
    marginals = partial(fit.problem.marginals, fit.state)
    return ranging_estimate(factors, _found(factors, filtered, fit), iterations, absorbed, marginals)


@dataclass(eq=False)
class _Problem:
    """Factors of the robots that have a pose: `steps` from some poses, `measured` ones by index, and `landmarks`.

    `gauge` is the pose that defines the world, with its value, if no landmark does.
    """

    factors: KeyframeFactors
    poses: Index
    steps: Index
    measured: Index
    landmarks: Collection[int]
    gauge: tuple[int, Array] | None
    _names: Sequence[int] = field(default=(), init=False)  # GTSAM's keys of the variables
    _last: tuple[State, list[Rows], float] | None = field(default=None, init=False)  # evaluated last

    def cost(self, state: State) -> float:
        """Return half chi2 of all factors with their robust loss."""
        return self._rows(state)[1]

    def linear(self, state: State) -> gtsam.GaussianFactorGraph:
        """Return all factors, linearised."""
        graph = self.factors.system(state, self._rows(state)[0]).graph
        self._names = graph.keyVector()
        return graph

    def moved(self, state: State, step: gtsam.VectorValues) -> State:
        """Return the state after a step from where it was linearised last."""
        return self.factors.moved(state, step, self._names)

    def _rows(self, state: State) -> tuple[list[Rows], float]:
        """Linearise all factors without the priors, and return them with the whole cost (half chi2)."""
        if self._last is None or self._last[0] is not state:
            steps = self.factors.steps(state, self.steps)
            measured, cost = robust(self.factors.measured(state, self.measured))
            cost += 0.5 * float((steps.residuals**2).sum()) + self.factors.cost_before(state)
            rows = [steps, measured]
            if self.gauge is not None:
                rows.append(self.factors.gauge(state, *self.gauge))
            self._last = state, rows, cost
        return self._last[1:]

    def marginals(self, state: State) -> Marginals:
        """Return the marginal covariances of all variables at the optimum."""
        return Marginals(self.linear(state), self.factors.keys.size)


@dataclass(frozen=True, eq=False)
class _Fit:
    """The optimum of a problem."""

    problem: _Problem
    optimum: Optimum[State]

    @property
    def state(self) -> State:
        return self.optimum.state

    @cached_property
    def marginals(self) -> Marginals:
        return Marginals(self.optimum.linear, self.problem.factors.keys.size, self.optimum.ordering)


def _start(filtered: Filtered, factors: KeyframeFactors) -> State:
    """Return the initial values, by the filter."""
    poses = np.concatenate(filtered.whole(factors.keyframes, factors.models))
    shared = factors.start()
    factors.wheels(shared)[:] = filtered.wheels
    factors.ranging(shared)[:] = filtered.ranging
    seen = np.isfinite(filtered.landmarks[:, 0])
    factors.landmarks(shared)[seen] = filtered.landmarks[seen]
    return State(poses, np.where(factors.free, shared, factors.start()))


def _posed(factors: KeyframeFactors, state: State, landmarks: Collection[int]) -> _Problem:
    placed, gauge = np.isfinite(state.poses[:, 0]), None
    poses = np.flatnonzero(placed)
    if not factors.models.map_known:
        gauge = int(poses[0]), state.poses[poses[0]].copy()
    measured = factors.measured_between(placed, landmarks)
    return _Problem(factors, poses, factors.steps_between(placed), measured, landmarks, gauge)


def _fitted(factors: KeyframeFactors, state: State, landmarks: Collection[int]) -> _Fit:
    """Find the optimum near a state, of some landmarks and those that are exact; Levenberg-Marquardt is no better."""
    problem = _posed(factors, state, landmarks)
    tolerance = COST_TOLERANCE_PER_POSE * len(factors)
    try:
        return _Fit(problem, gauss_newton(problem, state, lambda _: tolerance))
    except EstimationError as failure:
        raise EstimationError(f"{failure}: {CHECK}") from failure


def found_landmarks(
    factors: KeyframeFactors, shared: Array, C: Array, there: Collection[int]
) -> dict[int, tuple[Array, Array]]:
    """Return positions and covariances of the landmarks `there`, and of exact ones."""
    return {
        n: (factors.landmarks(shared)[n], factors.landmark_covariance(n, C))
        for n in range(len(factors.keyframes.landmarks))
        if n in there or factors.is_exact(n)
    }


def _found(factors: KeyframeFactors, filtered: Filtered, fit: _Fit) -> Found:
    state, poses = fit.state, fit.problem.poses
    covariances = np.full((len(factors), 3, 3), np.nan)
    names = factors.keys.names[poses].tolist()
    covariances[poses] = in_body(state.poses[poses], np.array(list(map(fit.marginals.covariance, names))))
    C = factors.shared_covariance(fit.marginals)
    errors = [
        factors.errors_in(robot, state.shared, C) if robot in filtered.placed_at else SensorErrors(None, None)
        for robot in range(len(factors.keyframes.robots))
    ]
    return Found(state, covariances, found_landmarks(factors, state.shared, C, fit.problem.landmarks), errors)


def _noise(factors: KeyframeFactors, fit: _Fit) -> tuple[Array, float]:
    """Return factors (robots, 2) on the sigmas of ranges and bearings, and the absorbed degrees of freedom.

    The fit absorbs a part of each squared residual. Of a measurement with a share s, of which it absorbs h, it leaves
    s (1 - h) degrees of freedom, and not s - h, since correlated errors are not fitted as independent ones would be.
    """
    m, index = factors.keyframes.measured, fit.problem.measured
    taken = _taken(fit)
    share, robots = m.share[index], m.robot[index]
    off = measured_off(factors, fit.state)[index]
    good = np.abs(off).max(axis=1, initial=0.0) < OUTLIER
    noise = factors.noise.copy()
    for robot in np.unique(robots[good]).tolist():
        own = good & (robots == robot)
        mean = (share[own] * off[own] ** 2).sum(axis=0) / share[own].sum(axis=0)
        noise[robot] *= np.sqrt(mean / np.maximum(1 - taken[own].mean(axis=0), MIN_REDUNDANCY))
    return np.clip(noise, *NOISE_RANGE), float(((1 - share) * taken)[good].sum())


def _taken(fit: _Fit) -> Array:
    """Return the part of each measurement's squared residuals (n, 2) that the fit absorbs, in units of their noise."""
    factors = fit.problem.factors
    rows, _ = robust(factors.measured(fit.state, fit.problem.measured))
    taken = np.zeros((len(fit.problem.measured), 2))
    for index, parts in factors.keys.blocks(rows):
        keys, jacobians = zip(*parts, strict=True)
        taken[index] = fit.marginals.variances([factors.keys.names[one] for one in keys], jacobians)
    return taken
