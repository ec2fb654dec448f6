"""Nothing that a run holds, and no option, is ignored in silence."""

import json
import shutil
from concurrent.futures import ThreadPoolExecutor

import msgspec
import numpy as np
import pytest
from mrclam_folder import make

from coloc_graph.cli import main
from coloc_graph.errors import InputError
from coloc_graph.exchange.mrclam import import_mrclam
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.pipeline.contents import kind_of, unused_in
from coloc_graph.results.writer import write_result
from coloc_graph.run import Ranges, Stance, open_run

RANGES = 7


def ranges(run):
    times = np.linspace(run.stances[0].start, run.stances[-1].end, RANGES).tolist()
    return [Ranges("A", time, ("B",), np.array([1.0]), np.array([0.0])) for time in times]


@pytest.fixture(scope="module")
def both(tmp_path_factory, short, copied):
    """A run with stances and ranges."""
    path = tmp_path_factory.mktemp("both") / "both.mcap"
    return copied(short, path, more=ranges(open_run(short)))


@pytest.fixture(scope="module")
def ranging(tmp_path_factory):
    """A run of ranges."""
    folder = tmp_path_factory.mktemp("ranging")
    import_mrclam(make(folder / "data", seed=1, seconds=20.0).path, folder / "ranging.mcap")
    return folder / "ranging.mcap"


@pytest.fixture(scope="module")
def empty(tmp_path_factory, short, copied):
    """A run with neither."""
    return copied(short, tmp_path_factory.mktemp("empty") / "empty.mcap", stances=())


def test_ranges_beside_stances_are_named_with_their_count(both, short_solution, tmp_path, capsys):
    solution = solve(open_run(both))
    assert [(one.kind, one.count) for one in unused_in(solution.run)] == [("ranges", RANGES)]
    assert any(
        f"{RANGES} range records not used: the team states no [robots.ranging] of A" in warning
        for warning in solution.warnings
    )
    assert not any("not used" in warning for warning in short_solution.warnings)
    write_result(solution, tmp_path / "result")
    assert json.loads((tmp_path / "result" / "summary.json").read_text())["unused"] == {"ranges": RANGES}
    assert main(["info", str(both)]) == 0
    assert f"problem: run: {RANGES} range records not used" in capsys.readouterr().out
    # and the estimate is as without them
    for robot, one in short_solution.estimate.trajectories.items():
        np.testing.assert_array_equal(solution.estimate.trajectories[robot].T_world_body, one.T_world_body)


def test_odometry_that_a_method_or_a_team_cannot_use_is_named(short, tmp_path, copied):
    run = open_run(short)
    (unused,) = unused_in(run, SolveOptions("chain"))
    assert unused.kind == "odometry" and unused.count == sum(run.topics[f"/{name}/odometry"] for name in "ABC")
    assert "odometry samples not used" in str(unused)
    assert not unused_in(run, SolveOptions("smooth"))


def test_tolerances_that_only_a_joint_estimate_uses_are_named(short, tmp_path, copied):
    team = open_run(short).team
    robots = tuple(
        msgspec.structs.replace(one, mount_if_any=msgspec.structs.replace(one.mount, yaw_sigma_deg=1.0))
        if one.name in "AB" else one
        for one in team.robots
    )  # fmt: skip
    run = open_run(copied(short, tmp_path / "yaw.mcap", team=msgspec.structs.replace(team, robots=robots)))
    (unused,) = unused_in(run, SolveOptions("smooth"))
    assert str(unused) == (
        "tolerances of yaw and position of the camera of A and B not used: `smooth` takes them as exact; use `joint`"
    )
    assert not unused_in(run)


def test_stances_of_one_observer_do_not_hide_ranges(ranging, tmp_path, copied):
    run = open_run(ranging)
    stance = Stance(0, run.start, run.start + 1, ("R1",), ("R2",))
    records = [one for robot in run.team.names for one in run.ranges(robot)]
    path = copied(ranging, tmp_path / "run.mcap", stances=[stance], more=records)
    assert kind_of(open_run(path)) == "ranges"
    assert [str(one) for one in unused_in(open_run(path))] == [
        "1 stance not used: fewer than two robots observe in each"
    ]


def test_a_run_with_nothing_to_solve_says_what_it_holds(empty, tmp_path, capsys):
    run = open_run(empty)
    samples = sum(run.topics[f"/{name}/odometry"] for name in "ABC")
    with pytest.raises(InputError) as why:
        solve(run)
    assert "no stances and no ranges (only " in str(why.value) and f"and {samples} odometry samples)" in str(why.value)
    words = str(why.value).removeprefix(f"{empty}: ")
    assert main(["solve", str(empty), "--out", str(tmp_path / "result")]) == 2
    assert words in capsys.readouterr().err
    assert main(["info", str(empty)]) == 0
    assert words in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "which"),
    [
        (["--scale", "span"], "ranging"),
        (["--scale", "heights"], "ranging"),
        (["--method", "joint"], "ranging"),
        (["--without-odometry"], "ranging"),
        (["--without-robots"], "both"),
    ],
)
def test_options_that_do_not_apply_are_refused(options, which, request, tmp_path, capsys):
    path = request.getfixturevalue(which)
    assert main(["solve", str(path), "--out", str(tmp_path / "result"), *options]) == 2
    error = capsys.readouterr().err
    assert f"({options[0]}) does not apply" in error and len(error.splitlines()) == 1
    assert not (tmp_path / "result").exists()


def test_each_run_in_a_folder_is_solved_by_what_it_holds(ranging, both, short, empty, tmp_path, capsys, monkeypatch):
    # processes are started in tests/results/test_many_runs.py
    monkeypatch.setattr("coloc_graph.results.executors.workers", lambda *_: ThreadPoolExecutor(1))
    folder = tmp_path / "runs"
    folder.mkdir()
    for path in (ranging, both, short, empty):
        shutil.copy(path, folder)
    (folder / "broken.mcap").write_bytes(short.read_bytes()[:2000])
    words = ["solve", str(folder), "--out", str(tmp_path / "results"), "--processes", "1", "--json"]
    assert main(words) == 1
    told = {one["run"].rsplit("/", 1)[1]: one for one in json.loads(capsys.readouterr().out)}
    assert {name: one["state"] for name, one in told.items()} == {
        "both.mcap": "solved", "broken.mcap": "failed", "empty.mcap": "failed", "ranging.mcap": "solved",
        "short.mcap": "solved",
    }  # fmt: skip
    assert told["both.mcap"]["summary"]["unused"] == {"ranges": RANGES}
    assert told["ranging.mcap"]["summary"]["unused"] == {}
    assert "no stances and no ranges" in told["empty.mcap"]["why"] and "broken.mcap" in told["broken.mcap"]["why"]
    assert main(words) == 1  # and those that were solved are there already
    again = {one["run"].rsplit("/", 1)[1]: one["state"] for one in json.loads(capsys.readouterr().out)}
    assert again == {name: one["state"].replace("solved", "resumed") for name, one in told.items()}
