"""A folder of runs: each solved by itself, resumed, and whatever one of them does to its process."""

import io
import json
import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path

import pytest
from killed_runs import kills_its_process

from coloc_graph.cli import main
from coloc_graph.errors import InputError
from coloc_graph.pipeline.batch import SolveOptions
from coloc_graph.results import many_runs
from coloc_graph.results.executors import workers
from coloc_graph.results.many_runs import result_folders, runs_in, solve_runs
from coloc_graph.run import open_run

SUPPORT = Path(__file__).parents[1] / "support"


@pytest.fixture(scope="module")
def runs(tmp_path_factory, short, copied):
    """Two runs, and one that is none."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "deep").mkdir(parents=True)
    stances = open_run(short).stances
    copied(short, folder / "a.mcap", stances=stances[:1])
    copied(short, folder / "deep" / "b.mcap", stances=stances[1:2])
    (folder / "bad.mcap").write_bytes(Path(short).read_bytes()[:2000])
    return folder


@pytest.fixture
def folder(runs, tmp_path):
    """A copy of these, to be spoiled."""
    return Path(shutil.copytree(runs, tmp_path / "runs"))


def solved(folder, out, executors, options=None):
    runs = runs_in(folder)
    heard = []
    outcomes = solve_runs(
        runs, result_folders(runs, folder, out), options, executors=executors, on_outcome=heard.append
    )
    assert [one.run for one in outcomes] == runs
    assert sorted(heard, key=lambda one: one.run) == sorted(outcomes, key=lambda one: one.run)
    return {one.run.stem: one for one in outcomes}


@pytest.fixture(scope="module")
def command(runs, tmp_path_factory):
    """The folder solved by the command, on two processes: its exit code, folder of results and stdout."""
    out, printed = tmp_path_factory.mktemp("solved") / "out", io.StringIO()
    with redirect_stdout(printed), redirect_stderr(io.StringIO()):
        code = main(["solve", str(runs), "--out", str(out), "--processes", "2", "--json"])
    return code, out, printed.getvalue()


@pytest.fixture
def out(command, tmp_path):
    """A copy of the results, to be spoiled."""
    return Path(shutil.copytree(command[1], tmp_path / "out"))


def test_a_bad_run_ends_none_of_the_others(command):
    code, out, printed = command
    assert code == 1 and [row["state"] for row in json.loads(printed)] == ["solved", "failed", "solved"]
    a, bad, _ = json.loads(printed)
    assert a["summary"]["stances"] and "bad.mcap" in bad["why"] and not (out / "bad").exists()
    assert (out / "deep" / "b" / "summary.json").is_file()


def test_results_that_are_there_stay_unless_options_or_runs_are_others(command, folder, out):
    one = partial(ThreadPoolExecutor, 1)
    again = solved(folder, out, one)
    assert {name: one.resumed for name, one in again.items()} == {"a": True, "bad": False, "b": True}
    assert again["a"].summary == json.loads(command[2])[0]["summary"]
    # other options, another run, or a later one are solved anew
    (folder / "bad.mcap").unlink()
    shutil.rmtree(folder / "deep")
    assert not solved(folder, out, one, SolveOptions(odometry=False))["a"].resumed
    assert solved(folder, out, one, SolveOptions(odometry=False))["a"].resumed
    shutil.copy(folder / "a.mcap", folder / "later.mcap")
    shutil.move(folder / "later.mcap", folder / "a.mcap")
    assert not solved(folder, out, one, SolveOptions(odometry=False))["a"].resumed


def test_a_run_that_kills_its_process_is_tried_again_and_then_given_up(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(many_runs, "solve_one", kills_its_process)
    monkeypatch.setenv("PYTHONPATH", f"{SUPPORT}:{os.environ.get('PYTHONPATH', '')}")
    shutil.move(folder / "deep" / "b.mcap", folder / "always.mcap")
    found = solved(folder, tmp_path / "out", partial(workers, 1))
    assert not found["a"].failed and "the process that solved it ended" in found["always"].failed
    assert (tmp_path / "out" / "killed").exists()


def test_a_cluster_goes_on_when_a_worker_is_killed(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(many_runs, "solve_one", kills_its_process)
    monkeypatch.setenv("PYTHONPATH", f"{SUPPORT}:{os.environ.get('PYTHONPATH', '')}")
    from distributed import LocalCluster

    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address="127.0.0.1:0", host="127.0.0.1") as cluster:
        found = solved(folder, tmp_path / "out", partial(workers, cluster=cluster.scheduler_address))
    assert not found["a"].failed and not found["b"].failed and found["bad"].failed
    assert (tmp_path / "out" / "killed").exists()


def test_the_command_prints_a_table_and_says_which_failed(folder, out, capsys):
    shutil.copytree(out / "a", out / "bad")  # the result of another run, which stays where --force is not given
    assert main(["solve", str(folder), "--out", str(out), "--processes", "1"]) == 1
    printed = capsys.readouterr()
    assert "3 runs: 0 solved, 2 solved before, 1 failed" in printed.out
    rows = {line.split()[0]: line.split()[1:] for line in printed.out.splitlines()}
    assert rows["a.mcap"][0] == "1" and rows["bad.mcap"] == ["failed"]
    assert str(out / "bad") in printed.err and f"{folder / 'a.mcap'}: solved before" in printed.err


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--view"], "--view shows one run"),
        (["--processes", "0"], "give at least 1"),
        (["--cluster", "tcp://127.0.0.1:1"], "no Dask scheduler at tcp://127.0.0.1:1"),
    ],
)
def test_what_a_folder_cannot_have_is_one_sentence(folder, tmp_path, capsys, monkeypatch, more, words):
    monkeypatch.setattr("coloc_graph.results.executors.CONNECT_TIMEOUT", 0.5)
    assert main(["solve", str(folder), "--out", str(tmp_path / "out"), *more]) == 2
    assert words in capsys.readouterr().err


def test_no_result_lies_in_another(folder, tmp_path, capsys):
    (folder / "a").mkdir()
    shutil.copy(folder / "a.mcap", folder / "a" / "c.mcap")
    assert main(["solve", str(folder), "--out", str(tmp_path / "out")]) == 2
    assert "its result would lie in that of" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_a_run_that_has_become_bad_leaves_its_earlier_result_and_says_so(folder, out):
    (folder / "a.mcap").write_bytes((folder / "bad.mcap").read_bytes())
    again = solved(folder, out, partial(ThreadPoolExecutor, 1))["a"]
    assert "still holds an earlier result" in again.failed and (out / "a" / "summary.json").is_file()


def test_an_empty_folder_and_processes_for_one_run_are_one_sentence(tmp_path, short, capsys):
    with pytest.raises(InputError, match=r"holds no run \(.mcap\)"):
        runs_in(tmp_path)
    assert main(["solve", str(short), "--out", str(tmp_path / "out"), "--processes", "2"]) == 2
    assert "is not a folder of runs" in capsys.readouterr().err
