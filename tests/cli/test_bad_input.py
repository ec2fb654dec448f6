"""Everything a user can get wrong: one clear sentence on stderr, exit code 2, and nothing written."""

import dataclasses
import json
import re
import shutil

import msgspec
import numpy as np
import pytest
from mcap.writer import Writer

from coloc_graph.cli import main
from coloc_graph.run import Detections, Stance, open_run
from coloc_graph.simulation import reference_team
from coloc_graph.team import write_team

HEADER = "stance,time,robot,marker,u,v\n"
GOOD = HEADER + "".join(
    f"0,{100 + 0.1 * k:.1f},{robot},C/0,{u},{v}\n"
    for robot in "AB"
    for k, (u, v) in enumerate(
        [(50, 150), (250, 160), (240, 60), (60, 70), (150, 100), (100, 40), (30, 90), (200, 120)]
    )
)
PLANES = "stance,robot,nx,ny,nz,d\n"


def everything_in(folder):
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in folder.rglob("*")}


@pytest.fixture
def refused(tmp_path, capsys):
    """Runs a command that must be refused; gives the sentence, and sees that nothing was written."""

    def run(*arguments):
        before = everything_in(tmp_path)
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as ended:
            code = ended.code
        out, err = capsys.readouterr()
        lines = err.splitlines()
        assert code == 2 and out == ""
        assert [line.startswith("coloc: ") for line in lines].count(True) == 1 and lines[-1].startswith("coloc: "), err
        # what comes before the sentence is progress
        assert all(re.fullmatch(r"[a-z ]+: \d+ of \d+", line) for line in lines[:-1]), err
        assert everything_in(tmp_path) == before
        return lines[-1].removeprefix("coloc: ")

    return run


@pytest.fixture
def solve_refused(refused, tmp_path):
    return lambda run: refused("solve", run, "--out", tmp_path / "out")


@pytest.fixture
def import_refused(refused, tmp_path):
    """Imports with the good files, of which some are replaced."""

    def run(tracks=GOOD, *, team=None, planes=None):
        write_team(reference_team(), tmp_path / "team.toml")
        if team is not None:
            text = (tmp_path / "team.toml").read_text()
            (tmp_path / "team.toml").write_text(team(text))
        (tmp_path / "tracks.csv").write_text(tracks)
        options = []
        if planes is not None:
            (tmp_path / "planes.csv").write_text(planes)
            options = ["--planes", tmp_path / "planes.csv"]
        paths = (tmp_path / "team.toml", tmp_path / "tracks.csv")
        return refused("import", "tracks", *paths, *options, "--out", tmp_path / "run.mcap")

    return run


def test_the_good_files_of_the_bad_ones_are_good(tmp_path, capsys):
    write_team(reference_team(), tmp_path / "team.toml")
    (tmp_path / "tracks.csv").write_text(GOOD)
    (tmp_path / "planes.csv").write_text(PLANES + "0,A,0,0.9,0.435889894,0.25\n")
    arguments = ["import", "tracks", "team.toml", "tracks.csv", "--planes", "planes.csv", "--out", "run.mcap"]
    assert main([str(tmp_path / one) if "." in one else one for one in arguments]) == 0
    assert "16 rows, 1 stance, observers A, B" in capsys.readouterr().out


# --- teams


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: text.replace("fx = ", "focal = ", 1), r"team.toml: .*`focal`.*robots\[.*camera"),
        (lambda text: text.replace("reference = ", "# ", 1), r"team.toml: .*missing required field `reference`"),
        (
            lambda text: re.sub(r"(?m)^tilt_deg = .*", 'tilt_deg = "steep"', text, count=1),
            r"team.toml: .*float.*tilt_deg",
        ),
        (lambda text: re.sub(r"(?m)^width = .*", "width = -3", text, count=1), r"team.toml: `width` is -3; give"),
        (lambda text: re.sub(r"(?m)^fx = .*", "fx = nan", text, count=1), r"team.toml: `fx` is nan; give a finite"),
        (lambda text: text.replace('reference = "A"', 'reference = "Z"'), r"team.toml: `reference` is `Z`"),
        (lambda text: text.replace('name = "B"', 'name = "A"'), r"team.toml: two robots are called `A`"),
        (lambda text: text + "\n[floor", r"team.toml: .*end of document"),
    ],
)
def test_a_team_with_unknown_missing_or_impossible_fields(import_refused, change, words):
    assert re.search(words, import_refused(team=change))


def test_a_team_that_is_not_there(refused, tmp_path):
    (tmp_path / "tracks.csv").write_text(GOOD)
    arguments = (tmp_path / "team.toml", tmp_path / "tracks.csv", "--out", tmp_path / "run.mcap")
    assert "team.toml: cannot be read (No such file" in refused("import", "tracks", *arguments)


# --- tracks and planes in CSV files


@pytest.mark.parametrize(
    ("tracks", "words"),
    [
        (GOOD.replace("stance,time", "stance,t", 1), r"tracks.csv, line 1: the header is .*; it must be `stance,time"),
        (GOOD.replace("150,100", "nan,100", 1), r"tracks.csv, line 6: `u` is `nan`; remove"),
        (
            GOOD.replace("0,100.2", "0,100.9", 1),
            r"tracks.csv, line 5: .*runs backwards, from 100.9 s.*; sort",
        ),
        (GOOD.replace(",B,", ",Z,", 1), r"tracks.csv, line 10: robot `Z` is not in the team \(A, B, C\)"),
        (HEADER, r"tracks.csv: has a header and no rows; add"),
        ("", r"tracks.csv: is empty; begin it with the header"),
        (
            "".join(GOOD.splitlines(keepends=True)[:9]),
            r"tracks.csv: every stance has only one observer.*two robots",
        ),
    ],
)
def test_bad_tracks(import_refused, tracks, words):
    sentence = import_refused(tracks)
    assert re.search(words, sentence), sentence


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("0,A,0,0,1.5,0.25\n", r"planes.csv, line 2: the normal .* has length 1.5; give a unit normal"),
        ("0,A,0,0.9,0.435889894,-0.25\n", r"planes.csv, line 2: `d` is -0.25; give the distance .* above 0"),
        ("0,A,0,0.9,0.435889894,0\n", r"planes.csv, line 2: `d` is 0; give"),
    ],
)
def test_bad_planes(import_refused, row, words):
    assert re.search(words, import_refused(planes=PLANES + row))


# --- runs


def foreign(path, rows):
    """A run as a program without our checks would write it: rows of (topic, schema, ns, JSON)."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        ids = {}
        for topic, schema, ns, data in [("/team", "coloc_graph.Team", 1, msgspec.json.encode(reference_team())), *rows]:
            if topic not in ids:
                ids[topic] = writer.register_channel(topic, "json", writer.register_schema(schema, "", b""))
            writer.add_message(ids[topic], ns, data, ns)
        writer.finish()
    return path


def stance_row(ns, index=0, observers=("A", "B")):
    wire = {"index": index, "end_ns": ns + 10**9, "observers": observers, "movers": ["C"], "anchors": []}
    return "/stance", "coloc_graph.Stance", ns, json.dumps(wire).encode()


def detections_row(robot, ns, u="1.0"):
    points = f'"u":[{u}],"v":[2.0],"covariance":[[1,0,1]],"marker":["C/0"],"flags":[[]],"peak":[1],"area":[1]'
    return f"/{robot}/detections", "coloc_graph.Detections", ns, f"{{{points}}}".encode()


@pytest.mark.parametrize("number", ["NaN", "1e999", "null"])
def test_pixels_that_are_no_numbers(solve_refused, tmp_path, number):
    rows = [stance_row(10), *(detections_row(robot, 20, number) for robot in "AB")]
    sentence = solve_refused(foreign(tmp_path / "run.mcap", rows))
    assert re.search(r"run.mcap: .*/A/detections at 2e-08 s", sentence), sentence


def test_times_that_run_backwards(solve_refused, tmp_path):
    rows = [stance_row(10), detections_row("A", 30), detections_row("A", 20)]
    sentence = solve_refused(foreign(tmp_path / "run.mcap", rows))
    assert "run.mcap" in sentence and "/A/detections" in sentence and "backwards" in sentence
    rows = [stance_row(30), stance_row(20, 1)]
    sentence = solve_refused(foreign(tmp_path / "run.mcap", rows))
    assert "/stance" in sentence and "backwards" in sentence


def test_a_robot_that_is_not_in_the_team(solve_refused, refused, tmp_path):
    run = foreign(tmp_path / "run.mcap", [stance_row(10, observers=("A", "Z"))])
    for sentence in (solve_refused(run), refused("info", run)):
        assert re.search(r"run.mcap: stance 0 names robot `Z`, which is not in the team \(A, B, C\); ", sentence)


def test_an_empty_run(solve_refused, tmp_path):
    sentence = solve_refused(foreign(tmp_path / "run.mcap", []))
    assert (
        "run.mcap: there is nothing to solve: the run holds no stances and no ranges" in sentence
        and "record stances" in sentence
    )


def test_one_observer_only(solve_refused, tmp_path):
    sentence = solve_refused(foreign(tmp_path / "run.mcap", [stance_row(10, observers=("A",))]))
    assert re.search(r"run.mcap: stance 0 has one observer only.*at least two robots", sentence)


def test_a_reference_that_does_not_observe(solve_refused, short, copied, tmp_path):
    team = msgspec.structs.replace(open_run(short).team, reference="C")
    sentence = solve_refused(copied(short, tmp_path / "run.mcap", team=team))
    assert re.search(r"reference robot C does not observe at stance 0.*name one of A, B", sentence)


def test_collinear_tracks(solve_refused, short, copied, collinear, tmp_path):
    def change(record):
        return collinear(record) if isinstance(record, Detections) else record

    sentence = solve_refused(copied(short, tmp_path / "run.mcap", change=change))
    assert re.search(r"run.mcap: .*stance 0, A and B: .*one line .*let it turn", sentence), sentence


@pytest.mark.parametrize("how", ["at other instants", "other markers", "one camera blind"])
def test_markers_that_are_never_in_both_cameras_at_once(solve_refused, short, copied, tmp_path, how, capsys):
    def change(record):
        if not isinstance(record, Detections):
            return record
        if how == "at other instants":
            late = 0.02 if record.robot == "B" else 0.0  # frames come every 0.1 s
            return dataclasses.replace(record, time=record.time + late)
        if how == "other markers":
            return dataclasses.replace(record, markers=tuple(f"{one}{record.robot}" for one in record.markers))
        return None if record.robot == "B" else record

    run = copied(short, tmp_path / "run.mcap", change=change)
    sentence = solve_refused(run)
    assert re.search(r"run.mcap: no stance gives a relative pose; stance 0, A and B: ", sentence), sentence
    words = {
        "at other instants": r"at the same instant \(within 5 ms\).*clocks",
        "other markers": r"no marker name is shared: A saw `C/0A`, `C/1A` and B saw `C/0B`, `C/1B`",
        "one camera blind": r"never see a marker at the same instant: only A saw one",
    }
    assert re.search(words[how], sentence), sentence
    assert main(["info", str(run)]) == 0
    problem = {"at other instants": "share no instant", "other markers": "no marker name is shared"}
    assert f"{problem.get(how, 'B recorded neither')}" in capsys.readouterr().out
    assert ":" in sentence.split("A and B: ", 1)[1], "no remedy: " + sentence


def test_a_camera_that_is_not_above_the_markers(solve_refused, refused, short, copied, tmp_path, capsys):
    team = open_run(short).team
    low = (msgspec.structs.replace(r, mount_if_any=msgspec.structs.replace(r.mount, height=0.15)) for r in team.robots)
    team = msgspec.structs.replace(team, robots=tuple(low))
    run = copied(short, tmp_path / "run.mcap", team=team)
    sentence = solve_refused(run)
    assert re.search(r"stance 0, A and B: the camera \(0.15 m\) is not above the markers \(0.15 m\).*mount", sentence)
    assert main(["info", str(run)]) == 0
    assert "problem: stance 0: A: the camera (0.15 m) is not above the markers" in capsys.readouterr().out


def test_a_run_that_is_none(solve_refused, refused, tmp_path):
    (tmp_path / "text.mcap").write_text("no MCAP at all, but long enough to be one" * 10)
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "folder.mcap").mkdir()
    for name in ("text", "empty", "folder", "missing"):
        for sentence in (solve_refused(tmp_path / f"{name}.mcap"), refused("info", tmp_path / f"{name}.mcap")):
            assert sentence.startswith(f"{tmp_path / name}.mcap: "), sentence


def test_a_run_cut_to_half_is_used_as_far_as_it_goes(hallway, tmp_path, capsys):
    data = hallway.read_bytes()
    (tmp_path / "half.mcap").write_bytes(data[: len(data) // 2])
    run = open_run(tmp_path / "half.mcap")
    assert 0 < len(run.stances) < 8
    assert main(["solve", str(tmp_path / "half.mcap"), "--out", str(tmp_path / "out")]) == 0
    assert re.search(r"warning: .*half.mcap: was cut off, the last \d+ bytes", capsys.readouterr().err)
    assert main(["info", str(tmp_path / "half.mcap")]) == 0
    assert "problem: file: " in capsys.readouterr().out


def test_info_names_what_is_wrong_with_a_run(short, copied, tmp_path, capsys):
    first, second, third = open_run(short).stances
    stances = [
        first,
        dataclasses.replace(second, anchors=()),
        Stance(2, third.start, third.end, third.observers[:1], third.movers, third.anchors),
    ]
    copied(short, tmp_path / "run.mcap", stances=stances)
    assert main(["info", "--json", str(tmp_path / "run.mcap")]) == 0
    problems = json.loads(capsys.readouterr().out)["problems"]
    assert any(p["where"] == "stance 1" and p["what"].startswith("no anchor") for p in problems)
    assert any(p["where"] == "stance 2" and p["what"].startswith("one observer only") for p in problems)
    assert not [p for p in problems if p["where"] == "stance 0"]


# --- places to write to


def test_a_result_that_would_replace_something_else_is_refused_before_the_work(refused, short, tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "mine").write_text("mine")
    for name, words in (
        ("file", "file exists and is not a result: give another folder"),
        ("folder", "folder exists and is not a result"),
        ("file/below", "file is not a folder: give another folder"),
    ):
        assert words in refused("solve", short, "--out", tmp_path / name)
    sentence = refused("demo", "--stances", "1", "--out", tmp_path / "file")
    assert "file" in sentence


def test_a_run_cannot_be_written_where_there_is_no_folder(refused, tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    for name in ("file/run.mcap", "missing/run.mcap", "folder"):
        sentence = refused("simulate", "single-step", "--points", 20, "--out", tmp_path / name)
        assert str(tmp_path / name) in sentence


def test_a_run_replaces_nothing_but_a_run_and_that_with_force_only(refused, import_refused, short, tmp_path, capsys):
    (tmp_path / "thesis.tex").write_text("years of work")
    (tmp_path / "run.mcap").write_bytes(short.read_bytes())
    simulate = ["simulate", "single-step", "--points", 20, "--out"]
    for force in ([], ["--force"]):
        assert "thesis.tex exists and is not a run; give another name" in refused(
            *simulate, tmp_path / "thesis.tex", *force
        )
    assert "run.mcap is an earlier run; replace it with --force" in refused(*simulate, tmp_path / "run.mcap")
    assert "run.mcap is an earlier run; replace it with --force" in import_refused()
    assert main([*map(str, simulate), str(tmp_path / "run.mcap"), "--force"]) == 0
    assert len(open_run(tmp_path / "run.mcap").stances) == 1
    capsys.readouterr()


def test_a_folder_that_is_missing_is_named(refused, tmp_path):
    sentence = refused("simulate", "single-step", "--out", tmp_path / "nodir" / "x.mcap")
    assert "nodir does not exist; make the folder" in sentence and ".part" not in sentence


def test_an_earlier_result_that_stays_after_a_failed_solve_is_mentioned(refused, short, short_result, copied, tmp_path):
    shutil.copytree(short_result, tmp_path / "out")
    copied(short, tmp_path / "empty.mcap", stances=())
    sentence = refused("solve", tmp_path / "empty.mcap", "--out", tmp_path / "out")
    assert sentence.endswith(f"; {tmp_path / 'out'} still holds an earlier result")


def test_a_result_is_not_compared_with_another_run(refused, result, short):
    assert re.search(r"short.mcap is not the run of the result ", refused("evaluate", result, "--run", short))


def test_the_present_folder_as_a_run_is_refused(refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "is a folder" in refused("simulate", "single-step", "--points", 20, "--out", ".")


# --- arguments


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["simulate", "labyrinth"], r"no scenario `labyrinth`; choose one of single-step, six-step, hallway"),
        (["simulate", "hallway", "--mount-sigma", "-1"], r"`mount_sigma_deg` is -1.0; give a number"),
        (["simulate", "hallway", "--noise", "nan"], r"`noise_px` is nan; give a finite number"),
        (["simulate", "hallway", "--stances", "0"], r"0 stances; give at least 1"),
        (["simulate", "hallway", "--stances", "many"], r"--stances.*see `coloc simulate --help`"),
        (["simulate", "hallway", "--points", "5"], r"`points` is 5; a homography needs at least 6"),
        (["simulate", "hallway", "--fps", "30"], r"--fps does not apply with --depth tracks; leave it out"),
        (["simulate", "hallway", "--image-format", "png"], r"--image-format does not apply with --depth tracks"),
        (["simulate", "hallway", "--depth", "images", "--noise", "1"], r"--noise does not apply with --depth images"),
        (["simulate", "hallway", "--seed", "-1"], r"`seed` is -1"),
        (["simulate", "hallway", "--depth", "sound"], r"--depth.*see `coloc simulate --help`"),
        (["demo", "--stances", "0"], r"0 stances; give at least 1"),
    ],
)
def test_bad_arguments(refused, tmp_path, arguments, words):
    sentence = refused(*arguments, "--out", tmp_path / "out")
    assert re.search(words, sentence), sentence


def test_an_unknown_method_or_command_or_none(refused, short, tmp_path):
    sentence = refused("solve", short, "--out", tmp_path / "out", "--method", "guess")
    assert "guess" in sentence and "chain" in sentence and "smooth" in sentence
    assert "dance" in refused("dance")
    assert "--out" in refused("solve", short)


def test_evaluating_without_truth_or_without_a_result(refused, short, copied, tmp_path, capsys):
    run = copied(short, tmp_path / "run.mcap")
    assert main(["solve", str(run), "--out", str(tmp_path / "out")]) == 0
    capsys.readouterr()
    assert re.search(r"run.mcap: the run holds no truth .*; record it", refused("evaluate", tmp_path / "out"))
    assert "is not a result" in refused("evaluate", tmp_path / "nowhere")
    (tmp_path / "out" / "trajectories" / "A.tum").write_text("1 2 3\n")
    assert re.search(r"A.tum, line 1: 8 finite numbers", refused("evaluate", tmp_path / "out"))


def test_truth_that_does_not_cover_the_run_stops_no_estimate(short, tmp_path, capsys):
    from coloc_graph.run import RunWriter

    run = open_run(short)
    with RunWriter(tmp_path / "run.mcap", run.team) as writer:
        writer.write_truth("A", run.stances[0].start, np.eye(4))
        for stance in run.stances:
            writer.write(stance)
            for robot in stance.observers:
                for one in run.detections(robot, stance.start, stance.end):
                    writer.write(one)
    assert main(["solve", str(tmp_path / "run.mcap"), "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "trajectories" / "B.tum").exists()
    said = capsys.readouterr()
    assert "robot B" in said.out + said.err
