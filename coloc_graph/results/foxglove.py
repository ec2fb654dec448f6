"""Export of a result to Foxglove: with the truth and the detections of its run, where that is still there."""

import math
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import ColocError
from coloc_graph.exchange.foxglove_export import DrawnEdge, write_foxglove
from coloc_graph.exchange.landmarks import read_landmarks
from coloc_graph.results.aligned_truth import aligned_truth
from coloc_graph.results.folder import LANDMARKS, MEASUREMENTS, Result
from coloc_graph.results.measurement_table import read_measurements
from coloc_graph.run import open_run

Array = NDArray[np.float64]

NO_INDEX = -1  # of a landmark, which has one pose


def export_foxglove(result: Result, out: Path, run_path: Path | None = None) -> tuple[int, list[str]]:
    """Write a result as an MCAP file for Foxglove; return the number of messages, and warnings of what it lacks."""
    warnings, truth, detections = [], dict[str, Array](), []
    try:
        path = result.run_path if run_path is None else run_path
        result.require_run(path)
        run = open_run(path)
        detections = [run.detections(robot) for robot in run.team.names if run.has_detections(robot)]
        truth = aligned_truth(result, path)
    except ColocError as why:
        warnings.append(f"exported without truth or without detections: {why}")
    messages = write_foxglove(
        result.trajectories,
        result.team,
        out,
        truth=truth,
        edges=list(_edges(result)),
        landmarks=read_landmarks(result.path / LANDMARKS),
        detections=chain.from_iterable(detections),
    )
    return messages, warnings


def _edges(result: Result) -> Iterator[DrawnEdge]:
    """Yield the used measurements between robots that have a pose at both ends, and ranges to landmarks."""
    at: dict[tuple[str, int], tuple[float, ...]] = {}
    for robot, one in result.trajectories.items():
        # of a ranging run poses are numbered as its keyframes
        numbers = range(len(one)) if one.stances is None else one.stances.tolist()
        for number, T in zip(numbers, one.T_world_body, strict=True):
            at[robot, number] = tuple(T[:3, 3].tolist())
    for landmark in read_landmarks(result.path / LANDMARKS):
        at[landmark.name, NO_INDEX] = (landmark.x, landmark.y, 0.0)
    for row in read_measurements(result.path / MEASUREMENTS, ("homography", "sighting", "odometry", "range")):
        if row["used"] == "yes" and row["index_i"] and (row["index_j"] or row["kind"] == "range"):
            ends = [at.get((row[f"robot_{end}"], int(row[f"index_{end}"] or NO_INDEX))) for end in "ij"]
            if ends[0] is not None and ends[1] is not None:
                yield DrawnEdge(ends[0], ends[1], float(row["residual"]) if row["residual"] else math.nan)
