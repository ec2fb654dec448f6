"""Foxglove's own reader libraries decode every message of a run with images and of an exported result."""

import json
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import pytest
from mcap.reader import make_reader

from coloc_graph.cli import main
from coloc_graph.simulation import simulate

NODE = Path(__file__).parents[1] / "node"
INSTALL = ["npm", "install", "--no-audit", "--no-fund", "--no-package-lock", "--silent"]


@pytest.fixture(scope="module")
def decode(tmp_path_factory):
    """Decodes a file by Foxglove's libraries: schema, encoding and number of messages by topic."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("Foxglove's readers need node and npm")
    folder = tmp_path_factory.mktemp("node")
    shutil.copy(NODE / "package.json", folder)
    try:
        subprocess.run(INSTALL, cwd=folder, check=True, timeout=90, capture_output=True)
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired):
        pytest.skip("no registry of npm packages can be reached")

    def run(path):
        done = subprocess.run(
            ["node", NODE / "decode.cjs", path], cwd=folder, capture_output=True, text=True, timeout=90
        )
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return run


def numbers(path):
    """Number of messages by topic, by Python's reader."""
    with path.open("rb") as file:
        return Counter(channel.topic for _, channel, _ in make_reader(file).iter_messages())


def test_an_exported_result_is_decoded_without_json(result, tmp_path, decode):
    path = tmp_path / "result.mcap"
    assert main(["export", "foxglove", str(result), "--out", str(path)]) == 0
    found = decode(path)
    assert {topic: one["messages"] for topic, one in found.items()} == numbers(path)
    assert all(one["encoding"] == "protobuf" and one["schema"].startswith("foxglove.") for one in found.values())
    assert {"/tf", "/scene", "/A/annotations", "/A/calibration"} <= set(found)


def test_a_run_with_images_is_decoded(tmp_path, decode):
    path = tmp_path / "run.mcap"
    simulate("single-step", path, depth="images", fps=4.0, points=20)
    found = decode(path)
    assert {topic: one["messages"] for topic, one in found.items()} == numbers(path)
    assert found["/A/image"]["schema"] == "foxglove.CompressedImage"
