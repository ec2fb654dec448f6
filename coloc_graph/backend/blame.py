"""Comparison of the causes that would explain measurements which contradict each other.

Each cause is fitted on the same data: an anchor that was bumped, one measurement that is wrong, all that a camera
measured in a stance, or all odometry of a robot. The one that explains most is taken; those that explain as much are
named with it.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.special import chdtri

from coloc_graph.backend.cause import Cause, or_else, to_check
from coloc_graph.backend.chi2_test import REJECTION_P_VALUE, Agreement, agreement_by_covariance, keys_of
from coloc_graph.backend.estimate import NO_LINE_OF_SIGHT, Bump, Rejection
from coloc_graph.backend.factors import Method, calibrations_in
from coloc_graph.backend.graph import Link, PoseGraph, StayPut
from coloc_graph.backend.landmarks import ALWAYS, OnMap
from coloc_graph.backend.optimize import ALL_TESTED, Fit, fit_graph
from coloc_graph.errors import EstimationError
from coloc_graph.measurements import Measurement, Odometry, Range, RelativePose, Sighting
from coloc_graph.team import Slip

TEST_SLIP = Slip(sigma=1e-3, sigma_deg=0.1)  # slip that a stay-put constraint is given to test it
MAX_FAULTS = 4  # faults that are searched for one after the other
MANY_FAULTS = 4.0  # chi2 left, in units of what the likeliest of `MAX_FAULTS` explains, from which many are wrong
MAX_FITTED = 6  # causes that are fitted in each round, the likeliest
MAX_GROUPS = 20  # groups of measurements that are tested together in each round, the worst
MIN_GAIN = 0.5  # part of the largest predicted decrease of chi2 from which a cause is fitted in any case
GROUP_PRICE = 30.0  # chi2 that several measurements must explain beyond one of them
EQUAL_CHI2 = 9.0  # two causes explain equally well if chi2 differs by less
SIGMAS_ALONE = 12.0  # a measurement that alone ties a pose is kept up to this: a wrong one is off by many more
TESTED = (RelativePose, Sighting, OnMap, Range)  # links that are tested to see whether anything is wrong
SEARCHED = (*TESTED, Odometry)  # links that may be wrong once something is


@dataclass(frozen=True, eq=False)
class WarmStart:
    """Fit of a large graph that only a few links, the `suspects`, contradict: initial values of further searches."""

    graph: PoseGraph
    values: gtsam.Values
    suspects: tuple[Link, ...]

    @property
    def robots(self) -> set[str]:
        """Robots that may have been bumped."""
        return {robot for link in self.suspects for robot, _ in link.ends}

    def start(self, graph: PoseGraph) -> gtsam.Values:
        """Return initial values for a graph with the same nodes and fewer stay-put constraints."""
        start = gtsam.Values()
        for key, errors in calibrations_in(self.values).items():
            start.insert(key, errors)
        for node in (*graph.nodes, *((name, ALWAYS) for name in graph.pose_keys.static())):
            before, now = self.graph.pose_keys.key(node), graph.pose_keys.key(node)
            if self.values.exists(before) and not start.exists(now):
                start.insert(now, self.values.atPose3(before))
        return start


@dataclass(frozen=True, eq=False)
class Fault:
    """A cause that explains most, with those that explain as much.

    Parameters
    ----------
    cause : Cause
        The likeliest.
    alternative : tuple of Cause
        Others whose chi2 differs by less than `EQUAL_CHI2`.
    sigmas : float
        Distance of its links from all others in standard deviations.
    T_before_after : gtsam.Pose3 or None
        Movement of a bumped anchor.
    """

    cause: Cause
    alternative: tuple[Cause, ...]
    sigmas: float
    T_before_after: gtsam.Pose3 | None = None

    @property
    def causes(self) -> tuple[Cause, ...]:
        """The cause, and those that explain as much."""
        return self.cause, *self.alternative

    def bump(self, graph: PoseGraph) -> Bump:
        """Return the bump that it is."""
        stay = self.cause.links[0]
        assert isinstance(stay, StayPut)
        assert self.T_before_after is not None
        return Bump(replace(stay, slip=graph.slips.get(stay.robot)), self.T_before_after, self.sigmas, self.alternative)

    def rejections(self) -> tuple[Rejection, ...]:
        """Return the rejections of its measurements."""
        reason = f"an outlier: {self.sigmas:.0f} sigmas from the other measurements"
        if self.cause.view is not None:
            robot, stance = self.cause.view
            reason += f", as all that {robot} observed in stance {stance}"
        if isinstance(self.cause.links[0], Range):
            reason += NO_LINE_OF_SIGHT
        if self.alternative:
            reason += (
                f"{or_else(self.alternative)}: both explain the measurements equally well; "
                f"check {to_check(self.cause, *self.alternative)}"
            )
        elif isinstance(self.cause.links[0], Odometry):
            reason += f"; check {self.cause.check}"
        return tuple(
            Rejection(link, reason, self.sigmas, self.alternative)
            for link in self.cause.links
            if not isinstance(link, StayPut)
        )


@dataclass(frozen=True, eq=False)
class _Tried:
    """A cause that was fitted, and what that explains."""

    cause: Cause
    gained: Agreement
    graph: PoseGraph
    fit: Fit

    @property
    def cost(self) -> float:
        """Chi2 above its expected value."""
        return self.fit.chi2 - self.fit.dof


def find_faults(method: Method, graph: PoseGraph, warm: WarmStart | None) -> tuple[tuple[Fault, ...], PoseGraph, bool]:
    """Find the faults that explain why a graph contradicts itself.

    Parameters
    ----------
    method : {"smooth", "joint"}
        Method of estimation.
    graph : PoseGraph
        Stances and measurements.
    warm : WarmStart or None
        Fit of a large graph.

    Returns
    -------
    tuple of Fault, PoseGraph, bool
        The faults, most significant first; the graph in which anchors that were bumped have moved, and what may be
        wrong instead is as uncertain as that; True if nothing contradicts the rest.
    """
    robots = warm.robots.intersection(graph.robots) if warm else graph.robots
    faults: list[Fault] = []
    fit: Fit | None = None
    for left in reversed(range(MAX_FAULTS + 1)):
        if fit is None:
            rejected = [one.measurement for fault in faults for one in fault.rejections()]
            tested = replace(graph.without(rejected), slips={**dict.fromkeys(robots, TEST_SLIP), **graph.slips})
            fit = fit_graph(method, tested, warm.start(tested) if warm else None, roughly=True)
        suspects = _suspects(fit)
        if not suspects:
            return tuple(faults), graph, True
        tried = list(_fitted(method, fit, suspects)) if left else []
        if not tried:
            break
        likeliest = min(tried, key=lambda one: one.cost)
        # scale of the variances once the likeliest is out: it distorts all other residuals
        scale = scale_of(likeliest.fit.agreements(SEARCHED).values())
        likeliest, equal = _equal(tried, scale)
        best = min(equal, key=lambda one: (_preference(one.cause), one.cost))
        if best.gained.p_value(scale) > REJECTION_P_VALUE:
            break
        others = sorted((one for one in equal if one is not best), key=lambda one: one.cost)
        faults.append(_fault_of(best, others))
        graph = _with_fault(graph, best, others)
        if likeliest.cost > MANY_FAULTS * MAX_FAULTS * best.gained.chi2:
            break
        fit = None if others else best.fit  # the same graph again
    return tuple(faults), graph, False


def bumps_of(faults: Iterable[Fault], graph: PoseGraph) -> tuple[Bump, ...]:
    """Return the bumps among some faults."""
    return tuple(one.bump(graph) for one in faults if one.cause.is_bump)


def scale_of(tested: Iterable[Agreement]) -> float:
    """Ratio of actual to stated variances by the median measurement; 1 at least.

    An error that all measurements share, such as a wrong mount, is no reason to reject a few of them.
    """
    chi2, dof = np.array([(one.chi2, one.dof) for one in tested if one.dof], float).reshape(-1, 2).T
    return max(1.0, float(np.median(chi2 / chdtri(dof, 0.5)))) if len(dof) else 1.0


def _suspects(fit: Fit) -> list[tuple[Cause, Agreement]]:
    """Causes that noise does not explain, the likeliest first."""
    alone = fit.agreements((StayPut, *SEARCHED))
    wrong = {index: one for index, one in alone.items() if one.dof and one.p_value() < REJECTION_P_VALUE}
    if not wrong:
        return []
    found = [(Cause((fit.links[index],)), one) for index, one in wrong.items()]
    places = {id(link): index for index, link in enumerate(fit.links)}
    chi2 = {id(fit.links[index]): one.chi2 for index, one in alone.items()}
    groups = _groups(fit.links, {id(fit.links[index]) for index in wrong})
    worst_first = sorted(groups, key=lambda one: -sum(chi2.get(id(link), 0.0) for link in one.links))
    for cause in worst_first[:MAX_GROUPS]:
        factors = [fit.factor(index) for index in sorted(places[id(link)] for link in cause.links)]
        with fit.batched:
            one = agreement_by_covariance(factors, fit.values, fit.marginals.joint(keys_of(factors)))
        if one.dof:
            found.append((cause, one))
    return sorted(found, key=lambda pair: pair[1].dof - pair[1].chi2)


def _groups(links: Iterable[Link], wrong: set[int]) -> Iterator[Cause]:
    """All that a camera measured in a stance, and all odometry of a robot, where some of it is `wrong`."""
    views: Mapping[tuple[str, int], list[Link]] = defaultdict(list)
    wheels: Mapping[str, list[Link]] = defaultdict(list)
    for link in links:
        if isinstance(link, RelativePose):
            views[link.robot_i, link.stance].append(link)
            views[link.robot_j, link.stance].append(link)
        elif isinstance(link, Sighting):
            views[link.observer, link.stance].append(link)
        elif isinstance(link, Odometry):
            wheels[link.robot].append(link)
    for node, seen in views.items():
        if len(seen) > 1 and any(id(one) in wrong for one in seen):
            yield Cause(tuple(seen), node)
    for driven in wheels.values():
        if len(driven) > 1 and sum(id(one) in wrong for one in driven) > 1:
            yield Cause(tuple(driven))


def _fitted(method: Method, fit: Fit, suspects: list[tuple[Cause, Agreement]]) -> Iterator[_Tried]:
    """Fit the likeliest causes, each alone."""
    tied = len(fit.graph.disconnected(fit.values.keys()))
    most = 2 if len(fit.links) > ALL_TESTED else MAX_FITTED
    warm = WarmStart(fit.graph, fit.values, ())
    least = np.inf
    for cause, tested in suspects[:most]:
        # what a cause explains is predicted by one step: where none of the likely ones is all, others are fitted
        if tested.chi2 <= MIN_GAIN * suspects[0][1].chi2 and least < GROUP_PRICE:
            break
        freed = _without(fit.graph, cause)
        try:
            other = fit_graph(method, freed, warm.start(freed), roughly=True)
        except EstimationError:
            continue  # without it nothing ties the robots to each other
        if len(freed.disconnected(other.values.keys())) > tied and tested.sigmas < SIGMAS_ALONE:
            continue
        gained = Agreement(max(fit.chi2 - other.chi2, 0.0), max(fit.dof - other.dof, 1))
        tried = _Tried(cause, gained, freed, other)
        least = min(least, tried.cost)
        yield tried


def _equal(tried: list[_Tried], scale: float) -> tuple[_Tried, list[_Tried]]:
    """The likeliest cause, and all that explain as much: of causes of which one contains the other, one."""

    def cost(one: _Tried) -> float:
        inner = any({*map(id, other.cause.links)} < {*map(id, one.cause.links)} for other in tried)
        return one.cost + GROUP_PRICE * scale * inner

    likeliest = min(tried, key=cost)
    links = {*map(id, likeliest.cause.links)}
    equal = [one for one in tried if cost(one) < cost(likeliest) + EQUAL_CHI2 * scale]
    return likeliest, [one for one in equal if one is likeliest or not links & {*map(id, one.cause.links)}]


def _preference(cause: Cause) -> int:
    """Order of causes that explain as much: the one that leaves the poses tied first."""
    if cause.is_bump:
        return 0
    return 1 if isinstance(cause.links[0], Odometry) else 2


def _fault_of(best: _Tried, others: list[_Tried]) -> Fault:
    alternative = tuple(one.cause for one in sorted(others, key=lambda one: one.cost))
    stay = best.cause.links[0]
    if not isinstance(stay, StayPut):
        return Fault(best.cause, alternative, best.gained.sigmas)
    before, after = (best.fit.values.atPose3(best.graph.pose_keys.key(node)) for node in stay.ends)
    return Fault(best.cause, alternative, best.gained.sigmas, before.between(after))


def _without(graph: PoseGraph, cause: Cause) -> PoseGraph:
    """Return the graph without a cause's links."""
    stay = cause.links[0]
    return moved(graph, stay) if isinstance(stay, StayPut) else graph.without(cause.links)


def moved(graph: PoseGraph, stay: StayPut) -> PoseGraph:
    """Return the graph in which a robot was no anchor at the later of two stances."""
    stances = tuple(
        replace(stance, anchors=tuple(robot for robot in stance.anchors if robot != stay.robot))
        if stance.index == stay.after
        else stance
        for stance in graph.stances
    )
    return replace(graph, stances=stances)


def as_stated(graph: PoseGraph, bumps: Iterable[Bump]) -> PoseGraph:
    """Return the graph in which anchors that were bumped stayed put, as is stated: the inverse of `moved`."""
    stays = {(one.stay_put.robot, one.stay_put.after) for one in bumps}
    stances = tuple(
        replace(stance, anchors=(*stance.anchors, *(r for r, after in stays if after == stance.index)))
        for stance in graph.stances
    )
    return replace(graph, stances=stances) if stays else graph


def _with_fault(graph: PoseGraph, best: _Tried, others: list[_Tried]) -> PoseGraph:
    """Return the graph with a bumped anchor freed; what may be wrong instead is as uncertain as it then is off."""
    for one in (best, *others):
        stay = one.cause.links[0]
        if isinstance(stay, StayPut):
            graph = moved(graph, stay)
    wrong = {id(link) for link in best.cause.links}
    if isinstance(best.cause.links[0], Odometry):  # which is wrong far more often than all that a camera measured
        others = [one for one in others if one.cause.view is None]
    widened = {
        id(link): _widened(link, one.fit)
        for one in others
        for link in one.cause.links
        if isinstance(link, Measurement) and id(link) not in wrong
    }
    return replace(graph, measurements=tuple(widened.get(id(one), one) for one in graph.measurements))


def _widened(link: Measurement, fit: Fit) -> Measurement:
    """Return a measurement that is as uncertain as it is off in a fit without it."""
    keys = [fit.graph.pose_keys.key(node) for node in link.ends]
    if not all(map(fit.values.exists, keys)):
        return link
    if isinstance(link, Range):
        factor = fit.factors_of.of_link(link, *keys)
        known = all(map(fit.values.exists, factor.keys()))
        misfit = max(2 * factor.error(fit.values) / factor.dim(), 1.0) if known else 1.0
        return replace(link, covariance=misfit * link.covariance)
    before, after = map(fit.values.atPose3, keys)
    off = gtsam.Pose3.Logmap(gtsam.Pose3(link.T_i_j).between(before.between(after)))
    off = off if isinstance(link, RelativePose) else off[2:5]
    unsure = np.diag(np.square(np.maximum(np.abs(off), np.abs(off).max() / 2)))
    if isinstance(link, Odometry):
        return replace(link, covariance=link.covariance + unsure)
    if isinstance(link, Sighting):
        return replace(link, covariance=link.covariance + unsure, x_markers=None, x_covariance=None)
    return replace(link, covariance=link.covariance + unsure, homography=None, plane=None, spans=())
