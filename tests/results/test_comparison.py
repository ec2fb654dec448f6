"""`coloc evaluate`: results and TUM files, its options, its pictures, and what it refuses."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from coloc_graph.cli import main
from coloc_graph.cli.evaluate import ALIGNMENTS as OFFERED
from coloc_graph.evaluation import ALIGNMENTS
from coloc_graph.exchange.tum import read_tum, write_tum
from coloc_graph.geometry.lie import floor_pose, se3_exp
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.results.folder import read_result
from coloc_graph.run import read_truth

EVO = Path(__file__).parents[1] / "evaluation" / "evo"


@pytest.fixture
def call(capsys):
    """Runs `coloc evaluate` in this process: (exit code, stdout, stderr)."""

    def run(*arguments):
        try:
            code = main(["evaluate", *(str(argument) for argument in arguments)])
        except SystemExit as ended:
            code = ended.code
        out, err = capsys.readouterr()
        return code, out, err

    return run


@pytest.fixture
def refused(call):
    """The one sentence with which it refuses."""

    def run(*arguments):
        code, out, err = call(*arguments)
        assert (code, out) == (2, "") and err.startswith("coloc: ") and err.count("\n") == 1, err
        return err

    return run


@pytest.fixture(scope="module")
def tums(result, hallway, tmp_path_factory):
    """The hallway's result and truth as folders of TUM files, as others would write them."""
    folder = tmp_path_factory.mktemp("tums")
    for name, trajectories in (("est", read_result(result).trajectories), ("true", read_truth(hallway))):
        (folder / name).mkdir()
        for robot, one in trajectories.items():
            write_tum(Trajectory(robot, one.times, one.T_world_body), folder / name / f"{robot}.tum")
    return folder


def test_the_alignments_that_are_offered_are_those_there_are():
    assert OFFERED == ALIGNMENTS


def test_a_result_is_aligned_by_its_reference_unless_another_way_is_asked_for(call, result):
    found = {}
    for alignment in (None, *ALIGNMENTS):
        code, out, err = call(result, "--json", *(["--align", alignment] if alignment else []))
        assert (code, err) == (0, "")
        found[alignment] = json.loads(out)
    assert found[None] == found["reference"] and found[None]["alignment"] == "reference"
    assert found["robot"]["ate_m"] < found["team"]["ate_m"] < found["reference"]["ate_m"] < found["none"]["ate_m"]
    of_a = found[None]["robots"]["A"]
    assert of_a["translation_m"]["rmse"] == of_a["ate_m"] <= of_a["translation_m"]["max"]
    assert of_a["nees"]["low"] < 1 < of_a["nees"]["high"] and 1 <= of_a["nees"]["effective"] <= of_a["nees"]["poses"]
    assert found["team"]["anees"] is None and found["team"]["robots"]["A"]["nees"] is None


def test_the_summary_of_a_result_says_the_same(call, result):
    _, out, _ = call(result, "--json")
    told, summary = json.loads(out), json.loads((result / "summary.json").read_text())["accuracy"]
    assert summary.keys() == told.keys() and summary["robots"]["B"].keys() == told["robots"]["B"].keys()
    assert summary["rpe"][0]["distance_m"] == 1.0 and summary["rpe"][0]["pairs"] > 0
    assert summary["rpe"][-1] | {"distance_m": 0} == {
        "distance_m": 0, "pairs": 0, "translation_m": None, "translation_percent": None, "rotation_deg": None
    }  # fmt: skip
    for a, b in zip(summary["rpe"], told["rpe"], strict=True):
        assert a["pairs"] == b["pairs"] and (not a["pairs"] or a == pytest.approx(b, rel=1e-6))


def test_tum_files_of_a_team_say_what_its_result_says(call, result, tums, hallway):
    # as files they know no stances, so that truth is where it was recorded: at both ends of each
    expected = json.loads(call(result, "--json", "--align", "team")[1])
    for truth in (tums / "true", hallway):
        code, out, err = call(tums / "est", "--truth", truth, "--planar", "--json")
        assert (code, err) == (0, "")
        found = json.loads(out)
        assert found["alignment"] == "team" and found["ate_m"] == pytest.approx(expected["ate_m"], rel=1e-9)
    code, out, _ = call(result, "--truth", tums / "true", "--align", "team", "--json")
    assert code == 0 and json.loads(out)["ate_m"] == pytest.approx(expected["ate_m"], rel=1e-6)


def test_robots_are_named_with_their_files_and_some_may_be_left_out(call, tums):
    named = ["--estimate", *(f"{robot}={tums}/est/{robot}.tum" for robot in "BA")]
    code, out, _ = call(*named, "--truth", tums / "true", "--json", "--align", "reference", "--reference", "A")
    assert code == 0 and list(json.loads(out)["robots"]) == ["B", "A"]
    code, out, _ = call(tums / "est", "--truth", tums / "true", "--robots", "A,C", "--json")
    assert code == 0 and list(json.loads(out)["robots"]) == ["A", "C"]


def test_one_file_against_one_file_is_one_robot(call):
    code, out, err = call("--estimate", EVO / "est.tum", "--truth", EVO / "true.tum", "--rpe", "2,0.5")
    assert (code, err) == (0, "")
    assert "aligned by all poses of the team" in out
    assert re.search(r"^est +0.5 m +57 +0.0403 m +8.07 % +4.63 deg$", out, re.MULTILINE), out
    code, truth, _ = call(
        "--estimate", EVO / "est.tum", "--truth", EVO / "true.tum", "--rpe", "0.5", "--pairs-from-truth"
    )
    assert re.search(r"^est +0.5 m +56 ", truth, re.MULTILINE), truth


def test_truth_at_a_hundred_hertz_is_interpolated_to_what_was_estimated_in_between(call, tmp_path):
    """A robot on a circle, its estimate right at any time: nothing is left of the time between the samples."""

    def circle(times):
        return floor_pose(np.cos(times), np.sin(times), times + np.pi / 2)

    dense, asked = np.arange(0, 6, 0.01), np.sort(np.random.default_rng(2).uniform(-0.5, 7, 300))
    write_tum(Trajectory("A", 1.7e9 + dense, circle(dense)), tmp_path / "true.tum")
    write_tum(Trajectory("A", 1.7e9 + asked, circle(asked)), tmp_path / "est.tum")
    files = ["--estimate", tmp_path / "est.tum", "--truth", tmp_path / "true.tum", "--json"]
    code, out, err = call(*files, "--align", "none")
    lost = int((asked < 0).sum()), int((asked > dense[-1]).sum())
    assert f"warning: robot est: {sum(lost)} of 300 poses are not evaluated" in err and err.count("\n") == 1
    assert f"({lost[0]} before it begins, {lost[1]} after it ends, 0 in its gaps)" in err
    assert code == 0 and 0 < json.loads(out)["translation_m"]["max"] < 2e-5  # a chord of 0.01 rad: 1.25e-5
    # of truth at 2 Hz nothing is known in between, unless one says so
    slow = np.arange(0, 6.1, 0.5)
    write_tum(Trajectory("A", 1.7e9 + slow, circle(slow)), tmp_path / "true.tum")
    assert "robot est has no truth at the times of its poses" in call(*files)[2]
    code, out, err = call(*files, "--align", "none", "--max-gap", 0.6)
    assert code == 0 and 0.01 < json.loads(out)["translation_m"]["max"] < 0.04  # a chord of 0.5 rad


def test_pictures_are_drawn_and_not_over_others(call, refused, result, tmp_path):
    png, folder = tmp_path / "all.png", tmp_path / "pictures"
    png.write_text("another picture")
    assert "all.png exists; replace it with --force" in refused(result, "--plot", png)
    assert png.read_text() == "another picture"
    code, out, _ = call(result, "--plot", png, "--force")
    assert code == 0 and out.splitlines()[-1] == f"written: {png}" and png.read_bytes().startswith(b"\x89PNG")
    code, out, _ = call(result, "--plot", folder, "--json", "--robots", "A", "--rpe", "0.3,0.35,0.4,0.7")
    assert code == 0 and json.loads(out)["ate_m"] > 0
    assert sorted(path.name for path in folder.iterdir()) == ["errors.png", "rpe.png", "trajectories.png"]
    # what is not drawn this time does not stay behind from the last
    assert call(result, "--plot", folder, "--force", "--robots", "A", "--rpe", "500")[0] == 0
    assert sorted(path.name for path in folder.iterdir()) == ["errors.png", "trajectories.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["all.png", "pictures"]
    assert "jpg is not a kind of picture; name one of .png, .svg, .pdf" in refused(result, "--plot", tmp_path / "a.jpg")
    assert "its folder does not exist" in refused(result, "--plot", tmp_path / "nowhere" / "a.png")


def test_what_is_in_the_pictures(result):
    """Estimate and truth of each robot, errors with what was predicted where that is known, and the RPE of the team."""
    from matplotlib.figure import Figure

    from coloc_graph.report.comparison import comparison_drawings
    from coloc_graph.results.comparison import of_result

    for alignment, bands in (("reference", 9), ("team", 0)):
        comparison = of_result(result, alignment=alignment)
        accuracy, true = comparison.compare()
        figures = {}
        drawings = comparison_drawings(comparison.estimated, true, accuracy, on_floor=True)
        for name, (_, draw) in drawings.items():
            figures[name] = Figure()
            draw(figures[name])
        lines = {name: [line for axes in one.axes for line in axes.lines] for name, one in figures.items()}
        for gid in ("estimate", "truth"):
            drawn = [line.get_xydata() for line in lines["trajectories"] if line.get_gid() == gid]
            positions = [
                one.positions if gid == "estimate" else true[robot][:, :3, 3]
                for robot, one in comparison.estimated.items()
            ]
            assert all(np.array_equal(a, b[:, :2]) for a, b in zip(drawn, positions, strict=True))
        errors = [line for line in lines["errors"] if line.get_gid() == "error"]
        off = comparison.estimated["A"].positions[:, 0] - true["A"][:, 0, 3]
        assert len(errors) == 9 and np.allclose(errors[0].get_ydata(), 100 * off)
        assert (
            len([1 for axes in figures["errors"].axes for one in axes.collections if one.get_gid() == "sigma"]) == bands
        )
        there = [one for one in accuracy.relative if one.pairs]
        team = figures["rpe"].axes[0].lines[-1]
        assert team.get_label() == "team" and team.get_ydata().tolist() == [one.translation_percent for one in there]


def spoiled(path, change):
    lines = path.read_text().splitlines()
    path.write_text("\n".join(change(lines)) + "\n")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda lines: [*lines[:4], lines[4] + " 1", *lines[5:]], "A.tum, line 5: 8 finite numbers are expected"),
        (lambda lines: [lines[1], lines[0], *lines[2:]], "A.tum, line 2: the time .* does not come after"),
        (lambda lines: [lines[0], *lines], "A.tum, line 2: the time .* does not come after .*one an instant"),
        (lambda lines: [re.sub(r" \S+", " nan", lines[0], count=1), *lines[1:]], "A.tum, line 1: 8 finite"),
        (lambda lines: [], "there are no poses of robot A to compare"),
    ],
)
def test_files_that_are_wrong_are_named_with_the_line(refused, tums, tmp_path, change, words):
    for which in ("est", "true"):
        folder = tmp_path / which
        shutil.copytree(tums, folder)
        spoiled(folder / which / "A.tum", change)
        assert re.search(words, refused(folder / "est", "--truth", folder / "true")), which


def test_times_that_do_not_meet_are_said_with_their_ends(refused, tums, tmp_path):
    for path in (tums / "true").iterdir():
        one = read_tum(path)
        write_tum(Trajectory(one.robot, one.times - 7200, one.T_world_body), tmp_path / path.name)
    sentence = refused(tums / "est", "--truth", tmp_path)
    assert re.search(
        r"robot A has no truth at the times of its poses: .* reaches from \d+\.\d+ to .*check the clocks", sentence
    )


def test_what_is_not_said_or_said_in_vain(refused, call, tums, result, tmp_path):
    estimate, true = tums / "est", ["--truth", tums / "true"]
    assert "nothing to compare" in refused()
    assert "nothing to compare" in refused(result, "--estimate", estimate)
    assert "TUM files need --truth" in refused(estimate)
    assert "choose from A, B, C" in refused(estimate, *true, "--robots", "A,Z")
    assert "the reference robot is not named: name one of A, B, C" in refused(estimate, *true, "--align", "reference")
    assert "the reference robot Z" in refused(estimate, *true, "--align", "reference", "--reference", "Z")
    assert "the truth holds Z, and the estimate A, B, C" in refused(estimate, "--truth", f"Z={tums}/true/A.tum")
    assert "robot A is given twice" in refused("--estimate", estimate, f"A={tums}/est/B.tum", *true)
    assert "`0` is not positive; give distances in metres, as 1,2,5" in refused(result, "--rpe", "1,0")
    assert "`1;2` is not positive" in refused(result, "--rpe", "1;2")
    assert "--planar apply to TUM files" in refused(result, "--planar")
    assert "holds no .tum files" in refused(result, "--truth", tmp_path)
    assert "nowhere.tum: cannot be read" in refused(result, "--truth", f"A={tmp_path}/nowhere.tum")
    code, out, _ = call(result, "--rpe", "1,500")
    assert code == 0 and "no two poses of a robot are 500 m apart along its path" in out


def test_a_continuous_estimate_with_covariances_has_its_nees(call, tmp_path, rng):
    """No stances, covariances beside it, truth at other times, both in one world: as of landmarks that are known."""
    times = 0.1 * np.arange(400)
    true = floor_pose(0.2 * times, np.sin(0.3 * times), 0.3 * np.cos(0.3 * times))
    sigma = np.array([0, 0, 0.01, 0.02, 0.01, 0])
    covariances = np.tile(np.diag(sigma**2 + 1e-12), (400, 1, 1))
    off = true @ se3_exp(-sigma * rng.normal(size=(400, 6)))
    write_tum(Trajectory("A", times, true), tmp_path / "true.tum")
    write_tum(Trajectory("A", times, off, None, covariances), tmp_path / "est.tum")
    files = ["--estimate", tmp_path / "est.tum", "--truth", tmp_path / "true.tum", "--planar", "--json"]
    found = json.loads(call(*files, "--align", "none")[1])["robots"]["est"]["nees"]
    assert found["low"] < found["mean"] < found["high"] and found["effective"] > 200
    assert found["low"] > 0.85 and found["high"] < 1.15
    assert json.loads(call(*files)[1])["anees"] is None  # fitted
