"""Benchmarks start: each takes --help, and those that are quick at their smallest size run at it."""

import runpy
import sys

import pytest
from architecture import ROOT

BENCHMARKS = sorted(
    path.stem for path in (ROOT / "benchmarks").glob("*.py") if "__main__" in path.read_text(encoding="utf-8")
)
#: Arguments of a run that takes a second or less.
SMALLEST = {
    "association": ["--scenes", "1", "--lockstep", "1"],
    "hallway": ["--seeds", "1", "--stances", "3", "--points", "30"],
    "leapfrog_ekf": ["--seeds", "1", "--stances", "3", "--points", "40"],
    "nees_interval": ["--draws", "5", "--seeds", "1"],
    "ranges": ["--seeds", "1", "--stances", "3", "--points", "40"],
    "relative_pose": ["--runs", "2", "--cells", "1"],
    "team": ["--seeds", "1", "--robots", "3", "--stances", "2"],
    "tracking": ["--seeds", "1", "--movers", "1", "--seconds", "2"],
    "frame_rates": ["--seeds", "1", "--fps", "5", "--speeds", "0.1", "--widths", "320"],
}


def run(monkeypatch, name, *arguments):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    monkeypatch.setattr(sys, "argv", [f"{name}.py", *arguments])
    try:
        runpy.run_path(str(ROOT / "benchmarks" / f"{name}.py"), run_name="__main__")
    except SystemExit as ended:
        return ended.code or 0
    return 0


@pytest.mark.parametrize("name", BENCHMARKS)
def test_a_benchmark_imports_all_it_needs_and_explains_its_options(name, monkeypatch, capsys):
    assert run(monkeypatch, name, "--help") == 0
    assert "--help" in capsys.readouterr().out


@pytest.mark.parametrize("name", SMALLEST)
def test_a_benchmark_runs_at_its_smallest_size(name, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, name, *SMALLEST[name]) == 0
    assert any(character.isdigit() for character in capsys.readouterr().out)
