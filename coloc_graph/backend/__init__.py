"""Measurements to an estimate: the pose graph with stay-put constraints, in batch and as it happens (no images).

`PoseGraph` holds what was measured in stances, `KeyframeGraph` what was measured without. `chain` composes as the paper
does, `smooth` optimises poses, `joint` calibration too; `Estimator` keeps a graph optimised while measurements come in,
`diagnose` says what is not tied and what would tie it.
"""

from coloc_graph.backend.gtsam_version import require_gtsam

require_gtsam()

from coloc_graph.backend.batch import joint, smooth  # noqa: E402
from coloc_graph.backend.calibration import Calibration, with_height_sigma  # noqa: E402
from coloc_graph.backend.chain import chain  # noqa: E402  after the check, so that its sentence is what one sees
from coloc_graph.backend.diagnosis import DisconnectedComponent, diagnose  # noqa: E402
from coloc_graph.backend.estimate import Bump, Estimate, Rejection, StanceEstimate  # noqa: E402
from coloc_graph.backend.estimator import Estimator  # noqa: E402
from coloc_graph.backend.factors import Method  # noqa: E402
from coloc_graph.backend.graph import PoseGraph, StayPut  # noqa: E402
from coloc_graph.backend.ranging import KeyframeGraph  # noqa: E402

__all__ = [
    "Bump",
    "Calibration",
    "DisconnectedComponent",
    "Estimate",
    "Estimator",
    "KeyframeGraph",
    "Method",
    "PoseGraph",
    "Rejection",
    "StanceEstimate",
    "StayPut",
    "chain",
    "diagnose",
    "joint",
    "smooth",
    "with_height_sigma",
]  # fmt: skip
