"""A result on disk: written whole or not at all, and read back.

DIR holds summary.json, trajectories/<robot>.tum (and .cov.csv), graph.g2o, graph.dot, measurements.csv, config.toml,
report.html; where landmarks were sighted, landmarks.csv; and, of a joint estimate, team.toml: the team with its mounts
and markers as they turned out. The same run, options and version give the same bytes, except for `seconds` in
summary.json.
"""

import csv
import dataclasses
import io
import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tomli_w
from numpy.typing import NDArray

from coloc_graph._version import __version__
from coloc_graph.errors import InputError
from coloc_graph.evaluation import Accuracy, accuracy_json, align, evaluate, usual_alignment
from coloc_graph.exchange.dot import to_dot
from coloc_graph.exchange.g2o_writer import write_g2o
from coloc_graph.exchange.landmarks import landmark_rows, landmarks_csv, map_row
from coloc_graph.exchange.tum import read_tum, write_tum
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.input_file import convert, read_json, read_toml
from coloc_graph.pipeline.batch import Solution, SolveOptions
from coloc_graph.pipeline.contents import unused_in
from coloc_graph.run import Run, read_truth, run_id
from coloc_graph.run.output_lock import locked_output
from coloc_graph.team import Team, read_team, without_none, write_team
from coloc_graph.team.landmark import require_name

SUMMARY = "summary.json"
CONFIG = "config.toml"
LANDMARKS = "landmarks.csv"
MEASUREMENT_COLUMNS = (
    *(
        "stance",
        "robot_i",
        "robot_j",
        "points",
        "inliers",
        "residual",
        "time_offset",
        "time_offset_sigma",
        "overlap_px",
    ),
    *("normal_error_deg", "solution", "distance", "estimate_residual", "usable", "why_not"),
)


def assess(
    solution: Solution, truth_path: str | Path | None = None
) -> tuple[Accuracy, dict[str, NDArray[np.float64]]] | None:
    """A solution against its run's truth, or that of another, with the true poses in its world (NaN where there are
    none); None without truth."""
    truth = read_truth(solution.run.path if truth_path is None else truth_path)
    if not truth:
        return None
    on_floor = solution.run.team.floor is not None
    trajectories = solution.estimate.trajectories
    how = usual_alignment(trajectories)
    true = align(trajectories, truth, solution.run.team.reference, on_floor=on_floor, alignment=how)
    return evaluate(trajectories, true, on_floor=on_floor, alignment=how), true


def holds_result(out: str | Path) -> bool:
    """Whether there is a result in a folder."""
    return (Path(out) / SUMMARY).is_file()


def require_place(out: str | Path) -> None:
    """Raise `InputError` where a result cannot go to `out`: it is something else, or its folder cannot be one."""
    out = Path(out)
    if out.exists() and not holds_result(out) and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} exists and is not a result; give another folder, or remove it")
    above = next(folder for folder in out.absolute().parents if folder.exists())
    if not above.is_dir():
        raise InputError(f"{out} cannot be made, since {above} is not a folder; give another folder")
    if not os.access(above, os.W_OK):
        raise InputError(f"{out} cannot be written, since {above} is not yours to write to; give another folder")


def write_result(solution: Solution, out: str | Path) -> Accuracy | None:
    """Write a solution to the folder `out`, compared with truth where the run has it.

    An earlier result there is replaced. Raises `InputError` where `out` is something else than a result.
    """
    from coloc_graph.report import render_report  # matplotlib is heavy, and of no use to who only reads results

    assessed = assess(solution)
    accuracy, true = assessed if assessed is not None else (None, None)
    with whole_result(out) as part:
        for robot, trajectory in solution.estimate.trajectories.items():
            write_tum(trajectory, part / "trajectories" / f"{robot}.tum")
        write_g2o(solution.estimate, part / "graph.g2o")
        (part / "graph.dot").write_text(to_dot(solution.estimate.graph), encoding="utf-8")
        (part / "measurements.csv").write_text(_measurements(solution), encoding="utf-8")
        if solution.estimate.landmarks:
            rows = landmarks_csv(landmark_rows(solution.estimate))
            (part / LANDMARKS).write_text(rows, encoding="utf-8")
        if solution.estimate.calibration.rows:
            write_team(solution.estimate.calibration.of_team(solution.run.team), part / "team.toml")
        (part / CONFIG).write_text(tomli_w.dumps(_config(solution)), encoding="utf-8")
        (part / "report.html").write_text(render_report(solution, accuracy, true), encoding="utf-8")
        write_summary(summarise(solution, accuracy), solution.run.path, out, part)
    return accuracy


@contextmanager
def whole_result(out: str | Path) -> Iterator[Path]:
    """A folder to write a result to, with trajectories/ in it, which is at `out` once it is whole.

    An earlier result there is replaced then, and stays as it was after an exception.
    """
    require_place(out)
    place = Path(out).resolve()  # "." has no name, and a link's target is what is replaced
    with locked_output(place):
        # a folder of our own beside it, whose name nobody else has
        work = Path(tempfile.mkdtemp(prefix=f".{place.name}-", dir=place.parent))
        part, old = work / "new", work / "old"
        (part / "trajectories").mkdir(parents=True)
        try:
            yield part
            if place.exists():
                place.rename(old)
            part.rename(place)
        except BaseException:
            if old.exists() and not place.exists():
                old.rename(place)
            raise
        finally:
            shutil.rmtree(work, ignore_errors=True)


def write_summary(summary: dict[str, Any], run: Path, out: str | Path, part: Path) -> None:
    """Write summary.json into `part` of the result `out`, with which run it is of."""
    named = summary | {"run": os.path.relpath(run.absolute(), Path(out).absolute()), "run_id": run_id(run)}
    (part / SUMMARY).write_text(json.dumps(named, indent=2) + "\n", encoding="utf-8")


def summarise(solution: Solution, accuracy: Accuracy | None) -> dict[str, Any]:
    """What summary.json says; numbers that do not exist are null."""
    estimate = solution.estimate
    summary: dict[str, Any] = {
        "version": __version__,
        "method": estimate.method,
        "robots": list(estimate.trajectories),
        "stances": len(solution.run.stances),
        "measurements": {"used": solution.used, "rejected": len(solution.measurements) - solution.used},
        "unused": unused_counts(solution.run, solution.options),
        "chi2": estimate.chi2,
        "dof": estimate.dof,
        "iterations": estimate.iterations,
        "untied": [list(one) for one in estimate.untied],
        "bumped": [[one.stay_put.robot, one.stay_put.before, one.stay_put.after] for one in estimate.bumped],
        "calibration": [dataclasses.asdict(row) for row in estimate.calibration.rows],
        "landmarks": [dataclasses.asdict(row) for row in landmark_rows(estimate)],
        "map": None if (row := map_row(estimate)) is None else dataclasses.asdict(row),
        "warnings": list(solution.warnings),
        "seconds": {
            "frontend": round(solution.seconds_frontend, 3),
            "backend": round(solution.seconds_backend, 3),
            **({"updates": [round(one, 6) for one in solution.seconds_updates]} if solution.seconds_updates else {}),
            "total": round(solution.seconds_frontend + solution.seconds_backend, 3),
        },
    }
    if accuracy is not None:
        summary["accuracy"] = accuracy_json(accuracy)
    return summary


def unused_counts(run: Run, options: SolveOptions) -> dict[str, int]:
    """Numbers of recorded data by kind that the estimate does not use."""
    counts: dict[str, int] = {}
    for one in unused_in(run, options):
        counts[one.kind] = counts.get(one.kind, 0) + one.count
    return counts


def _measurements(solution: Solution) -> str:
    """One row a homography. Angles in degrees, the relative pose is that of body j in body i; `residual` is that of the
    points, `estimate_residual` that of the measurement in the estimate, each RMS in units of its noise."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(MEASUREMENT_COLUMNS)
    for measured in solution.measurements:
        h, pose, why_not = measured.homography, measured.relative_pose, solution.why_not(measured)
        rows.writerow(
            [
                h.stance,
                h.robot_i,
                h.robot_j,
                h.points,
                h.inliers,
                _cell(h.residual),
                _cell(h.time_offset),
                _cell(h.time_offset_sigma),
                _cell(h.overlap_px),
                _cell(math.degrees(pose.normal_error)) if pose and pose.normal_error is not None else "",
                pose.solution if pose else "",
                _cell(float(np.linalg.norm(pose.T_i_j[:3, 3]))) if pose else "",
                _cell(solution.estimate.residual(pose)) if pose else "",
                "no" if why_not else "yes",
                why_not or "",
            ]
        )
    return text.getvalue()


def _cell(value: float) -> str:
    return f"{value:.9g}" if math.isfinite(value) else ""


def _config(solution: Solution) -> dict[str, Any]:
    return {
        "version": __version__,
        "options": options_of(solution.options),
        "team": without_none(msgspec.to_builtins(solution.run.team)),
    }


def options_of(options: SolveOptions) -> dict[str, Any]:
    """Options as they are in config.toml."""
    return dataclasses.asdict(options)


@dataclass(frozen=True, eq=False)
class Result:
    """A result read back: the summary, the trajectories, and where the run it was made of should be.

    `run_id` is that run's id (None in results of versions that did not write it).
    """

    path: Path
    summary: dict[str, Any]
    trajectories: Mapping[str, Trajectory]
    run_path: Path
    run_id: str | None = None

    def require_run(self, path: str | Path) -> None:
        """Raise `InputError` where the file at `path` is not the run that this result was made of."""
        if not Path(path).exists():
            raise InputError(f"{self.path}: the run that it was made of is no longer at {path}; give --run RUN")
        if self.run_id is not None and run_id(path) != self.run_id:
            raise InputError(
                f"{path} is not the run that {self.path} was made of; give that one with --run, or solve this one"
            )


def read_result(path: str | Path) -> Result:
    """The result in a folder; `InputError` where it is none."""
    path = Path(path)
    if not (path / SUMMARY).exists():
        raise InputError(f"{path} is not a result: it has no {SUMMARY}; give the folder that `coloc solve --out` wrote")
    summary = read_summary(path)
    if summary.get("kind") == "pose graph":
        raise InputError(f"{path} is a solved pose graph, without robots and times; take its graph.g2o")
    said = convert(path / SUMMARY, summary, _Said, "solve the run again")
    trajectories = {robot: read_tum(path / "trajectories" / f"{robot}.tum") for robot in said.robots}
    return Result(path, summary, trajectories, Path(os.path.normpath(path / said.run)), said.run_id)


class _Said(msgspec.Struct):
    """Fields of summary.json by which a result is read."""

    robots: tuple[str, ...]
    run: str
    run_id: str | None = None
    method: str = ""
    world: str = ""
    bumped: tuple[tuple[str, int, int], ...] = ()

    def __post_init__(self) -> None:
        for robot in self.robots:
            require_name(robot)
        if "\0" in self.run:
            raise ValueError("`run` is no path")


def read_summary(path: Path) -> dict[str, Any]:
    """Fields of the summary of the result in a folder.

    Raises
    ------
    InputError
        If there is none, or it is damaged.
    """
    summary = read_json(path / SUMMARY, "solve the run again")
    if not isinstance(summary, dict):
        raise InputError(f"{path / SUMMARY} is damaged (it holds no fields); solve the run again")
    return summary


def team_of(result: Result) -> Team:
    """The team of a result: as a joint estimate found it, otherwise as it was stated.

    Raises `TeamError` or `InputError` where the result is damaged.
    """
    found = result.path / "team.toml"
    if found.exists():
        return read_team(found)
    return stated_team_of(result.path)


def stated_team_of(path: Path) -> Team:
    """The team in the config.toml of the result in a folder.

    Raises
    ------
    InputError
        If it is missing or damaged.
    """
    config = path / CONFIG
    fields = read_toml(config, "solve the run again")
    return convert(config, fields.get("team"), Team, "solve the run again")
