"""Scene of a pose graph of any program: its vertices as poses of one robot a chain, its edges as links."""

from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.exchange.g2o import G2oGraph, read_g2o
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.measurements import Node
from coloc_graph.pipeline.pose_graph import solve_pose_graph
from coloc_graph.results.pose_graph import KIND, read_pose_graph_summary
from coloc_graph.run import Stance
from coloc_graph.viewer.links import links_of
from coloc_graph.viewer.scene import Layer, Scene, layer_of

SUFFIX = ".g2o"
AS_STATED = "as in the file"
OPTIMUM = "optimum"


def is_pose_graph(path: str | Path) -> bool:
    """Return whether a path is a pose graph, or the folder of the result of one."""
    path = Path(path)
    return path.suffix.lower() == SUFFIX or (path.is_dir() and read_pose_graph_summary(path).get("kind") == KIND)


def scene_of_pose_graph(path: str | Path) -> Scene:
    """Return the scene of a pose graph, solved with projected information, or of the result of one.

    Raises `InputError` where it is no pose graph, and as `solve_pose_graph` does.
    """
    path, notes = Path(path), []
    if path.is_dir():
        graph = read_g2o(path / "graph.g2o", lenient=True)
        layers = {OPTIMUM: graph.values}
        stated = Path(str(read_pose_graph_summary(path).get("graph")))
        try:
            before = read_g2o(stated, lenient=True).values
            if set(before.keys()) == set(graph.values.keys()):
                layers[AS_STATED] = before
        except InputError as error:
            notes.append(f"the poses before are not shown: {error}")
    else:
        solution = solve_pose_graph(path, lenient=True)
        graph, layers = solution.graph, {OPTIMUM: solution.values, AS_STATED: solution.graph.values}
    changed = graph.projected + graph.left_out
    if changed:
        notes.append(f"the information of {changed} edges is not positive definite; see `coloc solve --lenient`")
    nodes = _nodes(graph)
    robots = tuple(dict.fromkeys(robot for robot, _ in nodes.values()))
    stances = tuple(Stance(k, float(k), k + 1.0, (), robots) for k in range(1 + max(n for _, n in nodes.values())))
    ends = [(nodes[a], nodes[b]) for a, b in graph.ends]
    consecutive = {(a, b) for a, b in ends if a[0] == b[0] and abs(a[1] - b[1]) == 1}
    planar = graph.planar
    return Scene(
        robots=robots,
        stances=stances,
        layers=tuple(_layer(name, robots, stances, nodes, one, planar=planar) for name, one in layers.items()),
        sightings=links_of((one for one in ends if one not in consecutive), robots, stances),
        odometry=links_of(consecutive, robots, stances),
        title=path.absolute().name,
        notes=tuple(notes),
    )


def _nodes(graph: G2oGraph) -> dict[int, Node]:
    """A robot's name and a number for each vertex: as our own files name them, by GTSAM's symbols, or all in a row."""
    keys = sorted(graph.values.keys())
    of: dict[str, list[int]] = defaultdict(list)
    for key in keys:
        letter = chr(gtsam.symbolChr(key))
        named = graph.names.get(key)
        of[named[0][0] if named else letter if letter.isalpha() and letter.isascii() else "x"].append(key)
    return {key: (robot, number) for robot, own in of.items() for number, key in enumerate(own)}


def _layer(
    name: str,
    robots: tuple[str, ...],
    stances: tuple[Stance, ...],
    nodes: Mapping[int, Node],
    values: gtsam.Values,
    *,
    planar: bool,
) -> Layer:
    keys: dict[str, list[int]] = defaultdict(list)
    for key, (robot, _) in nodes.items():
        keys[robot].append(key)
    trajectories = {
        robot: Trajectory(
            robot,
            np.arange(len(own), dtype=float),
            np.array([_matrix(values, key, planar=planar) for key in own]),
            np.arange(len(own)),
        )
        for robot, own in keys.items()
    }
    return layer_of(name, robots, stances, trajectories)


def _matrix(values: gtsam.Values, key: int, *, planar: bool) -> NDArray[np.float64]:
    if planar:
        pose = values.atPose2(key)
        return floor_pose(pose.x(), pose.y(), pose.theta())
    return np.asarray(values.atPose3(key).matrix())
