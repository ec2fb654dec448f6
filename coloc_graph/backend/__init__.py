"""Measurements to an estimate: the pose graph with stay-put constraints, chained and smoothed (no images).

`PoseGraph` holds what was measured, `chain` composes it as the paper does, `smooth` optimises it.
"""

from coloc_graph.backend.gtsam_version import require_gtsam

require_gtsam()

from coloc_graph.backend.chain import chain  # noqa: E402  after the check, so that its sentence is what one sees
from coloc_graph.backend.estimate import Estimate  # noqa: E402
from coloc_graph.backend.graph import PoseGraph, StayPut  # noqa: E402
from coloc_graph.backend.smooth import smooth  # noqa: E402

__all__ = ["Estimate", "PoseGraph", "StayPut", "chain", "smooth"]
