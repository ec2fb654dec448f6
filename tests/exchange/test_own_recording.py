"""The page "Your own recording": its commands, run as they stand on two folders of images."""

import csv
import re
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest

from coloc_graph.cli import main
from coloc_graph.results.folder import read_result
from coloc_graph.run import open_run, read_truth
from coloc_graph.simulation import simulate

PAGE = Path(__file__).parents[2] / "docs" / "own-recording.md"


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A folder with A/*.png, B/*.png and times.csv, as a user has them, and the truth elsewhere."""
    folder, truth = (tmp_path_factory.mktemp(name) for name in ("own", "truth"))
    simulate("hallway", truth / "run.mcap", depth="images", stances=2, seed=1, points=60, image_format="png")
    run = open_run(truth / "run.mcap")
    rows = [("robot", "file", "time")]
    for robot in "AB":
        (folder / robot).mkdir()
        for k, image in enumerate(run.images(robot)):
            cv2.imwrite(str(folder / robot / f"{k}.png"), image.pixels)
            rows.append((robot, f"{robot}/{k}.png", f"{image.time:.6f}"))
    with (folder / "times.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    return folder, truth / "run.mcap"


def test_the_commands_of_the_page_give_a_result(recording, monkeypatch, capsys):
    folder, true_run = recording
    monkeypatch.chdir(folder)
    text = PAGE.read_text(encoding="utf-8")
    commands = re.search(r"```sh\n(.*?)```", text, re.S)[1].strip().splitlines()
    assert len(commands) == 5
    for command in commands:
        words = shlex.split(command)
        assert words[0] == "coloc" and main(words[1:]) == 0, (command, capsys.readouterr().err)
        if words[1:3] == ["team", "new"]:  # what `coloc calibrate camera` finds
            team = Path("team.toml").read_text(encoding="utf-8")
            lens = "fps = 30.0\ndistortion = [-0.1, 0.02, 0.0005, -0.0003]"
            Path("team.toml").write_text(team.replace("fps = 30.0", lens), encoding="utf-8")
    result = read_result("result")
    truth = read_truth(true_run)
    for robot in "AB":
        found = result.trajectories[robot].positions[-1] - result.trajectories["A"].positions[0]
        at = int(np.argmin(np.abs(truth[robot].times - result.trajectories[robot].times[-1])))
        true = truth[robot].positions[at] - truth["A"].positions[0]
        assert np.abs(np.linalg.norm(found) - np.linalg.norm(true)) < 0.01
