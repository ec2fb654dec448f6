"""Search for outliers among the links of a graph, and for anchors whose bump explains many of them.

Graduated non-convexity finds the first ones; then the worst are rejected, and those that agree with the rest are taken
back, in turns.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from coloc_graph.backend.blame import SEARCHED, SIGMAS_ALONE, WarmStart, moved, scale_of
from coloc_graph.backend.chi2_test import REJECTION_P_VALUE, UNCHECKED, Agreement, innovations, p_values
from coloc_graph.backend.estimate import Bump, Rejection, rejection_of
from coloc_graph.backend.factors import Method, poses_in
from coloc_graph.backend.graph import Link, PoseGraph, StayPut
from coloc_graph.backend.landmarks import OnMap
from coloc_graph.backend.optimize import ALL_TESTED, Fit, fit_graph
from coloc_graph.backend.solver import robust_parameters
from coloc_graph.errors import EstimationError
from coloc_graph.geometry.lie import se3_inverse, yaw
from coloc_graph.geometry.se2 import wrap
from coloc_graph.measurements import Measurement, Range, RelativePose, Sighting

REJECTION_PRICE = 30.0  # chi2 that one more outlier must explain
MAX_ROUNDS = 20  # rounds of rejecting the worst links and taking back those that then agree
MAX_AT_POSE_WHILE_ROUGH = 2  # links at a pose that are rejected in a round of a rough fit; right ones are taken back
MIN_PARALLEL = 3  # relative poses between the same two poses from which they are compared with each other
GROSS_SIGMAS = 8.0  # standard deviations beyond which two of them contradict each other
MIN_BUMP_LINKS = 3  # rejected links on one side of a stay-put constraint from which a bump is tried
MAX_BUMPS_TRIED = 8  # bumps that are fitted, those that explain most links first


@dataclass(frozen=True, eq=False)
class Found:
    """Result of a search: how far `off` the rejected links are, by identity, the `fit` without them, and bumps.

    `graph` has all links; in it bumped anchors have moved.
    """

    graph: PoseGraph
    off: Mapping[int, Agreement]
    fit: Fit
    bumped: tuple[Bump, ...] = ()

    @property
    def rejected(self) -> tuple[Rejection, ...]:
        """Rejections of the rejected links."""
        return tuple(rejection_of(link, self.off[key]) for key, link in self.links.items())

    @property
    def links(self) -> dict[int, Measurement | OnMap]:
        """The rejected links, in the order of the graph, by identity."""
        links: tuple[Measurement | OnMap, ...] = (*self.graph.measurements, *self.graph.on_map)
        return {id(link): link for link in links if id(link) in self.off}

    @property
    def price(self) -> float:
        """Implausibility: chi2 above its expected value, and a price for each rejection and bump."""
        return self.fit.chi2 - self.fit.dof + REJECTION_PRICE * (len(self.off) + len(self.bumped))


def parallel_outliers(graph: PoseGraph) -> dict[int, Link]:
    """Relative poses that contradict most others between the same two poses, by identity.

    Robots that stay for many stances measure each other again and again. Only gross errors are told so.
    """
    parallel: dict[tuple[int, int], list[RelativePose]] = defaultdict(list)
    for link in graph.relative_poses:
        i, j = map(graph.pose_keys.key, link.ends)
        parallel[min(i, j), max(i, j)].append(link)
    found: dict[int, Link] = {}
    for (first, _), links in parallel.items():
        if len(links) < MIN_PARALLEL:
            continue
        T = np.array([one.T_i_j for one in links])
        back = np.array([graph.pose_keys.key(one.ends[0]) != first for one in links])
        T[back] = se3_inverse(T[back])
        C = np.array([one.covariance.diagonal() for one in links])
        turned, moved_by = C[:, :3].max(axis=1), C[:, 3:].max(axis=1)
        moved_by += turned * (T[:, :3, 3] ** 2).sum(axis=1)
        d2 = ((T[:, None, :3, 3] - T[:, :3, 3]) ** 2).sum(axis=-1)
        heading = yaw(T)
        squared = wrap(heading[:, None] - heading) ** 2 / (turned[:, None] + turned)
        agrees = np.maximum(squared, d2 / (moved_by[:, None] + moved_by)) < GROSS_SIGMAS**2
        most = int(agrees.sum(axis=1).argmax())
        if 2 * agrees[most].sum() > len(links):
            found |= {id(links[n]): links[n] for n in np.flatnonzero(~agrees[most]).tolist()}
    return found


def gnc_outliers(graph: PoseGraph, fit: Fit | None = None) -> dict[int, Link]:
    """Outliers among relative poses and sightings of landmarks by graduated non-convexity, by identity.

    Everything else is taken as true. `fit` is that of poses alone (`smooth`), where there is one.

    Source: Yang, Antonante, Tzoumas, Carlone, "Graduated Non-Convexity for Robust Spatial Perception", 2020.
    """
    # poses alone: GTSAM's optimiser copies its factors, which those that are Python cannot be
    ranges = [one for one in graph.measurements if isinstance(one, Range)]
    if fit is None or ranges:
        fit = fit_graph("smooth", graph.without(ranges), roughly=True)
    first, landmarks = fit.factors.size() - len(fit.links), fit.graph.landmarks
    suspects = [
        index
        for index, link in enumerate(fit.links)
        if isinstance(link, RelativePose) or (isinstance(link, Sighting) and link.seen in landmarks)
    ]
    parameters = gtsam.GncLMParams(robust_parameters())
    parameters.setKnownInliers(sorted(set(range(fit.factors.size())) - {first + index for index in suspects}))
    optimiser = gtsam.GncLMOptimizer(fit.factors, fit.values, parameters)
    optimiser.setInlierCostThresholdsAtProbability(1 - 1e-4)
    optimiser.optimize()
    weights = optimiser.getWeights()
    return {id(fit.links[index]): fit.links[index] for index in suspects if weights[first + index] < 0.5}


def find_outliers(method: Method, graph: PoseGraph, first: Mapping[int, Link], start: gtsam.Values | None) -> Found:
    """Find the outliers of a graph, from those of graduated non-convexity and, in a small graph, also from none.

    The set with fewer rejections for the same fit is the likelier cause. In a large graph anchors are then tried whose
    bump explains several rejections.
    """
    found = _search(method, graph, first, start)
    if len(graph.links) > ALL_TESTED:
        return _with_bumps(method, found)
    if first and len(found.off) > 1:
        other = _search(method, graph, {}, start)
        if other.price < found.price:
            return other
    return found


def _search(method: Method, graph: PoseGraph, suspected: Mapping[int, Link], start: gtsam.Values | None) -> Found:
    """Reject the worst links and take back those that then agree, in turns; start from those `suspected`.

    One link is rejected a round, of a large graph one at each pose; two, and by residuals alone, while its fit is too
    bad to converge (`Fit.is_rough`). What alone ties a pose is taken back too, up to `SIGMAS_ALONE`.
    """
    suspected, at_rejection, alone = dict[int, Link](suspected), dict[int, Agreement](), set[int]()
    before: Fit | None = None
    large, roughly = len(graph.links) > ALL_TESTED, True
    # ends when a set repeats, or after the last round
    for left in reversed(range(MAX_ROUNDS)):
        try:
            before = fit = _fitted(method, graph, suspected, start, roughly=roughly, before=before)
        except EstimationError:
            if not suspected:
                raise
            # without these nothing ties the robots to each other: they disagree, and it is not known which are wrong
            return Found(graph, {}, fit_graph(method, graph, start))
        is_rough = large and left > 0 and fit.is_rough
        tested = fit.residuals(SEARCHED) if is_rough else fit.agreements(SEARCHED)
        scale = scale_of(tested.values())
        kept = {index for index, off in tested.items() if id(fit.links[index]) in alone and off.sigmas < SIGMAS_ALONE}
        is_wrong = p_values(tested.values(), scale) < REJECTION_P_VALUE
        wrong = [index for index, one in zip(tested, is_wrong.tolist(), strict=True) if one and index not in kept]
        wrong.sort(key=lambda index: tested[index].log_p_value())
        refused = _apart(fit, wrong, MAX_AT_POSE_WHILE_ROUGH if is_rough else 1) if large else wrong[:1]
        roughly = not large or bool(is_rough and refused)
        offs = {} if is_rough else _innovations(fit, suspected)
        again = {key for key, off in offs.items() if off.dof and off.p_value(scale) >= REJECTION_P_VALUE}
        untied = [key for key, off in offs.items() if not off.dof and at_rejection.get(key, off).sigmas < SIGMAS_ALONE]
        if not left and untied:
            for key in untied:
                del suspected[key], offs[key]
            fit = _fitted(method, graph, suspected, start, before=fit)
        if not left or not (is_rough or again or untied or refused):
            break
        if untied:  # one at a time, the last first: it was the least off, and may contradict the others
            again.add(untied[-1])
            alone.add(untied[-1])
        for key in again:
            del suspected[key]
        for index in refused:
            suspected[id(fit.links[index])] = fit.links[index]
            at_rejection[id(fit.links[index])] = tested[index]
        if large:
            start = _upright(fit)
    if fit.is_rough:
        fit = _fitted(method, graph, suspected, fit.values, before=fit)
    return Found(graph, {key: off if off.dof else at_rejection[key] for key, off in offs.items()}, fit)


def _fitted(
    method: Method,
    graph: PoseGraph,
    out: Mapping[int, Link],
    start: gtsam.Values | None,
    *,
    roughly: bool = False,
    before: Fit | None = None,
) -> Fit:
    """Fit a graph without some links, between whose ends there are joint covariances; `before` without others."""
    fit = fit_graph(method, graph.without(out.values()), start, roughly=roughly, before=before)
    return replace(fit, without=tuple(out.values()))


def _upright(fit: Fit) -> gtsam.Values:
    """Return the values of a fit with all robots on the floor: outliers turn poses upside down, where they stay."""
    values, static = gtsam.Values(fit.values), set(fit.graph.pose_keys.static().values())
    for key in poses_in(values):
        if key not in static:
            values.update(key, fit.factors_of.start(values.atPose3(key)))
    return values


def _apart(fit: Fit, worst_first: list[int], most: int) -> list[int]:
    """Return the links that are among the worst so many at both of their poses: an outlier distorts those around it."""
    worse, chosen = defaultdict[int, int](int), []
    for index in worst_first:
        poses = set(fit.graph.ends[id(fit.links[index])])
        if all(worse[pose] < most for pose in poses):
            chosen.append(index)
        for pose in poses:
            worse[pose] += 1
    return chosen


def _innovations(fit: Fit, out: Mapping[int, Link]) -> dict[int, Agreement]:
    """Agreement of links that are not in the fit; `UNCHECKED` where an end of one has no pose there."""
    made = {key: fit.factors_of.of_link(link, *fit.graph.ends[key]) for key, link in out.items()}
    made = {key: factor for key, factor in made.items() if all(map(fit.values.exists, factor.keys()))}
    tested = innovations(list(made.values()), fit.values, fit.marginals.joint)
    return dict.fromkeys(out, UNCHECKED) | dict(zip(made, tested, strict=True))


def _with_bumps(method: Method, found: Found) -> Found:
    """Take anchors as bumped where that explains several rejected links better."""
    for stay, side in list(_bumps(found))[:MAX_BUMPS_TRIED]:
        graph = moved(found.graph, stay)
        out = {key: link for key, link in found.links.items() if key not in side}
        warm = WarmStart(found.graph, found.fit.values, ())
        try:
            tried = _search(method, graph, out, warm.start(graph))
            keys = [graph.pose_keys.key(node) for node in stay.ends]
            before, after = map(tried.fit.values.atPose3, keys)
        except (EstimationError, RuntimeError):  # nothing else ties the robot there
            continue
        T = before.between(after)
        xi, J = gtsam.Pose3.Logmap(T), np.hstack([-T.inverse().AdjointMap(), np.eye(6)])
        squared = float(xi @ np.linalg.solve(J @ tried.fit.marginals.joint(keys) @ J.T, xi))
        bump = Bump(replace(stay, slip=graph.slips.get(stay.robot)), T, float(np.sqrt(max(squared, 0.0))))
        tried = replace(tried, bumped=(*found.bumped, bump))
        if tried.price < found.price:
            found = tried
    return found


def _bumps(found: Found) -> Iterator[tuple[StayPut, set[int]]]:
    """Stay-put constraints on one side of which all that was measured is rejected, with these links; most first."""
    graph = found.graph
    at: dict[int, list[tuple[int, int, bool]]] = defaultdict(list)
    for link in graph.measurements:
        if isinstance(link, RelativePose | Sighting):
            for robot, stance in link.ends:
                if robot in graph.robots:
                    at[graph.key(robot, stance)].append((stance, id(link), id(link) in found.off))
    best: dict[int, tuple[StayPut, set[int]]] = {}
    suspected = {key for key, every in at.items() if sum(out for _, _, out in every) >= MIN_BUMP_LINKS}
    # stances of the first and the last link at a pose that was not rejected
    right = {key: [stance for stance, _, out in at[key] if not out] for key in suspected}
    ends = {key: (min(some), max(some)) for key, some in right.items() if some}
    for stay in graph.stay_puts:
        key = graph.key(stay.robot, stay.after)
        if stay.slip is not None or key not in ends:
            continue
        first, last = ends[key]
        for is_rejected, earlier in ((stay.after <= first, True), (stay.after > last, False)):
            if is_rejected:
                links = {number for stance, number, _ in at[key] if (stance < stay.after) == earlier}
                if len(links) >= max(MIN_BUMP_LINKS, len(best.get(key, (stay, ()))[1]) + 1):
                    best[key] = stay, links
    yield from sorted(best.values(), key=lambda one: -len(one[1]))
