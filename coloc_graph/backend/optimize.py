"""Optimum of a graph: initial values, and, of a joint estimate, the mounts first."""

from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from coloc_graph.backend.batched_factors import BatchedFactors
from coloc_graph.backend.calibration import size_of
from coloc_graph.backend.chain import compose, spanning_tree, tied_keys
from coloc_graph.backend.chi2_test import Agreement, agreements, p_values
from coloc_graph.backend.factors import Factors, Method, calibrations_in, factors_for, poses_in
from coloc_graph.backend.graph import Link, PoseGraph, point_of, pose_of
from coloc_graph.backend.marginals import Marginals
from coloc_graph.backend.solver import optimise

Array = NDArray[np.float64]

ALL_TESTED = 500  # links up to which each is tested with its marginal covariance
LOOKED_INTO = 1e-3  # p-value of a residual alone below which a link of a larger graph is tested as well
LONG_RUN_STANCES = 30  # stances from which the mounts are estimated first, by a part of the run
LONG_RUN_PARTS = 3  # number of such parts; the first is used
MAX_ANCHORINGS = 4  # rounds of linearising spans at the estimated mounts; mounts 3 degrees off take two
ROUGH_CHI2_PER_DOF = 2.0  # chi2/dof above which a fit among outliers need not converge
MANY_ROBOTS = 20  # robots from which a clique holds a hundred variables, and Cholesky goes first


@dataclass(frozen=True, eq=False)
class Fit:
    """A graph at its optimum.

    `links` are the last of its `factors`, in that order; in the context `batched` those in Python are evaluated in
    batches. Joint covariances of the ends of `links` and of those that it is `without` take no search.
    """

    graph: PoseGraph
    factors_of: Factors
    factors: gtsam.NonlinearFactorGraph
    links: tuple[Link, ...]
    values: gtsam.Values
    iterations: int
    batched: BatchedFactors
    rough_above: float = np.inf  # half chi2 above which it did not need to converge
    without: tuple[Link, ...] = ()

    @cached_property
    def chi2(self) -> float:
        """Chi-squared of all factors."""
        with self.batched, self.batched.held(self.values):
            return float(2 * self.factors.error(self.values))

    @property
    def is_rough(self) -> bool:
        """True if it need not have converged."""
        return self.chi2 / 2 > self.rough_above

    @cached_property
    def marginals(self) -> Marginals:
        """Marginal covariances."""
        with self.batched, self.batched.held(self.values):
            linear = self.factors.linearize(self.values)
        for link in self.without:
            # no information, but its ends then share a clique
            i, j = self.graph.ends[id(link)]
            if i != j and self.values.exists(i) and self.values.exists(j):
                nothing = np.zeros((1, 6))
                unit = gtsam.noiseModel.Unit.Create(1)
                linear.push_back(gtsam.JacobianFactor(i, nothing, j, nothing, np.zeros(1), unit))
        return Marginals(linear, size_of)

    @cached_property
    def dof(self) -> int:
        """Degrees of freedom: rows of weight less unknowns."""
        points = sum(self.values.exists(self.graph.pose_keys.static()[name]) for name in self.graph.ranged_points)
        return self.factors_of.dof(self.values, [(link, self.factor(n)) for n, link in enumerate(self.links)], points)

    @property
    def p_value(self) -> float:
        """Probability of a larger chi2 by noise alone."""
        return float(chdtrc(self.dof, self.chi2)) if self.dof > 0 else 1.0

    def factor(self, index: int) -> gtsam.NonlinearFactor:
        """Return the factor of a link, by its index."""
        return self.factors.at(self.factors.size() - len(self.links) + index)

    def agreements(self, kinds: type | tuple[type, ...]) -> dict[int, Agreement]:
        """Test the links of some kinds against all others; by index, see `ALL_TESTED`."""
        with self.batched, self.batched.held(self.values):
            return self._agreements(kinds)

    def residuals(self, kinds: type | tuple[type, ...]) -> dict[int, Agreement]:
        """Test the residuals of the links of some kinds alone, as if all else were known; by index."""
        with self.batched, self.batched.held(self.values):
            return self._residuals(kinds)

    def _residuals(self, kinds: type | tuple[type, ...]) -> dict[int, Agreement]:
        rows, at, first = self.factors_of.rows, self.factors.at, self.factors.size() - len(self.links)
        found = dict[int, Agreement]()
        for n, link in enumerate(self.links):
            if isinstance(link, kinds):
                factor = at(first + n)
                found[n] = Agreement(2 * factor.error(self.values), rows(link, factor))
        return found

    def _agreements(self, kinds: type | tuple[type, ...]) -> dict[int, Agreement]:
        found, among = dict[int, Agreement](), [n for n, link in enumerate(self.links) if isinstance(link, kinds)]
        if len(self.links) > ALL_TESTED:
            found = self._residuals(kinds)
            among = [n for n, one in zip(among, p_values(found.values()), strict=True) if one <= LOOKED_INTO]
        tested = agreements([self.factor(n) for n in among], self.values, self.marginals.joint)
        return found | dict(zip(among, tested, strict=True))


def fit_graph(
    method: Method,
    graph: PoseGraph,
    start: gtsam.Values | None = None,
    anchorings: int = MAX_ANCHORINGS,
    *,
    roughly: bool = False,
    before: Fit | None = None,
) -> Fit:
    """Optimise a graph from `start`, or from the composition along the spanning tree.

    Factors of poses alone are those of the fit `before`, of the same graph with other links.

    `roughly`: without convergence where chi2/dof stays above `ROUGH_CHI2_PER_DOF`.

    Variables that `start` lacks are composed; disconnected ones are left out. Raises `EstimationError` where
    measurements tie nothing to the reference, or the optimiser did not converge.
    """
    if method == "joint" and start is None:
        start = _mounts_first(graph)
    factors_of = factors_for(method, graph, start)
    if before is not None and factors_of.variables is None and before.factors_of.variables is None:
        factors_of = before.factors_of
    mounts = {} if start is None else calibrations_in(start)

    def errors(key: int) -> Array:
        return mounts.get(key, factors_of.nominal(key))

    expected: dict[int, gtsam.Pose3] = {}  # poses of links' second ends in their first, by identity
    known = {} if start is None else {key: start.atPose3(key) for key in poses_in(start)}

    def along_tree(odometry_last: bool) -> dict[int, gtsam.Pose3]:
        steps = spanning_tree(graph, graph.links, odometry_last=odometry_last)
        if mounts:
            new = [one.link for one in steps if one.to not in known and id(one.link) not in expected]
            of_ends = [(link, *graph.ends[id(link)]) for link in new]
            expected.update(zip(map(id, new), factors_of.all_expected(of_ends, errors), strict=True))
        return compose(graph, steps, factors_of.start, lambda link: expected.get(id(link)) or pose_of(link), known)

    def composed(*, odometry_last: bool) -> gtsam.Values:
        values = gtsam.Values()
        tied = tied_keys(graph) if known else set()
        poses = (
            {key: known[key] for key in tied} if len(tied) > 1 and tied <= known.keys() else along_tree(odometry_last)
        )
        for key, pose in poses.items():
            values.insert(key, pose)
        for name, ranges in graph.ranged_points.items():
            key = graph.pose_keys.static()[name]
            if key in known:
                values.insert(key, known[key])
            elif placed := [one for one in ranges if values.exists(graph.pose_keys.key(one.ends[0]))]:
                values.insert(key, point_of(placed[0], values.atPose3(graph.pose_keys.key(placed[0].ends[0]))))
        return values

    values = composed(odometry_last=False)
    # two robots that are composed each by its own odometry end far apart after hundreds of stances
    others = composed(odometry_last=True) if mounts and not known else None
    iterations, rough_above = 0, np.inf
    for left in reversed(range(anchorings)):
        factors, links, batched = factors_of.of_graph(graph, poses_in(values))
        for key in map(int, factors.keyVector()):
            for one in (values,) if others is None else (values, others):
                if not one.exists(key):
                    one.insert(key, errors(key))
        with batched:
            if others is not None and factors.error(others) < factors.error(values):
                values = others
            others = None
            many = len(graph.robots) >= MANY_ROBOTS or len(links) > ALL_TESTED
            if roughly:
                rows = sum(factors.at(n).dim() for n in range(factors.size() - len(links), factors.size()))
                rough_above = ROUGH_CHI2_PER_DOF * rows / 2
            values, used = optimise(factors, values, roughly_first=many, rough_above=rough_above, held=batched.held)
        iterations += used
        # spans are linearised at the mounts known before: once more where the estimate is elsewhere
        if not left or factors_of.is_anchored(values):
            break
        factors_of = factors_for(method, graph, values)
    return Fit(graph, factors_of, factors, links, values, iterations, batched, rough_above)


def _mounts_first(graph: PoseGraph) -> gtsam.Values | None:
    """Estimate the mounts by a part of a long run, to compose all of it by them; None for a short run.

    With mounts a degree off each step is composed half a degree wrong, and a hundred steps are too bent for the search
    to converge.
    """
    part = graph.up_to(len(graph.stances) // LONG_RUN_PARTS)
    if len(graph.stances) < LONG_RUN_STANCES or not spanning_tree(part, part.links):
        return None
    known = gtsam.Values()
    for key, errors in calibrations_in(fit_graph("joint", part, anchorings=1, roughly=True).values).items():
        known.insert(key, errors)
    return known
