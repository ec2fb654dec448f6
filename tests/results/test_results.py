"""A result on disk: complete, reproducible, whole or not at all, and read back."""

import csv
import dataclasses
import json
import shutil
import tomllib

import msgspec
import numpy as np
import pytest

from coloc_graph.cli import main
from coloc_graph.errors import InputError
from coloc_graph.exchange.tum import read_tum
from coloc_graph.pipeline.batch import solve
from coloc_graph.results.folder import read_result
from coloc_graph.results.measurement_table import MEASUREMENT_COLUMNS
from coloc_graph.results.writer import write_result
from coloc_graph.run import open_run, read_truth, run_id
from coloc_graph.simulation import simulate
from coloc_graph.team import Team

FILES = {
    "summary.json",
    "trajectories/A.tum",
    "trajectories/A.cov.csv",
    "trajectories/B.tum",
    "trajectories/B.cov.csv",
    "trajectories/C.tum",
    "trajectories/C.cov.csv",
    "graph.dot",
    "graph.g2o",
    "factors.zip",
    "measurements.csv",
    "config.toml",
    "report.html",
    "team.toml",
}


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_result_has_every_file_of_the_design(result):
    assert set(contents(result)) == FILES
    assert not list(result.parent.glob("result.*"))


def test_the_summary_has_every_key_of_the_design(result):
    summary = json.loads((result / "summary.json").read_text())
    assert summary["method"] == "joint" and summary["robots"] == ["A", "B", "C"] and summary["stances"] == 8
    assert {name: summary["measurements"][name] for name in ("used", "rejected")} == {"used": 8, "rejected": 0}
    assert set(summary["seconds"]) == {"frontend", "backend", "total"}
    assert all(seconds >= 0 for seconds in summary["seconds"].values())
    accuracy = summary["accuracy"]
    assert set(accuracy["length_error_percent"]) == {"A", "B", "C"}
    for key in ("ate_m", "end_position_error_m", "heading_error_deg", "anees"):
        assert isinstance(accuracy[key], float), key


def test_a_summary_is_json_that_every_program_reads(result):
    def refuse(word):
        raise AssertionError(f"{word} is no JSON")

    json.loads((result / "summary.json").read_text(), parse_constant=refuse)


def test_measurements_are_one_row_each_of_every_kind(result, solutions):
    with (result / "measurements.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == MEASUREMENT_COLUMNS
    counts = json.loads((result / "summary.json").read_text())["measurements"]["kinds"]
    assert set(counts) == {"homography", "sighting", "odometry"}
    for kind, count in counts.items():
        own = [row["used"] for row in rows if row["kind"] == kind]
        assert (own.count("yes"), own.count("no")) == (count["used"], count["rejected"]) and count["used"]
    assert all(0 < float(row["residual"]) < 6 for row in rows)
    odometry = [(row["robot_i"], row["robot_j"]) for row in rows if row["kind"] == "odometry"]
    assert all(i == j for i, j in odometry)
    rows = [row for row in rows if row["kind"] == "homography"]
    assert [(row["index_i"], row["index_j"], row["robot_i"], row["robot_j"]) for row in rows] == [
        (str(s.index), str(s.index), *s.observers) for s in solutions["joint"].run.stances
    ]
    assert {row["used"] for row in rows} == {"yes"}
    for row, measured in zip(rows, solutions["joint"].measurements, strict=True):
        assert int(row["inliers"]) == measured.homography.inliers <= int(row["points"])
        distance = np.linalg.norm(measured.relative_pose.T_i_j[:3, 3])
        assert float(row["distance"]) == pytest.approx(distance)


def test_the_config_says_everything_that_was_used(result, solutions):
    config = tomllib.loads((result / "config.toml").read_text())
    assert config["options"]["method"] == "joint"
    assert config["options"]["frontend"]["criterion"] == "reprojection"
    assert msgspec.convert(config["team"], Team) == solutions["joint"].run.team


def test_the_same_input_gives_the_same_bytes_but_for_the_seconds(short, short_result, tmp_path):
    write_result(solve(open_run(short)), tmp_path / "again")
    one, two = contents(short_result), contents(tmp_path / "again")
    summaries = [json.loads(files.pop("summary.json")) for files in (one, two)]
    assert one == two
    for summary in summaries:
        del summary["seconds"], summary["run"]
    assert summaries[0] == summaries[1] and list(summaries[0]) == list(summaries[1])


def test_a_result_reads_back(result, solutions, hallway):
    read = read_result(result)
    assert read.summary["method"] == "joint"
    assert read.run_path.samefile(hallway)
    for robot, trajectory in solutions["joint"].estimate.trajectories.items():
        again = read.trajectories[robot]
        for name in ("times", "stances", "covariances", "positions"):
            assert np.array_equal(getattr(again, name), getattr(trajectory, name)), name


def test_a_result_and_its_run_may_be_moved_together(short, short_result, tmp_path):
    there = tmp_path / "there"
    there.mkdir()
    shutil.copy(short, there / short.name)
    shutil.copytree(short_result, there / "out")
    assert read_result(there / "out").run_path.samefile(there / short.name)


def test_an_earlier_result_is_replaced_whole(short_solution, result, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(result, out)
    (out / "trajectories" / "Z.tum").write_text("of an earlier team")
    write_result(short_solution, out)
    assert set(contents(out)) == FILES
    assert json.loads((out / "summary.json").read_text())["stances"] == 3
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_result_goes_to_a_deep_folder_the_present_empty_one_and_through_a_link(short_solution, tmp_path, monkeypatch):
    (tmp_path / "present").mkdir()
    (tmp_path / "target").mkdir()
    (tmp_path / "link").symlink_to("target")
    write_result(short_solution, tmp_path / "a" / "b" / "c")
    write_result(short_solution, tmp_path / "link")
    monkeypatch.chdir(tmp_path / "present")
    write_result(short_solution, ".")
    for name in ("a/b/c", "target", "present"):
        assert set(contents(tmp_path / name)) == FILES, name
    assert (tmp_path / "link").is_symlink()


def test_a_folder_that_is_something_else_is_refused_and_stays_as_it_was(short_solution, tmp_path):
    foreign = tmp_path / "thesis"
    foreign.mkdir()
    (foreign / "chapter.txt").write_text("years of work")
    (tmp_path / "file").write_text("a file")
    for place in (foreign, tmp_path / "file"):
        with pytest.raises(InputError, match=f"{place.name} exists and is not a result: give another folder"):
            write_result(short_solution, place)
    with pytest.raises(InputError, match="file is not a folder"):
        write_result(short_solution, tmp_path / "file" / "below")
    assert contents(tmp_path) == {"thesis/chapter.txt": b"years of work", "file": b"a file"}


def test_nothing_half_written_is_left_and_the_earlier_result_stands(
    short_solution, short_result, tmp_path, monkeypatch
):
    import coloc_graph.report

    out = shutil.copytree(short_result, tmp_path / "out")
    before = contents(tmp_path)

    def full_disk(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(coloc_graph.report, "render_report", full_disk)
    for place in (out, tmp_path / "new"):
        with pytest.raises(OSError, match="No space left"):
            write_result(short_solution, place)
    assert contents(tmp_path) == before and [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_run_without_truth_has_no_accuracy(short, copied, tmp_path):
    run = open_run(copied(short, tmp_path / "run.mcap"))
    assert write_result(solve(run), tmp_path / "out") is None
    assert "accuracy" not in json.loads((tmp_path / "out" / "summary.json").read_text())


def test_truth_that_begins_late_or_misses_robots_stops_no_estimate(short, copied, tmp_path, capsys):
    true = read_truth(short)
    late = {"A": true["A"].where(true["A"].times > open_run(short).stances[0].start + 0.05)}
    run = copied(short, tmp_path / "run.mcap", truth=late)
    assert main(["solve", str(run), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr()
    assert "robot A: 1 of" in said.err and "1 before it begins" in said.err
    assert "robot B is not evaluated: it has no truth" in said.err
    tables = said.out.split("x at the end")  # of the robots without truth their last poses are printed
    assert len(tables) == 2 and "\nB " in tables[1] and "\nA " in tables[0]
    x, y = 100 * read_tum(tmp_path / "out" / "trajectories" / "B.tum").positions[-1, :2]
    assert f"{x:.1f} +- " in tables[1] and f"{y:.1f} +- " in tables[1]
    assert list(json.loads((tmp_path / "out" / "summary.json").read_text())["accuracy"]["robots"]) == ["A"]


def test_truth_that_cannot_be_compared_with_is_a_warning(short, copied, tmp_path, capsys):
    true = read_truth(short)["B"]
    run = copied(short, tmp_path / "run.mcap", truth={"B": dataclasses.replace(true, times=true.times + 1e4)})
    assert main(["solve", str(run), "--out", str(tmp_path / "out"), "--json"]) == 0
    said = capsys.readouterr()
    for summary in (json.loads(said.out), json.loads((tmp_path / "out" / "summary.json").read_text())):
        assert "accuracy" not in summary
        assert sum("not compared with truth: robot B has no truth" in one for one in summary["warnings"]) == 1


@pytest.mark.parametrize(
    ("summary", "words"),
    [
        (None, r"is not a result, for want of summary.json"),
        ("{", "summary.json: is damaged"),
        ("[]", "summary.json is damaged"),
        ('{"format": 1}', r"summary.json: .* missing required field `robots`; solve the run again"),
        ('{"format": 1, "robots": ["A"], "run": "x.mcap"}', "A.tum: cannot be read"),
        ('{"format": 1, "robots": 3, "run": "x.mcap"}', "summary.json: Expected `array`"),
        (
            '{"format": 1, "robots": ["../A"], "run": "x.mcap"}',
            "summary.json: the name `../A` cannot be part of a topic",
        ),
        ("[" * 100_000, "summary.json: is damaged"),
        ('{"robots": ' + "1" * 5000 + "}", "summary.json: is damaged"),
    ],
)
def test_what_is_no_result_is_refused_in_words(tmp_path, summary, words):
    if summary is not None:
        (tmp_path / "summary.json").write_text(summary)
    with pytest.raises(InputError, match=words) as refusal:
        read_result(tmp_path)
    assert str(tmp_path) in str(refusal.value) and "\n" not in str(refusal.value)


def test_a_result_knows_its_run_by_content(short, hallway, short_result, tmp_path):
    read = read_result(short_result)
    read.require_run(short)
    copy, cut = tmp_path / "copy.mcap", tmp_path / "cut.mcap"
    copy.write_bytes(short.read_bytes())
    ends = [chunk.offset + chunk.length for chunk in open_run(short)._index.chunks]
    cut.write_bytes(short.read_bytes()[: ends[1] + 100])
    read.require_run(copy)
    read.require_run(cut)
    with pytest.raises(InputError, match=r"hallway.mcap is not the run of the result .*result"):
        read.require_run(hallway)
    with pytest.raises(InputError, match=r"no longer at .*gone.mcap: give --run RUN"):
        read.require_run(tmp_path / "gone.mcap")


@pytest.mark.parametrize("scenario", ["single-step", "six-step", "hallway"])
def test_runs_of_two_seeds_have_two_ids_and_one_of_the_same_seed_has_one(tmp_path, scenario):
    ids = []
    for name, seed in (("a", 0), ("b", 1), ("c", 0)):
        shorter = {"stances": 4} if scenario == "hallway" else {}
        simulate(scenario, tmp_path / name, seed=seed, points=20, **shorter)
        ids.append(run_id(tmp_path / name))
    assert ids[0] == ids[2] != ids[1]


def test_a_result_of_a_version_without_ids_is_taken_as_it_is(hallway, short_result, tmp_path):
    shutil.copytree(short_result, tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    del summary["run_id"]
    (tmp_path / "out" / "summary.json").write_text(json.dumps(summary))
    read_result(tmp_path / "out").require_run(hallway)


def test_results_of_earlier_versions_are_refused_in_one_sentence_everywhere(result, short, tmp_path, capsys):
    old = tmp_path / "old"
    shutil.copytree(result, old)
    summary = json.loads((old / "summary.json").read_text())
    for number, words in ((None, "an earlier version of coloc-graph wrote it"), (2, "its format is 2")):
        text = json.dumps({name: value for name, value in summary.items() if name != "format"} | {"format": number})
        (old / "summary.json").write_text(text)
        for command in (
            ["evaluate", str(old)],
            ["export", "tum", str(old), "--out", str(tmp_path / "out")],
            ["view", str(old), "--export", str(tmp_path / "page.html")],
            ["view", str(result), "--compare", str(old), "--export", str(tmp_path / "page.html")],
        ):
            assert main(command) == 2, command
            error = capsys.readouterr().err
            assert words in error and "solve the run again" in error and len(error.splitlines()) == 1
    assert not (tmp_path / "out").exists() and not (tmp_path / "page.html").exists()
