"""Range graphs solved from their measurements alone."""

import json

import gtsam
import numpy as np
import pytest

from coloc_graph.cli import main
from coloc_graph.errors import EstimationError, InputError
from coloc_graph.exchange.pyfg import write_pyfg
from coloc_graph.exchange.range_graph import RangeGraph, RangeValue, RelativeValue
from coloc_graph.pipeline.range_graph import solve_range_graph

SIGMA, STEP = 0.05, np.diag([1e-4, 1e-4, 1e-5])  # m of a range; of odometry


def graph_of(rng, *, poses=60, straight=False, robots="AB", landmark=True, outliers=0):
    """Robots that drive curves, and range each other and a landmark."""
    truth, relatives, ranges = {}, [], []
    starts = {"A": gtsam.Pose2(0, 0, 0.3), "B": gtsam.Pose2(2.0, -1.0, 2.0)}
    for robot in robots:
        T = starts[robot]
        for n in range(poses):
            if n:
                step = gtsam.Pose2(0.1, 0.0, 0.0 if straight else 0.15 * np.sin(n / 7 + ord(robot)))
                T = T.compose(step)
                noisy = step.retract(rng.multivariate_normal(np.zeros(3), STEP))
                relatives.append(RelativeValue(float(n), f"{robot}{n - 1}", f"{robot}{n}", noisy, STEP))
            truth[f"{robot}{n}"] = T
    if landmark:
        truth["L1"] = np.array([1.0, 2.0])
    for n in range(poses):
        pairs = [(f"{a}{n}", f"{b}{n}") for a, b in ("AB",) if b in robots]
        for i, j in [*pairs, *((f"{robot}{n}", "L1") for robot in robots if landmark)]:
            end = truth[j] if j == "L1" else truth[j].translation()
            far = float(np.linalg.norm(truth[i].translation() - end) + SIGMA * rng.standard_normal())
            ranges.append(RangeValue(float(n), i, j, far + (1.0 if len(ranges) < outliers else 0.0), SIGMA**2))
    return RangeGraph(
        True, {name: 0.0 for name in truth if name != "L1"}, truth, {}, (), tuple(relatives), tuple(ranges)
    )


def test_a_team_is_arranged_by_ranges_and_covariances_are_honest(rng, tmp_path, capsys):
    nees = []
    for n in range(4):
        write_pyfg(graph_of(rng, outliers=3), tmp_path / f"{n}.pyfg")
        found = solve_range_graph(tmp_path / f"{n}.pyfg")
        assert found.errors.position < 0.15 and found.errors.landmarks < 0.3
        assert {(one.first, one.second) for one, _ in found.rejected} >= {("A0", "B0"), ("A0", "L1"), ("B0", "L1")}
        assert len(found.rejected) < 6 and 0.6 < found.chi2 / found.dof < 1.4
        nees.append(found.errors.nees)
    assert 0.4 < np.mean(nees) < 2.0
    assert main(["solve", str(tmp_path / "0.pyfg"), "--out", str(tmp_path / "result")]) == 0
    summary = json.loads((tmp_path / "result" / "summary.json").read_text())
    assert summary["kind"] == "range graph" and len(summary["outliers"]) >= 3
    assert "NEES" in capsys.readouterr().out
    assert main(["solve", str(tmp_path / "0.pyfg"), "--out", str(tmp_path / "other"), "--incremental"]) == 2
    assert "--incremental applies to runs only" in capsys.readouterr().err


def test_truth_is_not_read(rng, tmp_path):
    graph = graph_of(rng)
    write_pyfg(graph, tmp_path / "right.pyfg")
    moved = {
        name: value if isinstance(value, np.ndarray) else gtsam.Pose2(7, 7, 1) for name, value in graph.truth.items()
    }
    write_pyfg(RangeGraph(True, graph.times, moved, {}, (), graph.relatives, graph.ranges), tmp_path / "wrong.pyfg")
    right, wrong = (solve_range_graph(tmp_path / name) for name in ("right.pyfg", "wrong.pyfg"))
    assert all(right.values[name].equals(wrong.values[name], 1e-9) for name in right.values if name != "L1")


def test_relative_poses_between_robots_tie_them(rng, tmp_path):
    graph = graph_of(rng, straight=True, landmark=False)  # by ranges alone it could be mirrored
    i, j = graph.truth["A20"], graph.truth["B30"]
    seen = RelativeValue(20.0, "B30", "A20", j.between(i).retract(np.array([0.01, -0.01, 0.005])), STEP)
    both = RangeGraph(True, graph.times, graph.truth, {}, (), (seen, *graph.relatives), graph.ranges)
    write_pyfg(both, tmp_path / "tied.pyfg")
    found = solve_range_graph(tmp_path / "tied.pyfg")
    assert found.errors.position < 0.15 and not found.rejected
    assert 0.6 < found.chi2 / found.dof < 1.4


def test_mirrored_and_floating_teams_are_diagnosed(rng, tmp_path):
    for name, graph, why in (
        (
            "mirrored",
            graph_of(rng, straight=True, landmark=False),
            "two arrangements, in which B is elsewhere, as mirrored",
        ),
        ("alone", graph_of(rng, robots="A", straight=True), "two arrangements, in which L1"),
    ):
        write_pyfg(graph, tmp_path / f"{name}.pyfg")
        with pytest.raises(EstimationError, match=why):
            solve_range_graph(tmp_path / f"{name}.pyfg")
    graph = graph_of(rng, landmark=False)
    write_pyfg(
        RangeGraph(True, graph.times, graph.truth, {}, (), graph.relatives, graph.ranges[:1]), tmp_path / "f.pyfg"
    )
    with pytest.raises(EstimationError, match="leave open where B is against A"):
        solve_range_graph(tmp_path / "f.pyfg")
    gap = tuple(one for one in graph.relatives if one.second != "B9")
    write_pyfg(RangeGraph(True, graph.times, graph.truth, {}, (), gap, graph.ranges), tmp_path / "gap.pyfg")
    with pytest.raises(InputError, match="B9, have no odometry"):
        solve_range_graph(tmp_path / "gap.pyfg")
