"""The most likely poses, landmarks and errors of a whole drive together: `optimise_drive`."""

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.planar.estimate import DriveEstimate, errors_of, placed_landmarks, poses_of, trajectory
from coloc_graph.backend.planar.factors import DriveFactors, landmark_key, pose_key, ranging_key, wheels_key
from coloc_graph.backend.planar.filter import Filtered, Models, filter_forward
from coloc_graph.backend.planar.gauss_newton import gauss_newton
from coloc_graph.backend.solver import joint_covariance, with_stack
from coloc_graph.errors import EstimationError
from coloc_graph.keyframes import Drive
from coloc_graph.team import Team

Array = NDArray[np.float64]

#: A measurement further off than this in one of its numbers [sigmas] is of something else.
DOUBTED = 6.0
#: Rounds of fitting, each with the noise that the residuals of the one before have.
ROUNDS = 2
#: Of so many measurements and steps of each robot it is looked how much of their residual the fit has taken away.
SAMPLED = 150
#: Noise is not taken for less, or more, than so many times what is stated.
NOISE_RANGE = (0.2, 5.0)


def optimise_drive(team: Team, drive: Drive, *, calibrate_noise: bool = True) -> DriveEstimate:
    """The most likely of all, given all steps and measurements, from where a filter sees it.

    Noise is what the team states, times what makes it that of the residuals (`calibrate_noise`), by robot and kind.
    Raises `EstimationError` where no robot can be placed, or the optimiser's answer does not pass its check.
    """
    count = sum(map(len, drive.times))
    return with_stack(count, lambda: _optimised(team, drive, calibrate_noise))


def _optimised(team: Team, drive: Drive, calibrate_noise: bool) -> DriveEstimate:
    filtered = filter_forward(team, drive)
    models = Models(team, drive)
    robots = sorted(filtered.placed_at)
    if not robots:
        raise EstimationError(
            "no robot's measurements say where it is: let one see two landmarks of known positions several times"
        )
    factors = DriveFactors(drive, models)
    values = _start(filtered, factors, robots)
    iterations = 0
    for left in reversed(range(ROUNDS if calibrate_noise else 1)):
        graph, measured = graph_of(factors, values, robots)
        values, used = gauss_newton(graph, values)
        iterations += used
        residuals = residuals_of(factors, values, measured)
        doubted = np.abs(residuals).max(axis=1, initial=0.0) > DOUBTED
        if left:
            marginals = gtsam.Marginals(graph, values)
            noise = _noise(factors, values, marginals, measured, residuals, doubted)
            factors = DriveFactors(drive, models, noise)
    return assemble(factors, values, graph, measured, residuals, doubted, iterations)


def _start(filtered: Filtered, factors: DriveFactors, robots: Sequence[int]) -> gtsam.Values:
    """Where the search starts: as the filter has it."""
    values = gtsam.Values()
    whole = filtered.whole(factors.drive, factors.models)
    for robot in robots:
        for k, pose in enumerate(whole[robot].tolist()):
            values.insert(pose_key(robot, k), gtsam.Pose2(*pose))
        for key, errors in ((wheels_key(robot), filtered.wheels), (ranging_key(robot), filtered.ranging)):
            if key in factors.calibration_keys(robot):
                values.insert(key, errors[robot])
    for landmark, position in enumerate(filtered.landmarks):
        if np.isfinite(position[0]) and not factors.is_exact(landmark):
            values.insert(landmark_key(landmark), position)
    return values


def graph_of(
    factors: DriveFactors, values: gtsam.Values, robots: Sequence[int]
) -> tuple[gtsam.NonlinearFactorGraph, NDArray[np.int64]]:
    """The graph over what has values, and which measurements are in it: its last factors, in their order."""
    drive, m = factors.drive, factors.drive.measured
    graph = gtsam.NonlinearFactorGraph()
    if not factors.models.map_known:
        key = pose_key(robots[0], 0)
        graph.add(factors.gauge(key, values.atPose2(key)))
    landmarks = [n for n in range(len(drive.landmarks)) if values.exists(landmark_key(n))]
    for factor in factors.priors(robots, landmarks):
        graph.add(factor)
    for robot in robots:
        for k in range(len(drive.times[robot]) - 1):
            graph.add(factors.step(robot, k))
    there = np.zeros(len(drive.robots) + len(drive.landmarks), bool)
    there[list(robots)] = True
    there[[len(drive.robots) + n for n in range(len(drive.landmarks)) if n in landmarks or factors.is_exact(n)]] = True
    measured = np.flatnonzero(there[m.robot] & there[m.target])
    for index in measured.tolist():
        graph.add(factors.measured(index))
    return graph, measured


def residuals_of(factors: DriveFactors, values: gtsam.Values, measured: NDArray[np.int64]) -> Array:
    """How far measurements are off (n, 2) in their own sigmas, whatever their share."""
    share = factors.drive.measured.share[measured]
    off = [factors.measured(index).unwhitenedError(values) for index in measured.tolist()]
    return np.array(off).reshape(-1, 2) / np.sqrt(share)


def _noise(
    factors: DriveFactors,
    values: gtsam.Values,
    marginals: gtsam.Marginals,
    measured: NDArray[np.int64],
    residuals: Array,
    doubted: NDArray[np.bool_],
) -> Array:
    """What standard deviations are to be multiplied with, (robots, 3): of ranges, bearings, steps.

    Of a sum of squared residuals the fit has taken away a part: that of the sampled ones.
    """
    drive, m = factors.drive, factors.drive.measured
    noise = factors.noise.copy()
    rng = np.random.default_rng(0)
    for robot, times in enumerate(drive.times):
        own = np.flatnonzero((m.robot[measured] == robot) & ~doubted)
        if len(own):
            share = m.share[measured[own]]
            some = rng.choice(own, min(SAMPLED, len(own)), replace=False)
            taken = np.array([_taken(factors.measured(int(measured[n])), values, marginals) for n in some])
            left = 1 - taken.sum(axis=0) / m.share[measured[some]].sum(axis=0)
            mean = (share * residuals[own] ** 2).sum(axis=0) / share.sum(axis=0)
            # bearings and ranges of a keyframe cannot take away more than what they know
            noise[robot, :2] *= np.sqrt(mean / np.maximum(left, 0.1))
        if len(times) > 1 and values.exists(pose_key(robot, 0)):
            steps = rng.choice(len(times) - 1, min(SAMPLED, len(times) - 1), replace=False)
            made = [factors.step(robot, int(k)) for k in steps]
            taken = np.mean([_taken(factor, values, marginals).sum() for factor in made]) / 3
            off = np.mean([factors.step(robot, k).unwhitenedError(values) ** 2 for k in range(len(times) - 1)])
            noise[robot, 2] *= float(np.sqrt(off / max(1 - float(taken), 0.1)))
    return np.clip(noise, *NOISE_RANGE)


def _taken(factor: gtsam.NonlinearFactor, values: gtsam.Values, marginals: gtsam.Marginals) -> Array:
    """How much of a factor's squared residual the fit has taken away, by row, in units of its noise."""
    A, _ = factor.linearize(values).jacobian()
    keys = list(dict.fromkeys(map(int, factor.keys())))
    taken: Array = np.einsum("ij,jk,ik->i", A, joint_covariance(marginals, keys), A)
    return taken


def assemble(
    factors: DriveFactors,
    values: gtsam.Values,
    graph: gtsam.NonlinearFactorGraph,
    measured: NDArray[np.int64],
    residuals: Array,
    doubted: NDArray[np.bool_],
    iterations: int,
) -> DriveEstimate:
    """The estimate that values are, with their covariances."""
    drive = factors.drive
    marginals = gtsam.Marginals(graph, values)
    covariances = {int(key): marginals.marginalCovariance(key) for key in values.keys()}  # noqa: SIM118  GTSAM's own
    trajectories, steps_chi2, keyframes, unplaced = {}, 0.0, 0, []
    for robot, (name, times) in enumerate(zip(drive.robots, drive.times, strict=True)):
        if not len(times) or not values.exists(pose_key(robot, 0)):
            unplaced.append(name)
            continue
        C = np.array([covariances[pose_key(robot, k)] for k in range(len(times))])
        trajectories[name] = trajectory(name, times, poses_of(values, robot, len(times)), C)
        keyframes += len(times)
        steps = (factors.step(robot, k).unwhitenedError(values) for k in range(len(times) - 1))
        steps_chi2 += sum(float(off @ off) for off in steps)
    whole = np.zeros(len(drive.measured), bool)
    whole[measured[doubted]] = True
    every = np.full((len(drive.measured), 2), np.nan)
    every[measured] = residuals
    share = drive.measured.share[measured[~doubted]]
    chi2 = steps_chi2 + float((share * residuals[~doubted] ** 2).sum())
    unknown_landmarks = sum(values.exists(landmark_key(n)) for n in range(len(drive.landmarks)))
    on_map = factors.models.map_known
    dof = 3 * (keyframes - len(trajectories)) + share.sum() - 3 * keyframes - 2 * unknown_landmarks
    return DriveEstimate(
        drive=drive,
        trajectories=trajectories,
        landmarks=placed_landmarks(factors, values, covariances),
        errors=errors_of(drive, values, covariances),
        noise=factors.noise,
        doubted=whole,
        residuals=every,
        chi2=chi2,
        dof=float(dof + (0 if on_map else 3)),
        iterations=iterations,
        on_map=on_map,
        unplaced=tuple(unplaced),
        values=values,
    )
