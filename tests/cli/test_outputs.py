"""Outputs that exist are replaced only with --force; config.toml makes the same result; -v and -q."""

import json
import logging
import shutil
import tomllib
from concurrent.futures import ThreadPoolExecutor

import pytest

from coloc_graph.cli import main, parser


@pytest.fixture
def solved(short, short_result, tmp_path):
    """A run and its result, in a folder of this test's own."""
    return shutil.copy(short, tmp_path / short.name), shutil.copytree(short_result, tmp_path / "out")


def call(capsys, *arguments):
    code = main([str(argument) for argument in arguments])
    return code, *capsys.readouterr()


def files(folder):
    """The bytes of all files of a result, without durations and paths in summary.json."""
    found = {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    summary = json.loads(found.pop("summary.json"))
    return found, {key: value for key, value in summary.items() if key not in ("seconds", "run")}


def test_config_of_a_result_makes_the_same_bytes(solved, tmp_path, capsys):
    run, _ = solved
    given = ("--method", "smooth", "--scale", "span", "--tracking", "speed=400", "--without-odometry")
    assert call(capsys, "solve", run, "--out", tmp_path / "one", *given)[0] == 0
    config = tmp_path / "one" / "config.toml"
    assert call(capsys, "solve", run, "--out", tmp_path / "two", "--config", config)[0] == 0
    assert files(tmp_path / "one") == files(tmp_path / "two")
    # what is given besides replaces it
    code, out, _ = call(
        capsys, "solve", run, "--out", tmp_path / "three", "--config", config, "--method", "chain", "--json"
    )
    assert (code, json.loads(out)["method"]) == (0, "chain")
    assert not tomllib.loads((tmp_path / "three" / "config.toml").read_text())["options"]["odometry"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: text.replace('reference = "A"', 'reference = "B"'), "states another team than"),
        (lambda text: text.replace("[options]", "[options]\nspeed = 3"), "unexpected keyword argument 'speed'"),
        (lambda text: text.replace("odometry = true", 'odometry = "no"'), "Expected `bool`, got `str`"),
        (lambda text: text.replace("[options", "[option"), "has no table [options]"),
        (lambda text: text.replace('method = "joint"', 'method = "guess"'), "there is no method `guess`"),
    ],
)
def test_a_wrong_config_is_one_sentence(solved, tmp_path, capsys, change, words):
    run, out = solved
    changed = tmp_path / "changed.toml"
    changed.write_text(change((out / "config.toml").read_text()))
    code, _, err = call(capsys, "solve", run, "--out", tmp_path / "again", "--config", changed)
    assert code == 2 and words in err and err.count("\n") == 1
    assert not (tmp_path / "again").exists()


def test_a_result_is_replaced_by_itself_and_otherwise_only_with_force(solved, tmp_path, capsys, hallway):
    run, out = solved
    before = files(out)
    assert call(capsys, "solve", run, "--out", out)[0] == 0  # the same result again
    assert files(out) == before
    for arguments, words in (
        ((run, "--method", "chain"), "holds a result of method joint"),
        ((run, "--without-odometry"), "holds a result of other options"),
        ((hallway,), "holds the result of another run"),
    ):
        code, _, err = call(capsys, "solve", *arguments, "--out", out)
        assert code == 2 and words in err and "--force" in err
    assert files(out) == before
    assert call(capsys, "solve", run, "--out", out, "--method", "chain", "--force")[0] == 0
    assert json.loads((out / "summary.json").read_text())["method"] == "chain"


def test_results_of_a_folder_are_replaced_only_with_force(solved, tmp_path, capsys, monkeypatch):
    # processes are started in tests/results/test_many_runs.py
    monkeypatch.setattr("coloc_graph.results.executors.workers", lambda *_: ThreadPoolExecutor(1))
    run, _ = solved
    folder, out = tmp_path / "runs", tmp_path / "results"
    folder.mkdir()
    shutil.move(run, folder / "a.mcap")
    assert call(capsys, "solve", folder, "--out", out, "--processes", 1)[0] == 0
    code, text, err = call(capsys, "solve", folder, "--out", out, "--processes", 1, "--method", "chain")
    assert code == 1 and "1 failed" in text and "holds a result of method joint; replace it with --force" in err
    code, text, _ = call(capsys, "solve", folder, "--out", out, "--processes", 1, "--method", "chain", "--force")
    assert code == 0 and "1 solved" in text


def test_exports_are_replaced_only_with_force_and_never_anything_else(solved, tmp_path, capsys):
    _, out = solved
    for form in ("g2o", "tum", "gtsam"):
        to = tmp_path / form
        assert call(capsys, "export", form, out, "--out", to)[0] == 0
        code, _, err = call(capsys, "export", form, out, "--out", to)
        assert code == 2 and "exists; replace it with --force" in err
        assert call(capsys, "export", form, out, "--out", to, "--force")[0] == 0
    (tmp_path / "tum" / "thesis.tex").touch()
    code, _, err = call(capsys, "export", "tum", out, "--out", tmp_path / "tum", "--force")
    assert code == 2 and "holds thesis.tex" in err and (tmp_path / "tum" / "A.tum").exists()


def test_quiet_prints_results_and_errors_alone(solved, tmp_path, capsys):
    run, _ = solved
    code, out, err = call(capsys, "solve", run, "--out", tmp_path / "quiet", "-q")
    assert (code, err) == (0, "") and "measurements used" in out
    code, out, err = call(capsys, "solve", run, "--out", tmp_path / "quiet", "-q", "--method", "chain")
    assert code == 2 and err.startswith("coloc: ")


def test_verbose_logs_the_work_and_causes(solved, tmp_path, capsys):
    run, _ = solved
    code, out, err = call(capsys, "solve", run, "--out", tmp_path / "out2", "-v", "--json")
    assert code == 0 and json.loads(out)["stances"] == 3
    assert "coloc_graph.pipeline.batch: 3 stances measured: 3 of 3 pairs usable" in err and "chi2/dof" in err
    (tmp_path / "bad.toml").write_text("[options")
    assert "caused by TOMLDecodeError" in call(
        capsys, "solve", run, "--out", tmp_path / "x", "-v", "--config", tmp_path / "bad.toml"
    )[2]  # fmt: skip
    assert logging.getLogger("coloc_graph").level == logging.NOTSET


def test_every_command_takes_v_and_q_but_not_both(capsys):
    for command in (["info", "r"], ["import", "ros", "b", "m", "--out", "r"], ["coordinate", "t"], ["demo"]):
        assert parser().parse_args([*command, "-v"]).verbose and parser().parse_args([*command, "-q"]).quiet
        with pytest.raises(SystemExit):
            parser().parse_args([*command, "-q", "-v"])
