"""Maximum-likelihood poses, landmarks and sensor errors of a whole ranging run."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.estimate import Estimate
from coloc_graph.backend.planar.factors import DriveFactors, Rows, State, robust
from coloc_graph.backend.planar.filter import Filtered, Models, filter_forward
from coloc_graph.backend.planar.slices import Slices, slices_of
from coloc_graph.backend.planar.summary import OUTLIER, Found, measured_off, ranging_estimate
from coloc_graph.backend.sensor_calibration import SensorErrors
from coloc_graph.errors import EstimationError
from coloc_graph.measurements import Drive
from coloc_graph.team import Team

Array = NDArray[np.float64]
Index = NDArray[np.int64]

#: The search ends where a step gains less than this much of half chi2 a pose, of which one has about 3.
ENOUGH = 1e-4
MOST_ITERATIONS = 40
MOST_HALVINGS = 6
#: Where the fit has left less than this of residuals, they say nothing of noise.
LEAST_LEFT = 0.3
CHECK = (
    "the measurements contradict each other, and it is not known which are wrong; check each robot's clock and "
    "odometry, who is called who, and the positions of the landmarks"
)
#: Noise is not taken for less, or more, than so many times what is stated.
NOISE_RANGE = (0.2, 5.0)


def optimise_keyframes(team: Team, drive: Drive, *, calibrate_noise: bool = True) -> Estimate:
    """Estimate everything together, given all steps and measurements; a filter gives the initial values.

    Noise of measurements is what the team states, times what makes it that of the residuals (`calibrate_noise`), by
    robot and kind. That of steps is as stated: errors of wheels last, and one step says nothing of them.
    Raises `EstimationError` where no robot can be placed, or the search leads nowhere.
    """
    filtered = filter_forward(team, drive)
    models = Models(team, drive)
    if not filtered.placed_at:
        raise EstimationError(
            "no robot can be placed: a robot must observe at least two landmarks with known positions, several times"
        )
    factors = DriveFactors(drive, models)
    fit = _fitted(factors, _start(filtered, factors))
    iterations, absorbed = fit.iterations, None
    if calibrate_noise:
        noise, absorbed = _noise(factors, fit)
        factors = DriveFactors(drive, models, noise)
        fit = _fitted(factors, fit.state)
        iterations += fit.iterations
    taken = np.zeros(len(drive.measured), bool)
    taken[fit.problem.measured] = True
    return ranging_estimate(factors, _found(factors, filtered, fit), taken, iterations, absorbed)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Everything of the robots that have a place: `steps` from which poses, which are `measured`, in `slices`; `gauge`
    is the pose that the world hangs on, with where it is, if no landmark fixes it."""

    factors: DriveFactors
    slices: Slices
    steps: Index
    measured: Index
    gauge: tuple[int, Array] | None

    def rows(self, state: State) -> tuple[list[Rows], float]:
        """All factors linearised, but for what is known before, and what all of it costs (half chi2)."""
        steps = self.factors.steps(state, self.steps)
        measured, cost = robust(self.factors.measured(state, self.measured))
        weights, off = self.factors.before(state)
        cost += 0.5 * float((steps.residuals**2).sum() + (weights * off**2).sum())
        rows = [steps, measured]
        if self.gauge is not None:
            rows.append(self.factors.gauge(state, *self.gauge))
        return rows, cost


@dataclass(frozen=True, eq=False)
class _Fit:
    """The optimum: a state, the problem there eliminated, and the covariance of what is shared."""

    problem: _Problem
    state: State
    eliminated: list[tuple[Array, Array]]
    shared: Array
    iterations: int


def _start(filtered: Filtered, factors: DriveFactors) -> State:
    """Where the search starts: as the filter has it."""
    poses = np.concatenate(filtered.whole(factors.drive, factors.models))
    shared = factors.start()
    factors.wheels(shared)[:] = filtered.wheels
    factors.ranging(shared)[:] = filtered.ranging
    seen = np.isfinite(filtered.landmarks[:, 0])
    factors.landmarks(shared)[seen] = filtered.landmarks[seen]
    return State(poses, np.where(factors.free, shared, factors.start()))


def _posed(factors: DriveFactors, state: State) -> _Problem:
    placed = np.isfinite(state.poses[:, 0])
    poses = np.flatnonzero(placed)
    last = factors.first[1:][np.diff(factors.first) > 0] - 1
    ends = placed[factors.observer] & (placed[factors.seen] | ~factors.of_robot)
    gauge = None
    if not factors.models.map_known:
        gauge = int(poses[0]), state.poses[poses[0]].copy()
    return _Problem(
        factors,
        Slices(factors, slices_of(factors), poses),
        steps=np.setdiff1d(poses, last),
        measured=np.flatnonzero(ends),
        gauge=gauge,
    )


def _fitted(factors: DriveFactors, state: State) -> _Fit:
    """The optimum near a state by Gauss-Newton; `EstimationError` where the search does not end.

    Levenberg-Marquardt gains nothing here.
    """
    problem = _posed(factors, state)
    slices, free = problem.slices, factors.free
    rows, cost = problem.rows(state)
    enough = ENOUGH * len(factors)
    for iteration in range(1, MOST_ITERATIONS + 1):
        flat = slices.problem(rows)
        slices.add_known(flat, *factors.before(state))
        eliminated = slices.eliminate(flat)
        of_shared, C = slices.shared(flat)
        of_poses = slices.steps(eliminated, of_shared)
        for halving in range(MOST_HALVINGS):
            poses, shared = state.poses.copy(), state.shared.copy()
            poses[slices.poses] += 0.5**halving * of_poses
            shared[free] += 0.5**halving * of_shared
            tried = State(poses, shared)
            rows, after = problem.rows(tried)
            if after <= cost + enough:
                break
        else:
            raise EstimationError(
                f"the optimisation does not converge (half chi2 {cost:.6g} after {iteration} steps): {CHECK}"
            )
        gained, state, cost = cost - after, tried, after
        if abs(gained) < enough and not halving:
            return _Fit(problem, state, eliminated, C, iteration)
    raise EstimationError(f"the optimisation did not end in {MOST_ITERATIONS} steps (half chi2 {cost:.6g}): {CHECK}")


def whole_covariance(factors: DriveFactors, of_free: Array) -> Array:
    """The covariance (m, m) of all that is shared, of that of what is free; the rest is exact."""
    C = np.zeros((len(factors.free),) * 2)
    C[np.ix_(factors.free, factors.free)] = of_free
    return C


def pose_covariances(poses: Array, joint: Array) -> Array:
    """Covariances (n, 3, 3) in the body frame, of that of poses (n, 3) together with whatever comes after them."""
    n = len(poses)
    own = joint[: 3 * n, : 3 * n].reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n), :]
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    R = np.zeros((n, 3, 3))
    R[:, 0, 0], R[:, 0, 1], R[:, 1, 0], R[:, 1, 1], R[:, 2, 2] = c, s, -s, c, 1.0
    return np.asarray(R @ own @ R.mT)


def found_landmarks(
    factors: DriveFactors, shared: Array, C: Array, there: Sequence[int]
) -> dict[int, tuple[Array, Array]]:
    """Positions and covariances of the landmarks that are there, and of those that are exact."""
    return {
        n: (factors.landmarks(shared)[n], factors.landmark_covariance(n, C))
        for n in range(len(factors.drive.landmarks))
        if n in there or factors.is_exact(n)
    }


def _found(factors: DriveFactors, filtered: Filtered, fit: _Fit) -> Found:
    slices, state = fit.problem.slices, fit.state
    covariances = np.full((len(factors), 3, 3), np.nan)
    for n, joint in slices.covariances(fit.eliminated, fit.shared):
        poses = slices.poses[slices.first[n] : slices.first[n + 1]]
        covariances[poses] = pose_covariances(state.poses[poses], joint)
    C = whole_covariance(factors, fit.shared)
    errors = [
        factors.errors_in(robot, state.shared, C) if robot in filtered.placed_at else SensorErrors(None, None)
        for robot in range(len(factors.drive.robots))
    ]
    seen = np.flatnonzero(np.isfinite(filtered.landmarks[:, 0])).tolist()
    return Found(state, covariances, found_landmarks(factors, state.shared, C, seen), errors)


def _noise(factors: DriveFactors, fit: _Fit) -> tuple[Array, float]:
    """What standard deviations of ranges and bearings are to be multiplied with, (robots, 2).

    Of a squared residual the fit has taken away a part. And how many degrees of freedom the fit has left more than
    shares say: of a measurement with a share s, of which it has taken h, it has left s (1 - h), and not s - h, since
    errors that last are not fitted as new ones would be.
    """
    m, index = factors.drive.measured, fit.problem.measured
    taken = _taken(fit)
    share, robots = m.share[index], m.robot[index]
    off = measured_off(factors, fit.state)[index]
    good = np.abs(off).max(axis=1, initial=0.0) < OUTLIER
    noise = factors.noise.copy()
    for robot in np.unique(robots[good]).tolist():
        own = good & (robots == robot)
        mean = (share[own] * off[own] ** 2).sum(axis=0) / share[own].sum(axis=0)
        noise[robot] *= np.sqrt(mean / np.maximum(1 - taken[own].mean(axis=0), LEAST_LEFT))
    return np.clip(noise, *NOISE_RANGE), float(((1 - share) * taken)[good].sum())


def _taken(fit: _Fit) -> Array:
    """How much of each measurement's squared residuals (n, 2) the fit has taken away, in units of their noise."""
    problem, slices = fit.problem, fit.problem.slices
    rows, _ = robust(problem.factors.measured(fit.state, problem.measured))
    first = slices.slices(rows.columns)
    order = np.argsort(first, kind="stable")
    cuts = np.searchsorted(first[order], np.arange(slices.count + 1))
    free = slices.is_free(rows.columns)
    taken = np.empty((len(first), 2))
    for n, joint in slices.covariances(fit.eliminated, fit.shared):
        some = order[cuts[n] : cuts[n + 1]]
        at = slices.within(rows.columns[some], n)
        C = joint[at[:, :, None], at[:, None, :]]
        A = rows.jacobians[some, :, :-1] * free[some][:, None, :]
        taken[some] = np.einsum("nij,njk,nik->ni", A, C, A)
    return taken
