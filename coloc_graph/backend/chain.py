"""The paper's composition (section IV): T_world_j = T_world_i * T_i_j, stance after stance."""

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.estimate import Estimate, make_estimate
from coloc_graph.backend.graph import GAUGE_SIGMA, PoseGraph

Array = NDArray[np.float64]


def chain(graph: PoseGraph) -> Estimate:
    """Compose the relative poses from the reference on, each robot by the first measurement that ties it.

    Covariances are propagated to first order. Anchors keep their pose exactly.
    """
    poses, covariances = compose(graph)
    return make_estimate("chain", graph, poses, covariances)


def compose(graph: PoseGraph) -> tuple[dict[int, gtsam.Pose3], dict[int, Array]]:
    """Poses and covariances (6, 6) by key, of all that is tied to the reference."""
    poses = {graph.reference_key: gtsam.Pose3()}
    covariances: dict[int, Array] = {graph.reference_key: GAUGE_SIGMA**2 * np.eye(6)}
    links = [(graph.key(p.robot_i, p.stance), graph.key(p.robot_j, p.stance), p) for p in graph.relative_poses]
    waiting = links
    while waiting:
        left = []
        for i, j, measured in waiting:
            if i in poses and j not in poses:
                poses[j] = poses[i].compose(measured.T_i_j)
                back = measured.T_i_j.inverse().AdjointMap()
                covariances[j] = back @ covariances[i] @ back.T + measured.covariance
            elif j in poses and i not in poses:
                T_j_i = measured.T_i_j.inverse()
                poses[i] = poses[j].compose(T_j_i)
                forth = measured.T_i_j.AdjointMap()
                covariances[i] = forth @ (covariances[j] + measured.covariance) @ forth.T
            elif i not in poses:
                left.append((i, j, measured))
        if len(left) == len(waiting):
            break
        waiting = left
    return poses, covariances
