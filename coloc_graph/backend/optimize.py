"""A graph's optimum: where the search starts, and, of a joint estimate, the mounts before all else."""

from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from coloc_graph.backend.batched_factors import BatchedFactors
from coloc_graph.backend.chain import compose, spanning_tree
from coloc_graph.backend.chi2_test import Agreement, agreement
from coloc_graph.backend.factors import Factors, Method, calibrations_in, factors_for, poses_in
from coloc_graph.backend.graph import Link, PoseGraph, pose_of
from coloc_graph.backend.marginals import Marginals
from coloc_graph.backend.solver import optimise

Array = NDArray[np.float64]

#: In larger graphs, measurements whose residual noise exceeds more often than `LOOKED_INTO` agree as well as that says.
ALL_TESTED = 500
LOOKED_INTO = 1e-3
#: Of a run of so many stances the mounts are found in the first part of this many.
LONG_RUN = 30
PART = 3
#: Rounds of finding the mounts and taking spans apart there; mounts 3 degrees off take two.
MOST_ANCHORINGS = 4
#: From so many robots on each clique of the graph holds a hundred variables.
MANY_ROBOTS = 20


@dataclass(frozen=True, eq=False)
class Fit:
    """A graph at its optimum; `links` are the last of its `factors`, in that order, and `at_once` evaluates together
    those that are in Python."""

    graph: PoseGraph
    factors_of: Factors
    factors: gtsam.NonlinearFactorGraph
    links: tuple[Link, ...]
    values: gtsam.Values
    iterations: int
    at_once: BatchedFactors

    @cached_property
    def chi2(self) -> float:
        """Of all rows that weigh."""
        with self.at_once:
            return float(2 * self.factors.error(self.values))

    @cached_property
    def marginals(self) -> Marginals:
        """Its covariances."""
        with self.at_once:
            return Marginals(self.factors, self.values)

    @cached_property
    def dof(self) -> int:
        """Rows that weigh, less unknowns."""
        return self.factors_of.dof(self.values, [(link, self.factor(n)) for n, link in enumerate(self.links)])

    @property
    def chance(self) -> float:
        """How often noise alone makes it this bad."""
        return float(chdtrc(self.dof, self.chi2)) if self.dof > 0 else 1.0

    def factor(self, index: int) -> gtsam.NonlinearFactor:
        """The factor of a link, by its index."""
        return self.factors.at(self.factors.size() - len(self.links) + index)

    def agreements(self, kinds: type | tuple[type, ...]) -> dict[int, Agreement]:
        """How the links of some kinds agree with all others, by index; see `ALL_TESTED`."""
        with self.at_once:
            return self._agreements(kinds)

    def _agreements(self, kinds: type | tuple[type, ...]) -> dict[int, Agreement]:
        found = {}
        for index, link in enumerate(self.links):
            if not isinstance(link, kinds):
                continue
            factor = self.factor(index)
            if len(self.links) > ALL_TESTED:
                alone = Agreement(2 * factor.error(self.values), self.factors_of.rows(link, factor))
                if alone.chance() > LOOKED_INTO:
                    found[index] = alone
                    continue
            found[index] = agreement([factor], self.values, self.marginals.joint(list(factor.keys())))
        return found


def fit_graph(method: Method, graph: PoseGraph, start: gtsam.Values | None = None) -> Fit:
    """A graph's optimum, from `start`, or else from the composition along the surest way.

    What a start does not hold is composed, and what nothing ties to the reference is left out. Raises `EstimationError`
    where measurements tie nothing to it, or the optimiser's answer does not pass its check.
    """
    if method == "joint" and start is None:
        start = _mounts_first(graph)
    factors_of = factors_for(method, graph, start)
    mounts = {} if start is None else calibrations_in(start)

    def errors(key: int) -> Array:
        return mounts.get(key, factors_of.nominal(key))

    def expected(link: Link) -> gtsam.Pose3:
        i, j = map(graph.places.key, link.ends)
        return factors_of.expected(link, i, j, errors) if mounts else pose_of(link)

    known = {} if start is None else {key: start.atPose3(key) for key in poses_in(start)}
    values = gtsam.Values()
    for key, pose in compose(graph, spanning_tree(graph, graph.links), factors_of.start, expected, known).items():
        values.insert(key, pose)
    iterations = 0
    for left in reversed(range(MOST_ANCHORINGS)):
        factors, links, at_once = factors_of.of_graph(graph, poses_in(values))
        for key in map(int, factors.keyVector()):
            if not values.exists(key):
                values.insert(key, errors(key))
        with at_once:
            values, used = optimise(factors, values, roughly_first=len(graph.robots) >= MANY_ROBOTS)
        iterations += used
        # spans were taken apart for mounts as stated: once more where they turned out to be elsewhere
        if not left or factors_of.is_anchored(values):
            break
        factors_of = factors_for(method, graph, values)
    return Fit(graph, factors_of, factors, links, values, iterations, at_once)


def _mounts_first(graph: PoseGraph) -> gtsam.Values | None:
    """The mounts as a part of a long run has them, to compose all of it by; None where it is short.

    With mounts a degree off each step is composed half a degree wrong, a hundred of them are a circle the wrong way
    round, and no search in the poses of a whole run unbends that.
    """
    part = graph.up_to(len(graph.stances) // PART)
    if len(graph.stances) < LONG_RUN or not spanning_tree(part, part.links):
        return None
    known = gtsam.Values()
    for key, errors in calibrations_in(fit_graph("joint", part).values).items():
        known.insert(key, errors)
    return known
