"""The page that plays a scene without a server: what is recorded in it."""

import base64
import re
from dataclasses import replace

import msgspec
import numpy as np
import pytest
import zstandard

from coloc_graph.geometry.lie import floor_pose
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.run import open_run
from coloc_graph.viewer import Scene, empty_scene, export, scene_of_result
from coloc_graph.viewer.frame import ViewState, frame_of
from coloc_graph.viewer.scene import layer_of


@pytest.fixture(scope="module")
def scene(result):
    return scene_of_result(result)


def recorded(page):
    """The seconds of a page's recording, and its messages with the times at which they are played."""
    data = base64.b64decode(re.search(r'__VISER_EMBED_DATA__="([^"]*)"', page)[1])
    inner = zstandard.ZstdDecompressor().decompress(data[8:], max_output_size=int.from_bytes(data[:8], "little"))
    packed = msgspec.msgpack.decode(inner[8 : 8 + int.from_bytes(inner[:8], "little")])
    return packed["durationSeconds"], packed["messages"]


def seen(messages, until, kind, name, what):
    """What the last message of a kind about a node says by then."""
    return [m[what] for time, m in messages if time <= until + 1e-6 and m["type"] == kind and m.get("name") == name][-1]


def state_of(scene, **options):
    return ViewState(shown=frozenset(layer.name for layer in scene.layers), **options)


def test_every_stance_is_played_at_its_time(scene):
    seconds, messages = recorded(export.page_of(scene, state_of(scene)))
    assert np.isclose(seconds, len(scene) - 1 + export.HELD_SECONDS)
    for row in range(len(scene)):
        frame = frame_of(scene, state_of(scene, time=scene.middle(row)))
        for robot, pose in zip(scene.robots, frame.poses, strict=True):
            at = seen(messages, row, "SetPositionMessage", f"/robots/{robot}", "position")
            assert np.allclose(at, pose[:3], atol=1e-6)
        told = [m["updates"] for t, m in messages if m.get("name") == "/stance" and "updates" in m and t <= row + 1e-6]
        assert [one["text"] for one in told if "text" in one][-1] == f"stance {row}"
    # and it drives from the one to the other
    halfway = frame_of(scene, state_of(scene, time=(scene.middle(0) + scene.middle(1)) / 2)).poses[2]
    at = seen(messages, 0.5, "SetPositionMessage", "/robots/C", "position")
    assert np.allclose(at, halfway[:3], atol=1e-6)
    assert np.linalg.norm(halfway[:2] - scene.layers[0].xyz[2, 0, :2]) > 0.02


def test_titles_are_text_and_the_legend_is_in_the_page(scene):
    page = export.page_of(replace(scene, title="<script>alert(1)</script>"), state_of(scene, k_sigma=30))
    assert "<script>alert(1)" not in page and "&lt;script&gt;alert(1)" in page
    assert "ellipses and wedges: 30 sigma" in page and "anchor of this stance" in page


def test_of_a_long_run_some_stances_are_played_and_the_page_says_so(scene, monkeypatch):
    assert "stances are played" not in export.page_of(scene, state_of(scene))
    monkeypatch.setattr(export, "MAX_STANCES", 4)
    monkeypatch.setattr(export, "MAX_STANCES_IN_FULL", 3)
    page = export.page_of(scene, state_of(scene))
    seconds, messages = recorded(page)
    assert f"4 of {len(scene)} stances are played" in page and np.isclose(seconds, 3 + export.HELD_SECONDS)
    last = seen(messages, 3, "SetPositionMessage", "/robots/A", "position")
    assert np.allclose(last, scene.layers[0].xyz[0, -1], atol=1e-6)


@pytest.mark.parametrize("make", ["nothing", "empty", "one stance"])
def test_a_scene_without_a_way_is_a_page_that_stands(make, short):
    drawn, stances = Scene(("A",), ()), open_run(short).stances[:1]
    if make != "nothing":
        drawn = empty_scene(open_run(short), "joint")
    if make == "one stance":
        first = Trajectory("A", np.zeros(1), floor_pose([1.0], [2.0], [0.0]), np.zeros(1, int), np.zeros((1, 6, 6)))
        drawn = replace(drawn, stances=stances, layers=(layer_of("joint", drawn.robots, stances, {"A": first}),))
    seconds, messages = recorded(export.page_of(drawn, state_of(drawn)))
    assert seconds == 0 and any(m.get("name") == "/floor" for _, m in messages)
    if make == "one stance":
        assert np.allclose(seen(messages, 0, "SetPositionMessage", "/robots/A", "position"), (1, 2, 0))


def test_from_afar_robots_are_drawn_larger_and_the_page_says_so(scene):
    far = replace(scene.layers[0], xyz=scene.layers[0].xyz * 50)
    page = export.page_of(replace(scene, layers=(far,), wheels={}), state_of(scene))
    size = int(re.search(r"robots are drawn (\d+) times as large", page)[1])
    _, messages = recorded(page)
    said = [m["updates"] for _, m in messages if m.get("name") == "/robots/A/body" and "updates" in m]
    assert size > 1 and {"scale": size} in said
    assert "times as large" not in export.page_of(scene, state_of(scene))
