"""A lone mover's two equal lights, tracked with hindsight where they move far from image to image."""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend import (
    FrontendOptions,
    StanceTracks,
    correspond,
    describe_unused,
    measure_pair,
    plane_from_mount,
    sight_movers,
    unsighted_movers,
)
from coloc_graph.frontend.odometry import WheelTrack
from coloc_graph.frontend.pairing.rigid_alignment import align_paths
from coloc_graph.frontend.tracks.rigid_path import rigid_path
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.run import OdometrySample, Stance
from coloc_graph.simulation.crowd import STEP, Faults, detect, lights_of, wander
from coloc_graph.simulation.paths import SPEED
from coloc_graph.simulation.rig import reference_team
from coloc_graph.team.shared_view import View

TEAM = reference_team()
POSES = ((0.0, 0.4, -0.3), (0.0, -0.4, 0.3))
WINDOW = 5e-3


@dataclass(frozen=True)
class Scene:
    """One stance as recorded: what both cameras detected, which light each detection is, and where lights are."""

    seen: dict
    lights: dict
    uv: dict
    stance: Stance
    team: object = TEAM
    path: Path = Path("scene")
    planes: dict = field(default_factory=dict)

    def has_detections(self, robot):
        return True

    def detections(self, robot, start, end):
        return (one for one in self.seen[robot] if start <= one.time <= end)

    def order(self, path):
        """Whether the first light of each sample of a path is the robot's first."""
        of = {one.time: n for n, one in enumerate(self.seen[path.robot])}
        true = self.uv[path.robot][[of[time] for time in path.times.tolist()]]
        return np.linalg.norm(path.uv[:, 0] - true[:, 0], axis=1) < np.linalg.norm(path.uv[:, 0] - true[:, 1], axis=1)


def scene(fps, speed, seed, poses=None, seconds=8.0):
    rng = np.random.default_rng((seed, 7))
    times = np.arange(round(seconds * fps)) / fps
    faster = speed / SPEED
    poses = wander(1, faster * seconds + STEP, (0.8, 2.2, -0.6, 0.6), rng) if poses is None else poses
    p_lights = lights_of(poses, faster * times, TEAM["C"].markers.p_body)
    seen, lights, uv = {}, {}, {}
    for name, pose in zip("AB", POSES, strict=True):
        view = View(TEAM[name].camera, floor_pose(*pose) @ TEAM[name].mount.T_body_camera)
        found = detect(view, name, p_lights, 1000.0 + times, Faults(false_detections=1.0), rng)
        seen[name], lights[name] = found.images, found.lights
        uv[name] = view.project(p_lights[:, 0])[0]
    return Scene(seen, lights, uv, Stance(0, 999.0, 1000.0 + seconds, ("A", "B"), ("C",)))


def path_of(one, robot):
    plane = plane_from_mount(TEAM[robot].mount, TEAM["C"].markers)
    return rigid_path(robot, one.seen[robot], TEAM[robot].camera, [plane], TEAM["C"].markers.span)


@pytest.mark.parametrize(("fps", "speed", "seed"), [(10.0, 0.4, 0), (10.0, 0.4, 1), (5.0, 0.5, 2), (10.0, 1.0, 3)])
def test_lights_are_never_swapped_within_a_piece_and_both_cameras_order_them_alike(fps, speed, seed):
    one = scene(fps, speed, seed)
    paths = path_of(one, "A"), path_of(one, "B")
    for path in paths:
        for piece in range(path.pieces):
            order = one.order(path)[path.piece == piece]
            assert max(order.mean(), 1 - order.mean()) > 0.97  # a false detection may be nearer
    i, j = align_paths(*paths, WINDOW)
    largest = np.bincount(i.piece).argmax()
    ordered = [one.order(path)[path.piece == largest] for path in (i, j)]
    assert min(map(len, ordered)) > 15
    assert abs(ordered[0].mean() - ordered[1].mean()) < 0.05


def arcs(seconds):
    """A robot that drives curves, to and fro between fast and slow turns."""
    t = STEP * np.arange(round(seconds / STEP) + 1)
    turn = 1.6 * np.sin(1.7 * t) + 1.3 * np.sin(0.6 * t + 1)
    x, y = 1.35 + 0.35 * np.sin(1.3 * t), 0.4 * np.sin(0.9 * t + 0.5)
    return np.stack([x, y, np.cumsum(turn) * STEP], axis=1)[:, None]


def test_a_stance_that_the_causal_tracker_cannot_follow_is_measured():
    one = scene(10.0, 4 * SPEED, 0, arcs(20.1), seconds=5.0)
    tracks = StanceTracks(one, one.stance)
    with pytest.raises(DegenerateGeometry):
        correspond(tracks.of("A"), tracks.of("B"), TEAM["A"].camera, TEAM["B"].camera, alone=True)
    measured = measure_pair(one, one.stance, "A", "B", FrontendOptions(), tracks)
    assert measured.homography.unusable is None
    assert measured.homography.inliers > 70
    T_i_j = np.linalg.inv(floor_pose(*POSES[0])) @ floor_pose(*POSES[1])
    off = np.linalg.inv(T_i_j) @ measured.relative_pose.T_i_j
    assert np.linalg.norm(off[:2, 3]) < 0.015
    assert {track.mover for side in measured.tracks for track in side} == {"C"}


def test_a_body_that_turns_on_the_spot_leaves_the_order_open():
    k = np.arange(round(20 / STEP) + 1)
    poses = np.stack([np.full(len(k), 1.4), np.zeros(len(k)), 1.0 * STEP * k], axis=1)[:, None]
    one = scene(10.0, 0.2, 0, poses)
    paths = path_of(one, "A"), path_of(one, "B")
    assert align_paths(*paths, WINDOW) == paths
    assert "ambiguous" in measure_pair(one, one.stance, "A", "B", FrontendOptions()).homography.unusable


def test_a_mover_too_fast_for_the_frame_rate_is_refused_with_what_was_seen():
    one = scene(2.0, 1.0, 1, seconds=12.0)
    why = measure_pair(one, one.stance, "A", "B", FrontendOptions()).homography.unusable
    assert re.search(r"A saw 2 lights or more in \d+ % of its 24 images, \d+ px apart, median step \d+ px", why)
    assert re.search(r"its tracks broke \d+ times: record more images a second", why)


def renamed(one, names):
    """The scene with the lights' true identities under other names."""
    seen = {
        robot: [
            replace(image, markers=tuple(names[n] if n >= 0 else "" for n in lights), uv=image.uv)
            for image, lights in zip(images, one.lights[robot], strict=True)
        ]
        for robot, images in one.seen.items()
    }
    kept = {
        robot: [
            replace(image, **{
                name: getattr(image, name)[[bool(m) for m in image.markers]]
                for name in ("uv", "covariance", "flags", "peak", "area")
            }, markers=tuple(filter(None, image.markers)))
            for image in images
        ]
        for robot, images in seen.items()
    }  # fmt: skip
    return replace(one, seen=kept)


@pytest.mark.parametrize("names", [("C/0", "C/1"), ("led0", "led1"), ("7", "12")])
def test_a_mover_with_named_markers_is_sighted_whatever_their_names(names):
    one = renamed(scene(20.0, 0.2, 0), names)
    measured = measure_pair(one, one.stance, "A", "B", FrontendOptions())
    assert [span.mover for span in measured.relative_pose.spans] == ["C"]
    (sighting,) = sight_movers(one, one.stance, [measured], {})
    assert sighting.seen == "C"
    assert not unsighted_movers(one, one.stance, [measured], {}, [sighting])


def test_wheels_tell_which_of_two_markers_with_any_names_is_which():
    poses = arcs(20.1)
    one = renamed(scene(20.0, SPEED, 0, poses), ("port", "starboard"))
    measured = measure_pair(one, one.stance, "A", "B", FrontendOptions())
    assert not sight_movers(one, one.stance, [measured], {})
    driven = [OdometrySample("C", 1000.0 + STEP * k, pose, 1e-6 * np.eye(3)) for k, pose in enumerate(poses[:, 0])]
    (sighting,) = sight_movers(one, one.stance, [measured], {"C": WheelTrack("C", driven)})
    at = floor_pose(*poses[round((sighting.time - 1000.0) / STEP), 0])
    off = np.linalg.inv(at) @ floor_pose(*POSES["AB".index(sighting.observer)]) @ sighting.T_observer_seen
    assert np.linalg.norm(off[:2, 3]) < 0.03 and off[0, 0] > 0.99  # and not the other way round


def test_a_mover_whose_like_lights_nothing_tells_apart_has_a_reason():
    one = scene(20.0, 0.2, 0)
    measured = measure_pair(one, one.stance, "A", "B", FrontendOptions())
    assert measured.relative_pose is not None
    assert not sight_movers(one, one.stance, [measured], {})
    (doubt,) = unsighted_movers(one, one.stance, [measured], {}, [])
    assert describe_unused([doubt]) == [
        "stance 0: C has no pose as A sees it: its two equal lights cannot be told apart; record its wheel odometry, "
        "or name its markers `C/0` and `C/1`"
    ]
