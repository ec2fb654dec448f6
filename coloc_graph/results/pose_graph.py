"""Result of a pose graph on disk: graph.g2o with the poses at the optimum, and summary.json."""

import json
from pathlib import Path
from typing import Any

import gtsam

from coloc_graph._version import __version__
from coloc_graph.geometry.lie import quaternion
from coloc_graph.input_file import read_json, read_text
from coloc_graph.pipeline.pose_graph import PoseGraphSolution
from coloc_graph.results.folder import SUMMARY, atomic_result

KIND = "pose graph"  # `kind` in summary.json, which results of runs do not have


def write_pose_graph_result(solution: PoseGraphSolution, out: str | Path) -> None:
    """Write a solved pose graph to the folder `out`; an earlier result there is replaced.

    Lines of graph.g2o other than vertices are copied from the file that was solved.
    """
    with atomic_result(out) as part:
        (part / "trajectories").rmdir()
        (part / "graph.g2o").write_text(_solved_text(solution), encoding="utf-8")
        (part / SUMMARY).write_text(json.dumps(summarise_pose_graph(solution), indent=2) + "\n", encoding="utf-8")


def read_pose_graph_summary(out: str | Path) -> dict[str, Any]:
    """Return the fields of summary.json in a folder, `kind` being `KIND` of a pose graph; {} where there is none."""
    path = Path(out) / SUMMARY
    found = read_json(path, "solve the graph again") if path.is_file() else {}
    return found if isinstance(found, dict) else {}


def summarise_pose_graph(solution: PoseGraphSolution) -> dict[str, Any]:
    """Return the content of summary.json."""
    graph = solution.graph
    return {
        "version": __version__,
        "kind": KIND,
        "graph": str(solution.path),
        "dimensions": 2 if graph.planar else 3,
        "poses": graph.values.size(),
        "edges": graph.factors.size() - len(graph.fixed),
        "fixed": list(graph.fixed),
        "projected": graph.projected,
        "left_out": graph.left_out,
        "chi2_before": solution.chi2_before,
        "chi2": solution.chi2,
        "dof": solution.dof,
        "iterations": solution.iterations,
        "seconds": round(solution.seconds, 3),
    }


def _solved_text(solution: PoseGraphSolution) -> str:
    values, planar = solution.values, solution.graph.planar
    tag = "VERTEX_SE2" if planar else "VERTEX_SE3:QUAT"
    vertices = {key: f"{tag} {key} {_pose(values, key, planar=planar)}" for key in values.keys()}  # noqa: SIM118
    lines = []
    for line in read_text(solution.path, "solve it again").split("\n"):
        words = line.split()
        lines.append(vertices.pop(int(words[1])) if words and words[0] == tag else line.rstrip("\r"))
    return "\n".join([*vertices.values(), *lines]).rstrip("\n") + "\n"


def _pose(values: gtsam.Values, key: int, *, planar: bool) -> str:
    if planar:
        pose = values.atPose2(key)
        numbers = (pose.x(), pose.y(), pose.theta())
    else:
        T = values.atPose3(key).matrix()
        w, x, y, z = quaternion(T[:3, :3])
        numbers = (*T[:3, 3], x, y, z, w)
    return " ".join(repr(float(number)) for number in numbers)
