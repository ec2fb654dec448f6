"""Estimate of a ranging run from an optimiser's result: `ranging_estimate`."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.calibration import Calibration
from coloc_graph.backend.estimate import Estimate, Rejection
from coloc_graph.backend.floor_poses import trajectory
from coloc_graph.backend.landmarks import StaticPose
from coloc_graph.backend.marginals import Marginals
from coloc_graph.backend.planar.factors import KeyframeFactors, State
from coloc_graph.backend.ranging import RangingProblem
from coloc_graph.backend.sensor_calibration import CalibratedSensors, SensorErrors
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.team import Landmark

Array = NDArray[np.float64]

OUTLIER = 6.0  # residual of a range or bearing beyond which a measurement is an outlier [sigmas]


@dataclass(frozen=True, eq=False)
class Found:
    """Result of an optimiser, robots and landmarks by number.

    `state` of all keyframes and shared variables, with `covariances` (n, 3, 3) of the poses in the body frame;
    `landmarks` (2,) with covariances; `errors` by robot.
    """

    state: State
    covariances: Array
    landmarks: Mapping[int, tuple[Array, Array]]
    errors: Sequence[SensorErrors]


def measured_off(factors: KeyframeFactors, state: State) -> Array:
    """Return residuals (n, 2) in units of the measurements' sigmas, without shares; NaN where an end has no pose."""
    m = factors.keyframes.measured
    return factors.measured(state, np.arange(len(m))).residuals / np.sqrt(m.share)


def ranging_estimate(
    factors: KeyframeFactors,
    found: Found,
    iterations: int,
    absorbed: float | None = None,
    marginals: Callable[[], Marginals] | None = None,
) -> Estimate:
    """Return the estimate of an optimiser's result.

    `absorbed` are the degrees of freedom of a batch fit beyond the shares; without it there is no chi2. `marginals`
    gives those of all variables, by number.
    """
    keyframes, models = factors.keyframes, factors.models
    valid = np.zeros(len(keyframes.measured), bool)
    valid[factors.measured_between(np.isfinite(found.state.poses[:, 0]), found.landmarks)] = True
    off = np.where(valid[:, None], measured_off(factors, found.state), np.nan)
    outliers = valid & (np.abs(np.where(valid[:, None], off, 0.0)).max(axis=1, initial=0.0) > OUTLIER)
    good = valid & ~outliers
    share = keyframes.measured.share[good]
    chi2, dof = float((share * off[good] ** 2).sum()), float(share.sum())
    trajectories, numbers, disconnected = {}, {}, []
    for robot, (name, times) in enumerate(zip(keyframes.robots, keyframes.times, strict=True)):
        own = np.arange(factors.first[robot], factors.first[robot + 1])
        poses, covariances = found.state.poses[own], found.covariances[own]
        there = np.isfinite(poses[:, 0])
        disconnected += [(name, number) for number in np.flatnonzero(~there).tolist()]
        if not there.any():
            continue
        unsure = models.wheels[robot].wheels.direction_sigma_deg
        trajectories[name] = trajectory(name, times[there], poses[there], covariances[there], unsure)
        numbers[name] = np.flatnonzero(there)
        steps = factors.steps(found.state, own[:-1]).residuals
        chi2 += float(np.nansum(steps**2))
        dof += 3.0 * np.isfinite(steps[:, 0]).sum() - 3.0 * there.sum()
    landmarks, positions = {}, {}
    for number, name in enumerate(keyframes.landmarks):
        if number in found.landmarks:
            position, C = found.landmarks[number]
            landmarks[name] = _placed(position, C)
            if not np.isfinite(models.map[number, 0]):
                sigma = float(np.sqrt(np.trace(C) / 2))
                positions[name] = Landmark(name=name, position=tuple(position.tolist()), position_sigma=sigma)
                dof -= 2
    directions = np.deg2rad([each.wheels.direction_sigma_deg for each in models.wheels])
    problem = RangingProblem(keyframes, numbers, off, outliers, factors.noise, models.map_known, directions, marginals)
    sensors = {
        name: CalibratedSensors(models.team[name], errors, tuple(factors.noise[robot].tolist()))
        for robot, (name, errors) in enumerate(zip(keyframes.robots, found.errors, strict=True))
    }
    return Estimate(
        method="ranging",
        source=problem,
        trajectories=trajectories,
        disconnected=tuple(disconnected),
        chi2=0.0 if absorbed is None else chi2,
        dof=0.0 if absorbed is None else float(dof) + absorbed + (0 if models.map_known else 3),
        iterations=iterations,
        rejected=tuple(
            Rejection(problem.measurements[row], problem.reason(row) or "", problem.sigmas(row))
            for row in np.flatnonzero(outliers).tolist()
        ),
        calibration=Calibration(driven=sensors, landmarks=positions),
        landmarks=landmarks,
    )


def _placed(position: Array, covariance: Array) -> StaticPose:
    """Return a landmark that is a point at (2,) on the floor, with a covariance (2, 2)."""
    C = np.zeros((6, 6))
    C[3:5, 3:5] = covariance
    return StaticPose(gtsam.Pose3(floor_pose(position[0], position[1], 0.0)), C, has_heading=False)
