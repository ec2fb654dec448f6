"""Recorded missions, with a kill and a push, are estimated again as online."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from coloc_graph.cli import main
from coloc_graph.errors import InputError
from coloc_graph.online.replay import replay

RECORDED = Path(__file__).parent / "recorded"


def entered(folder):
    rows = [json.loads(line) for line in (folder / "mission.jsonl").read_text().splitlines()]
    return {row["stance"]: row["poses"] for row in rows if row["what"] == "entered"}


@pytest.mark.parametrize("folder", sorted(RECORDED.iterdir()), ids=lambda folder: folder.name)
def test_a_recorded_mission_gives_the_poses_of_online(folder):
    online, found = entered(folder), list(replay(folder))
    assert [one.entered.stance.index for one in found] == list(online)
    for one in found:
        poses = one.entered.estimate.poses
        assert poses.keys() == online[one.entered.stance.index].keys()
        for name, pose in poses.items():  # bits depend on processor and libraries
            np.testing.assert_allclose(pose.matrix(), online[one.entered.stance.index][name], atol=1e-6)


def test_replay_says_what_differs_and_what_is_not_known(tmp_path, capsys):
    folder = shutil.copytree(RECORDED / "three-stances", tmp_path / "mission")
    log = folder / "mission.jsonl"
    rows = [json.loads(line) for line in log.read_text().splitlines()]
    for row in rows:
        if row["what"] == "entered":
            row["digest"] = "another" if row["stance"] == 1 else ""
    log.write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert main(["replay", str(folder)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3 and "differs from online" in lines[1] and "not in the log" in lines[2]
    log.write_text("".join(json.dumps(row) + "\n" for row in rows if row["what"] == "state"))  # as of earlier versions
    assert main(["replay", "--json", str(folder)]) == 0
    assert [row["same"] for row in json.loads(capsys.readouterr().out)] == [None] * 3
    log.write_text('{"what": "entering"}\n')
    assert main(["replay", str(folder)]) == 2 and "is not the log of a mission" in capsys.readouterr().err
    with pytest.raises(InputError, match="is not the folder of a mission"):
        next(replay(tmp_path))
