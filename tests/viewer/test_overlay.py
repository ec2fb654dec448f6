"""Legend and scale over a picture."""

import numpy as np
import pytest

from coloc_graph.viewer import scene_of_result
from coloc_graph.viewer.cameras import ASPECT, FILLED, FOV, TALL, camera_on
from coloc_graph.viewer.frame import ViewState
from coloc_graph.viewer.meshes import disc, ring, wedge
from coloc_graph.viewer.motion import extent
from coloc_graph.viewer.overlay import BAR, overlay_script, scale_bar


def test_the_bar_is_as_long_as_it_says(result):
    scene = scene_of_result(result)
    length, pixels = scale_bar(scene, 720)
    assert length in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0) and BAR / 2.6 < pixels <= BAR
    # two points so far apart across the picture, seen by a pinhole of this field of view
    eye, at = camera_on(scene)
    ahead = (at - eye) / np.linalg.norm(at - eye)
    right = np.cross(ahead, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    f = 360 / np.tan(FOV / 2)
    seen = [f * ((p - eye) @ right) / ((p - eye) @ ahead) for p in (at, at + length * right)]
    assert seen[1] - seen[0] == pytest.approx(pixels)


def test_the_legend_names_the_robots(result):
    script = overlay_script(scene_of_result(result), ViewState(), (1280, 720))
    assert all(f"&#9679; {robot}" in script for robot in "ABC") and "3 sigma" in script


def test_the_first_camera_sees_all_of_the_data_and_no_more_than_it_must(result):
    scene = scene_of_result(result)
    eye, at = camera_on(scene)
    ahead = (at - eye) / np.linalg.norm(at - eye)
    right = np.cross(ahead, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    low, high = extent(scene)
    corners = np.array([(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (0.0, TALL)]) - eye
    depth = corners @ ahead
    across, up = np.abs(corners @ right) / depth, np.abs(corners @ np.cross(right, ahead)) / depth
    assert depth.min() > 0
    assert max(across.max() / ASPECT, up.max()) == pytest.approx(FILLED * np.tan(FOV / 2), rel=1e-6)


@pytest.mark.parametrize("shape", [disc(), ring(0.5, 1.0), wedge()], ids=["disc", "ring", "wedge"])
def test_flat_shapes_have_their_faces_up(shape):
    vertices, faces = shape
    a, b, c = vertices[faces].swapaxes(0, 1)
    assert (np.cross(b - a, c - a)[:, 2] > 1e-3).all() and set(faces.ravel()) == set(range(len(vertices)))
