"""Writing of a result, with its accuracy where the run holds truth: `write_result`.

The same run, options and version give the same bytes, except for `seconds` in summary.json.
"""

import dataclasses
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.estimate import Rejection
from coloc_graph.errors import ColocError
from coloc_graph.evaluation import Accuracy, accuracy_json, align, evaluate, usual_alignment
from coloc_graph.exchange.dot import to_dot
from coloc_graph.exchange.g2o_writer import write_g2o
from coloc_graph.exchange.gtsam_files import gtsam_files, write_gtsam
from coloc_graph.exchange.jrl import write_jrl
from coloc_graph.exchange.landmarks import landmark_rows, landmarks_csv, map_row
from coloc_graph.exchange.ranging_factors import ranging_gtsam_files
from coloc_graph.exchange.ranging_graph import ranging_graph
from coloc_graph.exchange.stance_graph import ranges_in, stance_graph
from coloc_graph.exchange.tum import write_tum
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.pipeline.solution import Solution
from coloc_graph.results.config import write_config
from coloc_graph.results.folder import (
    CALIBRATED_TEAM,
    GTSAM_FACTORS,
    LANDMARKS,
    MEASUREMENTS,
    RANGING_GRAPH,
    atomic_result,
    write_summary,
)
from coloc_graph.results.measurement_table import measurement_table
from coloc_graph.run import read_truth
from coloc_graph.team import write_team

Poses = Mapping[str, NDArray[np.float64]]


def assess(solution: Solution, truth_path: str | Path | None = None) -> tuple[Accuracy, Poses] | None:
    """Compare a solution with truth.

    Parameters
    ----------
    solution : Solution
        The estimate: on its map as it is, or aligned as `usual_alignment` says.
    truth_path : str or Path, optional
        A run with truth; by default the run that was solved.

    Returns
    -------
    (Accuracy, mapping of str to (n, 4, 4) float) or None
        The accuracy, and the true poses in the estimate's world, NaN where there is none; None without truth that
        can be compared with, of which `with_truth_warning` has the reason.
    """
    with suppress(ColocError):
        return _assess(solution, solution.estimate.trajectories, truth_path)
    return None


def with_truth_warning(solution: Solution) -> Solution:
    """Return a solution with a warning where its run holds truth that cannot be compared with."""
    try:
        _assess(solution, solution.estimate.trajectories, None)
    except ColocError as why:
        return dataclasses.replace(solution, warnings=(*solution.warnings, f"not compared with truth: {why}"))
    return solution


def assess_online(solution: Solution, truth_path: str | Path | None = None) -> Accuracy | None:
    """Compare each pose as it was estimated at its time with truth; None where there is none of either."""
    with suppress(ColocError):
        assessed = _assess(solution, solution.online, truth_path) if solution.online else None
        return None if assessed is None else assessed[0]
    return None


def _assess(
    solution: Solution, trajectories: Mapping[str, Trajectory], truth_path: str | Path | None
) -> tuple[Accuracy, Poses] | None:
    truth = read_truth(solution.run.path if truth_path is None else truth_path, trajectories)
    if not truth:
        return None
    team = solution.run.team
    on_floor, how = team.floor is not None, usual_alignment(trajectories, truth, team.reference)
    if solution.estimate.is_ranging:
        on_floor, how = True, "none" if solution.estimate.ranging.on_map else "team"
    true = align(trajectories, truth, team.reference, on_floor=on_floor, alignment=how)
    return evaluate(trajectories, true, on_floor=on_floor, alignment=how, reference=team.reference), true


def write_result(solution: Solution, out: str | Path) -> Accuracy | None:
    """Write a solution to a folder, compared with truth where the run has it.

    Parameters
    ----------
    solution : Solution
        Solution by `solve`.
    out : str or Path
        The folder; an earlier result there is replaced.

    Returns
    -------
    Accuracy or None
        The accuracy; None without truth.

    Raises
    ------
    InputError
        `out` is something else than a result.
    """
    from coloc_graph.report import render_report  # matplotlib is heavy, and reading results does not need it

    estimate = solution.estimate
    assessed = assess(solution)
    accuracy, true = assessed if assessed is not None else (None, None)
    if assessed is None:
        solution = with_truth_warning(solution)
    with atomic_result(out) as part:
        for robot, trajectory in estimate.trajectories.items():
            write_tum(trajectory, part / "trajectories" / f"{robot}.tum")
        if solution.online:
            (part / "online").mkdir()
            for robot, trajectory in solution.online.items():
                write_tum(trajectory, part / "online" / f"{robot}.tum")
        if estimate.is_ranging:
            write_jrl(ranging_graph(estimate, solution.run.team), part / RANGING_GRAPH)
            write_gtsam(ranging_gtsam_files(estimate, solution.run.team), part / GTSAM_FACTORS)
        else:
            write_g2o(estimate, part / "graph.g2o")
            if ranges_in(estimate):
                write_jrl(stance_graph(estimate, solution.run.team), part / RANGING_GRAPH)
            write_gtsam(gtsam_files(estimate), part / GTSAM_FACTORS)
            (part / "graph.dot").write_text(to_dot(estimate.graph), encoding="utf-8")
        (part / MEASUREMENTS).write_text(measurement_table(solution), encoding="utf-8")
        if estimate.landmarks:
            rows = landmarks_csv(landmark_rows(estimate))
            (part / LANDMARKS).write_text(rows, encoding="utf-8")
        if (calibrated := solution.calibrated_team) is not None:
            write_team(calibrated, part / CALIBRATED_TEAM)
        write_config(solution.options, solution.run.team, part)
        (part / "report.html").write_text(render_report(solution, accuracy, true), encoding="utf-8")
        write_summary(summarise(solution, accuracy), solution.run.path, out, part)
    return accuracy


def _rejection(one: Rejection) -> dict[str, Any]:
    return {"measurement": str(one.measurement), "reason": one.reason, "sigmas": one.sigmas}


def summarise(solution: Solution, accuracy: Accuracy | None) -> dict[str, Any]:
    """Return the content of summary.json; numbers that do not exist are null."""
    estimate, count = solution.estimate, solution.count
    disconnected: dict[str, int] = {}
    for robot, _ in estimate.disconnected:
        disconnected[robot] = disconnected.get(robot, 0) + 1
    unused: dict[str, int] = {}
    for one in solution.unused:
        unused[one.kind] = unused.get(one.kind, 0) + one.count
    summary: dict[str, Any] = {
        "method": estimate.method,
        "incremental": solution.options.incremental,
        "world": "map" if estimate.is_ranging and estimate.ranging.on_map else "reference",
        "robots": list(estimate.trajectories),
        "stances": len(solution.run.stances),
        "poses": sum(map(len, estimate.trajectories.values())),
        "measurements": {
            "used": count.used,
            "rejected": sum(one.rejected for one in solution.counts.values()),
            "kinds": {kind: dataclasses.asdict(one) for kind, one in solution.counts.items()},
        },
        "unused": unused,
        "chi2": estimate.chi2,
        "dof": estimate.dof,
        "iterations": estimate.iterations,
        "disconnected": disconnected,
        "rejected": [] if estimate.is_ranging else [_rejection(one) for one in estimate.rejected],
        "without_pose": dict(solution.without_pose),
        "bumped": [[one.stay_put.robot, one.stay_put.before, one.stay_put.after] for one in estimate.bumped],
        "calibration": [dataclasses.asdict(row) for row in estimate.calibration.rows],
        "landmarks": [row.as_json() for row in landmark_rows(estimate)],
        "map": None if (row := map_row(estimate)) is None else row.as_json(),
        "warnings": list(solution.warnings),
        "seconds": {
            "frontend": round(solution.seconds_frontend, 3),
            "backend": round(solution.seconds_backend, 3),
            **({"updates": [round(one, 6) for one in solution.seconds_updates]} if solution.seconds_updates else {}),
            "total": round(solution.seconds_frontend + solution.seconds_backend, 3),
        },
    }
    if solution.noise is not None:
        summary["centre_noise"] = [dataclasses.asdict(row) for row in solution.noise.rows(solution.run.team)]
    if estimate.is_ranging:
        noise = estimate.ranging.noise.tolist()
        summary["noise"] = dict(zip(estimate.ranging.keyframes.robots, noise, strict=True))
    if accuracy is not None:
        summary["accuracy"] = accuracy_json(accuracy)
    if (online := assess_online(solution)) is not None:
        summary["online_accuracy"] = accuracy_json(online)
    return summary
