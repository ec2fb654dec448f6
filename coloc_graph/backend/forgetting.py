"""State of an estimator that forgets what is older than its lag, so that its memory stays bounded."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.estimate import Rejection
from coloc_graph.backend.graph import Link, PoseKeys
from coloc_graph.errors import EstimationError
from coloc_graph.measurements import Measurement, Node
from coloc_graph.run import Stance

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Past:
    """State of an estimator when it forgot last; it is restored from there.

    Parameters
    ----------
    factors, values
        Graph at that time, in which the forgotten poses are marginalised.
    tied
        Keys tied to the reference.
    anchors
        Estimated mounts at which spans are linearised.
    pose_keys, stances, log, rejected, instants
        State of the estimator, of the stances that were kept.
    newly
        Identities of the measurements that were rejected since the last stance.
    disconnected
        Links that nothing ties to the reference.
    """

    factors: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    tied: frozenset[int]
    anchors: Mapping[int, Array]
    pose_keys: PoseKeys
    stances: Mapping[int, Stance]
    log: tuple[Measurement, ...]
    rejected: Mapping[int, Rejection]
    instants: Mapping[Node, float]
    newly: frozenset[int]
    disconnected: Sequence[Link]


def require_all(kept: str | None, what: str) -> None:
    """Raise `EstimationError` where an estimator has forgotten all but what it `kept`, and needs it for `what`."""
    if kept is not None:
        raise EstimationError(
            f"the estimator cannot {what}, since it has forgotten all before {kept}: solve the recorded run, or make "
            "the estimator without `forgets`"
        )
