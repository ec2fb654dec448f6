"""Markers of a robot are told from reflections by a camera that is tilted otherwise than stated."""

import numpy as np
import pytest
from msgspec.structs import replace

from coloc_graph.frontend import plane_from_mount
from coloc_graph.frontend.homography.plane_tilts import plausible_planes
from coloc_graph.frontend.tracks.marker_pairs import markers_of_movers
from coloc_graph.frontend.tracks.track import Track
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.simulation.rig import reference_team
from coloc_graph.team.shared_view import View

TEAM = reference_team()
MOUNT, MARKERS = TEAM["A"].mount, TEAM["C"].markers


def tracks_of(p):
    """Tracks of points (n, m, 3) [m] in the image of A, whose body is the world."""
    uv, _ = View(TEAM["A"].camera, floor_pose(0, 0, 0) @ MOUNT.T_body_camera).project(p.reshape(-1, 3))
    uv = uv.reshape(*p.shape[:2], 2)
    times = 0.1 * np.arange(len(p))
    ones = np.ones(len(p))
    return [Track("A", "", times, uv[:, k], np.tile(0.01 * np.eye(2), (len(p), 1, 1)), ones) for k in range(p.shape[1])]


@pytest.mark.parametrize("wrong", [-2.5, 0.0, 2.5])
def test_two_lights_are_bound_and_not_their_reflections_by_a_mount_that_is_off(wrong):
    k = np.arange(60)
    T = floor_pose(2.0 + 0.4 * np.sin(0.1 * k), 0.5 * np.cos(0.13 * k), 0.2 * k)
    body = np.concatenate([MARKERS.p_body, MARKERS.p_body * (1, 1, -1)])  # the floor is a mirror
    tracks = tracks_of((T[:, None, :3, :3] @ body[..., None])[..., 0] + T[:, None, :3, 3])
    stated = replace(MOUNT, tilt_deg=MOUNT.tilt_deg + wrong, tilt_sigma_deg=1.0)
    plane = plane_from_mount(stated, MARKERS)
    kept = markers_of_movers(tracks, TEAM["A"].camera, plausible_planes(plane, stated), [MARKERS.span], 1)
    assert [tracks.index(next(t for t in tracks if t.uv is one.uv)) for one in kept] == [0, 1]
    assert {one.body for one in kept} == {0}
    if wrong:
        alone = markers_of_movers(tracks, TEAM["A"].camera, [plane], [MARKERS.span], 1)
        assert len(alone) != 2 or {one.body for one in alone} == {-1}
