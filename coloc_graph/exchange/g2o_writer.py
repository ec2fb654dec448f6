"""Write pose graphs in the g2o format; `g2o` reads them.

VERTEX_SE3:QUAT and EDGE_SE3:QUAT with the information's upper triangle, translation first. Ids are plain integers;
numbers are read back bit for bit. g2o cannot express a stay-put constraint: stances that share a pose share a vertex,
and a comment says so, which `read_g2o` understands. Landmarks and the map are ordinary vertices, named in comments.
Floor priors cannot be expressed and are omitted. Components that a planar measurement leaves unknown get the
information `UNKNOWN`.

Source: g2o's file format, https://github.com/RainerKuemmerle/g2o/wiki/File-Format
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend import Estimate
from coloc_graph.backend.factors import link_covariance
from coloc_graph.backend.landmarks import MAP
from coloc_graph.exchange.g2o import TRANSLATION_FIRST
from coloc_graph.geometry.lie import quaternion

Array = NDArray[np.float64]

UNKNOWN = 1e-6  # information of an unknown component: a standard deviation of 1 km, or of 1000 rad


def write_g2o(estimate: Estimate, path: Path) -> None:
    """Write the poses of an estimate and its measurements that were not rejected."""
    graph = estimate.graph
    poses: dict[int, Array] = {}
    names: dict[int, list[str]] = {}
    for robot, trajectory in estimate.trajectories.items():
        assert trajectory.stances is not None
        for stance, T in zip(trajectory.stances.tolist(), trajectory.T_world_body, strict=True):
            key = graph.key(robot, stance)
            poses.setdefault(key, T)
            names.setdefault(key, []).append(f"{robot}@{stance}")
    still = estimate.landmarks if estimate.map is None else {**estimate.landmarks, MAP: estimate.map}
    for name, placed in still.items():
        key = graph.pose_keys.static()[name]
        poses[key], names[key] = placed.T_world_body.matrix(), ["the map" if name == MAP else f"landmark {name}"]
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
    for link in graph.without(one.measurement for one in estimate.rejected).links:
        i, j = map(graph.pose_keys.key, link.ends)
        if i in ids and j in ids:
            upper = " ".join(repr(float(x)) for x in _information(link_covariance(link))[np.triu_indices(6)])
            lines.append(f"EDGE_SE3:QUAT {ids[i]} {ids[j]} {_pose(link.T_i_j)} {upper}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _information(C: Array) -> Array:
    """Information (6, 6), translation first, of a covariance (6, 6), or (3, 3) of heading, x, y."""
    information = UNKNOWN * np.eye(6)
    known = slice(0, 6) if len(C) == 6 else slice(2, 5)
    information[known, known] = np.linalg.inv(C)
    return information[np.ix_(TRANSLATION_FIRST, TRANSLATION_FIRST)]


def _pose(T: Array) -> str:
    w, x, y, z = quaternion(T[:3, :3])
    return " ".join(repr(float(number)) for number in (*T[:3, 3], x, y, z, w))
