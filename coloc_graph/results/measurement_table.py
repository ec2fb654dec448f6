"""The table measurements.csv: one row per measurement, of every kind."""

import csv
import io
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from coloc_graph.errors import InputError
from coloc_graph.input_file import read_text
from coloc_graph.measurements import Odometry, Range
from coloc_graph.pipeline.solution import Solution

#: `index_i` and `index_j` are stances, or, of a ranging run, keyframes (empty for a landmark). `residual` is the RMS
#: residual in the estimate in units of the measurement's noise; `points_residual` that of a homography's points.
#: Angles are in degrees, except `bearing` [rad]; lengths in metres; times in seconds.
MEASUREMENT_COLUMNS = (
    *("kind", "used", "reason", "time", "robot_i", "index_i", "robot_j", "index_j", "residual"),
    *("points", "inliers", "points_residual", "time_offset", "time_offset_sigma", "overlap_px"),
    *("normal_error_deg", "solution", "distance"),
    *("range", "bearing", "share_range", "share_bearing", "residual_range", "residual_bearing"),
)


def measurement_table(solution: Solution) -> str:
    """Return the text of measurements.csv."""
    text = io.StringIO()
    rows = csv.DictWriter(text, MEASUREMENT_COLUMNS, restval="", lineterminator="\n")
    rows.writeheader()
    rows.writerows(_ranges(solution) if solution.estimate.is_ranging else (*_homographies(solution), *_links(solution)))
    return text.getvalue()


def read_measurements(path: Path, kinds: Iterable[str]) -> list[Mapping[str, str]]:
    """Return the rows of some kinds; `InputError` where the file is missing or damaged."""
    kinds = frozenset(kinds)
    rows = csv.DictReader(io.StringIO(read_text(path, "solve the run again"), newline=""))
    try:
        if tuple(rows.fieldnames or ()) != MEASUREMENT_COLUMNS:
            raise ValueError("its columns are not those of this version")
        found: list[Mapping[str, str]] = []
        for row in rows:
            if row["used"] not in ("yes", "no") or None in row.values():
                raise ValueError(f"line {rows.line_num} is incomplete")
            if row["kind"] in kinds:
                found.append(row)
        return found
    except (ValueError, csv.Error) as error:
        raise InputError(f"{path} is damaged ({error}): solve the run again") from error


def _row(kind: str, reason: str | None, **cells: Any) -> dict[str, Any]:
    cells = {name: _cell(value) if isinstance(value, float) else value for name, value in cells.items()}
    return {"kind": kind, "used": "no" if reason else "yes", "reason": reason or "", **cells}


def _cell(value: float) -> str:
    return f"{value:.9g}" if math.isfinite(value) else ""


def _homographies(solution: Solution) -> Iterator[dict[str, Any]]:
    """Rows of pairs of observers; the relative pose is that of body j in body i."""
    times = {stance.index: stance.start for stance in solution.run.stances}
    for measured in solution.measurements:
        h, pose = measured.homography, measured.relative_pose
        of_pose = {}
        if pose is not None:
            of_pose = {
                "residual": solution.estimate.residual(pose),
                "normal_error_deg": "" if pose.normal_error is None else math.degrees(pose.normal_error),
                "solution": pose.solution,
                "distance": float(np.linalg.norm(pose.T_i_j[:3, 3])),
            }
        yield _row(
            "homography",
            solution.reason(measured),
            time=f"{times[h.stance]:.6f}",
            robot_i=h.robot_i,
            index_i=h.stance,
            robot_j=h.robot_j,
            index_j=h.stance,
            points=h.points,
            inliers=h.inliers,
            points_residual=h.residual,
            time_offset=h.time_offset,
            time_offset_sigma=h.time_offset_sigma,
            overlap_px=h.overlap_px,
            **of_pose,
        )


def _links(solution: Solution) -> Iterator[dict[str, Any]]:
    """Rows of sightings, odometry and ranges, which are means of `points` samples."""
    times = {stance.index: stance.start for stance in solution.run.stances}
    for kind, one, reason in solution.links:
        (robot_i, index_i), (robot_j, index_j) = one.ends
        if isinstance(one, Range):
            cells: dict[str, float] = {"range": float(one.range.mean()), "points": one.samples}
            cells |= {} if one.bearing is None else {"bearing": one.bearing}
        else:
            cells = {"distance": float(np.linalg.norm(one.T_i_j[:3, 3]))}
        yield _row(
            kind,
            reason,
            time=f"{times[one.after] if isinstance(one, Odometry) else one.time:.6f}",
            robot_i=robot_i,
            index_i=index_i,
            robot_j=robot_j,
            index_j=index_j if index_j >= 0 else "",
            residual=solution.estimate.residual(one),
            **cells,
        )


def _ranges(solution: Solution) -> Iterator[dict[str, Any]]:
    """Rows of ranges and bearings."""
    problem = solution.estimate.ranging
    shares, residuals = problem.keyframes.measured.share.tolist(), problem.residuals.tolist()
    for one, (share_range, share_bearing), (of_range, of_bearing) in zip(
        problem.measurements, shares, residuals, strict=True
    ):
        bearing = {"bearing": one.bearing, "share_bearing": share_bearing, "residual_bearing": of_bearing}
        yield _row(
            "range",
            problem.reason(one.row),
            time=f"{one.time:.6f}",
            robot_i=one.robot,
            index_i=one.keyframe,
            robot_j=one.target,
            index_j=one.target_keyframe if one.target_keyframe >= 0 else "",
            residual=problem.residual(one),
            range=one.range,
            share_range=share_range,
            residual_range=of_range,
            **({} if math.isnan(one.bearing) else bearing),
        )
