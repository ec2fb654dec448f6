"""Alignment of truth with the estimate's world: by the reference's first pose, by a fit, or not at all."""

from collections.abc import Mapping
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.evaluation.truth import (
    MAX_TRUTH_GAP,
    first_with_truth,
    nearest_true_poses,
    require_truth,
    true_poses,
    with_truth,
)
from coloc_graph.geometry.lie import closest_rotation, floor_pose, se3, se3_inverse, yaw
from coloc_graph.geometry.trajectory import Trajectory

Array = NDArray[np.float64]

#: Alignment of the truth with the estimate.
#: `reference`: by the reference robot's first pose; `team`: all poses of all robots by one rigid motion;
#: `robot`: each robot's poses by a rigid motion of its own; `none`: both are in the same world.
Alignment = Literal["reference", "team", "robot", "none"]
ALIGNMENTS: tuple[Alignment, ...] = get_args(Alignment)

_DEGENERATE_RATIO = 1e-9  # ratio of the positions' principal variances below which they lie on a line: 0.03 mm per m


def usual_alignment(
    estimated: Mapping[str, Trajectory], truth: Mapping[str, Trajectory], reference: str | None
) -> Alignment:
    """Return the default alignment: by the reference, in whose world poses at stances are.

    By the team where poses belong to no stances, or the reference has no truth at its poses.
    """
    if reference is None or any(one.stances is None for one in estimated.values()):
        return "team"
    if reference in estimated and not with_truth(true_poses(truth, estimated[reference])).any():
        return "team"
    return "reference"


def align(
    estimated: Mapping[str, Trajectory],
    truth: Mapping[str, Trajectory],
    reference: str | None = None,
    *,
    on_floor: bool,
    alignment: Alignment = "reference",
    max_gap: float = MAX_TRUTH_GAP,
    nearest: float | None = None,
) -> dict[str, Array]:
    """Return the true poses at the times of an estimate, in the estimate's world.

    Parameters
    ----------
    estimated, truth : mapping of str to Trajectory
        Estimated and true poses by robot.
    reference : str or None
        Robot that defines the world, for alignment by its first pose that has truth.
    on_floor : bool
        Move and turn the truth on the floor only.
    alignment : Alignment
        Kind of alignment.
    max_gap : float
        Longest gap over which truth is interpolated [s].
    nearest : float or None
        Take the true pose with the nearest stamp within this time [s], as evo does, instead of interpolating.

    Returns
    -------
    dict of str to (n, 4, 4) float
        T_world_body by robot, NaN where there is no truth.

    Raises
    ------
    InputError
        No pose has truth, or the alignment is undetermined.
    """
    at = {
        robot: true_poses(truth, one, max_gap) if nearest is None else nearest_true_poses(truth, one, nearest)
        for robot, one in estimated.items()
    }
    require_truth(truth, estimated, at)
    if alignment == "none":
        return at
    if alignment == "reference":
        T_world_truth = _of_reference(estimated, at, reference, on_floor=on_floor)
        return {robot: T_world_truth @ poses for robot, poses in at.items()}
    if alignment == "team":
        T_world_truth = _fitted(estimated, at, on_floor=on_floor)
        return {robot: T_world_truth @ poses for robot, poses in at.items()}
    return {
        robot: _fitted({robot: estimated[robot]}, {robot: poses}, on_floor=on_floor) @ poses
        if with_truth(poses).any()
        else poses
        for robot, poses in at.items()
    }


def _of_reference(
    estimated: Mapping[str, Trajectory], at: Mapping[str, Array], reference: str | None, *, on_floor: bool
) -> Array:
    """Return T_world_truth (4, 4) by the reference's first pose with truth."""
    if reference is None or reference not in at:
        raise InputError(f"the estimate does not hold the reference robot {reference}: choose another alignment")
    first = first_with_truth(estimated, at, reference)
    if first is None:
        raise InputError(
            f"there is no truth of the reference robot {reference} at the times of its poses: give its truth, or align "
            "the team (--align team)"
        )
    T_truth_body, T_world_body = at[reference][first], estimated[reference].T_world_body[first]
    if on_floor:
        T_truth_body, T_world_body = (floor_pose(T[0, 3], T[1, 3], yaw(T)) for T in (T_truth_body, T_world_body))
    return np.asarray(T_world_body @ se3_inverse(T_truth_body))


def _fitted(estimated: Mapping[str, Trajectory], at: Mapping[str, Array], *, on_floor: bool) -> Array:
    """Fit T_world_truth (4, 4) that brings all true positions nearest to the estimated ones.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991, without scale.
    """
    known = {robot: with_truth(poses) for robot, poses in at.items()}
    to = np.concatenate([one.positions[known[robot]] for robot, one in estimated.items()])
    of = np.concatenate([poses[known[robot], :3, 3] for robot, poses in at.items()])
    size = 2 if on_floor else 3
    a, b = (to - to.mean(0))[:, :size], (of - of.mean(0))[:, :size]
    spreads = np.array([np.linalg.eigvalsh(x.T @ x / len(x))[::-1] for x in (a, b)])
    if (spreads[:, 0] < 1e-12).any() or (not on_floor and (spreads[:, 1] < _DEGENERATE_RATIO * spreads[:, 0]).any()):
        whose = ", ".join(estimated)
        shape, remedy = "in one place", "reference"
        if spreads.shape[1] == 3 and not (spreads[:, 0] < 1e-12).any():
            shape, remedy = "on one line", "reference, or planar if they are on a floor"
        raise InputError(
            f"no rotation can be fitted, since all poses of {whose} are {shape}: choose another alignment ({remedy})"
        )
    R = np.eye(3)
    R[:size, :size] = _rotation(a.T @ b)
    t = to.mean(0) - R @ of.mean(0)
    if on_floor:
        t[2] = 0.0  # heights are relative to the floor in both
    return se3(R, t)


def _rotation(M: Array) -> Array:
    """Return the rotation nearest to a matrix (2, 2) or (3, 3)."""
    if len(M) == 3:
        return closest_rotation(M)
    angle = np.arctan2(M[1, 0] - M[0, 1], M[0, 0] + M[1, 1])
    return floor_pose(0, 0, angle)[:2, :2]
