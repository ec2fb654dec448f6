"""Write pose graphs in the g2o format; `g2o` reads them.

VERTEX_SE3:QUAT and EDGE_SE3:QUAT with the upper triangle of the information, translation first. Ids are plain integers,
0 for the first pose of the reference; numbers are read back bit for bit. g2o cannot express stay-puts: stances that
share a pose share a vertex, and a comment says so, which `read_g2o` understands. Landmarks and the map are ordinary
vertices, named in comments. Nor can it express floors and mounts: see `relative_edges`.

Source: g2o's file format, https://github.com/RainerKuemmerle/g2o/wiki/File-Format
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend import Estimate
from coloc_graph.backend.landmarks import MAP
from coloc_graph.errors import EstimationError
from coloc_graph.exchange.g2o import TRANSLATION_FIRST
from coloc_graph.exchange.relative_edges import relative_edges
from coloc_graph.geometry.lie import quaternion
from coloc_graph.measurements import Range

Array = NDArray[np.float64]


def write_g2o(estimate: Estimate, path: Path) -> None:
    """Write the poses of an estimate, and the measurements between them that it uses."""
    graph = estimate.graph
    # a stock solver's script puts its prior on the first
    poses: dict[int, Array] = {graph.reference_key: np.eye(4)}
    names: dict[int, list[str]] = {graph.reference_key: []}
    for robot, trajectory in estimate.trajectories.items():
        assert trajectory.stances is not None
        for stance, T in zip(trajectory.stances.tolist(), trajectory.T_world_body, strict=True):
            key = graph.key(robot, stance)
            poses[key] = T
            names.setdefault(key, []).append(f"{robot}@{stance}")
    still = {name: one for name, one in estimate.landmarks.items() if one.has_heading}
    still = still if estimate.map is None else {**still, MAP: estimate.map}
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
    if ranges := sum(isinstance(one, Range) for one in graph.measurements):
        lines.append(f"# left out: {ranges} ranges, which a pose graph cannot express; the poses are those with them")
    try:
        edges = relative_edges(estimate)
    except EstimationError as why:
        edges = relative_edges(estimate, shifted=False)
        lines.append(f"# the optimum of these edges is not the estimate: {why}")
    for edge in edges:
        information = edge.information[np.ix_(TRANSLATION_FIRST, TRANSLATION_FIRST)]
        upper = " ".join(repr(float(x)) for x in information[np.triu_indices(6)])
        lines.append(f"EDGE_SE3:QUAT {ids[edge.i]} {ids[edge.j]} {_pose(edge.T_i_j.matrix())} {upper}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _pose(T: Array) -> str:
    w, x, y, z = quaternion(T[:3, :3])
    return " ".join(repr(float(number)) for number in (*T[:3, 3], x, y, z, w))
