"""A pose graph with its estimate in the g2o format.

VERTEX_SE3:QUAT and EDGE_SE3:QUAT with the information's upper triangle, translation first (as g2o and GTSAM's
reader have it). Ids are plain integers; numbers read back to the bit. g2o has no word for a stay-put
constraint: stances that share a pose share a vertex, and a comment says so.
"""

from pathlib import Path

import gtsam
import numpy as np

from coloc_graph.backend import Estimate
from coloc_graph.lie import quaternion

_TRANSLATION_FIRST = [3, 4, 5, 0, 1, 2]


def write_g2o(estimate: Estimate, path: Path) -> None:
    """Write what was estimated, and the relative poses between it."""
    graph = estimate.graph
    poses: dict[int, gtsam.Pose3] = {}
    names: dict[int, list[str]] = {}
    for robot, trajectory in estimate.trajectories.items():
        assert trajectory.stances is not None
        for stance, T in zip(trajectory.stances.tolist(), trajectory.T_world_body, strict=True):
            key = graph.key(robot, stance)
            poses.setdefault(key, gtsam.Pose3(T))
            names.setdefault(key, []).append(f"{robot}@{stance}")
    ids = {key: number for number, key in enumerate(poses)}

    lines = []
    for key, pose in poses.items():
        lines.append(f"# {ids[key]} is {' = '.join(names[key])}")
        lines.append(f"VERTEX_SE3:QUAT {ids[key]} {_pose(pose)}")
    lines.append(f"FIX {ids[graph.reference_key]}")
    lines += [
        f"# STAY_PUT {stay.robot} {stay.before} {stay.after}"
        for stay in graph.stay_puts
        if graph.key(stay.robot, stay.after) in ids
    ]
    for measured in graph.relative_poses:
        i, j = (graph.key(robot, measured.stance) for robot in (measured.robot_i, measured.robot_j))
        if i in ids and j in ids:
            information = np.linalg.inv(measured.covariance)[np.ix_(_TRANSLATION_FIRST, _TRANSLATION_FIRST)]
            upper = " ".join(repr(float(x)) for x in information[np.triu_indices(6)])
            lines.append(f"EDGE_SE3:QUAT {ids[i]} {ids[j]} {_pose(measured.T_i_j)} {upper}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _pose(pose: gtsam.Pose3) -> str:
    w, x, y, z = quaternion(pose.rotation().matrix())
    return " ".join(repr(float(number)) for number in (*pose.translation(), x, y, z, w))
