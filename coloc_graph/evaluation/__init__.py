"""Evaluation of an estimate with truth: alignment of a whole team, ATE, RPE, lengths as in Table II, and NEES.

`align` transforms the truth into the estimate's world, at its times; `evaluate` compares. See docs/evaluation.md.
"""

from coloc_graph.evaluation.accuracy import Accuracy, DistanceAccuracy, RobotAccuracy, accuracy_json, evaluate
from coloc_graph.evaluation.alignment import ALIGNMENTS, Alignment, align, usual_alignment
from coloc_graph.evaluation.nees import FREE, PLANAR, Nees, effective_poses, nees, nees_of, whitened
from coloc_graph.evaluation.pose_errors import (
    RPE_DISTANCES,
    PairsFrom,
    RelativeError,
    Spread,
    absolute_errors,
    relative_errors,
)
from coloc_graph.evaluation.truth import MAX_TRUTH_GAP, true_poses, with_truth, without_truth

__all__ = [
    "ALIGNMENTS",
    "FREE",
    "MAX_TRUTH_GAP",
    "PLANAR",
    "RPE_DISTANCES",
    "Accuracy",
    "Alignment",
    "DistanceAccuracy",
    "Nees",
    "PairsFrom",
    "RelativeError",
    "RobotAccuracy",
    "Spread",
    "absolute_errors",
    "accuracy_json",
    "align",
    "effective_poses",
    "evaluate",
    "nees",
    "nees_of",
    "relative_errors",
    "true_poses",
    "usual_alignment",
    "whitened",
    "with_truth",
    "without_truth",
]
