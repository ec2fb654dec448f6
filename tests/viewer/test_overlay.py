"""Legend and scale over a picture."""

import numpy as np
import pytest

from coloc_graph.viewer import scene_of_result
from coloc_graph.viewer.cameras import FOV, camera_on
from coloc_graph.viewer.frame import ViewState
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
