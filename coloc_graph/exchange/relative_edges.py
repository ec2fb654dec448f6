"""Edges of a pose graph for programs that know relative poses only: neither a floor nor calibration variables.

Each link that was used becomes an edge with a full information matrix. On a floor an edge also has what the priors of
its two ends say of their relative height, roll and pitch. A prior is shared equally by the edges of its pose, so that
all edges together say no more than the priors. Mounts and clocks have no such form: the measured poses are shifted, all
at once and by as little as possible, so that the optimum of the edges is the estimate.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend import Estimate
from coloc_graph.backend.chain import spanning_tree
from coloc_graph.backend.factors import GAUGE_SIGMA, Factors, link_covariance
from coloc_graph.backend.graph import PoseLink, StayPut
from coloc_graph.backend.solver import optimise, with_stack
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.measurements import Range, RelativePose

Array = NDArray[np.float64]

UNKNOWN = 1e-6  # information of what neither a measurement nor a floor tells: a sigma of 1 km, or of 1000 rad
UPRIGHT = [0, 1, 5]  # roll, pitch and height in GTSAM's tangent
MAX_SHIFTS = 5  # rounds of shifting measured poses; each leaves a hundredth of the distance before
SHIFTED = 1e-6  # m, rad: distance of the edges' optimum from the estimate below which nothing is shifted


@dataclass(frozen=True, eq=False)
class Edge:
    """Relative pose of two poses of the graph.

    Parameters
    ----------
    link : Link
        The measurement that it is made of.
    i, j : int
        GTSAM keys of its ends.
    T_i_j : gtsam.Pose3
        Pose of j in i.
    information : (6, 6) float
        In GTSAM's tangent at j: rotation first, then translation.
    """

    link: PoseLink
    i: int
    j: int
    T_i_j: gtsam.Pose3
    information: Array

    @property
    def factor(self) -> gtsam.BetweenFactorPose3:
        """The edge as a factor."""
        return gtsam.BetweenFactorPose3(
            self.i, self.j, self.T_i_j, gtsam.noiseModel.Gaussian.Information(self.information)
        )


def used_links(estimate: Estimate) -> tuple[PoseLink, ...]:
    """Return the links of an estimate that give poses, without ranges; of a chain those that it was composed along."""
    graph = estimate.graph.without(one.measurement for one in estimate.rejected)
    if estimate.method == "chain":
        return tuple(
            step.link
            for step in spanning_tree(graph, [one for one in graph.links if isinstance(one, RelativePose | StayPut)])
        )
    key, values = graph.pose_keys.key, estimate.values
    links = [link for link in graph.links if not isinstance(link, Range)]
    ends = [(link, key(link.ends[0]), key(link.ends[1])) for link in links]
    return tuple(link for link, i, j in ends if i != j and values.exists(i) and values.exists(j))


def relative_edges(estimate: Estimate, *, shifted: bool = True) -> tuple[Edge, ...]:
    """Return edges whose optimum, with the reference's pose given, is the estimate.

    Parameters
    ----------
    estimate : Estimate
        Of a run with stances.
    shifted : bool
        False: leave the poses as measured; the optimum is then near the estimate only.

    Returns
    -------
    tuple of Edge
        One for each link that the estimate uses.

    Raises
    ------
    EstimationError
        The optimiser did not converge on the edges.
    """
    graph, values = estimate.graph, estimate.values
    key = graph.pose_keys.key
    ends = [(link, key(link.ends[0]), key(link.ends[1])) for link in used_links(estimate)]
    count = Counter(one for _, i, j in ends for one in (i, j))
    floor = None if estimate.method == "chain" or graph.floor is None else Factors(graph.floor).gauge_sigmas[UPRIGHT]
    factors = Factors(graph.floor, estimate.calibration.variables)
    edges = []
    for link, i, j in ends:
        T_i_j, information = factors.expected(link, i, j, values.atVector), _information(link_covariance(link))
        if floor is not None:
            T_j_i = values.atPose3(j).between(values.atPose3(i))
            by_i = T_j_i.AdjointMap()[np.ix_(UPRIGHT, UPRIGHT)]
            known = np.zeros((6, 6))
            known[np.ix_(UPRIGHT, UPRIGHT)] = np.linalg.inv(
                count[j] * np.diag(floor**2) + count[i] * (by_i * floor**2) @ by_i.T
            )
            information = information + known
            flat = gtsam.Pose3(floor_pose(T_i_j.x(), T_i_j.y(), T_i_j.rotation().yaw()))
            step = np.linalg.solve(information, known @ gtsam.Pose3.Logmap(T_i_j.between(flat)))
            T_i_j = T_i_j.compose(gtsam.Pose3.Expmap(step))
        edges.append(Edge(link, i, j, T_i_j, information))
    return _shifted(edges, values, graph.reference_key) if shifted else tuple(edges)


def _information(C: Array) -> Array:
    """Return the information (6, 6) of a covariance (6, 6), or (3, 3) of heading, x, y."""
    information = UNKNOWN * np.eye(6)
    known = slice(0, 6) if len(C) == 6 else slice(2, 5)
    information[known, known] = np.linalg.inv(C)
    return (information + information.T) / 2


def _shifted(edges: Sequence[Edge], estimated: gtsam.Values, reference: int) -> tuple[Edge, ...]:
    """Return the edges with the residuals of their own optimum at the estimate."""
    poses = gtsam.Values()
    for key in dict.fromkeys([reference, *(key for edge in edges for key in (edge.i, edge.j))]):
        poses.insert(key, estimated.atPose3(key))
    fixed = gtsam.noiseModel.Isotropic.Sigma(6, GAUGE_SIGMA)
    gauge = gtsam.PriorFactorPose3(reference, poses.atPose3(reference), fixed)
    for _ in range(MAX_SHIFTS):
        factors = gtsam.NonlinearFactorGraph()
        for factor in (gauge, *(edge.factor for edge in edges)):
            factors.add(factor)
        optimum, _ = with_stack(poses.size(), partial(optimise, factors, poses))
        keys = poses.keys()
        off = [optimum.atPose3(key).matrix() - poses.atPose3(key).matrix() for key in keys]
        if np.abs(off).max() < SHIFTED:
            break
        edges = [_at(edge, poses, optimum) for edge in edges]
    return tuple(edges)


def _at(edge: Edge, poses: gtsam.Values, optimum: gtsam.Values) -> Edge:
    residual = gtsam.Pose3.Logmap(edge.T_i_j.between(_between(edge, optimum)))
    return replace(edge, T_i_j=_between(edge, poses).compose(gtsam.Pose3.Expmap(-residual)))


def _between(edge: Edge, values: gtsam.Values) -> gtsam.Pose3:
    return values.atPose3(edge.i).between(values.atPose3(edge.j))
