"""The paper's composition (section IV): T_world_j = T_world_i * T_i_j, stance after stance."""

import heapq
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from coloc_graph.backend.estimate import Estimate, make_estimate
from coloc_graph.backend.factors import GAUGE_SIGMA, link_covariance
from coloc_graph.backend.graph import Link, PoseGraph, PoseLink, StayPut, pose_of
from coloc_graph.errors import EstimationError
from coloc_graph.measurements import Odometry, Range, RelativePose

Array = NDArray[np.float64]


AVOIDED = 1e9  # m^2, length added to links that are taken only where no others lead


class Step(NamedTuple):
    """One composition: the pose of key `to` from that of key `via`, by a link read forwards or backwards."""

    via: int
    to: int
    link: PoseLink
    forwards: bool


def chain(graph: PoseGraph) -> Estimate:
    """Compose the relative poses along the spanning tree of least variance from the reference.

    Parameters
    ----------
    graph : PoseGraph
        Stances and measurements; sightings and odometry are no part of the paper's chain.

    Returns
    -------
    Estimate
        Poses T_world_body with covariances (6, 6), propagated to first order. Anchors keep their pose exactly.

    Raises
    ------
    EstimationError
        No relative pose ties a robot to the reference.
    """
    composed = [link for link in graph.links if isinstance(link, RelativePose | StayPut)]
    steps = spanning_tree(graph, composed)
    poses = compose(graph, steps)
    covariances: dict[int, Array] = {graph.reference_key: GAUGE_SIGMA**2 * np.eye(6)}
    for via, to, link, forwards in steps:
        if forwards:
            back = pose_of(link).inverse().AdjointMap()
            covariances[to] = back @ covariances[via] @ back.T + link_covariance(link)
        else:
            forth = pose_of(link).AdjointMap()
            covariances[to] = forth @ (covariances[via] + link_covariance(link)) @ forth.T
    values = gtsam.Values()
    for key, pose in poses.items():
        values.insert(key, pose)
    return make_estimate("chain", graph, values, covariances)


def spanning_tree(graph: PoseGraph, links: Sequence[Link], *, odometry_last: bool = False) -> list[Step]:
    """Return the shortest paths from the reference to every pose that links tie to it, nearer poses first (Dijkstra).

    The length of a link is its variance: of the translation, and of the heading at one metre. Ranges place nothing.
    With `odometry_last` it leads only to poses that nothing else leads to.
    """
    tying = [link for link in links if not isinstance(link, Range)]
    neighbours: dict[int, list[tuple[int, int, bool]]] = defaultdict(list)
    lengths = []
    for index, link in enumerate(tying):
        i, j = graph.ends[id(link)]
        neighbours[i].append((j, index, True))
        neighbours[j].append((i, index, False))
        C = link_covariance(link)
        diagonal = C.diagonal()
        length = float(diagonal[-3:].sum() + diagonal[2] if len(C) == 6 else diagonal.sum())
        lengths.append(length + AVOIDED * (odometry_last and isinstance(link, Odometry)))
    steps: list[Step] = []
    reached: set[int] = set()
    waiting: list[tuple[float, int, int, int, bool]] = [(0.0, -1, -1, graph.reference_key, True)]
    while waiting:
        length, index, via, at, forwards = heapq.heappop(waiting)
        if at in reached:
            continue
        reached.add(at)
        if index >= 0:
            steps.append(Step(via, at, tying[index], forwards))
        for to, through, along in neighbours[at]:
            if to not in reached:
                heapq.heappush(waiting, (length + lengths[through], through, at, to, along))
    return steps


def tied_keys(graph: PoseGraph) -> set[int]:
    """Return the keys of the reference and of every pose that links other than ranges tie to it."""
    ends = np.array([graph.ends[id(one)] for one in graph.links if not isinstance(one, Range)], np.int64).reshape(-1, 2)
    keys, index = np.unique(np.append(ends, graph.reference_key), return_inverse=True)
    i, j = index[:-1].reshape(-1, 2).T
    _, part = connected_components(coo_array((np.ones(len(i)), (i, j)), (len(keys), len(keys))), directed=False)
    return set(keys[part == part[index[-1]]].tolist())


def compose(
    graph: PoseGraph,
    steps: Sequence[Step],
    project: Callable[[gtsam.Pose3], gtsam.Pose3] = lambda pose: pose,
    expected: Callable[[PoseLink], gtsam.Pose3] = pose_of,
    known: Mapping[int, gtsam.Pose3] | None = None,
) -> dict[int, gtsam.Pose3]:
    """Compose poses T_world_body, by key, from the reference along `steps`.

    Parameters
    ----------
    graph : PoseGraph
        The graph that the steps are of.
    steps : sequence of Step
        Links in the order of their composition.
    project : callable
        Applied to each composed pose, for instance to put it on the floor.
    expected : callable
        Gives the pose of a link's second end in its first; by default the measured one.
    known : mapping of int to gtsam.Pose3
        Poses that keep these values.

    Raises
    ------
    EstimationError
        There are measurements and none leads from the reference.
    """
    if graph.measurements and not steps:
        raise EstimationError(
            f"no measurement ties a robot to the reference {graph.reference} at stance {graph.stances[0].index}: "
            "measure it there together with another robot"
        )
    known = known or {}
    poses = {graph.reference_key: known.get(graph.reference_key, gtsam.Pose3())}
    for via, to, link, forwards in steps:
        if to in known:
            poses[to] = known[to]
            continue
        T_i_j = expected(link)
        poses[to] = project(poses[via].compose(T_i_j if forwards else T_i_j.inverse()))
    return poses
