"""Scenes of what there is: an estimate, a result on disk, a run that is solved for it, two results of one run."""

import itertools
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from coloc_graph.backend import Estimate, Method, chain, smooth
from coloc_graph.backend.graph import PoseKeys
from coloc_graph.errors import EstimationError, InputError
from coloc_graph.evaluation import Alignment
from coloc_graph.exchange.landmarks import LandmarkRow, landmark_rows, read_landmarks
from coloc_graph.frontend import FrontendOptions, PairMeasurement
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.measurements import Node, RelativePose
from coloc_graph.pipeline.batch import Progress, Solution, solve
from coloc_graph.results.folder import LANDMARKS, MEASUREMENTS, read_result
from coloc_graph.results.measurement_table import read_measurements
from coloc_graph.run import Run, Stance, open_run
from coloc_graph.viewer.landmarks import landmarks_in, sighted_in
from coloc_graph.viewer.links import links_in, links_of, wheels_of
from coloc_graph.viewer.moments import first_poses, moment_at, moments_of
from coloc_graph.viewer.plans import LOG, read_plans
from coloc_graph.viewer.scene import NO_EDGES, Edges, Index, Scene, layer_of
from coloc_graph.viewer.truth import true_layers

#: Names of the methods' layers.
NAMES = {"chain": "chained", "smooth": "smoothed", "joint": "joint", "ranging": "ranging"}
OF_GRAPH = "of the measurement in the estimate"


def scene_of_estimate(
    estimate: Estimate,
    *,
    run: Run | None = None,
    measurements: Sequence[PairMeasurement] = (),
    others: Sequence[Estimate] = (),
    frontend: FrontendOptions | None = None,
) -> Scene:
    """Make the scene of an estimate, with the run's truth if it has any.

    Parameters
    ----------
    estimate : Estimate
        Of a run with stances.
    run : Run, optional
        The run, for images, tracks and truth.
    measurements : sequence of PairMeasurement
        Measurements of all pairs, so that unusable ones are shown too.
    others : sequence of Estimate
        Further estimates of the same graph.
    frontend : FrontendOptions, optional
        Options by which pairs are measured again.

    Raises
    ------
    InputError
        A pose is not finite.
    """
    graph = estimate.graph
    every = (estimate, *others)
    layers = [layer_of(NAMES[one.method], graph.robots, graph.stances, one.trajectories) for one in every]
    team = run.team if run is not None else None
    on_floor = run is not None and run.team.floor is not None
    true, notes = true_layers(run, graph.robots, graph.stances, estimate.trajectories, on_floor=on_floor)
    sightings, odometry = links_in(graph.measurements, graph.robots, graph.stances)
    rejected = {id(one.measurement) for one in estimate.rejected}
    sighted = sighted_in((m for m in graph.measurements if id(m) not in rejected), graph.landmarks)
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
    """Make the scene of a run without an estimate, for stances to be published to."""
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
    """Return the scene of a run, solved with default options; of stances with chain and pose graph beside it.

    Raises as `solve` does.
    """
    return scene_of_solution(solve(run, progress=progress))


def scene_of_solution(solution: Solution) -> Scene:
    """Return the scene of a solution; of stances with the estimates of other methods beside it."""
    estimate, run, others = solution.estimate, solution.run, []
    if estimate.is_ranging:
        problem = estimate.ranging
        measured = [
            (one.time, one.robot, one.target)
            for one, used in zip(problem.measurements, problem.used.tolist(), strict=True)
            if used
        ]
        rows = landmark_rows(estimate)
        return _scene_of_ranges(run, run.path.name, estimate.trajectories, problem.on_map, measured, rows)
    for name, method in (("smooth", smooth), ("chain", chain)):
        if name != estimate.method:
            with suppress(EstimationError):  # a method that cannot solve the graph has no layer
                others.append(method(estimate.graph))
    return scene_of_estimate(
        estimate, run=run, measurements=solution.measurements, others=others, frontend=solution.options.frontend
    )


def scene_of_result(path: str | Path, run_path: str | Path | None = None) -> Scene:
    """Return the scene of a result on disk, and of its run at `run_path` or where the result says that it is.

    Raises `InputError` where the folder is no result of this format, or the run is not the one it was made of.
    """
    result = read_result(path)
    where = run_path or result.run_path
    result.require_run(where)
    run, title, table = open_run(where), result.path.absolute().name, result.path / MEASUREMENTS
    landmarks = read_landmarks(result.path / LANDMARKS)
    if result.is_ranging:
        with _damage_named(table):
            measured = [
                (float(row["time"]), row["robot_i"], row["robot_j"])
                for row in read_measurements(table, ["range"])
                if row["used"] == "yes"
            ]
        return _scene_of_ranges(run, title, result.trajectories, result.on_map, measured, landmarks)
    robots, stances = run.team.names, run.stances
    name = NAMES.get(str(result.summary.get("method")), str(result.summary.get("method")))
    true, notes = true_layers(run, robots, stances, result.trajectories, on_floor=run.team.floor is not None)
    names = {row.name for row in landmarks}
    with _damage_named(table):
        edges = _edges_on_disk(table, robots, stances)
        ends = {kind: _ends_on_disk(table, kind) for kind in ("sighting", "range", "odometry")}
    seen = [*ends["sighting"], *ends["range"]]
    sighted = [(a[0], a[1], b[0]) for a, b in seen if b[0] in names]
    return Scene(
        robots=robots,
        stances=stances,
        layers=(layer_of(name, robots, stances, result.trajectories), *true),
        edges=edges,
        sightings=links_of(seen, robots, stances),
        odometry=links_of(ends["odometry"], robots, stances),
        stayed=stayed(robots, stances, _anchored(stances, result.summary.get("bumped", []))),
        team=run.team,
        calibrated=result.calibrated_team,
        run=run,
        frontend=result.config.options.frontend or FrontendOptions(),
        wheels=wheels_of(run),
        title=title,
        notes=notes,
        landmarks=landmarks_in(landmarks, sighted, robots, stances),
        plans=read_plans(result.path.absolute().parent / LOG),
    )


def _scene_of_ranges(
    run: Run,
    title: str,
    trajectories: Mapping[str, Trajectory],
    on_map: bool,
    measured: Sequence[tuple[float, str, str]],
    landmarks: Sequence[LandmarkRow],
) -> Scene:
    """Make the scene of a ranging run: the first keyframe of each robot in each moment.

    `measured` are (time [UTC s], observer, target).
    """
    robots, moments = run.team.names, moments_of(trajectories)
    first = {robot: first_poses(one, moments) for robot, one in trajectories.items()}
    alignment: Alignment = "none" if on_map else "team"
    true, notes = true_layers(run, robots, moments, first, on_floor=True, alignment=alignment)
    at = moment_at(np.array([time for time, _, _ in measured]), moments).tolist()
    seen = sorted({(k, a, b) for k, (_, a, b) in zip(at, measured, strict=True) if k >= 0})
    # a point has no heading; it is drawn with none
    rows = [row if np.isfinite(row.yaw_deg) else replace(row, yaw_deg=0.0, yaw_sigma_deg=0.0) for row in landmarks]
    names = {row.name for row in rows}
    return Scene(
        robots=robots,
        stances=moments,
        layers=(layer_of(NAMES["ranging"], robots, moments, first), *true),
        sightings=links_of([((a, k), (b, k)) for k, a, b in seen if b in robots], robots, moments),
        team=run.team,
        run=run,
        wheels=wheels_of(run),
        title=title,
        notes=notes,
        landmarks=landmarks_in(rows, [(a, k, b) for k, a, b in seen if b in names], robots, moments),
    )


def with_other(scene: Scene, path: str | Path) -> Scene:
    """Add another result of the same run to a scene; `InputError` where it is of another run."""
    if scene.run is None:
        raise InputError(f"{path} cannot be compared: the scene has no run")
    other = scene_of_result(path, scene.run.path)
    layer = replace(other.layers[0], name=f"{other.title}: {other.layers[0].name}", aside=True)
    other = replace(other, layers=(layer, *other.layers[1:]))
    return replace(
        scene, layers=(*scene.layers, layer), beside=other, title=f"{scene.title} and {other.title}",
        notes=tuple(dict.fromkeys((*scene.notes, *other.notes))),
    )  # fmt: skip


def is_run(path: str | Path) -> bool:
    """Return whether to open a path as a run, not as the folder of a result; true of a path that does not exist."""
    return not os.path.isdir(path)  # noqa: PTH112  opening a missing path raises the error


def _edges(estimate: Estimate, measurements: Sequence[PairMeasurement]) -> Edges:
    graph = estimate.graph
    rejected = {id(one.measurement): one.reason for one in estimate.rejected}
    found = [
        (one.stance, one.robot_i, one.robot_j, estimate.residual(one), rejected.get(id(one), ""))
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
    """Make edges of (stance, robot i, robot j, sigmas, reason for rejection), in the order of the stances."""
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
        reason=tuple(one[4] for one in kept),
        of_what=of_what,
    )


def _edges_on_disk(path: Path, robots: Sequence[str], stances: Sequence[Stance]) -> Edges:
    """Read the homographies of a result, with their residuals in the estimate."""
    found = [
        (int(row["index_i"]), row["robot_i"], row["robot_j"], float(row["residual"] or "nan"), row["reason"])
        for row in read_measurements(path, ["homography"])
    ]
    return as_edges(found, robots, stances, OF_GRAPH)


def _ends_on_disk(path: Path, kind: str) -> list[tuple[Node, Node]]:
    """Read the nodes that used measurements of a kind connect; a landmark has the stance in which it was seen."""
    return [
        ((row["robot_i"], int(row["index_i"])), (row["robot_j"], int(row["index_j"] or row["index_i"])))
        for row in read_measurements(path, [kind])
        if row["used"] == "yes"
    ]


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    """Name the file whose rows are damaged."""
    try:
        yield
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(f"{path} is damaged ({error}); solve the run again") from error


def _anchored(stances: Sequence[Stance], bumped: Sequence[Sequence[object]]) -> list[tuple[str, int]]:
    """Return (robot, later stance) of all stay-put constraints, without those of bumped anchors."""
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
