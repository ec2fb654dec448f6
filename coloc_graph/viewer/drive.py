"""The scene of a drive: robots that drive all the time, whose moments stand where others have stances."""

import csv
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from coloc_graph.errors import InputError
from coloc_graph.evaluation import Alignment
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.results.writer import LANDMARKS, Result
from coloc_graph.run import Run, Stance
from coloc_graph.viewer.scene import Array, Landmarks, Scene, layer_of
from coloc_graph.viewer.ties import links_of, wheels_of
from coloc_graph.viewer.truth import true_layers

#: How long a moment is at least [s], and how many there are at most.
MOMENT = 1.0
MOST = 2000


def scene_of_drive(result: Result, run: Run) -> Scene:
    """The scene of a drive's result: in each moment the first keyframe of each robot, and who measured whom.

    Raises `InputError` where the result is damaged.
    """
    robots = run.team.names
    moments = _moments(result)
    first = {robot: _firsts(one, moments) for robot, one in result.trajectories.items()}
    how: Alignment = "none" if result.summary.get("world") == "map" else "team"
    true, notes = true_layers(run, robots, moments, first, on_floor=True, alignment=how)
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


@contextmanager
def _rows(path: Path) -> Iterator[list[dict[str, str]]]:
    """The rows of a file of the result; what is wrong with them is an `InputError` that names it."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            yield list(csv.DictReader(file))
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is damaged ({error}); solve the run again") from error


def _measured(path: Path, moments: Sequence[Stance]) -> list[tuple[int, str, str]]:
    """(moment, who, whom) of what is in the estimate, each once."""
    with _rows(path) as rows:
        used = [row for row in rows if row["residual_range"] and row["doubted"] == "no"]
        at = _moment_of(np.array([float(row["time"]) for row in used]), moments)
        return sorted({(int(k), row["robot"], row["target"]) for k, row in zip(at, used, strict=True) if k >= 0})


def _landmarks(
    path: Path, measured: Sequence[tuple[int, str, str]], robots: Sequence[str], moments: Sequence[Stance]
) -> Landmarks:
    """Landmarks, which have a place and no heading."""
    columns = ("x", "y", "x_sigma", "y_sigma", "xy_correlation")
    with _rows(path) as rows:
        names = tuple(row["name"] for row in rows)
        numbers = np.array([[float(row[name]) for name in columns] for row in rows]).reshape(-1, len(columns))
    sigmas = numbers[:, 2:4]
    covariance = sigmas[:, :, None] * sigmas[:, None]
    covariance[:, 0, 1] *= numbers[:, 4]
    covariance[:, 1, 0] = covariance[:, 0, 1]
    seen = [((a, k), (b, k)) for k, a, b in measured if b in names]
    none = np.zeros(len(names))
    return Landmarks(names, numbers[:, :2], none, covariance, none, links_of(seen, robots, moments, seen=names))
