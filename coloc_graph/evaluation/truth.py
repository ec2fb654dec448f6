"""Interpolation of true poses at the times of an estimate, and warnings of missing truth."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.geometry.lie import so3_exp, so3_log
from coloc_graph.geometry.trajectory import Trajectory

Array = NDArray[np.float64]

MAX_TRUTH_GAP = 0.25  # s between true poses over which truth is interpolated
SAME_TIME = 1e-6  # s: difference of equal times by rounding


def true_poses(truth: Mapping[str, Trajectory], estimated: Trajectory, max_gap: float = MAX_TRUTH_GAP) -> Array:
    """Interpolate true poses at the times of an estimate.

    Parameters
    ----------
    truth : mapping of str to Trajectory
        True poses by robot.
    estimated : Trajectory
        Estimated poses of one robot.
    max_gap : float
        Longest gap between true poses that is interpolated [s].

    Returns
    -------
    (n, 4, 4) float
        True poses; NaN where there is no truth.

    Notes
    -----
    In a longer gap a robot of an estimate with stances stood where it was before, since robots stand while they
    observe and truth may be sparse then; of an estimate without stances nothing is known.
    """
    true = truth.get(estimated.robot)
    times = estimated.times
    if true is None or not len(true):
        return np.full((len(times), 4, 4), np.nan)
    index = np.searchsorted(true.times, times + SAME_TIME, side="right") - 1
    known = (index >= 0) & (times <= true.times[-1] + SAME_TIME)
    index = index.clip(min=0)
    after = np.minimum(index + 1, len(true) - 1)
    gap = true.times[after] - true.times[index]
    near = (gap > 0) & (gap <= max_gap)
    if estimated.stances is None:
        known &= near | (times <= true.times[index] + SAME_TIME)
    share = np.where(near, ((times - true.times[index]) / np.where(near, gap, 1.0)).clip(0, 1), 0.0)[:, None]
    T_world_body, ahead = true.T_world_body[index].copy(), true.T_world_body[after]
    moved = share[:, 0] > 0
    turn = so3_log(T_world_body[moved, :3, :3].mT @ ahead[moved, :3, :3])
    T_world_body[moved, :3, :3] = T_world_body[moved, :3, :3] @ so3_exp(share[moved] * turn)
    T_world_body[:, :3, 3] += share * (ahead[:, :3, 3] - T_world_body[:, :3, 3])
    T_world_body[~known] = np.nan
    return T_world_body


def nearest_true_poses(truth: Mapping[str, Trajectory], estimated: Trajectory, max_difference: float) -> Array:
    """Return the true poses with the nearest stamps, as evo associates trajectories.

    Parameters
    ----------
    truth : mapping of str to Trajectory
        True poses by robot.
    estimated : Trajectory
        Estimated poses of one robot.
    max_difference : float
        Largest difference of two stamps [s].

    Returns
    -------
    (n, 4, 4) float
        True poses; NaN where none is near in time.

    Notes
    -----
    As in evo's `sync.associate_trajectories`, each pose of the shorter trajectory gets the nearest one of the longer.
    Where several true poses fall to one estimated pose, evo counts that pose several times, and here the nearest of
    them counts once.
    """
    times, true = estimated.times, truth.get(estimated.robot)
    found = np.full((len(times), 4, 4), np.nan)
    if true is None or not len(true) or not len(times):
        return found
    if len(true) >= len(times):
        index = nearest_index(true.times, times)
        near = np.abs(true.times[index] - times) <= max_difference
        found[near] = true.T_world_body[index[near]]
        return found
    index = nearest_index(times, true.times)
    off = np.abs(times[index] - true.times)
    for number in np.argsort(-off, kind="stable"):  # the nearest is written last
        if off[number] <= max_difference:
            found[index[number]] = true.T_world_body[number]
    return found


def nearest_index(times: Array, at: Array) -> NDArray[np.intp]:
    """Return the indices of the times (n,), ascending, that are nearest to others (m,); the earlier of two as near."""
    after = np.searchsorted(times, at).clip(max=len(times) - 1)
    before = (after - 1).clip(min=0)
    return np.where(np.abs(times[before] - at) <= np.abs(times[after] - at), before, after)


def with_truth(true: Array) -> NDArray[np.bool_]:
    """Return where poses (n, 4, 4) have truth (are finite), (n,)."""
    return np.asarray(np.isfinite(true).all(axis=(1, 2)))


def first_with_truth(estimated: Mapping[str, Trajectory], true: Mapping[str, Array], robot: str) -> int | None:
    """Return the index of a robot's first pose with truth; None where there is none."""
    known = np.flatnonzero(with_truth(true[robot])) if robot in estimated else np.zeros(0, np.int64)
    return int(known[0]) if len(known) else None


def require_truth(
    truth: Mapping[str, Trajectory], estimated: Mapping[str, Trajectory], true: Mapping[str, Array]
) -> None:
    """Raise `InputError` where no pose of any robot has truth."""
    if any(with_truth(one).any() for one in true.values()):
        return
    both = [robot for robot in estimated if len(truth.get(robot, ()))]
    if not both:
        raise InputError(
            f"the truth holds {', '.join(truth) or 'no robot'}, and the estimate {', '.join(estimated)}: give the "
            "truth of a robot that was estimated"
        )
    robot = both[0]
    raise InputError(
        f"robot {robot} has no truth at the times of its poses: the estimate reaches from "
        f"{_span(estimated[robot].times)}, the truth from {_span(truth[robot].times)}, with gaps; check the clocks, or "
        "record truth more often"
    )


def without_truth(estimated: Mapping[str, Trajectory], true: Mapping[str, Array]) -> tuple[str, ...]:
    """Warn of poses without truth, one sentence per robot."""
    sentences = []
    for robot in estimated:
        known = np.flatnonzero(with_truth(true[robot]))
        n, lost = len(true[robot]), len(true[robot]) - len(known)
        if not lost:
            continue
        if not len(known):
            sentences.append(f"robot {robot} is not evaluated: it has no truth at the times of its {n} poses")
            continue
        before, after = int(known[0]), n - 1 - int(known[-1])
        sentences.append(
            f"robot {robot}: {lost} of {n} poses are not evaluated: they have no truth at their times "
            f"({before} before it begins, {after} after it ends, {lost - before - after} in its gaps)"
        )
    return tuple(sentences)


def _span(times: Array) -> str:
    return f"{times[0]:.3f} to {times[-1]:.3f} s"
