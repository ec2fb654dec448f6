"""Export of a result to Foxglove: with the truth and the detections of its run, where that is still there."""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import ColocError, DegenerateGeometry
from coloc_graph.exchange.foxglove_export import DrawnEdge, write_foxglove
from coloc_graph.exchange.landmarks import read_landmarks
from coloc_graph.frontend import FrontendOptions
from coloc_graph.frontend.stance_tracks import StanceTracks
from coloc_graph.results.aligned_truth import aligned_truth
from coloc_graph.results.folder import LANDMARKS, MEASUREMENTS, Result
from coloc_graph.results.measurement_table import read_measurements
from coloc_graph.run import Detections, Run, open_run

Array = NDArray[np.float64]

NO_INDEX = -1  # of a landmark, which has one pose


def export_foxglove(
    result: Result,
    out: Path,
    run_path: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[int, list[str]]:
    """Write a result as an MCAP file for Foxglove; return the number of messages, and warnings of what it lacks.

    Images are annotated with the recorded detections or, given a callback (done, total) of stances, with the tracks of
    the markers, which are followed again.
    """
    warnings, truth, detections = [], dict[str, Array](), list[Iterable[Detections]]()
    try:
        path = result.run_path if run_path is None else run_path
        result.require_run(path)
        run = open_run(path)
        if progress is not None:
            detections = [_tracked(run, result.config.options.frontend or FrontendOptions(), progress)]
        else:
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


def _tracked(run: Run, options: FrontendOptions, progress: Callable[[int, int], None]) -> Iterator[Detections]:
    """Yield the tracked marker centres of each image in a stance."""
    stances = list(run.stances)
    for number, stance in enumerate(stances, start=1):
        tracks = StanceTracks(run, stance, options.tracker)
        for robot in stance.observers:
            centres = defaultdict[float, list[tuple[str, Array, Array, float]]](list)
            try:
                found = tracks.of(robot)
            except DegenerateGeometry:
                continue
            for track in found:
                for time, *one in zip(track.times.tolist(), track.uv, track.covariance, track.peak, strict=True):
                    centres[time].append((track.marker, *one))
            for time, seen in sorted(centres.items()):
                names, uv, covariance, peak = zip(*seen, strict=True)
                none = np.zeros(len(names))
                yield Detections(
                    robot, time, np.array(uv), np.array(covariance), names, none.astype(np.uint8), np.array(peak), none
                )
        progress(number, len(stances))


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
