"""Recordings that did not begin together, by what both saw at once."""

import numpy as np
import pytest

from coloc_graph.cli.import_ import _offsets
from coloc_graph.errors import InputError
from coloc_graph.exchange.recording_offsets import RecordedTracks, recording_offset
from coloc_graph.frontend import Detector, MarkerTracker
from coloc_graph.frontend.images.detection import Blobs
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.simulation.crowd import STEP, Faults, detect, lights_of, wander
from coloc_graph.simulation.rig import reference_team
from coloc_graph.team.shared_view import View

TEAM = reference_team()
POSES = {"A": (0.0, 0.4, -0.3), "B": (0.0, -0.4, 0.3)}
SECONDS = 9.0


def recorded(robot, poses, late, fps=10.0):
    """A recording that begins `late` [s], whose times count from 0."""
    times = np.arange(round((SECONDS - late) * fps)) / fps
    view = View(TEAM[robot].camera, floor_pose(*POSES[robot]) @ TEAM[robot].mount.T_body_camera)
    p_lights = lights_of(poses, late + times, TEAM["C"].markers.p_body)
    seen = detect(view, robot, p_lights, times, Faults(false_detections=0.0), np.random.default_rng(1))
    tracker = MarkerTracker(robot, Detector(), size=(320, 240))
    for one in seen.images:
        tracker.take(one.time, Blobs(one.uv, one.covariance, one.flags, one.peak, one.area))
    return RecordedTracks(robot, tracker.tracks(), ((0.0, float(times[-1])),))


@pytest.mark.parametrize("late", [(0.0, 3.137), (2.4, 0.0)])
def test_a_recording_that_begins_later_is_moved_by_what_both_saw(late):
    poses = wander(1, SECONDS + STEP, (0.8, 2.2, -0.6, 0.6), np.random.default_rng(4))
    a, b = (recorded(robot, poses, one) for robot, one in zip("AB", late, strict=True))
    assert recording_offset(TEAM, a, b) == pytest.approx(late[1] - late[0], abs=0.02)


def test_recordings_of_different_motions_are_refused_in_words():
    a, b = (
        recorded(robot, wander(1, SECONDS + STEP, (0.8, 2.2, -0.6, 0.6), np.random.default_rng(seed)), 0.0)
        for robot, seed in (("A", 4), ("B", 9))
    )
    with pytest.raises(InputError, match=r"when the recordings of A and B began is not said.*--offset"):
        recording_offset(TEAM, a, b)


@pytest.mark.parametrize("given", ["B", "B=", "B=soon", "B=nan", "B=inf", "B=1e9", "B=-1e9"])
def test_an_offset_that_is_no_time_is_one_sentence(given):
    with pytest.raises(InputError, match=f"--offset: `{given}` is no ROBOT=SECONDS"):
        _offsets(["A=0.5", given])
    assert _offsets(["A=0.5", "B=-9e8"]) == {"A": 0.5, "B": -9e8}
