"""How well an estimate of a drive agrees with what was measured, and all that is said of it: `summed_up`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.planar.estimate import DriveEstimate, Errors, PlacedLandmark, trajectory
from coloc_graph.backend.planar.factors import DriveFactors, State

Array = NDArray[np.float64]

#: A measurement further off than this in one of its numbers [sigmas] is of something else.
DOUBTED = 6.0


@dataclass(frozen=True, eq=False)
class Found:
    """What was found, robots and landmarks by number: the `state` of all keyframes and of what is shared, with
    `covariances` (n, 3, 3) of the poses in the body frame; `landmarks` (2,) with covariances; `errors` by robot."""

    state: State
    covariances: Array
    landmarks: Mapping[int, tuple[Array, Array]]
    errors: Sequence[Errors]


def measured_off(factors: DriveFactors, state: State) -> Array:
    """How far measurements are off (n, 2) in their own sigmas, whatever their share; NaN where an end has no place."""
    m = factors.drive.measured
    return factors.measured(state, np.arange(len(m))).residuals / np.sqrt(m.share)


def summed_up(
    factors: DriveFactors, found: Found, taken: NDArray[np.bool_], iterations: int, absorbed: float | None = None
) -> DriveEstimate:
    """The estimate that was found, of the measurements that were taken in.

    `absorbed` are the degrees of freedom that a fit of all of it together leaves beyond what shares say; without it
    there is no chi2.
    """
    drive, models = factors.drive, factors.models
    off = np.where(taken[:, None], measured_off(factors, found.state), np.nan)
    valid = np.isfinite(off[:, 0])
    doubted = valid & (np.abs(np.where(valid[:, None], off, 0.0)).max(axis=1, initial=0.0) > DOUBTED)
    good = valid & ~doubted
    share = drive.measured.share[good]
    chi2, dof = float((share * off[good] ** 2).sum()), float(share.sum())
    trajectories, unplaced = {}, []
    for robot, (name, times) in enumerate(zip(drive.robots, drive.times, strict=True)):
        own = np.arange(factors.first[robot], factors.first[robot + 1])
        poses, covariances = found.state.poses[own], found.covariances[own]
        there = np.isfinite(poses[:, 0])
        if not there.any():
            unplaced.append(name)
            continue
        trajectories[name] = trajectory(name, times[there], poses[there], covariances[there])
        steps = factors.steps(found.state, own[:-1]).residuals
        chi2 += float(np.nansum(steps**2))
        dof += 3.0 * np.isfinite(steps[:, 0]).sum() - 3.0 * there.sum()
    counts = np.bincount(drive.measured.target[valid], minlength=len(drive.robots) + len(drive.landmarks))
    landmarks = []
    for number, name in enumerate(drive.landmarks):
        if number in found.landmarks:
            position, C = found.landmarks[number]
            stated = bool(np.isfinite(models.map[number, 0]))
            landmarks.append(PlacedLandmark(name, position, C, stated, int(counts[len(drive.robots) + number])))
            dof -= 0 if stated else 2
    return DriveEstimate(
        drive=drive,
        trajectories=trajectories,
        landmarks=tuple(landmarks),
        errors=dict(zip(drive.robots, found.errors, strict=True)),
        noise=factors.noise,
        doubted=doubted,
        residuals=off,
        chi2=0.0 if absorbed is None else chi2,
        dof=0.0 if absorbed is None else float(dof) + absorbed + (0 if models.map_known else 3),
        iterations=iterations,
        on_map=models.map_known,
        unplaced=tuple(unplaced),
    )
