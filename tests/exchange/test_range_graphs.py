"""PyFG and JRL: read and written, one into the other, with all ranges; what is wrong in them is one sentence."""

import json
from pathlib import Path

import gtsam
import numpy as np
import pytest

from coloc_graph.cli import main
from coloc_graph.errors import InputError
from coloc_graph.exchange.jrl import read_jrl, write_jrl
from coloc_graph.exchange.pyfg import read_pyfg, write_pyfg
from coloc_graph.exchange.range_graph import RangeValue, factors_of, key_of, values_of
from coloc_graph.exchange.range_graph_files import letters_of, read_range_graph

PLANAR = """\
VERTEX_SE2 1248362857.7 A0 1.25 3.0 -1.5
VERTEX_SE2 1248362857.9 A1 1.5 3.25 -1.25
VERTEX_SE2 1248362857.7 B3 0.0 0.0 0.5
VERTEX_XY L8 2.0 1.0
VERTEX_SE2:PRIOR 1248362857.7 A0 1.25 3.0 -1.5 0.01 0.0 0.0 0.01 0.0 0.001
EDGE_SE2 1248362857.9 A0 A1 0.25 0.125 0.25 0.0004 0.0001 -0.0 0.0005 -0.0 0.0001
EDGE_SE2_XY 1248362857.9 A1 L8 1.0 -2.0 0.25 0.125 0.5
EDGE_RANGE 1248362857.7 A0 B3 3.5 0.0073
EDGE_RANGE 1248362857.9 A1 L8 2.25 0.0073
"""
SOLID = """\
VERTEX_SE3:QUAT 1.0 A0 0.0 0.0 0.0 0.0 0.0 0.0 1.0
VERTEX_SE3:QUAT 2.0 A1 1.0 0.0 0.5 0.0 0.0 0.6 0.8
VERTEX_XYZ L0 1.0 2.0 3.0
EDGE_SE3:QUAT 2.0 A0 A1 1.0 0.0 0.5 0.0 0.0 0.6 0.8 1.0 0 0 0 0 0.5 2.0 0 0 0 0 3.0 0 0 0 4.0 0 0 5.0 0 6.0
EDGE_SE3_XYZ 2.0 A1 L0 0.5 1.5 2.5 0.25 0.0 0.0 0.25 0.0 0.25
EDGE_RANGE 2.0 A0 L0 3.75 0.01
"""


@pytest.mark.parametrize("text", [PLANAR, SOLID], ids=["planar", "solid"])
def test_a_graph_goes_through_both_formats_and_keeps_every_factor(tmp_path, text):
    (tmp_path / "a.pyfg").write_text(text)
    graph = read_pyfg(tmp_path / "a.pyfg")
    values, factors = values_of(graph.truth), factors_of(graph)
    write_pyfg(graph, tmp_path / "b.pyfg")
    write_jrl(graph, tmp_path / "a.jrl")
    for again in (read_pyfg(tmp_path / "b.pyfg"), read_jrl(tmp_path / "a.jrl")):
        assert set(again.names) == set(graph.names) and again.planar == graph.planar
        assert [vars(one) for one in again.ranges] == [vars(one) for one in graph.ranges]
        assert values_of(again.truth).equals(values, 1e-12)
        assert factors_of(again).size() == factors.size()
        assert factors_of(again).error(values) == pytest.approx(factors.error(values), rel=1e-12)
        if graph.planar:  # JRL states times of measurements only
            assert again.times == pytest.approx(graph.times, abs=1e-6)


def test_pyfg_is_what_its_fields_say(tmp_path):
    (tmp_path / "a.pyfg").write_text(SOLID)
    graph = read_pyfg(tmp_path / "a.pyfg")
    edge, seen = graph.relatives
    assert np.diag(edge.covariance).tolist() == [4, 5, 6, 1, 2, 3]  # rotation first, as GTSAM has it
    assert edge.covariance[3, 2] == edge.covariance[2, 3] == 0.5  # x with the rotation about z
    assert edge.value.equals(gtsam.Pose3(gtsam.Rot3(0.8, 0, 0, 0.6), [1, 0, 0.5]), 1e-12)
    assert seen.value.tolist() == [0.5, 1.5, 2.5] and seen.second == "L0"
    assert graph.ranges == graph.ranges and vars(graph.ranges[0]) == vars(RangeValue(2.0, "A0", "L0", 3.75, 0.01))


def test_jrl_is_written_as_its_own_parser_reads_it(tmp_path):
    """The fields of jrl's C++ parser: codes of characters, scalars in objects, keys of GTSAM, nanoseconds."""
    (tmp_path / "a.pyfg").write_text(PLANAR)
    write_jrl(read_pyfg(tmp_path / "a.pyfg"), tmp_path / "a.jrl", "test")
    dataset = json.loads((tmp_path / "a.jrl").read_text())
    assert dataset["name"] == "test" and dataset["robots"] == [ord("A"), ord("B")]
    first, second = dataset["measurements"]["A"]
    assert (first["stamp"], second["stamp"]) == (1248362857700000000, 1248362857900000000)
    assert [one["type"] for one in first["measurements"]] == ["PriorFactorPose2", "RangeFactorPose2"]
    assert [one["type"] for one in second["measurements"]] == [
        "BetweenFactorPose2", "BearingRangeFactor2D", "RangeFactor2D",
    ]  # fmt: skip
    landmark = second["measurements"][2]
    assert landmark["key2"] == gtsam.symbol("L", 1_000_000_008) and landmark["measurement"]["value"] == 2.25
    bearing = second["measurements"][1]
    assert bearing["measurement"]["bearing"]["theta"] == pytest.approx(np.arctan2(-2, 1))
    J = np.array([[2, 1], [np.sqrt(5), -2 * np.sqrt(5)]]) / 5  # of bearing and range at (1, -2)
    assert np.reshape(bearing["covariance"], (2, 2)) == pytest.approx(J @ [[0.25, 0.125], [0.125, 0.5]] @ J.T)
    assert {one["key"] for one in dataset["groundtruth"]["B"]} == {gtsam.symbol("B", 3)}


def test_times_of_a_simulated_clock_are_kept(tmp_path):
    text = PLANAR.replace("1248362857.7", "0.75").replace("1248362857.9", "1.5")
    (tmp_path / "a.pyfg").write_text(text)
    graph = read_pyfg(tmp_path / "a.pyfg")
    write_jrl(graph, tmp_path / "a.jrl")
    again = read_jrl(tmp_path / "a.jrl")
    assert again.times == graph.times and [one.time for one in again.ranges] == [0.75, 1.5]
    stamps = [one["stamp"] for one in json.loads((tmp_path / "a.jrl").read_text())["measurements"]["A"]]
    assert stamps == [750_000_000, 1_500_000_000]  # whole numbers, as its parser asks
    (tmp_path / "a.pyfg").write_text(text.replace("1.5 A1 1.5", "-1.5 A1 1.5"))
    with pytest.raises(InputError, match="no times before 0"):
        write_jrl(read_pyfg(tmp_path / "a.pyfg"), tmp_path / "a.jrl")


def test_jrl_as_its_description_has_it_is_read(tmp_path):
    def pose(key, x):
        return {"key": key, "type": "Pose2", "x": x, "y": 0.0, "theta": 0.0}

    a0, a1, landmark = gtsam.symbol("a", 0), gtsam.symbol("a", 1), gtsam.symbol("a", 1_000_000_000)
    between = {"type": "BetweenFactorPose2", "key1": a0, "key2": a1, "measurement": pose(0, 1.0)}
    seen = {"bearing": 0.5, "range": 2.0}
    rows = [
        {**between, "covariance": np.eye(3).ravel().tolist()},
        {"type": "RangeFactor2D", "key1": a1, "key2": landmark, "measurement": 2.0, "covariance": [0.25]},
        {"type": "BearingRangeFactor2D", "key1": a1, "key2": landmark, "measurement": seen, "covariance": [1, 0, 0, 1]},
    ]
    dataset = {
        "name": "small", "robots": ["a"], "measurements": {"a": [{"stamp": 3, "measurements": rows}]},
        "initialization": {"a": [pose(a0, 0.0), pose(a1, 1.25)]}, "outlier_factors": {"a": [[0, 1]]},
    }  # fmt: skip
    (tmp_path / "a.jrl").write_text(json.dumps(dataset))
    graph = read_jrl(tmp_path / "a.jrl")
    assert not graph.truth and graph.initial["a1"].x() == 1.25 and graph.times == {"a0": 3.0, "a1": 3.0}
    assert [graph.measurements[place] for place in graph.outliers] == list(graph.ranges)
    assert graph.bearings[0].bearing == 0.5 and key_of("a1") == a1
    with pytest.raises(InputError, match="PyFG holds no bearings"):
        write_pyfg(graph, tmp_path / "a.pyfg")
    write_jrl(graph, tmp_path / "b.jrl")
    again = json.loads((tmp_path / "b.jrl").read_text())
    assert again["measurements"]["a"][0]["measurements"][1]["key2"] == landmark
    assert again["outlier_factors"] == {"a": [[0, 1]]}


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("VERTEX_SE2 0 A0 1 2", "line 3: VERTEX_SE2 has 6 entries, not 5"),
        ("VERTEX_SE2 0 A0 1 2 3", "line 3: A0 is there twice"),
        ("EDGE_RANGE 0 A0 B0 1 0.1", "B0 is measured but is no vertex"),
        ("EDGE_RANGE 0 A0 A1 -1 0.1", "line 3: the range -1.0 is below 0"),
        ("EDGE_RANGE 0 A0 A1 1 0", "line 3: the covariance is not positive definite"),
        ("EDGE_RANGE 0 A0 A0 1 1", "line 3: the measurement is from A0 to itself"),
        ("EDGE_RANGE 0 A0 one 1 1", "line 3: `one` is no name"),
        ("EDGE_RANGE 0 A0 A1 nan 1", "line 3: finite numbers"),
        ("VERTEX_XYZ L1 1 2 3", "line 3: VERTEX_XYZ mixes"),
        ("EDGE_SIM2 A0 A1", "line 3: `EDGE_SIM2` is no record of the PyFG format"),
    ],
)
def test_a_wrong_line_of_pyfg_is_one_sentence(tmp_path, line, words):
    (tmp_path / "a.pyfg").write_text(f"VERTEX_SE2 0 A0 1 2 3\nVERTEX_SE2 0 A1 1 2 3\n{line}\n")
    with pytest.raises(InputError, match=words):
        read_pyfg(tmp_path / "a.pyfg")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data.pop("measurements"), "`measurements` is missing"),
        (lambda data: data["measurements"]["A"][0]["measurements"][0].update(type="SmartFactor"), "is no measurement"),
        (lambda data: data["measurements"]["A"][0]["measurements"][1].update(covariance=[]), "0 numbers, not 1"),
        (lambda data: data["measurements"]["A"][0]["measurements"][1].update(key1=-4), "is no key of 64 bits"),
        (lambda data: data["measurements"]["A"][0]["measurements"][1].update(measurement=-2.0), "-2.0 is below 0"),
        (lambda data: data["measurements"]["A"][0].update(stamp="late"), "could not convert string to float"),
        (lambda data: data["groundtruth"]["A"][0].update(type="Point3", z=0), "two dimensions is mixed with one"),
    ],
)
def test_a_wrong_jrl_is_one_sentence(tmp_path, change, words):
    (tmp_path / "a.pyfg").write_text(PLANAR)
    write_jrl(read_pyfg(tmp_path / "a.pyfg"), tmp_path / "a.jrl")
    dataset = json.loads((tmp_path / "a.jrl").read_text())
    change(dataset)
    (tmp_path / "a.jrl").write_text(json.dumps(dataset))
    with pytest.raises(InputError, match=words) as why:
        read_jrl(tmp_path / "a.jrl")
    assert "\n" not in str(why.value)


@pytest.mark.parametrize("name", ["mrclam5a", "tiers"])
def test_real_benchmarks_fit_their_truth_as_their_noise_says(name, tmp_path):
    path = Path(__file__).parents[3] / "shared" / "data" / "range_graphs" / f"{name}.pyfg"
    if not path.exists():
        pytest.skip("the benchmark graphs are not on this machine")
    graph = read_pyfg(path)
    lines = path.read_text().splitlines()
    assert len(graph.ranges) == sum(line.startswith("EDGE_RANGE") for line in lines)
    off = [
        np.linalg.norm(graph.truth[one.first].translation() - _position(graph.truth[one.second])) - one.distance
        for one in graph.ranges
    ]
    assert np.mean(np.square(off) / [one.variance for one in graph.ranges]) == pytest.approx(1, abs=0.05)


def _position(value):
    return value.translation() if hasattr(value, "translation") else value


@pytest.mark.parametrize("form", ["pyfg", "jrl"])
def test_a_result_is_exported_with_the_optimum_of_graph_g2o(result, tmp_path, form, capsys):
    out = tmp_path / f"graph.{form}"
    assert main(["export", form, str(result), "--out", str(out)]) == 0
    assert "robots A = A, B = B, C = C" in capsys.readouterr().out
    graph = read_range_graph(out)
    values = values_of(graph.truth or graph.initial)
    factors, fixed = factors_of(graph), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    factors.add(gtsam.PriorFactorPose3(key_of("A0"), values.atPose3(key_of("A0")), fixed))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    again = gtsam.LevenbergMarquardtOptimizer(factors, values, parameters).optimize()
    off = [again.atPose3(key).range(values.atPose3(key)) for key in values.keys()]  # noqa: SIM118
    assert len(off) == 17 and max(off) < 1e-3
    assert graph.times["C0"] > 1e9 and len({one.time for one in graph.relatives}) > 7


def test_letters_are_capitals_as_long_as_there_are_some():
    """PyFactorGraph knows no other names of robots, and L are landmarks."""
    robots = ("R1", "R2", "r3", "Lena", "alpha")
    letters = letters_of(robots)
    assert letters["R1"] == "R" and set(letters.values()) <= set("ABCDEFGHIJKMNOPQRSTUVWXYZ")
    assert len(set(letters.values())) == len(robots)


def test_graphs_of_files_are_converted(tmp_path, capsys):
    (tmp_path / "a.pyfg").write_text(PLANAR)
    assert main(["export", "jrl", str(tmp_path / "a.pyfg"), "--out", str(tmp_path / "a.jrl")]) == 0
    assert "1 prior, 2 relative poses and positions, 2 ranges" in capsys.readouterr().out
    assert len(read_jrl(tmp_path / "a.jrl").ranges) == 2
    assert main(["export", "g2o", str(tmp_path / "a.pyfg"), "--out", str(tmp_path / "b")]) == 2
    assert "give the result of `coloc solve`" in capsys.readouterr().err
