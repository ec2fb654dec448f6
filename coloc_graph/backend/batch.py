"""Batch optimisation of a graph, with a search for outliers and for bumped anchors.

`smooth` estimates poses alone, `joint` the mounts, markers and clocks of the team with them.
"""

import itertools
from dataclasses import replace

import gtsam

from coloc_graph.backend.blame import TESTED, Fault, WarmStart, bumps_of, find_faults, moved
from coloc_graph.backend.chi2_test import REJECTION_P_VALUE
from coloc_graph.backend.estimate import Estimate, Rejection, make_estimate
from coloc_graph.backend.factors import Method, require_robot_models
from coloc_graph.backend.graph import Link, PoseGraph, StayPut
from coloc_graph.backend.optimize import ALL_TESTED, Fit, fit_graph
from coloc_graph.backend.outliers import Found, find_outliers, gnc_outliers, parallel_outliers
from coloc_graph.backend.planar import optimise_keyframes
from coloc_graph.backend.ranging import KeyframeGraph
from coloc_graph.backend.solver import with_stack

MIN_FIT_P_VALUE = 1e-4  # probability of a fit as bad as this by noise below which outliers are searched for
CHI2_PER_DOF_OF_MODEL = 1.1  # chi2/dof up to which a fit passes in any case: no model is better than that
MANY_OUTLIERS = 12  # of a large graph, from which they are not searched for one by one


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


def joint(graph: PoseGraph | KeyframeGraph, *, reject: bool = True, start: gtsam.Values | None = None) -> Estimate:
    """Estimate the most likely poses, mounts, markers, clocks, wheels and range sensors together.

    Parameters and results are those of `smooth`; the estimate holds a `Calibration` as well. A `KeyframeGraph` needs no
    `start`, and its outliers are weighed down, not searched for.

    Raises
    ------
    EstimationError
        As `smooth`, or the graph does not know the robots' mounts (`PoseGraph.robot_models`).

    Notes
    -----
    Each homography is a factor on two poses and two mounts. The team's statements with a tolerance are priors;
    statements without a tolerance are exact.
    """
    if isinstance(graph, KeyframeGraph):
        return optimise_keyframes(graph.team, graph.keyframes)
    require_robot_models(graph.robots, graph.robot_models)
    return with_stack(len(graph.nodes), lambda: _optimised("joint", graph, reject, start))


def _optimised(method: Method, graph: PoseGraph, reject: bool, start: gtsam.Values | None) -> Estimate:
    first = parallel_outliers(graph) if reject and len(graph.links) > ALL_TESTED else {}
    if len(first) >= MANY_OUTLIERS:
        return _estimate(method, find_outliers(method, graph, first, start))
    fit = fit_graph(method, graph, start)
    suspects = _suspects(fit) if reject else None
    if suspects is None:
        return _estimate(method, Found(graph, {}, fit))
    large = len(graph.links) > ALL_TESTED
    if large and not suspects:
        first = gnc_outliers(graph, fit if method == "smooth" else None)
        if len(first) >= MANY_OUTLIERS:
            del fit
            return _estimate(method, find_outliers(method, graph, first, None))  # that many bend all of it
        suspects = tuple(first.values())
    warm = WarmStart(graph, fit.values, suspects) if large and suspects else None
    del fit  # of a large graph it holds gigabytes
    faults, freed, explained = find_faults(method, graph, warm)
    if explained:
        rejected = tuple(one for fault in faults for one in fault.rejections())
        without = freed.without(one.measurement for one in rejected)
        fit = fit_graph(method, without, warm.start(without) if warm else None)
        return _estimate(method, Found(freed, {}, fit, bumps_of(faults, graph)), rejected)
    # many are wrong: which anchors moved is known of those that explain more than any measurement
    bumped = bumps_of(tuple(itertools.takewhile(lambda one: one.cause.is_bump, faults)), graph)
    for bump in bumped:
        graph = moved(graph, bump.stay_put)
    found = find_outliers(method, graph, first if large else gnc_outliers(graph), warm.start(graph) if warm else None)
    return _estimate(method, replace(found, bumped=(*bumped, *found.bumped)))


def _estimate(method: Method, found: Found, rejected: tuple[Rejection, ...] | None = None) -> Estimate:
    """Return the estimate of a search, with its own rejections or those that are given."""
    fit = found.fit
    return make_estimate(
        method,
        found.graph,
        fit.values,
        fit.marginals.covariances(),
        variables=fit.factors_of.variables,
        chi2=fit.chi2,
        dof=fit.dof,
        iterations=fit.iterations,
        rejected=found.rejected if rejected is None else rejected,
        bumped=found.bumped,
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


def faults_of(method: Method, graph: PoseGraph) -> tuple[Fault, ...]:
    """Find what explains that a graph contradicts itself, the most significant first."""
    return with_stack(len(graph.nodes), lambda: find_faults(method, graph, None)[0])
