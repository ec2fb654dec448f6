"""`coloc plan`: the table, the plan that a simulated team follows, and bad input."""

import json
import re

import cv2
import msgspec
import numpy as np
import pytest

from coloc_graph.cli import main
from coloc_graph.planning.formation import Gait
from coloc_graph.planning.gaits import GaitSearch
from coloc_graph.planning.plan import read_plan
from coloc_graph.planning.prediction import Predictor
from coloc_graph.run import open_run
from coloc_graph.simulation import Imperfections, reference_team
from coloc_graph.simulation.rig import stated_team
from coloc_graph.team import write_team

FIELD = Imperfections(mount_sigma_deg=1.0, height_sigma=0.005, span_sigma=1e-4, floor_sigma_deg=0.1)


@pytest.fixture(scope="module", autouse=True)
def few_gaits():
    """Compare fewer gaits than a user does."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("coloc_graph.planning.gaits.LEAPS", (0.4, 0.8))
        patch.setattr("coloc_graph.planning.gaits.ABREAST", (0.5,))
        patch.setattr("coloc_graph.planning.gaits.TOE_INS", (25.0,))
        yield


@pytest.fixture(scope="module")
def team(tmp_path_factory):
    path = tmp_path_factory.mktemp("team") / "team.toml"
    write_team(stated_team(reference_team(), FIELD), path)
    return str(path)


def test_the_best_plan_promises_more_than_the_paper_s_and_is_written_and_drawn(team, tmp_path, capsys):
    poses, picture = tmp_path / "plan.csv", tmp_path / "plan.png"
    arguments = [
        "plan",
        team,
        "--length",
        "2.4",
        "--fps",
        "10",
        "--json",
        "--poses",
        str(poses),
        "--draw",
        str(picture),
    ]
    assert main(arguments) == 0
    found = json.loads(capsys.readouterr().out)
    best, paper = found["the best plan"], found["the paper's formation"]
    assert best["end_sigma"] < 0.6 * paper["end_sigma"]
    assert best["capture_seconds"] == pytest.approx(paper["capture_seconds"])
    plan = read_plan(poses)
    assert len(plan.stances) == best["stances"]
    last = np.array(list(plan.stances[-1].standing.values()))
    assert last[:, 0].max() == pytest.approx(2.4, abs=0.5)
    assert picture.read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize("way", [["--length", "1.2"], ["--goal", "1.2,0"]])
def test_a_wanted_sigma_is_kept_by_the_planned_drives_and_decides_the_time_alone(team, capsys, way):
    assert main(["plan", team, *way, "--fps", "10", "--sigma-end", "2.5mm", "--json"]) == 0
    found = next(iter(json.loads(capsys.readouterr().out).values()))
    assert 0.0018 < found["end_sigma"] <= 0.0025
    # by far fewer images than the paper's formation takes
    assert found["capture_seconds"] < 0.7 * 35.0


def test_a_tighter_sigma_takes_a_longer_mission():
    gaits = [Gait(0.5, 0.6, 10.0), Gait(1.0, 0.5, 25.0)]
    predictor = Predictor(stated_team(reference_team(), FIELD), 10.0)
    times = [GaitSearch(predictor, 2.0, ("A", "B"), "C", gaits).shortest(sigma) for sigma in (0.004, 0.002)]
    assert times[0] < 0.7 * times[1]
    search = GaitSearch(predictor, 2.0, ("A", "B"), "C", gaits)
    gait, mission = search.planned(search.ranked(time=times[1]))
    assert gait in gaits
    assert mission.end_sigma < 1.1 * 0.002


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (
            ["--sigma-end", "0.1mm"],
            "no plan reaches 0.1 mm at the end of 2 m: the best one .* would help most",
        ),
        (["--time", "3s"], "the time is too short for any gait"),
        (["--time", "4"], "`4` has no unit; give it as in 10min"),
        (["--mover", "X"], "there is no robot X in the team: name one of A, B, C"),
        (["--length", "-2"], "a way of -2.0 m is none"),
        (["--map", "map.yaml"], "a map needs a goal on it"),
        (["--goal", "1e6,0"], "a course of 1e\\+06 m is too long for one plan: give up to 200 m"),
        (["--length", "1e9"], "a way of 1e\\+09 m is too long for one plan: give up to 200 m"),
        (["--goal", "2,0", "--time", "9s"], "9 s are too short for 2.0 m: give a longer time"),
        (["--goal", "2"], "`2` is not a waypoint"),
        (["--goal", "2,0", "--map", "none.yaml"], "none.yaml"),
        (["--fps", "0"], "--fps is 0.0; give a number above 0"),
    ],
)
def test_what_cannot_be_planned_is_one_sentence(team, capsys, arguments, sentence):
    try:
        code = main(["plan", team, "--length", "2", *arguments])
    except SystemExit as ended:
        code = ended.code
    assert code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert re.search(sentence, error)


def test_cameras_that_look_away_share_no_view(tmp_path, capsys):
    new = msgspec.structs.replace
    team = stated_team(reference_team(), FIELD)
    up = tuple(new(robot, mount_if_any=new(robot.mount, tilt_deg=-60.0)) for robot in team.robots)
    write_team(new(team, robots=up), tmp_path / "team.toml")
    assert main(["plan", str(tmp_path / "team.toml")]) == 2
    assert "share no view of C's markers in any formation" in capsys.readouterr().err


def test_a_plan_along_goals_keeps_off_the_walls_of_a_map(team, tmp_path, capsys):
    free = np.zeros((60, 80), np.uint8)
    free[20:40, 5:75] = 254  # a corridor of 2 m
    cv2.imwrite(str(tmp_path / "map.png"), free)
    text = "image: map.png\nresolution: 0.1\norigin: [-2.0, -3.0, 0.0]\nnegate: 0\nfree_thresh: 0.2\n"
    (tmp_path / "map.yaml").write_text(text)
    poses, picture = str(tmp_path / "plan.csv"), str(tmp_path / "plan.png")
    walls = ["--map", str(tmp_path / "map.yaml"), "--draw", picture]
    assert main(["plan", team, "--goal", "2,0", *walls, "--fps", "10", "--json", "--poses", poses]) == 0
    found = json.loads(capsys.readouterr().out)["the plan"]
    plan = read_plan(poses)
    assert len(plan.stances) == found["stances"] > 1
    places = np.array([pose[:2] for stance in plan.stances for pose in stance.standing.values()])
    assert np.abs(places[:, 1]).max() < 0.75
    assert places[-2:, 0].mean() == pytest.approx(2.0, abs=0.5)
    for goals in (["--goal", "2,3"], ["--goal", "2,3", "--goal", "4,0"]):
        assert main(["plan", team, *goals, "--map", str(tmp_path / "map.yaml")]) == 2
        assert "the goal at 2.00, 3.00 is in a wall or beyond the map" in capsys.readouterr().err


def test_a_team_whose_mover_has_no_camera_follows_its_plan(tmp_path, capsys):
    team, plan, out = (str(tmp_path / name) for name in ("team.toml", "plan.csv", "run.mcap"))
    assert main(["team", "new", "A", "B", "C", "--no-camera", "C", "--out", team]) == 0
    assert main(["plan", team, "--length", "1", "--fps", "10", "--time", "30s", "--poses", plan]) == 0
    assert main(["simulate", "hallway", "--plan", plan, "--team", team, "--fps", "10", "--out", out]) == 0
    run = open_run(out)
    assert len(run.stances) > 1
    assert run.team["C"].camera_if_any is None
