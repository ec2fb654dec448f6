"""Pose graphs of other people, and ours for them: g2o in and out, dot, the export command."""

import html
import json
import shutil
import subprocess
from pathlib import Path

import gtsam
import numpy as np
import pytest
from teams import graph_of_team, team_of

from coloc_graph.backend import PoseGraph, smooth
from coloc_graph.backend.solver import optimise
from coloc_graph.cli import main
from coloc_graph.errors import InputError
from coloc_graph.exchange.dot import to_dot
from coloc_graph.exchange.g2o import read_g2o
from coloc_graph.exchange.g2o_writer import write_g2o
from coloc_graph.exchange.tum import read_tum
from coloc_graph.pipeline.pose_graph import solve_pose_graph
from coloc_graph.team import Slip

DATA = Path(__file__).parents[3] / "shared" / "data" / "pose_graphs"


@pytest.mark.parametrize("floor", [True, False])
def test_a_graph_goes_out_and_comes_back_with_its_stay_puts(tmp_path, floor):
    team = team_of(5, 8) if floor else team_of(5, 8, floor=None)
    estimate = smooth(graph_of_team(team))
    write_g2o(estimate, tmp_path / "graph.g2o")
    read = read_g2o(tmp_path / "graph.g2o")
    at = {node: key for key, nodes in read.names.items() for node in nodes}
    assert set(at) == set(estimate.graph.nodes)
    for node, key in at.items():
        assert np.abs(read.values.atPose3(key).matrix() - estimate.pose(*node).matrix()).max() < 1e-15
    assert read.stay_puts == estimate.graph.stay_puts
    for stay in read.stay_puts:
        assert at[stay.ends[0]] == at[stay.ends[1]]
    assert read.fixed == (at["A", 0],)
    assert read.factors.size() == 1 + len(estimate.graph.measurements)
    if not floor:  # whose priors g2o has no word for
        assert 2 * read.factors.error(read.values) == pytest.approx(estimate.chi2, rel=1e-6)
        values, _ = optimise(read.factors, read.values)
        for node, key in at.items():
            assert values.atPose3(key).equals(estimate.pose(*node), 1e-6)


def test_refused_measurements_are_not_written(tmp_path):
    team = team_of(6, 8, seed=1, wrong=0.1)
    estimate = smooth(graph_of_team(team))
    assert estimate.rejected
    write_g2o(estimate, tmp_path / "graph.g2o")
    edges = [line for line in (tmp_path / "graph.g2o").read_text().splitlines() if line.startswith("EDGE")]
    assert len(edges) == len(estimate.graph.measurements) - len(estimate.rejected)


V2 = "VERTEX_SE2 {} 0 0 0"
V3 = "VERTEX_SE3:QUAT {} 0 0 0 0 0 0 1"
E2 = "EDGE_SE2 {} {} 1 0 0 1 0 0 1 0 1"
E3 = "EDGE_SE3:QUAT {} {} 1 0 0 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([V2.format(0), V2.format(0)], "line 2: vertex 0 is there twice"),
        ([V3.format(0), E3.format(0, 7)], "line 2: vertex 7 is not there"),
        ([V2.format(0), "FIX 3"], "line 2: vertex 3 is not there"),
        ([V2.format(0), V3.format(1)], "mixes SE2 and SE3"),
        ([V3.format(0), V3.format(1), E2.format(0, 1)], "mixes SE2 and SE3"),
        ([V2.format(0), "VERTEX_XY 1 0 0"], "line 2: `VERTEX_XY` is not read"),
        (["VERTEX_SE2 0 0 0"], r"line 1: `VERTEX_SE2` has 3 numbers; 4"),
        (["VERTEX_SE2 0 0 0 nan"], "all finite"),
        (["VERTEX_SE2 0 0 0 zero"], "holds what is no number"),
        (["VERTEX_SE2 0.5 0 0 0"], "`0.5` is no id"),
        (["VERTEX_SE2 -1 0 0 0"], "`-1` is no id"),
        (["VERTEX_SE2 1e3 0 0 0"], "`1e3` is no id"),
        ([f"VERTEX_SE2 {2**64} 0 0 0"], "is no id; ids are whole numbers from 0 to 18446744073709551615"),
        ([f"VERTEX_SE2 {'1' * 5000} 0 0 0"], "line 1: `1111.*` is no id"),
        (["VERTEX_SE2 0 1e300 0 0"], "all finite"),
        ([V2.format(0), "FIX"], "line 2: `FIX` has no id"),
        ([V2.format(0), E2.format(0, 0)], "line 2: the edge is from vertex 0 to itself"),
        (["VERTEX_SE3:QUAT 0 0 0 0 0 0 0 2"], "not of unit length"),
        (
            [V2.format(0), V2.format(1), "EDGE_SE2 0 1 1 0 0 1 0 0 -1 0 1"],
            "3: .*not positive definite, as in 1 of 1",
        ),
        ([V2.format(0), V2.format(1), "EDGE_SE2 0 1 1 0 0 1 1 0 1 0 1"], "line 3: .*as in 1 of 1 edges.*--lenient"),
        ([], "holds no vertex and no edge"),
    ],
)
def test_a_bad_g2o_is_named_by_its_line(tmp_path, lines, words):
    path = tmp_path / "bad.g2o"
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError, match=words) as refusal:
        read_g2o(path)
    assert str(path) in str(refusal.value) and "\n" not in str(refusal.value)


def test_ids_of_64_bits_comments_marks_and_windows_line_ends_are_read(tmp_path):
    a, b = gtsam.symbol("a", 0), gtsam.symbol("b", 2**40)
    path = tmp_path / "two.g2o"
    lines = [V3.format(a) + " # the first", "  # of another program", V3.format(b), "", E3.format(a, b), f"FIX {a} {b}"]
    lines += [f"# {'9' * 5000} is A@0", f"# 1 is A@{'9' * 5000}", f"# STAY_PUT A {'9' * 5000} 1"]
    path.write_bytes(b"\xef\xbb\xbf" + "\r\n".join(lines).encode())
    read = read_g2o(path)
    assert sorted(read.values.keys()) == sorted([a, b]) and read.fixed == (a, b)
    assert read.factors.size() == 3 and not read.names and not read.stay_puts and not read.planar
    assert list(read.factors.at(2).keys()) == [a, b]


def test_numbers_and_spaces_that_json_does_not_have_are_read(tmp_path):
    path = tmp_path / "two.g2o"
    path.write_text("VERTEX_SE2\t7 +1 .5 1.\nVERTEX_SE2  8 01 2   3e0 \nEDGE_SE2 7 8\t1 0 0 1 0 0 1 0 1\n")
    read = read_g2o(path)
    assert read.ends == ((7, 8),) and read.planar
    assert [read.values.atPose2(key).x() for key in (7, 8)] == [1, 1] and read.values.atPose2(7).y() == 0.5
    path.write_text(path.read_text() + "VERTEX_SE2 9 1 2\nVERTEX_SE2 10 1 2 3 4\n")  # as many numbers as two have
    with pytest.raises(InputError, match="line 4: `VERTEX_SE2` has 3 numbers; 4"):
        read_g2o(path)


def test_lenient_projects_information_that_is_not_positive_definite_and_counts(tmp_path):
    path = tmp_path / "odd.g2o"
    negative, zero = "EDGE_SE2 0 1 1 0 0 4 0 0 -1 0 1", "EDGE_SE2 1 2 1 0 0 0 0 0 0 0 0"
    half = "EDGE_SE2 1 2 1 0 0 1 0 0 1 0 0"  # it knows nothing of the heading
    path.write_text("\n".join([*map(V2.format, range(3)), E2.format(1, 2), negative, zero, half]))
    with pytest.raises(InputError, match=r"line 5: .* as in 3 of 4 edges; correct them, or .* --lenient"):
        read_g2o(path)
    read = read_g2o(path, lenient=True)
    assert (read.projected, read.left_out, read.factors.size()) == (2, 1, 4)
    np.testing.assert_allclose(np.diag(read.factors.at(2).noiseModel().information()), [4, 4e-9, 1], rtol=1e-6)
    values, _ = optimise(read.factors, read.values)
    np.testing.assert_allclose(values.atPose2(2).translation(), [2, 0], atol=1e-6)


def test_a_g2o_that_is_not_there_is_one_sentence(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_g2o(tmp_path / "none.g2o")


def test_a_planar_graph_is_solved(tmp_path):
    path = tmp_path / "square.g2o"
    turn = f"EDGE_SE2 {{}} {{}} 1 0 {np.pi / 2} 1 0 0 1 0 1"
    near = ("0 0 0", "0.8 0.1 1.4", "1.2 0.9 3.0", "0.1 1.1 -1.5")
    edges = [turn.format(k, (k + 1) % 4) for k in range(4)]
    path.write_text("\n".join([*(f"VERTEX_SE2 {k} {at}" for k, at in enumerate(near)), *edges]))
    read = read_g2o(path)
    values, _ = optimise(read.factors, read.values)
    corners = [values.atPose2(k).translation() for k in range(4)]
    np.testing.assert_allclose(corners, [[0, 0], [1, 0], [1, 1], [0, 1]], atol=1e-6)


@pytest.mark.skipif(not DATA.is_dir(), reason="the pose graphs of others are not beside this checkout")
@pytest.mark.parametrize(("name", "solid"), [("sphere2500.g2o", True), ("input_M3500_g2o.g2o", False)])
def test_other_peoples_graphs_reach_the_error_that_gtsams_own_lm_reaches(name, solid):
    read = read_g2o(DATA / name)
    values, _ = optimise(read.factors, read.values)
    theirs, start = gtsam.readG2o(str(DATA / name), solid)
    theirs.push_back(_first(read.factors))
    error = theirs.error(gtsam.LevenbergMarquardtOptimizer(theirs, start).optimize())
    assert theirs.error(values) == pytest.approx(error, rel=1e-6)


def _first(factors):
    one = gtsam.NonlinearFactorGraph()
    one.add(factors.at(0))
    return one


def test_dot_shows_places_and_who_stayed_put():
    team = team_of(4, 6)
    slips = {"C": Slip(sigma=0.01, sigma_deg=1)}
    graph = PoseGraph("A", team.robots, team.stances, team.measurements, team.floor, slips)
    text = to_dot(graph)
    assert text.startswith("graph poses {") and text.rstrip().endswith("}")
    exact = [s for s in graph.stay_puts if s.slip is None]
    for stay in exact:
        assert f"{stay.robot}@{stay.before} = {stay.robot}@{stay.after}" in text
    assert text.count('label="stay put", style=dashed') == sum(s.slip is not None for s in graph.stay_puts) > 0
    assert text.count('label="H ') == len(graph.relative_poses)


@pytest.mark.skipif(shutil.which("dot") is None, reason="Graphviz is not installed")
def test_graphviz_draws_it():
    text = to_dot(graph_of_team(team_of(4, 6)))
    drawn = subprocess.run(["dot", "-Tsvg"], input=text, capture_output=True, text=True, timeout=60, check=True)
    assert "B@0 = B@1" in html.unescape(drawn.stdout).replace("\xa0", " ")


def test_a_result_is_exported(result, tmp_path, capsys):
    for form in ("g2o", "dot", "tum"):
        assert main(["export", form, str(result), "--out", str(tmp_path / form)]) == 0
    assert read_g2o(tmp_path / "g2o").values.size() == 17
    assert "graph poses {" in (tmp_path / "dot").read_text()
    assert len(read_tum(tmp_path / "tum" / "C.tum")) == 8
    capsys.readouterr()
    assert main(["export", "g2o", str(result), "--out", str(tmp_path / "g2o")]) == 2
    assert "exists; replace it with --force" in capsys.readouterr().err
    assert main(["export", "g2o", str(tmp_path), "--out", str(tmp_path / "x")]) == 2
    assert "is not a result" in capsys.readouterr().err


def test_solve_incrementally_says_what_a_stance_costs(short, short_result, tmp_path, capsys):
    assert main(["solve", str(short), "--out", str(tmp_path / "a"), "--incremental"]) == 0
    assert "update time for a stance" in capsys.readouterr().out
    a, b = (read_tum(way / "trajectories" / "B.tum") for way in (tmp_path / "a", short_result))
    # incrementally the noise is learnt from the stances that came before
    np.testing.assert_allclose(a.T_world_body, b.T_world_body, atol=3e-4)
    assert main(["solve", str(short), "--out", str(tmp_path / "c"), "--incremental", "--method", "chain"]) == 2
    assert "cannot be incremental" in capsys.readouterr().err


def square(corners, edges):
    """A unit square as a planar graph; each edge turns by 90 degrees."""
    turn = f"EDGE_SE2 {{}} {{}} 1 0 {np.pi / 2} 1 0 0 1 0 1"
    near = ("0 0 0", "0.8 0.1 1.4", "1.2 0.9 3.0", "0.1 1.1 -1.5")
    ids = [gtsam.symbol("a", k) for k in range(corners)]
    vertices = [f"VERTEX_SE2 {key} {at}" for key, at in zip(ids, near, strict=False)]
    return "\n".join([*vertices, *(turn.format(ids[i], ids[j]) for i, j in edges)])


def test_solve_writes_the_optimum_of_a_pose_graph(tmp_path, capsys):
    path, out = tmp_path / "square.g2o", tmp_path / "result"
    path.write_text(square(4, [(0, 1), (1, 2), (2, 3), (3, 0)]).replace("\n", "\r\n"), newline="")
    assert main(["solve", str(path), "--out", str(out)]) == 0
    assert "4 poses in 2D, 4 edges: chi2 " in capsys.readouterr().out
    solved = read_g2o(out / "graph.g2o")
    corners = [solved.values.atPose2(gtsam.symbol("a", k)).translation() for k in range(4)]
    np.testing.assert_allclose(corners, [[0, 0], [1, 0], [1, 1], [0, 1]], atol=1e-6)
    assert main(["solve", str(path), "--out", str(out), "--json"]) == 0  # replaces it
    figures = json.loads(capsys.readouterr().out)
    assert figures["chi2"] < 1e-9 < figures["chi2_before"] and figures["dof"] == 3
    assert main(["export", "tum", str(out), "--out", str(tmp_path / "x")]) == 2
    assert "is a solved pose graph" in capsys.readouterr().err


def test_solve_of_a_pose_graph_in_3d_is_gtsams_optimum(tmp_path, capsys):
    estimate = smooth(graph_of_team(team_of(4, 6, floor=None)))
    write_g2o(estimate, tmp_path / "graph.g2o")
    assert main(["solve", str(tmp_path / "graph.g2o"), "--out", str(tmp_path / "result"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["chi2"] == pytest.approx(estimate.chi2, rel=1e-6)
    before, after = (read_g2o(one / "graph.g2o") for one in (tmp_path, tmp_path / "result"))
    assert after.names == before.names and after.stay_puts == before.stay_puts


@pytest.mark.parametrize("planar", [True, False])
def test_a_loop_is_closed_from_poses_that_are_far_off(tmp_path, planar):
    path, count, rng = tmp_path / "loop.g2o", 60, np.random.default_rng(0)
    turn = 2 * np.pi / count
    vertex = "VERTEX_SE2 {} {} {} {}" if planar else "VERTEX_SE3:QUAT {} {} {} 0 {} {} {} {}"
    information = E2[-11:] if planar else E3[-41:]
    edge = f"1 0 {turn}" if planar else f"1 0 0 0 0 {np.sin(turn / 2)} {np.cos(turn / 2)}"
    lines = []
    for k in range(count):
        q = rng.normal(size=4)
        lines.append(vertex.format(k, *rng.normal(size=2) * 20, *([3 * q[0]] if planar else q / np.linalg.norm(q))))
        kind = "EDGE_SE2" if planar else "EDGE_SE3:QUAT"
        lines.append(f"{kind} {k} {(k + 1) % count} {edge} {information}")
    path.write_text("\n".join(lines))
    assert solve_pose_graph(path).chi2 < 1e-6


def test_a_graph_without_vertices_begins_at_its_edges(tmp_path):
    path, out = tmp_path / "square.g2o", tmp_path / "result"
    whole = square(4, [(0, 1), (3, 2), (1, 2), (3, 0)]).split("\n")
    path.write_text("\n".join(line for line in whole if line.startswith("EDGE")))
    assert main(["solve", str(path), "--out", str(out)]) == 0
    solved = read_g2o(out / "graph.g2o")
    assert solved.values.size() == 4 and len(solved.ends) == 4
    path.write_text("\n".join(whole))
    np.testing.assert_allclose(solve_pose_graph(path).chi2, solve_pose_graph(out / "graph.g2o").chi2, rtol=1e-6)
    path.write_text("\n".join([*whole[4:], "FIX 3"]))
    with pytest.raises(InputError, match="vertex 3 is not there"):
        read_g2o(path)


def test_a_disconnected_graph_and_options_of_runs_are_refused(tmp_path, capsys):
    path = tmp_path / "square.g2o"
    path.write_text(square(4, [(0, 1), (2, 3)]))
    assert main(["solve", str(path), "--out", str(tmp_path / "out")]) == 2
    assert "2 of 4 vertices, as " in (said := capsys.readouterr().err) and "are disconnected from vertex" in said
    assert main(["solve", str(path), "--out", str(tmp_path / "out"), "--incremental"]) == 2
    assert "is a pose graph: --incremental applies to runs only" in capsys.readouterr().err
    odd = square(2, [(0, 1)]).replace(" 1 0 0 1 0 1", " 1 0 0 1 0 0")
    path.write_text(odd)
    assert main(["solve", str(path), "--out", str(tmp_path / "out")]) == 2
    assert "as in 1 of 1 edges" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main(["solve", str(path), "--out", str(tmp_path / "out"), "--lenient"]) == 0
    assert "1 of 1 edges is not positive definite: 1 were projected" in capsys.readouterr().err
