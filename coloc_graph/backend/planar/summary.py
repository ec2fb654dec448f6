"""Estimate of a ranging run from an optimiser's result: `ranging_estimate`."""

from collections.abc import Callable, Collection

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.calibration import Calibration
from coloc_graph.backend.estimate import Estimate, rejection_of
from coloc_graph.backend.floor_poses import trajectory
from coloc_graph.backend.landmarks import StaticPose
from coloc_graph.backend.marginals import Marginals
from coloc_graph.backend.planar.factors import KeyframeFactors, State
from coloc_graph.backend.ranging import RangingProblem, outliers_of
from coloc_graph.backend.sensor_calibration import CalibratedSensors, SensorErrors
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.team import Landmark

Array = NDArray[np.float64]


def trajectories_of(factors: KeyframeFactors, poses: Array, covariances: Array) -> dict[str, Trajectory]:
    """Return the trajectories of robots that have any poses (n, 3), NaN where there is none; covariances of bodies."""
    found, ends = {}, factors.first[1:-1]
    split = zip(factors.keyframes.times, np.split(poses, ends), np.split(covariances, ends), strict=True)
    for name, model, (times, own, C) in zip(factors.keyframes.robots, factors.models.wheels, split, strict=True):
        there = np.isfinite(own[:, 0])
        if there.any():
            found[name] = trajectory(name, times[there], own[there], C[there], model.wheels.direction_sigma_deg)
    return found


def ranging_estimate(
    factors: KeyframeFactors,
    state: State,
    covariances: Array,
    shared_covariance: Array,
    seen: Collection[int],
    iterations: int,
    absorbed: float | None = None,
    marginals: Callable[[], Marginals] | None = None,
) -> Estimate:
    """Return the estimate of an optimiser's result.

    Covariances are those of the poses (n, 3, 3) in the body frame, and of the shared variables; landmarks `seen` have
    positions. `absorbed` are the degrees of freedom of a batch fit beyond the shares; without it there is no chi2.
    `marginals` gives those of all variables, by GTSAM's key.
    """
    keyframes, models, located = factors.keyframes, factors.models, np.isfinite(state.poses[:, 0])
    valid = np.zeros(len(keyframes.measured), bool)
    valid[factors.measured_between(located, seen)] = True
    off = np.where(valid[:, None], factors.off(state), np.nan)
    good = valid & ~outliers_of(off)
    share = keyframes.measured.share[good]
    steps = factors.steps(state, factors.steps_between(located)).residuals
    chi2 = float(np.nansum(share * off[good] ** 2) + (steps**2).sum())
    dof = float(share.sum()) + 3.0 * len(steps) - 3.0 * located.sum()
    numbers, disconnected, sensors = {}, [], {}
    for robot, (name, there) in enumerate(zip(keyframes.robots, np.split(located, factors.first[1:-1]), strict=True)):
        disconnected += [(name, number) for number in np.flatnonzero(~there).tolist()]
        errors = SensorErrors(None, None)
        if there.any():
            numbers[name] = np.flatnonzero(there)
            errors = factors.errors_in(robot, state.shared, shared_covariance)
        sensors[name] = CalibratedSensors(models.team[name], errors, tuple(factors.noise[robot].tolist()))
    landmarks, positions = {}, {}
    for number, name in enumerate(keyframes.landmarks):
        if number in seen or factors.is_exact(number):
            position, C = (
                factors.landmarks(state.shared)[number],
                factors.landmark_covariance(number, shared_covariance),
            )
            landmarks[name] = _placed(position, C)
            if not np.isfinite(models.map[number, 0]):
                sigma = float(np.sqrt(np.trace(C) / 2))
                positions[name] = Landmark(name=name, position=tuple(position.tolist()), position_sigma=sigma)
                dof -= 2
    directions = np.deg2rad([each.wheels.direction_sigma_deg for each in models.wheels])
    problem = RangingProblem(models.team, keyframes, numbers, off, factors.noise, directions, marginals)
    return Estimate(
        method="ranging",
        source=problem,
        trajectories=trajectories_of(factors, state.poses, covariances),
        disconnected=tuple(disconnected),
        chi2=0.0 if absorbed is None else chi2,
        dof=0.0 if absorbed is None else float(dof) + absorbed + (0 if models.map_known else 3),
        iterations=iterations,
        rejected=tuple(
            rejection_of(problem.measurements[row], problem.agreement(row))
            for row in np.flatnonzero(problem.outliers).tolist()
        ),
        calibration=Calibration(driven=sensors, landmarks=positions),
        landmarks=landmarks,
    )


def _placed(position: Array, covariance: Array) -> StaticPose:
    """Return a landmark that is a point at (2,) on the floor, with a covariance (2, 2)."""
    C = np.zeros((6, 6))
    C[3:5, 3:5] = covariance
    return StaticPose(gtsam.Pose3(floor_pose(position[0], position[1], 0.0)), C, has_heading=False)
