"""Recordings of a team: `RunWriter` writes a run, `open_run` reads it lazily, as the records of `messages`.

A run is one MCAP file that Foxglove opens; docs/run-format.md is its specification. `read_truth` and
`read_true_team` are for evaluation alone.
"""

from coloc_graph.run.index import is_mcap
from coloc_graph.run.messages import (
    Clocks,
    Detections,
    EncodedImage,
    Flag,
    Image,
    Motion,
    OdometrySample,
    Planes,
    Ranges,
    RobotClock,
    Stance,
)
from coloc_graph.run.reader import Run, open_run, read_true_team, read_truth, run_id, truth_counts
from coloc_graph.run.recorded import Recorded
from coloc_graph.run.writer import RunWriter, atomic_run

__all__ = [
    "Clocks",
    "Detections",
    "EncodedImage",
    "Flag",
    "Image",
    "Motion",
    "OdometrySample",
    "Planes",
    "Ranges",
    "Recorded",
    "RobotClock",
    "Run",
    "RunWriter",
    "Stance",
    "atomic_run",
    "is_mcap",
    "open_run",
    "read_true_team",
    "read_truth",
    "run_id",
    "truth_counts",
]
