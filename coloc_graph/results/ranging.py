"""The result of a drive on disk: written whole or not at all, read back by `read_result`.

DIR holds summary.json, trajectories/<robot>.tum (and .cov.csv), of an incremental one also online/<robot>.tum,
landmarks.csv, measurements.csv, team.toml as it turned out, config.toml and report.html.
"""

import csv
import dataclasses
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tomli_w
from numpy.typing import NDArray

from coloc_graph._version import __version__
from coloc_graph.evaluation import Accuracy, Alignment, accuracy_json, align, evaluate
from coloc_graph.exchange.tum import write_tum
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.pipeline.incremental import SolveOptions
from coloc_graph.pipeline.ranging import DriveSolution, calibrated
from coloc_graph.results.writer import CONFIG, unused_counts, whole_result, write_summary
from coloc_graph.run import read_truth
from coloc_graph.team import without_none, write_team

Array = NDArray[np.float64]

LANDMARK_COLUMNS = ("name", "x", "y", "x_sigma", "y_sigma", "xy_correlation", "stated", "measured")
MEASUREMENT_COLUMNS = (
    *("time", "robot", "target", "range", "bearing", "share_range", "share_bearing"),
    *("residual_range", "residual_bearing", "doubted"),
)


@dataclasses.dataclass(frozen=True, eq=False)
class DriveAssessment:
    """A drive against truth: its accuracy, that of what was thought at the time (None in batch), and the true poses."""

    accuracy: Accuracy
    online: Accuracy | None
    true: Mapping[str, Array]


def assess_drive(solution: DriveSolution) -> DriveAssessment | None:
    """A solution against the truth in its run, on the map as it is, else by one alignment of the team; None without."""
    truth = read_truth(solution.run.path)
    if not truth:
        return None
    how: Alignment = "none" if solution.estimate.on_map else "team"
    reference = solution.run.team.reference

    def against(trajectories: Mapping[str, Trajectory]) -> tuple[Accuracy, dict[str, Array]]:
        true = align(trajectories, truth, reference, on_floor=True, alignment=how)
        return evaluate(trajectories, true, on_floor=True, alignment=how), true

    accuracy, true = against(solution.estimate.trajectories)
    return DriveAssessment(accuracy, against(solution.online)[0] if solution.online else None, true)


def write_drive_result(solution: DriveSolution, out: str | Path) -> DriveAssessment | None:
    """Write a solution to the folder `out`, compared with truth where the run has it.

    An earlier result there is replaced. Raises `InputError` where `out` is something else than a result.
    """
    from coloc_graph.report.drive import render_drive_report  # matplotlib is heavy

    assessed = assess_drive(solution)
    with whole_result(out) as part:
        for robot, trajectory in solution.estimate.trajectories.items():
            write_tum(trajectory, part / "trajectories" / f"{robot}.tum")
        if solution.online:
            (part / "online").mkdir()
            for robot, trajectory in solution.online.items():
                write_tum(trajectory, part / "online" / f"{robot}.tum")
        (part / "landmarks.csv").write_text(_landmarks(solution), encoding="utf-8")
        (part / "measurements.csv").write_text(_measurements(solution), encoding="utf-8")
        write_team(calibrated(solution.run.team, solution.estimate), part / "team.toml")
        config = {
            "version": __version__,
            "options": dataclasses.asdict(solution.options),
            "team": without_none(msgspec.to_builtins(solution.run.team)),
        }
        (part / CONFIG).write_text(tomli_w.dumps(config), encoding="utf-8")
        report = render_drive_report(
            solution, assessed.accuracy if assessed else None, assessed.true if assessed else None
        )
        (part / "report.html").write_text(report, encoding="utf-8")
        write_summary(summarise_drive(solution, assessed), solution.run.path, out, part)
    return assessed


def summarise_drive(solution: DriveSolution, assessed: DriveAssessment | None) -> dict[str, Any]:
    """What summary.json says; numbers that do not exist are null."""
    estimate = solution.estimate
    summary: dict[str, Any] = {
        "version": __version__,
        "method": "incremental" if solution.options.incremental else "batch",
        "world": "map" if estimate.on_map else "reference",
        "robots": list(estimate.trajectories),
        "unplaced": list(estimate.unplaced),
        "landmarks": {one.name: one.position.tolist() for one in estimate.landmarks},
        "keyframes": sum(map(len, estimate.drive.times)),
        "measurements": {
            "used": int((np.isfinite(estimate.residuals[:, 0]) & ~estimate.doubted).sum()),
            "rejected": int(estimate.doubted.sum()),
        },
        "unused": unused_counts(solution.run, SolveOptions()),
        "chi2": estimate.chi2,
        "dof": estimate.dof,
        "iterations": estimate.iterations,
        "noise": dict(zip(estimate.drive.robots, estimate.noise.tolist(), strict=True)),
        "warnings": list(solution.warnings),
        "seconds": {
            "frontend": round(solution.seconds_frontend, 3),
            "backend": round(solution.seconds_backend, 3),
            "total": round(solution.seconds_frontend + solution.seconds_backend, 3),
        },
    }
    if assessed is not None:
        summary["accuracy"] = accuracy_json(assessed.accuracy)
        if assessed.online is not None:
            summary["online_accuracy"] = accuracy_json(assessed.online)
    return summary


def _landmarks(solution: DriveSolution) -> str:
    rows = []
    for one in solution.estimate.landmarks:
        sx, sy = np.sqrt(np.diagonal(one.covariance)).tolist()
        numbers = (*one.position.tolist(), sx, sy, float(one.covariance[0, 1]) / (sx * sy))
        rows.append([one.name, *(f"{v:.9g}" for v in numbers), "yes" if one.stated else "no", one.measured])
    return _table(LANDMARK_COLUMNS, rows)


def _measurements(solution: DriveSolution) -> str:
    """One row a measurement; residuals in units of their noise, empty where it was not taken in."""
    estimate = solution.estimate
    drive, m = estimate.drive, estimate.drive.measured
    names = (*drive.robots, *drive.landmarks)
    rows = []
    for n in range(len(m)):
        residuals = ("" if np.isnan(off) else f"{off:.4g}" for off in estimate.residuals[n].tolist())
        rows.append(
            [
                f"{m.time[n]:.6f}",
                names[m.robot[n]],
                names[m.target[n]],
                *(f"{v:.9g}" for v in (m.range[n], m.bearing[n], *m.share[n])),
                *residuals,
                "yes" if estimate.doubted[n] else "no",
            ]
        )
    return _table(MEASUREMENT_COLUMNS, rows)


def _table(head: tuple[str, ...], rows: list[list[Any]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(rows)
    return text.getvalue()
