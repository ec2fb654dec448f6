"""Moments of a ranging run: equal intervals, which the viewer shows in place of stances."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from coloc_graph.errors import InputError
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.run import Stance
from coloc_graph.viewer.scene import Array

MIN_MOMENT = 1.0  # s, duration of a moment
MAX_MOMENTS = 2000  # moments of a run


def moments_of(trajectories: Mapping[str, Trajectory]) -> tuple[Stance, ...]:
    """Return the moments of some trajectories, as stances without observers; `InputError` without any pose."""
    times = [one.times for one in trajectories.values() if len(one)]
    if not times:
        raise InputError("there are no poses to show; solve the run again")
    begin, end = min(t[0] for t in times), max(t[-1] for t in times)
    step = max(MIN_MOMENT, (end - begin) / MAX_MOMENTS)
    starts = (begin + step * np.arange(int((end - begin) / step) + 1)).tolist()
    return tuple(Stance(k, t, t + step, (), tuple(trajectories)) for k, t in enumerate(starts))


def moment_at(times: Array, moments: Sequence[Stance]) -> Array:
    """Return the number of the moment of each time; -1 before the first."""
    starts = np.array([one.start for one in moments])
    return np.asarray(np.searchsorted(starts, times + 1e-9, side="right") - 1)


def first_poses(one: Trajectory, moments: Sequence[Stance]) -> Trajectory:
    """Return the first pose of a trajectory in each moment that has one."""
    moment, first = np.unique(moment_at(one.times, moments), return_index=True)
    kept = np.zeros(len(one), bool)
    kept[first] = True
    return replace(one.where(kept), stances=moment.astype(np.int64))
