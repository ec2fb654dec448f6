"""coloc team new and check: a team that can be solved, also with a robot that only moves and has no camera."""

import re

import pytest

from coloc_graph.cli import main
from coloc_graph.team import read_team


def test_a_new_team_reads_back_and_has_nothing_wrong(tmp_path, capsys):
    path = tmp_path / "team.toml"
    assert main(["team", "new", "A", "B", "C", "--no-camera", "C", "--size", "320x240", "--out", str(path)]) == 0
    team = read_team(path)
    assert team.names == ("A", "B", "C")
    assert team["C"].camera_if_any is None
    assert (team["A"].camera.width, team["A"].camera.height) == (320, 240)
    capsys.readouterr()
    assert main(["team", "check", str(path)]) == 0
    assert "no problem found" in capsys.readouterr().out
    assert main(["team", "new", "A", "B", "C", "--out", str(path)]) == 2
    assert "replace it with --force" in capsys.readouterr().err


def test_a_principal_point_far_from_the_middle_is_said(tmp_path, capsys):
    path = tmp_path / "team.toml"
    assert main(["team", "new", "A", "B", "C", "--size", "320x240", "--out", str(path)]) == 0
    text = path.read_text()
    for axis, at in (("cx", 30.0), ("cy", 20.0)):
        before = next(line for line in text.splitlines() if line.startswith(f"{axis} = "))
        path.write_text(text.replace(before, f"{axis} = {at}", 1))
        main(["team", "check", str(path)])
        said = capsys.readouterr()
        assert "the principal point of A is far from the middle" in said.out + said.err
        assert "principal point of B" not in said.out + said.err


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"height = 0.4": 6.0}, "the camera of A is 6 m high: metres?"),
        ({"height = 0.4": 4.9}, None),
        ({"fx": 90.0}, None),
        ({"fx": 80.0}, "the camera of A sees 152 deg across: is fx (80 px) of this size?"),
        ({"fx": 2500.0}, "the camera of A sees 15 deg across"),
        ({"fx": 2400.0}, None),
        ({"tilt_deg": -30.0}, "the camera of A does not see the floor at a tilt of -30 deg"),
        ({"height_sigma": 0.0, "tilt_sigma_deg": 0.0, "roll_sigma_deg": 0.0}, "the mount of A has no tolerances"),
        ({"height_sigma": 0.0, "tilt_sigma_deg": 0.0}, None),
        ({"positions": "[[0.0, 0.1]]"}, "A carries one marker, which does not tell its heading: give it two"),
        ({"positions": "[[0.0, 2.0], [0.0, -2.0]]"}, "the markers of A are 4 m apart: metres?"),
    ],
)
def test_what_is_implausible_in_a_team_is_said(tmp_path, capsys, changes, words):
    path = tmp_path / "team.toml"
    assert main(["team", "new", "A", "B", "C", "--out", str(path)]) == 0
    head, robots = path.read_text().split("[[robots]]", 1)
    for field, value in changes.items():
        name = field.split(" = ")[0]  # the first height that is 0.4 is the camera's
        robots = re.sub(rf"^{field}\b.*$", f"{name} = {value}", robots, count=1, flags=re.MULTILINE)
    if "positions" in changes:
        robots = re.sub(r"^span_sigma = .*$", "", robots, count=1, flags=re.MULTILINE)
    path.write_text(head + "[[robots]]" + robots)
    capsys.readouterr()
    main(["team", "check", str(path)])
    said = capsys.readouterr()
    assert (words in said.out + said.err) if words else "no problem found" in said.out, said


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["A", "B", "--size", "320"], "write it like 640x480"),
        (["A", "B", "--no-camera", "X"], "`X`, which is not one of the robots A, B"),
        (["A", "B", "--no-camera", "B"], "fewer than two robots have a camera"),
        (["A", "B", "C", "--camera-height", "0.1"], "is not above the markers"),
        (["A", "A"], "two robots are called `A`"),
    ],
)
def test_a_team_that_cannot_be_solved_is_not_written(tmp_path, capsys, arguments, words):
    path = tmp_path / "team.toml"
    assert main(["team", "new", *arguments, "--out", str(path)]) == 2
    assert words in capsys.readouterr().err
    assert not path.exists()


def test_one_robot_is_enough_to_calibrate(tmp_path, capsys):
    team, info = tmp_path / "team.toml", tmp_path / "info.yaml"
    assert main(["team", "new", "A", "--out", str(team)]) == 0
    assert main(["team", "check", str(team)]) == 0
    assert "one robot is enough to calibrate: add those that observe and move" in capsys.readouterr().out
    K, P = "[600, 0, 320, 0, 600, 240, 0, 0, 1]", "[600, 0, 320, 0, 0, 600, 240, 0, 0, 0, 1, 0]"
    info.write_text(
        f"image_width: 640\nimage_height: 480\ncamera_name: a\ncamera_matrix: {{rows: 3, cols: 3, data: {K}}}\n"
        "distortion_model: plumb_bob\ndistortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}\n"
        "rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}\n"
        f"projection_matrix: {{rows: 3, cols: 4, data: {P}}}\n"
    )
    words = ["calibrate", "camera", "--from-camera-info", str(info), "--team", str(team), "--robot", "A"]
    assert main(words) == 0, capsys.readouterr().err
    assert "fx = 600.0" in team.read_text()
