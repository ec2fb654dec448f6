"""Batch optimisation of a graph, with a search for outliers and for bumped anchors.

`smooth` estimates poses alone, `joint` the mounts, markers and clocks of the team with them.
"""

import itertools
from collections.abc import Mapping

import gtsam

from coloc_graph.backend.blame import (
    SEARCHED,
    SIGMAS_ALONE,
    TESTED,
    Fault,
    WarmStart,
    bumps_of,
    find_faults,
    moved,
    scale_of,
)
from coloc_graph.backend.chi2_test import REJECTION_P_VALUE, UNCHECKED, Agreement, innovation
from coloc_graph.backend.estimate import Bump, Estimate, Rejection, make_estimate, rejection_of
from coloc_graph.backend.factors import Method, require_robot_models
from coloc_graph.backend.graph import Link, PoseGraph, StayPut
from coloc_graph.backend.optimize import ALL_TESTED, Fit, fit_graph
from coloc_graph.backend.solver import robust_parameters, with_stack
from coloc_graph.errors import EstimationError
from coloc_graph.measurements import Range, RelativePose, Sighting

MIN_FIT_P_VALUE = 1e-4  # probability of a fit as bad as this by noise below which outliers are searched for
CHI2_PER_DOF_OF_MODEL = 1.1  # chi2/dof up to which a fit passes in any case: no model is better than that
REJECTION_PRICE = 30.0  # chi2 that one more outlier must explain
MAX_ROUNDS = 20  # rounds of rejecting the worst link and taking back those that then agree


def smooth(graph: PoseGraph, *, reject: bool = True, start: gtsam.Values | None = None) -> Estimate:
    """Estimate the most likely poses given all measurements, the floor and the stay-put constraints.

    Parameters
    ----------
    graph : PoseGraph
        Stances and measurements.
    reject : bool
        Reject outliers and name bumped anchors where the measurements disagree.
    start : gtsam.Values or None
        Initial values; None: composed along the spanning tree of least variance.

    Returns
    -------
    Estimate
        Poses T_world_body with covariances (6, 6), outliers and bumps.

    Raises
    ------
    EstimationError
        The optimiser did not converge, or no measurement ties anything to the reference.

    Notes
    -----
    Outliers are searched for by graduated non-convexity on the relative poses, with everything else taken as true;
    then each link is tested against the rest. A bumped anchor is taken to have moved.
    """
    return with_stack(len(graph.nodes), lambda: _optimised("smooth", graph, reject, start))


def joint(graph: PoseGraph, *, reject: bool = True, start: gtsam.Values | None = None) -> Estimate:
    """Estimate the most likely poses, mounts, markers and clocks together, given the images.

    Parameters and results are those of `smooth`; the estimate holds a `Calibration` as well.

    Raises
    ------
    EstimationError
        As `smooth`, or the graph does not know the robots' mounts (`PoseGraph.robot_models`).

    Notes
    -----
    Each homography is a factor on two poses and two mounts. The team's statements with a tolerance are priors;
    statements without a tolerance are exact.
    """
    require_robot_models(graph.robots, graph.robot_models)
    return with_stack(len(graph.nodes), lambda: _optimised("joint", graph, reject, start))


def _optimised(method: Method, graph: PoseGraph, reject: bool, start: gtsam.Values | None) -> Estimate:
    fit = fit_graph(method, graph, start)
    rejected: tuple[Rejection, ...] = ()
    bumped: tuple[Bump, ...] = ()
    suspects = _suspects(fit) if reject else None
    if suspects is not None:
        warm = WarmStart(graph, fit.values, suspects) if suspects and len(fit.links) > ALL_TESTED else None
        del fit  # of a large graph it holds gigabytes
        faults, freed, explained = find_faults(method, graph, warm)
        if explained:
            bumped, graph = bumps_of(faults, graph), freed
            rejected = tuple(one for fault in faults for one in fault.rejections())
            without = graph.without(one.measurement for one in rejected)
            fit = fit_graph(method, without, warm.start(without) if warm else None)
        else:  # many are wrong: which anchors moved is known of those that explain more than any measurement
            bumped = bumps_of(tuple(itertools.takewhile(lambda one: one.cause.is_bump, faults)), graph)
            for bump in bumped:
                graph = moved(graph, bump.stay_put)
            rejected, fit = _find_outliers(method, graph, warm)
    return make_estimate(
        method,
        graph,
        fit.values,
        fit.marginals.covariances(),
        variables=fit.factors_of.variables,
        chi2=fit.chi2,
        dof=fit.dof,
        iterations=fit.iterations,
        rejected=rejected,
        bumped=bumped,
    )


def _suspects(fit: Fit) -> tuple[Link, ...] | None:
    """Return the links that contradict the others.

    () where the fit as a whole is worse than noise explains, None where nothing is suspicious.
    """
    if fit.dof <= 0:
        return None
    if fit.p_value < MIN_FIT_P_VALUE and fit.chi2 > CHI2_PER_DOF_OF_MODEL * fit.dof:
        return ()
    tested = fit.agreements((*TESTED, StayPut))
    return tuple(fit.links[index] for index, one in tested.items() if one.p_value() < REJECTION_P_VALUE) or None


def _find_outliers(method: Method, graph: PoseGraph, warm: WarmStart | None) -> tuple[tuple[Rejection, ...], Fit]:
    """Return the outliers, and the fit without them.

    The search starts from the outliers of graduated non-convexity and, in a small graph, also from none: the set with
    fewer rejections for the same fit is the likelier cause.
    """
    start = warm.start(graph) if warm else None
    if warm is not None:
        offs, fit = _search(method, graph, {}, start)
    else:
        # poses alone for a start: GTSAM's optimiser copies its factors, which those that are Python cannot be
        ranges = [one for one in graph.measurements if isinstance(one, Range)]
        first = _outliers(fit_graph("smooth", graph.without(ranges)))
        offs, fit = _search(method, graph, first, start)
        if first and len(fit.links) <= ALL_TESTED and len(offs) > 1:
            other, other_fit = _search(method, graph, {}, start)
            if _price(other, other_fit) < _price(offs, fit):
                offs, fit = other, other_fit
    links = (*graph.measurements, *graph.on_map)
    return tuple(rejection_of(link, offs[id(link)]) for link in links if id(link) in offs), fit


def _price(rejected: Mapping[int, Agreement], fit: Fit) -> float:
    """Implausibility of a set of rejections: chi2 above its expected value, and a price for each."""
    return fit.chi2 - fit.dof + REJECTION_PRICE * len(rejected)


def _search(
    method: Method, graph: PoseGraph, suspected: dict[int, Link], start: gtsam.Values | None
) -> tuple[dict[int, Agreement], Fit]:
    """Reject the worst measurement and take back those that then agree, in turns; start from those `suspected`.

    What alone ties a pose is taken back too, up to `SIGMAS_ALONE`. Return how far off the rejected are, by identity,
    and the fit without them.
    """
    suspected, at_rejection, alone = dict(suspected), dict[int, Agreement](), set[int]()
    # ends when a set repeats, or after the last round
    for left in reversed(range(MAX_ROUNDS)):
        try:
            fit = fit_graph(method, graph.without(suspected.values()), start)
        except EstimationError:
            if not suspected:
                raise
            # without these nothing ties the robots to each other: they disagree, and it is not known which are wrong
            return {}, fit_graph(method, graph, start)
        tested = fit.agreements(SEARCHED)
        scale = scale_of(tested.values())
        kept = {index for index, off in tested.items() if id(fit.links[index]) in alone and off.sigmas < SIGMAS_ALONE}
        worst = min(tested.keys() - kept, key=lambda index: tested[index].log_p_value(), default=None)
        refusing = worst is not None and tested[worst].p_value(scale) < REJECTION_P_VALUE
        offs = {key: _innovation(fit, link) for key, link in suspected.items()}
        again = {key for key, off in offs.items() if off.dof and off.p_value(scale) >= REJECTION_P_VALUE}
        untied = [key for key, off in offs.items() if not off.dof and at_rejection.get(key, off).sigmas < SIGMAS_ALONE]
        if not left and untied:
            for key in untied:
                del suspected[key], offs[key]
            fit = fit_graph(method, graph.without(suspected.values()), start)
        if not left or not (again or untied or refusing):
            break
        if untied:  # one at a time, the last first: it was the least off, and may contradict the others
            again.add(untied[-1])
            alone.add(untied[-1])
        for key in again:
            del suspected[key]
        if worst is not None and refusing:
            suspected[id(fit.links[worst])] = fit.links[worst]
            at_rejection[id(fit.links[worst])] = tested[worst]
    return {key: off if off.dof else at_rejection[key] for key, off in offs.items()}, fit


def _outliers(fit: Fit) -> dict[int, Link]:
    """Outliers among relative poses and sightings of landmarks by graduated non-convexity, by identity.

    Everything else is taken as true.

    Source: Yang, Antonante, Tzoumas, Carlone, "Graduated Non-Convexity for Robust Spatial Perception", 2020.
    """
    first = fit.factors.size() - len(fit.links)
    landmarks = fit.graph.landmarks
    suspects = [
        index
        for index, link in enumerate(fit.links)
        if isinstance(link, RelativePose) or (isinstance(link, Sighting) and link.seen in landmarks)
    ]
    parameters = gtsam.GncLMParams(robust_parameters(fit.values.size()))
    parameters.setKnownInliers(sorted(set(range(fit.factors.size())) - {first + index for index in suspects}))
    optimiser = gtsam.GncLMOptimizer(fit.factors, fit.values, parameters)
    optimiser.setInlierCostThresholdsAtProbability(1 - 1e-4)
    optimiser.optimize()
    weights = optimiser.getWeights()
    return {id(fit.links[index]): fit.links[index] for index in suspects if weights[first + index] < 0.5}


def _innovation(fit: Fit, link: Link) -> Agreement:
    """Agreement of a link that is not in the fit; `UNCHECKED` where an end of it has no pose there."""
    i, j = map(fit.graph.pose_keys.key, link.ends)
    factor = fit.factors_of.of_link(link, i, j)
    if not all(map(fit.values.exists, factor.keys())):
        return UNCHECKED
    return innovation([factor], fit.values, fit.marginals.joint(list(factor.keys())))


def faults_of(method: Method, graph: PoseGraph) -> tuple[Fault, ...]:
    """Find what explains that a graph contradicts itself, the most significant first."""
    return with_stack(len(graph.nodes), lambda: find_faults(method, graph, None)[0])
