"""The scene of a drive: robots that drive all the time, whose moments stand where others have stances."""

import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from coloc_graph.errors import InputError
from coloc_graph.evaluation import Alignment, align, left_out, with_truth
from coloc_graph.results import LANDMARKS, Result
from coloc_graph.run import Run, Stance, read_truth
from coloc_graph.trajectory import Trajectory
from coloc_graph.viewer.scene import TRUE, Array, Landmarks, Layer, Scene, layer_of
from coloc_graph.viewer.ties import links_of, wheels_of

#: How long a moment is at least [s], and how many there are at most.
MOMENT, MOST = 1.0, 2000


def scene_of_drive(result: Result, run: Run) -> Scene:
    """The scene of a drive's result: in each moment the first keyframe of each robot, and who measured whom.

    Raises `InputError` where the result is damaged.
    """
    robots = run.team.names
    moments = _moments(result)
    first = {robot: _firsts(one, moments) for robot, one in result.trajectories.items()}
    true, notes = _true(result, run, first, robots, moments)
    measured = _measured(result.path / "measurements.csv", moments)
    between = [((a, k), (b, k)) for k, a, b in measured if b in robots]
    return Scene(
        robots=robots,
        stances=moments,
        layers=(layer_of(str(result.summary.get("method")), robots, moments, first), *true),
        sightings=links_of(between, robots, moments),
        team=run.team,
        run=run,
        wheels=wheels_of(run),
        title=result.path.absolute().name,
        notes=notes,
        landmarks=_landmarks(result.path / LANDMARKS, measured, robots, moments),
    )


def _moments(result: Result) -> tuple[Stance, ...]:
    times = [one.times for one in result.trajectories.values() if len(one)]
    if not times:
        raise InputError(f"{result.path} holds no pose; solve the run again")
    begin, end = min(t[0] for t in times), max(t[-1] for t in times)
    step = max(MOMENT, (end - begin) / MOST)
    starts = (begin + step * np.arange(int((end - begin) / step) + 1)).tolist()
    robots = tuple(result.trajectories)
    return tuple(Stance(k, t, t + step, (), robots) for k, t in enumerate(starts))


def _moment_of(times: Array, moments: Sequence[Stance]) -> Array:
    """The moment that each time is of."""
    starts = np.array([one.start for one in moments])
    return np.asarray(np.searchsorted(starts, times + 1e-9, side="right") - 1)


def _firsts(one: Trajectory, moments: Sequence[Stance]) -> Trajectory:
    """The first pose in each moment that has one."""
    moment, first = np.unique(_moment_of(one.times, moments), return_index=True)
    kept = np.zeros(len(one), bool)
    kept[first] = True
    return replace(one.where(kept), stances=moment.astype(np.int64))


def _true(
    result: Result, run: Run, first: dict[str, Trajectory], robots: Sequence[str], moments: Sequence[Stance]
) -> tuple[tuple[Layer, ...], tuple[str, ...]]:
    """The true poses at the same instants; and why not, where there are none."""
    truth = read_truth(run.path)
    if not truth:
        return (), ()
    how: Alignment = "none" if result.summary.get("world") == "map" else "team"
    try:
        true = align(first, truth, run.team.reference, on_floor=True, alignment=how)
    except InputError as error:
        return (), (f"the truth in the run is not shown: {error}",)
    poses = {
        robot: replace(one, T_world_body=true[robot], covariances=None).where(with_truth(true[robot]))
        for robot, one in first.items()
    }
    return (layer_of(TRUE, robots, moments, poses),), left_out(first, true)


def _measured(path: Path, moments: Sequence[Stance]) -> list[tuple[int, str, str]]:
    """(moment, who, whom) of what is in the estimate, each once."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = [row for row in csv.DictReader(file) if row["residual_range"] and row["doubted"] == "no"]
        at = _moment_of(np.array([float(row["time"]) for row in rows]), moments)
        return sorted({(int(k), row["robot"], row["target"]) for k, row in zip(at, rows, strict=True) if k >= 0})
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is damaged ({error}); solve the run again") from error


def _landmarks(
    path: Path, measured: Sequence[tuple[int, str, str]], robots: Sequence[str], moments: Sequence[Stance]
) -> Landmarks:
    """Landmarks, which have a place and no heading."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        names = tuple(row["name"] for row in rows)
        columns = ("x", "y", "x_sigma", "y_sigma", "xy_correlation")
        numbers = np.array([[float(row[name]) for name in columns] for row in rows]).reshape(-1, len(columns))
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is damaged ({error}); solve the run again") from error
    sigmas = numbers[:, 2:4]
    covariance = sigmas[:, :, None] * sigmas[:, None]
    covariance[:, 0, 1] *= numbers[:, 4]
    covariance[:, 1, 0] = covariance[:, 0, 1]
    seen = [((a, k), (b, k)) for k, a, b in measured if b in names]
    none = np.zeros(len(names))
    return Landmarks(names, numbers[:, :2], none, covariance, none, links_of(seen, robots, moments, seen=names))
