"""Maximum-likelihood poses, landmarks and sensor errors of a whole ranging run."""

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.estimate import Estimate
from coloc_graph.backend.floor_poses import in_body
from coloc_graph.backend.marginals import Marginals
from coloc_graph.backend.planar.factors import KeyframeFactors, State, robust
from coloc_graph.backend.planar.filter import INITIAL_PERIOD, Filter, filter_forward
from coloc_graph.backend.planar.problem import KeyframeProblem
from coloc_graph.backend.planar.summary import ranging_estimate
from coloc_graph.backend.ranging import outliers_of
from coloc_graph.backend.solver import Optimum, gauss_newton
from coloc_graph.errors import EstimationError
from coloc_graph.measurements import Keyframes
from coloc_graph.team import Team

Array = NDArray[np.float64]

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
    if not filtered.placed_at:
        name, why = next(iter(filtered.unlocated().items()))
        raise EstimationError(f"no robot can be localised, as {name}: {why}")
    factors = KeyframeFactors(keyframes, filtered.models)
    seen = np.flatnonzero(np.isfinite(filtered.landmarks[:, 0])).tolist()
    problem, optimum = _fitted(factors, _start(filtered, factors), seen)
    marginals = Marginals(optimum.linear, factors.keys.size, optimum.ordering)
    iterations, absorbed = optimum.iterations, None
    if calibrate_noise:
        noise, absorbed = _noise(problem, optimum.state, marginals)
        factors = KeyframeFactors(keyframes, filtered.models, noise)
        problem, optimum = _fitted(factors, optimum.state, seen)
        marginals = Marginals(optimum.linear, factors.keys.size, optimum.ordering)
        iterations += optimum.iterations
    state, C = optimum.state, np.full((len(factors), 3, 3), np.nan)
    poses = np.flatnonzero(np.isfinite(state.poses[:, 0]))
    found = np.array([marginals.covariance(name) for name in factors.keys.names[poses].tolist()])
    C[poses] = in_body(state.poses[poses], found)
    return ranging_estimate(
        factors, state, C, factors.shared_covariance(marginals), seen, iterations, absorbed,
        lambda: Marginals(problem.linear(state), factors.keys.size),
    )  # fmt: skip


def _start(filtered: Filter, factors: KeyframeFactors) -> State:
    """Return the initial values, by the filter."""
    poses = np.concatenate(filtered.whole())
    shared = factors.start()
    factors.wheels(shared)[:] = filtered.wheels
    factors.ranging(shared)[:] = filtered.ranging
    seen = np.isfinite(filtered.landmarks[:, 0])
    factors.landmarks(shared)[seen] = filtered.landmarks[seen]
    return State(poses, np.where(factors.free, shared, factors.start()))


def _fitted(
    factors: KeyframeFactors, state: State, landmarks: Collection[int]
) -> tuple[KeyframeProblem, Optimum[State]]:
    """Find the optimum near a state, of some landmarks and those that are exact; Levenberg-Marquardt is no better."""
    placed, gauge = np.isfinite(state.poses[:, 0]), None
    if not factors.models.map_known:
        first = int(np.argmax(placed))
        gauge = first, state.poses[first].copy()
    measured, tolerance = factors.measured_between(placed, landmarks), COST_TOLERANCE_PER_POSE * len(factors)
    problem = KeyframeProblem(factors, factors.steps_between(placed), measured, gauge)
    try:
        return problem, gauss_newton(problem, state, lambda _: tolerance)
    except EstimationError as failure:
        raise EstimationError(f"{failure}: {CHECK}") from failure


def _noise(problem: KeyframeProblem, state: State, marginals: Marginals) -> tuple[Array, float]:
    """Return factors (robots, 2) on the sigmas of ranges and bearings, and the absorbed degrees of freedom.

    The fit absorbs a part of each squared residual. Of a measurement with a share s, of which it absorbs h, it leaves
    s (1 - h) degrees of freedom, and not s - h, since correlated errors are not fitted as independent ones would be.
    """
    factors = problem.factors
    m, off = factors.keyframes.measured, factors.off(state)
    taken = np.full((len(m), 2), np.nan)  # absorbed part, in units of the noise
    for some, parts in factors.keys.blocks(robust(factors.measured(state, problem.measured))[0]):
        keys, jacobians = zip(*parts, strict=True)
        taken[problem.measured[some]] = marginals.variances([factors.keys.names[one] for one in keys], jacobians)
    taken[~np.isfinite(off)] = np.nan  # no bearing
    good = np.isfinite(taken[:, 0]) & ~outliers_of(off)
    noise = factors.noise.copy()
    for robot in np.unique(m.robot[good]).tolist():
        own = good & (m.robot == robot)
        for kind in np.flatnonzero(np.isfinite(taken[own]).any(axis=0)).tolist():
            there = own & np.isfinite(taken[:, kind])
            mean = (m.share[there, kind] * off[there, kind] ** 2).sum() / m.share[there, kind].sum()
            noise[robot, kind] *= np.sqrt(mean / max(1 - taken[there, kind].mean(), MIN_REDUNDANCY))
    return np.clip(noise, *NOISE_RANGE), float(np.nansum(((1 - m.share) * taken)[good]))
