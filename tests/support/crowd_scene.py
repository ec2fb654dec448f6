"""Robots that wander before the reference pair of cameras, detected, followed and bound: with what is true of it."""

from collections import Counter

import numpy as np

from coloc_graph.frontend import Detector, MarkerTracker, plane_from_mount
from coloc_graph.frontend.images.detection import Blobs
from coloc_graph.frontend.tracks.marker_pairs import markers_of_movers
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.run import Image, RunWriter, Stance, open_run
from coloc_graph.simulation.crowd import STEP, Faults, detect, lights_of, wander
from coloc_graph.simulation.rig import reference_team
from coloc_graph.team.shared_view import View

FACTS = reference_team()["A"]
AREA = (0.8, 2.2, -0.6, 0.6)
SECONDS = 10.0
FPS = 20.0


def movers(n, seed):
    return wander(n, SECONDS + STEP, AREA, np.random.default_rng(seed))


def lockstep(seed):
    """Two robots that drive the same way, side by side."""
    rng = np.random.default_rng(seed)
    poses = wander(1, SECONDS + STEP, AREA, rng)
    angle = rng.uniform(-np.pi, np.pi)
    aside = 0.5 * np.array([np.cos(angle), np.sin(angle), 0.0])
    return np.concatenate([poses - aside / 2, poses + aside / 2], axis=1)


def seen_by_both(poses, seed, hidden=None, faults=None):
    """(tracks, their lights) of each camera; the camera `hidden` does not see the first robot."""
    rng = np.random.default_rng((seed, 1))
    times = np.arange(round(SECONDS * FPS)) / FPS
    p_lights = lights_of(poses, times, FACTS.markers.p_body)
    plane = plane_from_mount(FACTS.mount, FACTS.markers)
    both = []
    for n, side in enumerate((1, -1)):
        view = View(FACTS.camera, floor_pose(0.0, side * 0.4, -side * 0.3) @ FACTS.mount.T_body_camera)
        first = int(hidden == n)
        seen = detect(view, "AB"[n], p_lights[:, first:], times, faults or Faults(false_detections=1.0), rng)
        tracker = MarkerTracker("AB"[n], Detector(), size=(320, 240))
        for one in seen.images:
            tracker.take(one.time, Blobs(one.uv, one.covariance, one.flags, one.peak, one.area))
        tracks = markers_of_movers(tracker.tracks(), FACTS.camera, [plane], [0.25], poses.shape[1])
        both.append((tracks, [light_of(track, seen) + 2 * first for track in tracks]))
    return both


def light_of(track, seen):
    number = {one.time: k for k, one in enumerate(seen.images)}
    lights = Counter()
    for time, uv in zip(track.times.tolist(), track.uv, strict=True):
        k = number[time]
        lights[int(seen.lights[k][np.argmin(np.abs(seen.images[k].uv - uv).sum(axis=1))])] += 1
    return lights.most_common(1)[0][0]


def right(found, both):
    return all(both[0][1][a] == both[1][1][b] for a, b in found.chosen)


def lockstep_run(path, team, image, frames=50, step=0.1):
    """A run of A and B that watch C and D, who drive the same way side by side; where A and B stand; and where they see
    the four lights, (frames, 4, 2) [px]. `image` makes one of these in frame k.
    """
    seen = {}
    poses = {"A": floor_pose(0, 0.4, -0.3), "B": floor_pose(0, -0.4, 0.3)}
    s = np.linspace(0, 2 * np.pi, frames)
    x, y = 1.4 + 0.3 * np.sin(s), 0.25 * np.sin(2 * s)
    yaw = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    way = np.stack([np.stack([x, y + side, yaw], axis=1) for side in (-0.3, 0.3)], axis=1)
    p_lights = lights_of(way, STEP * np.arange(frames), team["C"].markers.p_body)
    with RunWriter(path, team, image_format="raw") as writer:
        writer.write(Stance(0, 100.0, 110.0, ("A", "B"), ("C", "D")))
        for robot, T in poses.items():
            view = View(team[robot].camera, T @ team[robot].mount.T_body_camera)
            seen[robot], _ = view.project(p_lights.reshape(frames, 4, 3))
            for k in range(frames):
                writer.write(Image(robot, 101.0 + step * k, image(seen[robot][k], k)))
    return open_run(path), poses, seen
