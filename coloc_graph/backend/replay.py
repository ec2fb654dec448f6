"""A whole graph, fed to an estimator stance by stance as it would have come in."""

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

#: Called after each stance with it, where its robots stand, and what was measured in it and on the way to it.
Entered = Callable[[Stance, StanceEstimate, Sequence[Measurement]], None]


def replay(
    graph: PoseGraph, method: Method = "smooth", entered: Entered | None = None
) -> tuple[Estimate, tuple[float, ...]]:
    """The estimate at the end by `smooth` or `joint`, and how long each stance took to enter [s].

    A stance without an anchor, which an estimator refuses, raises `MeasurementError`.
    """
    by_stance: dict[int, list[Measurement]] = defaultdict(list)
    for measured in graph.measurements:
        by_stance[max(stance for _, stance in measured.ends)].append(measured)
    rigs = graph.rigs if method == "joint" else None
    estimator = Estimator(graph.reference, graph.robots, graph.floor, graph.slips, rigs, graph.landmarks)
    seconds = []
    before = None
    for stance in graph.stances:
        started = time.perf_counter()
        # before the first nobody can have stayed, whatever it says
        here = replace(stance, anchors=()) if before is None else stance
        said = estimator.add(here, by_stance[stance.index], after=before)
        seconds.append(time.perf_counter() - started)
        if entered is not None:
            entered(here, said, by_stance[stance.index])
        before = stance.index
    return estimator.estimate(), tuple(seconds)
