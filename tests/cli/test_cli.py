"""The commands: round trips, what goes to stdout and what to stderr, exit codes, and a light --help."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from coloc_graph._version import __version__
from coloc_graph.cli import main
from coloc_graph.cli.printing import warn
from coloc_graph.pipeline.batch import solve
from coloc_graph.run import open_run
from coloc_graph.simulation.simulated_team import field_team
from coloc_graph.team import write_team

COLOC = Path(sys.executable).with_name("coloc")
COMMANDS = ["", "demo", "simulate", "import", "import tracks", "info", "solve", "evaluate", "experiment", "view"]
COMMANDS += ["import ros", "import mrclam", "export", "coordinate", "robot", "certificates"]
COMMANDS += ["calibrate", "calibrate camera", "calibrate mount"]


def coloc(*arguments, cwd=None):
    return subprocess.run([COLOC, *map(str, arguments)], capture_output=True, text=True, cwd=cwd, timeout=60)


@pytest.fixture
def call(capsys):
    """Runs a command in this process: (exit code, stdout, stderr)."""

    def run(*arguments):
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as ended:
            code = ended.code
        out, err = capsys.readouterr()
        return code, out, err

    return run


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(call, command):
    code, out, err = call(*command.split(), "--help")
    assert (code, err) == (0, "")
    assert out.startswith(f"usage: coloc {command}".rstrip())


def test_help_imports_nothing_heavy():
    script = f"""
import sys, contextlib, io
from coloc_graph.cli import main
for command in {COMMANDS!r}:
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()) as out:
        main([*command.split(), "--help"])
    assert "usage" in out.getvalue(), command
heavy = {{"numpy", "gtsam", "cv2", "scipy", "matplotlib", "msgspec", "mcap", "rich", "google"}} & set(sys.modules)
sys.exit(" ".join(sorted(heavy)) or 0)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr.strip()) == (0, "")


def test_version_and_no_command(call):
    assert call("--version") == (0, f"coloc {__version__}\n", "")
    code, out, err = call()
    assert (code, out) == (2, "") and err.startswith("coloc: ") and err.count("\n") == 1


def test_simulate_solve_info_evaluate_round_trip(call, tmp_path):
    run, out = tmp_path / "run.mcap", tmp_path / "out"
    code, text, err = call("simulate", "hallway", "--stances", 3, "--points", 40, "--seed", 5, "--out", run)
    assert (code, text) == (0, f"{run}\n")
    assert "stances simulated: 3 of 3" in err

    code, text, err = call("solve", run, "--out", out)
    assert code == 0 and "3 of 3 measurements used, chi2/dof " in text and "error rate" in text
    assert re.search(r"predicted 1-sigma at the end: A \d+\.\d mm, \d\.\d\d deg; B ", text)
    assert "stances measured: 3 of 3" in err and "stances measured" not in text

    code, text, err = call("solve", run, "--out", out, "--json", "--method", "chain", "--force")
    solved = json.loads(text)
    assert code == 0 and solved["method"] == "chain"
    on_disk = json.loads((out / "summary.json").read_text())
    assert {key: on_disk[key] for key in solved} == solved

    code, text, err = call("evaluate", out, "--json")
    evaluated = json.loads(text)
    assert (code, err) == (0, "")
    assert evaluated["length_error_percent"] == pytest.approx(solved["accuracy"]["length_error_percent"], abs=1e-9)
    assert evaluated["anees"] == pytest.approx(solved["accuracy"]["anees"], rel=1e-6)

    code, text, err = call("evaluate", out)
    assert (code, err) == (0, "") and text.startswith("robot") and "NEES per degree of freedom" in text

    code, text, err = call("info", run, "--json")
    info = json.loads(text)
    assert (code, err) == (0, "")
    assert info["robots"] == ["A", "B", "C"] and info["stances"] == 3 and info["problems"] == []
    assert info["truth"] == ["A", "B", "C"] and info["topics"]["/stance"] == 3
    assert info["topics"]["/A/truth"] > 6

    code, text, err = call("info", run)
    assert (code, err) == (0, "") and "no problem found" in text and "/A/detections" in text


def test_a_run_that_was_moved_is_evaluated_when_it_is_named(call, result, hallway, tmp_path):
    moved = tmp_path / "result"
    moved.mkdir()
    for path in result.rglob("*"):
        target = moved / path.relative_to(result)
        target.mkdir() if path.is_dir() else target.write_bytes(path.read_bytes())
    code, out, err = call("evaluate", moved)
    assert code == 2 and err.startswith("coloc: ") and err.count("\n") == 1 and out == ""
    assert "give --run RUN" in err
    code, out, err = call("evaluate", moved, "--run", hallway, "--json")
    assert code == 0 and json.loads(out)["ate_m"] > 0


def test_without_truth_solve_says_where_the_robots_are_and_how_far_to_trust_it(call, short, copied, tmp_path):
    run = open_run(copied(short, tmp_path / "run.mcap"))
    code, text, _ = call("solve", run.path, "--out", tmp_path / "out")
    head, a, b, *_, last = text.splitlines()
    assert code == 0 and head.split("  ")[0] == "robot" and "path length" in head
    estimate = solve(run).estimate
    for line, robot in ((a, "A"), (b, "B")):
        T, covariance = estimate.trajectories[robot].T_world_body[-1], estimate.trajectories[robot].covariances[-1]
        numbers = [float(one) for one in re.findall(r"-?\d+\.\d+", line)]
        R = T[:2, :2]
        sigmas = 100 * np.sqrt(np.diag(R @ covariance[3:5, 3:5] @ R.T))
        heading = np.rad2deg([np.arctan2(T[1, 0], T[0, 0]), np.sqrt(covariance[2, 2])])
        expected = [100 * T[0, 3], sigmas[0], 100 * T[1, 3], sigmas[1], *heading]
        np.testing.assert_allclose(numbers[1:], expected, atol=0.051)
    assert f"{tmp_path / 'out'} holds trajectories" in last


def test_of_robots_that_stand_still_the_distance_is_printed(call, tmp_path):
    run, out = tmp_path / "run.mcap", tmp_path / "out"
    call("simulate", "single-step", "-l", 0.9, "--points", 60, "--out", run)
    code, text, _ = call("solve", run, "--out", out)
    assert code == 0 and re.search(r"A to B +90\.0 cm +(89|90)\.\d cm +\d\.\d\d cm", text), text
    assert "1 of 1 measurement used" in text
    code, text, _ = call("evaluate", out)
    assert code == 0 and "A to B" in text
    code, text, _ = call("evaluate", out, "--json")
    (distance,) = json.loads(text)["distances"]
    assert distance["true_m"] == pytest.approx(0.9) and distance["robots"] == ["A", "B"]
    assert f"{run}: 1 stance in" in call("info", run)[1]


def test_the_scale_may_come_from_the_markers_span(call, short, tmp_path):
    code, out, _ = call("solve", short, "--out", tmp_path / "out", "--scale", "span", "--json")
    assert code == 0 and json.loads(out)["measurements"]["used"] == 3


def test_options_of_simulate_reach_the_world(call, tmp_path):
    arguments = ["simulate", "single-step", "-l", 1.0, "--theta", 20, "--points", 30, "--mount-sigma", 0.5]
    arguments += ["--height-sigma", 0.01, "--span-sigma", 0.002, "--floor-sigma", 0.1, "--noise", 0.7]
    code, _, _ = call(*arguments, "--out", tmp_path / "run.mcap")
    team = open_run(tmp_path / "run.mcap").team
    assert code == 0
    for robot in team.robots:
        assert (robot.mount.tilt_sigma_deg, robot.mount.roll_sigma_deg, robot.mount.height_sigma) == (0.5, 0.5, 0.01)
        assert robot.markers.span_sigma == 0.002 and robot.camera.noise_px == 0.7
    assert team.floor.tilt_sigma_deg == 0.1


def test_the_demo_goes_all_the_way(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = call("demo", "--stances", 2, "--no-browser", "--out", "demo")
    assert code == 0, err
    assert "robot" in out and f"report: {Path('demo', 'result', 'report.html')}" in out
    assert "stances rendered: 2 of 2" in err
    assert (tmp_path / "demo" / "result" / "report.html").stat().st_size > 1000
    assert (tmp_path / "demo" / "hallway.mcap").is_file()


def test_the_installed_command_and_the_module_are_the_same():
    a = coloc("solve", "--help")
    b = subprocess.run([sys.executable, "-m", "coloc_graph.cli", "solve", "--help"], capture_output=True, text=True)
    assert (a.returncode, a.stderr) == (b.returncode, b.stderr) == (0, "")
    assert a.stdout == b.stdout and a.stdout.startswith("usage: coloc solve")


def test_a_bad_argument_is_exit_code_2_in_a_real_process(tmp_path):
    done = coloc("team", "check", "nowhere.toml", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("coloc: nowhere.toml: ") and done.stderr.count("\n") == 1


def test_a_reader_who_goes_away_is_no_traceback(tmp_path):
    write_team(field_team(), tmp_path / "team.toml")
    process = subprocess.Popen(
        [COLOC, "team", "check", tmp_path / "team.toml"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=os.environ
    )
    process.stdout.close()
    err = process.stderr.read().decode()
    process.stderr.close()
    process.wait(timeout=60)
    assert process.returncode == 141 and err == ""


def test_interrupting_ends_with_130_and_leaves_nothing(tmp_path):
    process = subprocess.Popen(
        [COLOC, "simulate", "hallway", "--depth", "images", "--stances", "6", "--out", "run.mcap"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # a shell's background job ignores SIGINT, and hands that on
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    end = time.monotonic() + 120
    while not list(tmp_path.glob("run.mcap.*.part")) and time.monotonic() < end:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130
    assert err.splitlines()[-1] == "coloc: interrupted" and "Traceback" not in err and out == ""
    assert list(tmp_path.iterdir()) == []


def test_of_many_warnings_those_are_said_that_no_file_keeps(capsys):
    many = [f"number {n}" for n in range(12)]
    warn(many)
    assert capsys.readouterr().err.count("\n") == 9
    warn(many, kept=False)
    assert capsys.readouterr().err.splitlines() == [f"warning: {one}" for one in many]
