"""Validation of measurements before they reach a solver, which GTSAM does not do.

A NaN spoils an ISAM2 for good, and 1e150 comes back as NaN poses with finite covariances.
"""

import math
from collections.abc import Sequence
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import MeasurementError
from coloc_graph.measurements import Keyframes, Measurement, PoseMeasurement, Range, RelativePose
from coloc_graph.team import Floor

Array = NDArray[np.float64]

MAX_DISTANCE = 1e6  # m: distance of two robots; m, rad: standard deviation
MIN_SIGMA = 1e-9  # m, rad: standard deviation; a covariance of zero is not a measurement's
ROUNDING = 1e-6  # error of a rotation, and of a covariance's symmetry relative to its largest entry
_IDENTITY = np.eye(3)
_EYE = np.eye(6)[None]
_LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])


def require_valid(measurements: Sequence[Measurement], floor: Floor | None) -> None:
    """Raise `MeasurementError` for the first invalid measurement, with the reason."""
    for one in measurements:
        if isinstance(one, Range):
            _require_ranges(one)
    poses = [one for one in measurements if not isinstance(one, Range)]
    if poses:
        _require_poses(poses, floor)


def require_following(before: Keyframes, new: Keyframes) -> None:
    """Raise `MeasurementError` where keyframes do not follow those before, or hold what is no measurement."""
    if (new.robots, new.landmarks) != (before.robots, before.landmarks):
        raise MeasurementError(
            f"keyframes of {', '.join((*new.robots, *new.landmarks))} are not of the team's robots and landmarks: "
            f"name {', '.join((*before.robots, *before.landmarks))}, in this order"
        )
    for name, times, steps, begin, end, had in zip(
        new.robots, new.times, new.steps, new.begins, before.ends, before.times, strict=True
    ):
        every, why = np.concatenate([had[-1:], times[len(had[-1:]) :]]), None
        if len(times) and begin != end - (len(had) > 0):
            why = f"begin with number {begin}: begin with its last one, {max(end - 1, 0)}"
        elif not np.isfinite(every).all() or (np.diff(every) <= 0).any():
            why = "have times that do not increase"
        elif len(steps.covariances) != max(len(times) - 1, 0) or not np.isfinite(steps.covariances).all():
            why = "have steps that are not those between them, or are not finite"
        if why is not None:
            raise MeasurementError(f"keyframes of {name} {why}")
    m, robots = new.measured, len(new.robots)
    begins, ends = np.array(before.begins), np.maximum(before.ends, new.ends)
    last = np.minimum(m.target, robots - 1)
    there = (begins[m.robot] <= m.keyframe) & (m.keyframe < ends[m.robot])
    there &= (m.target >= robots) | ((begins[last] <= m.target_keyframe) & (m.target_keyframe < ends[last]))
    share = np.where(np.isfinite(m.bearing)[:, None], m.share, m.share[:, :1])
    valid = np.isfinite(m.range) & (m.range > 0) & ~np.isinf(m.bearing) & (share > 0).all(axis=1)
    for row in np.flatnonzero(~(there & valid))[:1].tolist():
        why = "is of a keyframe that has not come, or has left the window"
        if not valid[row]:
            why = "has a range that is not finite, a range of 0 or less, an infinite bearing, or a share of 0"
        names = *new.robots, *new.landmarks
        raise MeasurementError(
            f"the range of {names[m.target[row]]} by {names[m.robot[row]]} at {m.time[row]:.3f} s {why}"
        )


def _require_ranges(measured: Range) -> None:
    n = len(measured.range) if measured.range.ndim == 1 else 0
    C = measured.covariance
    why = None
    if not n or measured.moved.shape != (n, 3) or measured.target_moved.shape != (n, 3) or C.shape != (n, n):
        why = f"has ranges of shape {measured.range.shape}: give (n,), with places (n, 3) and a covariance (n, n)"
    elif not all(np.isfinite(one).all() for one in (measured.range, measured.moved, measured.target_moved, C)):
        why = "holds a number that is not finite"
    elif not (measured.range.min() > 0 and measured.range.max() <= MAX_DISTANCE):
        why = f"has a range of {measured.range.min():.3g} m: give metres above 0, at most {MAX_DISTANCE:.0e}"
    elif np.abs(C - C.T).max() > ROUNDING * np.abs(C).max() or np.linalg.eigvalsh(C)[0] < MIN_SIGMA**2:
        why = "has a covariance that is not symmetric and positive definite: every range needs an uncertainty"
    elif measured.bearing is not None and not (
        math.isfinite(measured.bearing) and MIN_SIGMA <= (measured.bearing_sigma or 0.0) < math.inf
    ):
        why = "has a bearing without a number or uncertainty: give both, in radians"
    if why is not None:
        raise MeasurementError(f"the {measured} {why}")


def _require_poses(measurements: Sequence[PoseMeasurement], floor: Floor | None) -> None:
    if _all_well(measurements, floor):
        return
    for size, group in groupby(sorted(measurements, key=_size), key=_size):
        alike = list(group)
        if size == 3 and floor is None:
            raise MeasurementError(f"the {alike[0]} needs a floor, and the team has none: add a [floor] to the team")
        for check in (_why_not_poses, _why_not_covariances):
            found = check(alike)
            if found is not None:
                index, why = found
                raise MeasurementError(f"the {alike[index]} {why}")


def _all_well(measurements: Sequence[PoseMeasurement], floor: Floor | None) -> bool:
    """Return whether all measurements pass the checks, in one vectorised pass."""
    if any(m.T_i_j.shape != (4, 4) for m in measurements):
        return False
    C = _EYE.repeat(len(measurements), axis=0)
    for one, measured in zip(C, measurements, strict=True):
        planar = not isinstance(measured, RelativePose)
        if measured.covariance.shape != ((3, 3) if planar else (6, 6)) or (planar and floor is None):
            return False
        if planar:
            one[2:5, 2:5] = measured.covariance
        else:
            one[:] = measured.covariance
    T = np.array([m.T_i_j for m in measurements])
    R = T[:, :3, :3]
    # NaN compares as False
    if not (np.abs(T).max() <= MAX_DISTANCE and np.abs(R.mT @ R - _IDENTITY).max() <= ROUNDING):
        return False
    if not (np.linalg.det(R).min() > 0 and np.abs(T[:, 3] - _LAST_ROW).max() <= ROUNDING):
        return False
    if not np.abs(C).max() <= MAX_DISTANCE**2:
        return False
    if not np.array_equal(C, C.mT):  # most are symmetric to the last bit
        largest = np.array([np.abs(m.covariance).max() for m in measurements])
        if (np.abs(C - C.mT).max(axis=(1, 2)) > ROUNDING * largest).any():
            return False
    try:
        return bool(np.linalg.cholesky(C).diagonal(axis1=1, axis2=2).min() >= MIN_SIGMA)
    except np.linalg.LinAlgError:
        return False


def _size(measured: PoseMeasurement) -> int:
    return 6 if isinstance(measured, RelativePose) else 3


def _why_not_poses(measurements: Sequence[PoseMeasurement]) -> tuple[int, str] | None:
    for index, measured in enumerate(measurements):
        if measured.T_i_j.shape != (4, 4):
            return index, f"has a pose of shape {measured.T_i_j.shape}: give (4, 4)"
    T = np.array([m.T_i_j for m in measurements])
    finite = np.isfinite(T).all(axis=(1, 2))
    if not finite.all():
        return int(np.argmin(finite)), "has a pose that is not finite"
    far = np.abs(T[:, :3, 3]).max(axis=1)
    if far.max() > MAX_DISTANCE:
        return int(np.argmax(far)), f"is {far.max():.3g} m away: at most {MAX_DISTANCE:.0e} m is possible"
    R = T[:, :3, :3]
    off = np.abs(R.mT @ R - np.eye(3)).max(axis=(1, 2))
    if off.max() > ROUNDING:
        return int(np.argmax(off)), f"is no rigid motion: R^T R differs from the identity by {off.max():.2g}"
    flipped = np.linalg.det(R) < 0
    if (np.abs(T[:, 3] - _LAST_ROW) > ROUNDING).any():
        index = int(np.argmax(np.abs(T[:, 3] - _LAST_ROW).max(axis=1)))
        return index, "is no rigid motion: its last row is not 0, 0, 0, 1"
    if flipped.any():
        return int(np.argmax(flipped)), "is no rigid motion but a reflection"
    return None


def _why_not_covariances(measurements: Sequence[PoseMeasurement]) -> tuple[int, str] | None:
    size = _size(measurements[0])
    for index, measured in enumerate(measurements):
        if np.shape(measured.covariance) != (size, size):
            return index, f"has a covariance of shape {np.shape(measured.covariance)}: give ({size}, {size})"
    C = np.array([m.covariance for m in measurements], float)
    finite = np.isfinite(C).all(axis=(1, 2))
    if not finite.all():
        return int(np.argmin(finite)), "has a covariance that is not finite"
    largest = np.abs(C).max(axis=(1, 2))
    if largest.max() > MAX_DISTANCE**2:
        return int(
            np.argmax(largest)
        ), f"has a covariance of {largest.max():.3g}: at most {MAX_DISTANCE**2:.0e} is possible"
    uneven = np.abs(C - C.mT).max(axis=(1, 2)) > ROUNDING * largest
    if uneven.any():
        return int(np.argmax(uneven)), "has a covariance that is not symmetric"
    try:
        pivots = np.linalg.cholesky(C).diagonal(axis1=1, axis2=2).min(axis=1)
    except np.linalg.LinAlgError:
        pivots = np.sqrt(np.linalg.eigvalsh(C)[:, 0].clip(min=0))
    if pivots.min() < MIN_SIGMA:
        return int(
            np.argmin(pivots)
        ), "has a covariance that is not positive definite: every direction needs an uncertainty"
    return None
