"""Scenes of what there is: an estimate, a result on disk, a run that is solved for it, two results of one run."""

import csv
import itertools
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from coloc_graph.backend import Estimate, Method, chain, smooth
from coloc_graph.backend.graph import PoseKeys
from coloc_graph.errors import EstimationError, InputError
from coloc_graph.exchange.landmarks import landmark_rows, read_landmarks
from coloc_graph.frontend import FrontendOptions, PairMeasurement, TrackerOptions
from coloc_graph.input_file import read_toml
from coloc_graph.measurements import RelativePose
from coloc_graph.pipeline.batch import Progress, Solution, SolveOptions, solve
from coloc_graph.pipeline.contents import kind_of
from coloc_graph.results.writer import LANDMARKS, read_result
from coloc_graph.run import Run, Stance, open_run
from coloc_graph.team import read_team
from coloc_graph.viewer.drive import scene_of_drive
from coloc_graph.viewer.scene import NO_EDGES, Edges, Index, Scene, layer_of
from coloc_graph.viewer.still import landmarks_in, sighted_in
from coloc_graph.viewer.ties import ties_in, ties_on_disk, wheels_of
from coloc_graph.viewer.truth import true_layers

#: What the methods' layers are called.
NAMES = {"chain": "chained", "smooth": "smoothed", "joint": "joint"}
OF_GRAPH = "of the measurement in the estimate"
OF_POINTS = "of the points against their homography"


def scene_of_estimate(
    estimate: Estimate,
    *,
    run: Run | None = None,
    measurements: Sequence[PairMeasurement] = (),
    others: Sequence[Estimate] = (),
    frontend: FrontendOptions | None = None,
) -> Scene:
    """The scene of an estimate, with `others` of the same graph beside it, and the run's truth where it has some.

    `measurements` are all that were made, so that those which never came into the graph are shown too. Raises
    `InputError` where a pose is not finite.
    """
    graph = estimate.graph
    every = (estimate, *others)
    layers = [layer_of(NAMES[one.method], graph.robots, graph.stances, one.trajectories) for one in every]
    team = run.team if run is not None else None
    on_floor = run is not None and run.team.floor is not None
    true, notes = true_layers(run, graph.robots, graph.stances, estimate.trajectories, on_floor=on_floor)
    sightings, odometry = ties_in(graph.measurements, graph.robots, graph.stances)
    refused = {id(one.measurement) for one in estimate.refused}
    sighted = sighted_in((m for m in graph.measurements if id(m) not in refused), graph.landmarks)
    return Scene(
        robots=graph.robots,
        stances=graph.stances,
        layers=(*layers, *true),
        edges=_edges(estimate, measurements),
        sightings=sightings,
        odometry=odometry,
        stayed=stayed(graph.robots, graph.stances, [(s.robot, s.after) for s in graph.stay_puts]),
        team=team,
        calibrated=estimate.calibration.of_team(team) if team is not None and estimate.calibration.rows else None,
        run=run,
        frontend=frontend or FrontendOptions(),
        wheels=wheels_of(run),
        title=run.path.name if run is not None else "",
        notes=notes,
        landmarks=landmarks_in(landmark_rows(estimate), sighted, graph.robots, graph.stances),
    )


def empty_scene(run: Run, method: Method, frontend: FrontendOptions | None = None) -> Scene:
    """The scene of a run before anything is estimated, for stances to be published to."""
    return Scene(
        robots=run.team.names,
        stances=(),
        layers=(layer_of(NAMES[method], run.team.names, (), {}),),
        team=run.team,
        run=run,
        frontend=frontend or FrontendOptions(),
        wheels=wheels_of(run),
        title=run.path.name,
    )


def scene_of_run(run: Run, progress: Progress | None = None) -> Scene:
    """The scene of a run, solved: joint, with the chain and the pose graph of the same measurements beside it.

    Raises as `pipeline.solve` does.
    """
    if kind_of(run) == "ranges":
        raise InputError(f"{run.path} is solved by its ranges: solve it, and view the folder of its result")
    options = SolveOptions().resolved()
    return scene_of_solution(solve(run, options, progress))


def scene_of_solution(solution: Solution) -> Scene:
    """The scene of a solution, with what the other methods make of the same measurements beside it."""
    estimate, others = solution.estimate, []
    for name, method in (("smooth", smooth), ("chain", chain)):
        if name != estimate.method:
            with suppress(EstimationError):  # what one method can solve and another cannot is left out
                others.append(method(estimate.graph))
    return scene_of_estimate(
        estimate, run=solution.run, measurements=solution.measurements, others=others,
        frontend=solution.options.resolved().frontend,
    )  # fmt: skip


def scene_of_result(path: str | Path, run_path: str | Path | None = None) -> Scene:
    """The scene of a result on disk, and of its run at `run_path` or where the result says that it is.

    Raises `InputError` where the folder is no result, or the run is not the one it was made of.
    """
    result = read_result(path)
    where = run_path or result.run_path
    result.require_run(where)
    run = open_run(where)
    if kind_of(run) == "ranges":
        return scene_of_drive(result, run)
    name = NAMES.get(str(result.summary.get("method")), str(result.summary.get("method")))
    robots, stances = run.team.names, run.stances
    refined = result.path / "team.toml"
    on_floor = run.team.floor is not None
    true, notes = true_layers(run, robots, stances, result.trajectories, on_floor=on_floor)
    edges = _edges_on_disk(result.path / "measurements.csv", robots, stances)
    pairs = {
        (stances[row].index, frozenset((robots[i], robots[j])))
        for row, i, j in zip(edges.rows.tolist(), edges.i.tolist(), edges.j.tolist(), strict=True)
    }
    sightings, odometry, sighted = ties_on_disk(result.path / "graph.g2o", pairs, robots, stances)
    return Scene(
        robots=robots,
        stances=stances,
        layers=(layer_of(name, robots, stances, result.trajectories), *true),
        edges=edges,
        sightings=sightings,
        odometry=odometry,
        stayed=stayed(robots, stances, _anchored(stances, result.summary.get("bumped", []))),
        team=run.team,
        calibrated=read_team(refined) if refined.exists() else None,
        run=run,
        frontend=_frontend(result.path / "config.toml"),
        wheels=wheels_of(run),
        title=result.path.absolute().name,
        notes=notes,
        landmarks=landmarks_in(read_landmarks(result.path / LANDMARKS), sighted, robots, stances),
    )


def with_other(scene: Scene, path: str | Path) -> Scene:
    """The scene with that of another result of the same run beside it; `InputError` where it is of another run."""
    if scene.run is None:
        raise InputError(f"{path} cannot be compared: there is no run that both could be of")
    other = scene_of_result(path, scene.run.path)
    layer = replace(other.layers[0], name=f"{other.title}: {other.layers[0].name}", aside=True)
    other = replace(other, layers=(layer, *other.layers[1:]))
    return replace(
        scene, layers=(*scene.layers, layer), beside=other, title=f"{scene.title} and {other.title}",
        notes=tuple(dict.fromkeys((*scene.notes, *other.notes))),
    )  # fmt: skip


def is_run(path: str | Path) -> bool:
    """Whether a path is to be opened as a run, and not as the folder of a result."""
    return not os.path.isdir(path)  # noqa: PTH112  a path that is not there is opened, and says so


def _edges(estimate: Estimate, measurements: Sequence[PairMeasurement]) -> Edges:
    graph = estimate.graph
    refused = {id(one.measurement): one.reason for one in estimate.refused}
    found = [
        (one.stance, one.robot_i, one.robot_j, estimate.residual(one), refused.get(id(one), ""))
        for one in graph.measurements
        if isinstance(one, RelativePose)
    ]
    found += [
        (h.stance, h.robot_i, h.robot_j, np.nan, h.unusable)
        for h in (one.homography for one in measurements)
        if h.unusable
    ]
    return as_edges(found, graph.robots, graph.stances, OF_GRAPH)


def as_edges(
    found: Sequence[tuple[int, str, str, float, str]], robots: Sequence[str], stances: Sequence[Stance], of_what: str
) -> Edges:
    """Edges of (stance, robot i, robot j, sigmas, why not), in the order of the stances."""
    row_of = {stance.index: row for row, stance in enumerate(stances)}
    number = {robot: n for n, robot in enumerate(robots)}
    kept = [one for one in found if one[0] in row_of and one[1] in number and one[2] in number]
    if not kept:
        return NO_EDGES
    kept.sort(key=lambda one: row_of[one[0]])
    return Edges(
        rows=np.array([row_of[one[0]] for one in kept]),
        i=np.array([number[one[1]] for one in kept]),
        j=np.array([number[one[2]] for one in kept]),
        sigmas=np.array([one[3] for one in kept], float),
        why_not=tuple(one[4] for one in kept),
        of_what=of_what,
    )


def _edges_on_disk(path: Path, robots: Sequence[str], stances: Sequence[Stance]) -> Edges:
    """The measurements of a result, with their residual in the estimate (of the homography's points in results of
    versions that did not write it)."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = csv.DictReader(file)
            column = "estimate_residual" if "estimate_residual" in (rows.fieldnames or ()) else "residual"
            found = [
                (
                    int(row["stance"]),
                    row["robot_i"],
                    row["robot_j"],
                    float(row[column] or "nan"),
                    (row["why_not"] or "for no reason that is written") if row["usable"] != "yes" else "",
                )
                for row in rows
            ]
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); solve the run again") from error
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(f"{path} is damaged ({error}); solve the run again") from error
    return as_edges(found, robots, stances, OF_POINTS if column == "residual" else OF_GRAPH)


def _anchored(stances: Sequence[Stance], bumped: Sequence[Sequence[object]]) -> list[tuple[str, int]]:
    """Who stayed put, and until which stance: all anchors but those that were found to have been bumped."""
    moved = {(str(one[0]), one[2]) for one in bumped if len(one) == 3}
    return [
        (robot, after.index)
        for before, after in itertools.pairwise(stances)
        for robot in after.anchors
        if PoseKeys.stays(robot, before, after) and (robot, after.index) not in moved
    ]


def stayed(robots: Sequence[str], stances: Sequence[Stance], held: Sequence[tuple[str, int]]) -> Index:
    """Stay-put constraints (q, 2), robot by number and row, of (robot, later stance)."""
    row_of = {stance.index: row for row, stance in enumerate(stances)}
    number = {robot: n for n, robot in enumerate(robots)}
    return np.array([(number[robot], row_of[after]) for robot, after in held], np.int64).reshape(-1, 2)


def _frontend(path: Path) -> FrontendOptions:
    """The front end that a result was made with; as it is by default where the file does not say."""
    try:
        stated = read_toml(path, "solve the run again")["options"]["frontend"]
        return FrontendOptions(**(stated | {"tracker": TrackerOptions(**stated.get("tracker", {}))}))
    except (InputError, KeyError, TypeError, AttributeError):
        return FrontendOptions()
