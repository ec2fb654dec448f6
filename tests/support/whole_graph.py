"""Replay of a whole graph through an incremental estimator, stance by stance."""

import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace

from coloc_graph.backend.estimate import Estimate, StanceEstimate
from coloc_graph.backend.estimator import Estimator
from coloc_graph.backend.factors import Method
from coloc_graph.backend.graph import PoseGraph
from coloc_graph.measurements import Measurement
from coloc_graph.run import Stance

#: Called after each stance with it, the poses of its robots, and its measurements with the odometry into it.
OnStance = Callable[[Stance, StanceEstimate, Sequence[Measurement]], None]


def replay(
    graph: PoseGraph, method: Method = "smooth", on_stance: OnStance | None = None
) -> tuple[Estimate, tuple[float, ...]]:
    """Feed a graph to an incremental estimator.

    Parameters
    ----------
    graph : PoseGraph
        All stances and measurements.
    method : {"smooth", "joint"}
        Estimate poses alone, or mounts with them.
    on_stance : callable or None
        Called after each stance.

    Returns
    -------
    estimate : Estimate
        The estimate at the end.
    seconds : tuple of float
        Time of insertion of each stance [s].

    Raises
    ------
    MeasurementError
        A stance after the first has no anchor and no odometry into it.
    """
    by_stance: dict[int, list[Measurement]] = defaultdict(list)
    for measured in graph.measurements:
        by_stance[max(stance for _, stance in measured.ends)].append(measured)
    robot_models = graph.robot_models if method == "joint" else None
    estimator = Estimator(graph.reference, graph.robots, graph.floor, graph.slips, robot_models, graph.landmarks)
    seconds = []
    before = None
    for stance in graph.stances:
        started = time.perf_counter()
        # the first stance has no anchors, whatever it names
        here = replace(stance, anchors=()) if before is None else stance
        said = estimator.add(here, by_stance[stance.index], after=before)
        seconds.append(time.perf_counter() - started)
        if on_stance is not None:
            on_stance(here, said, by_stance[stance.index])
        before = stance.index
    return estimator.estimate(), tuple(seconds)
