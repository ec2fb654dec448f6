"""How well an estimate of a drive agrees with what was measured, and all that is said of it: `summed_up`."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.planar.estimate import DriveEstimate, Errors, PlacedLandmark, trajectory
from coloc_graph.backend.planar.factors import DriveFactors
from coloc_graph.backend.planar.model import NO_ERRORS, NOTHING_OFF, between, wrapped

Array = NDArray[np.float64]

#: A measurement further off than this in one of its numbers [sigmas] is of something else.
DOUBTED = 6.0


@dataclass(frozen=True, eq=False)
class Found:
    """What was found, robots and landmarks by number: `poses` (n, 3) of each robot's keyframes, NaN where there is
    none, with `covariances` (n, 3, 3) in the body frame; `landmarks` (2,) with covariances; `errors` by robot."""

    poses: Sequence[Array]
    covariances: Sequence[Array]
    landmarks: Mapping[int, tuple[Array, Array]]
    errors: Sequence[Errors]

    def wheels(self, robot: int) -> Sequence[float]:
        """The errors of a robot's wheels."""
        found = self.errors[robot].wheels
        return NO_ERRORS if found is None else found[0].tolist()

    def ranging(self, robot: int) -> Sequence[float]:
        """The errors of a robot's sensor."""
        found = self.errors[robot].ranging
        return NOTHING_OFF if found is None else found[0].tolist()


def steps_off(factors: DriveFactors, found: Found, robot: int) -> Array:
    """How far a robot's steps are off (n, 3), whitened; NaN where an end has no pose."""
    model, errors = factors.models.wheels[robot], found.wheels(robot)
    poses = found.poses[robot].tolist()
    off = np.empty((len(model), 3))
    for k in range(len(model)):
        x, y, yaw = between(poses[k], poses[k + 1])
        delta, _ = model.step(k, errors)
        off[k] = x - delta[0], y - delta[1], yaw - delta[2]
    off[:, 2] = (off[:, 2] + np.pi) % (2 * np.pi) - np.pi
    p, q = model.units(errors)
    off *= (p, p, q)
    whitened: Array = np.einsum("nij,nj->ni", factors.whiten(robot), off)
    return whitened


def measured_off(factors: DriveFactors, found: Found) -> Array:
    """How far measurements are off (n, 2) in their own sigmas, whatever their share; NaN where an end has no place."""
    drive, models = factors.drive, factors.models
    m, robots = drive.measured, len(drive.robots)
    poses = [each.tolist() for each in found.poses]
    places = {n: position.tolist() for n, (position, _) in found.landmarks.items()}
    off = np.full((len(m), 2), np.nan)
    columns = (m.robot, m.keyframe, m.target, m.target_keyframe, m.range, m.bearing)
    for index, (robot, k, target, k_target, range_, bearing) in enumerate(
        zip(*(column.tolist() for column in columns), strict=True)
    ):
        there = poses[target][k_target] if target < robots else places.get(target - robots)
        pose = poses[robot][k]
        if there is None or math.isnan(pose[0]) or math.isnan(there[0]):
            continue
        x, y, _ = between(pose, (there[0], there[1], 0.0))
        expected = models.ranging[robot].expected(x, y, found.ranging(robot))
        of_range, of_bearing = models.ranging[robot].sigmas(range_)
        off[index] = (expected.range - range_) / of_range, wrapped(expected.bearing - bearing) / of_bearing
    return np.asarray(off / factors.noise[m.robot, :2])


def summed_up(
    factors: DriveFactors, found: Found, taken: NDArray[np.bool_], iterations: int, absorbed: float | None = None
) -> DriveEstimate:
    """The estimate that was found, of the measurements that were taken in.

    `absorbed` are the degrees of freedom that a fit of all of it together leaves beyond what shares say; without it
    there is no chi2.
    """
    drive, models = factors.drive, factors.models
    off = np.where(taken[:, None], measured_off(factors, found), np.nan)
    valid = np.isfinite(off[:, 0])
    doubted = valid & (np.abs(np.where(valid[:, None], off, 0.0)).max(axis=1, initial=0.0) > DOUBTED)
    good = valid & ~doubted
    share = drive.measured.share[good]
    chi2, dof = float((share * off[good] ** 2).sum()), float(share.sum())
    trajectories, unplaced = {}, []
    for robot, (name, times) in enumerate(zip(drive.robots, drive.times, strict=True)):
        there = np.isfinite(found.poses[robot][:, 0])
        if not there.any():
            unplaced.append(name)
            continue
        trajectories[name] = trajectory(name, times[there], found.poses[robot][there], found.covariances[robot][there])
        steps = steps_off(factors, found, robot)
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
