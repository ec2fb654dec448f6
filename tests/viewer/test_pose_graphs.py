"""A pose graph of another program, and its result, in the viewer."""

import gtsam
import numpy as np
import pytest

from coloc_graph.cli import main
from coloc_graph.errors import EstimationError
from coloc_graph.viewer import is_pose_graph, scene_of_pose_graph

A, B = (gtsam.symbol(letter, 0) for letter in "ab")
TWO_ROBOTS = f"""VERTEX_SE2 {A} 0 0 0
VERTEX_SE2 {A + 1} 0.8 0.1 0
VERTEX_SE2 {B} 0 1.2 0
VERTEX_SE2 {B + 1} 1 1 0
EDGE_SE2 {A} {A + 1} 1 0 0 100 0 0 100 0 400
EDGE_SE2 {B} {B + 1} 1 0 0 100 0 0 100 0 400
EDGE_SE2 {A} {B} 0 1 0 100 0 0 100 0 400
EDGE_SE2 {A + 1} {B + 1} 0 1 0 100 0 0 100 0 400
"""


@pytest.fixture
def graph(tmp_path):
    """Path of a graph of two robots by GTSAM's symbols."""
    path = tmp_path / "graph.g2o"
    path.write_text(TWO_ROBOTS)
    return path


def test_a_graph_and_its_result_are_shown_alike(graph, tmp_path):
    assert main(["solve", str(graph), "--out", str(tmp_path / "result")]) == 0
    for path in (graph, tmp_path / "result"):
        assert is_pose_graph(path)
        scene = scene_of_pose_graph(path)
        assert scene.robots == ("a", "b") and len(scene) == 2
        optimum, stated = scene.layers
        np.testing.assert_allclose(optimum.xyz[:, :, :2], [[[0, 0], [1, 0]], [[0, 1], [1, 1]]], atol=1e-6)
        assert stated.xyz[0, 1].tolist() == [0.8, 0.1, 0]
        assert (len(scene.odometry), len(scene.sightings)) == (2, 2)
        assert [(one.start, one.end) for one in scene.stances] == [(0, 1), (1, 2)]
    graph.unlink()  # of the result nothing but the poses before is lost
    (layer,) = (scene := scene_of_pose_graph(tmp_path / "result")).layers
    assert layer.name == "optimum" and "the poses before are not shown" in scene.notes[0]


def test_view_writes_a_page_of_a_graph(graph, tmp_path, capsys):
    assert main(["view", str(graph), "--export", str(tmp_path / "page.html")]) == 0
    assert (tmp_path / "page.html").stat().st_size > 1e5
    assert main(["view", str(graph), "--compare", str(tmp_path)]) == 2
    assert "--compare and --run apply to results of runs" in capsys.readouterr().err


def test_a_graph_in_parts_is_refused_in_words(graph):
    graph.write_text("\n".join(TWO_ROBOTS.splitlines()[:6]))
    with pytest.raises(EstimationError, match="disconnected from vertex"):
        scene_of_pose_graph(graph)
