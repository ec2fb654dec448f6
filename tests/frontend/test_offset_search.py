"""Offsets of clocks up to seconds from one motion that two cameras saw, on drawn paths."""

import numpy as np
import pytest
from scipy.stats import chi2

from coloc_graph.frontend.odometry import WheelTrack
from coloc_graph.frontend.pairing.offset_search import TimedPath, search_offset
from coloc_graph.frontend.tracks.track import Track
from coloc_graph.frontend.wheel_offset import refine_wheel_offset
from coloc_graph.geometry.lie import floor_pose, se3_inverse
from coloc_graph.simulation import reference_team
from coloc_graph.simulation.paths import Path
from coloc_graph.simulation.wheels import odometry

H = np.array([[0.9, 0.2, 30.0], [-0.1, 1.1, 12.0], [4e-4, -3e-4, 1.0]])


def motion(times, rng):
    """Path of a marker that wanders about [px]."""
    phases, amplitudes = rng.uniform(0, 2 * np.pi, (2, 4)), 60 / np.arange(1, 5)
    waves = np.sin(2 * np.pi * np.outer(times, [0.06, 0.11, 0.17, 0.25])[:, None] + phases) * amplitudes
    return 150 + waves.sum(axis=2)


def seen(rng, offset, rate=10.0, noise=0.3):
    """The same motion as two cameras see it, whose clocks differ by an offset."""
    seed = rng.integers(1 << 30)
    paths = []
    for late in (0.0, offset):
        times = np.arange(0.0, 20.0, 1 / rate) + rng.uniform(0, 1 / rate)
        xy = motion(times, np.random.default_rng(seed))
        if late or offset == 0:
            moved = np.column_stack([xy, np.ones(len(xy))]) @ H.T
            xy = moved[:, :2] / moved[:, 2:]
        paths.append(TimedPath(times + late, xy + noise * rng.standard_normal(xy.shape)))
    return [tuple(paths)]


@pytest.mark.parametrize("offset", [0.01, -0.3, 1.0, -3.0])
@pytest.mark.parametrize("rate", [10.0, 4.0])
def test_an_offset_up_to_seconds_is_found_within_its_sigma(offset, rate):
    for seed in range(3):
        found = search_offset(seen(np.random.default_rng(seed), offset, rate))
        assert found is not None and found.sigma < 0.02
        assert abs(found.value - offset) < 4 * found.sigma


def test_a_drive_with_a_long_rest_and_a_glare_is_timed_right():
    """A homography fits half of a path, where the robot rests, at nearly any offset."""
    times = np.arange(0.0, 8.5, 0.1)
    for seed in (1, 3):
        rng, pairs = np.random.default_rng(seed), []
        for glare, later in ((15, 0.0), (0, 0.6)):  # two markers, as if one were a moment later on the same path
            way = 2 * (np.clip(times, 0, 2) + np.clip(times - 6.5, 0, 9)) + later
            xy = motion(way, np.random.default_rng(seed))
            moved = np.column_stack([xy, np.ones(len(xy))]) @ H.T
            other = moved[:, :2] / moved[:, 2:]
            other[3 : 3 + glare] += rng.uniform(-40, 40, 2)
            noise = 0.1 * rng.standard_normal((2, *xy.shape))
            pairs.append((TimedPath(times, xy + noise[0]), TimedPath(times + 1.0, other + noise[1])))
        found = search_offset(pairs)
        assert found is not None and abs(found.value - 1.0) < 0.02


def test_an_offset_that_the_motion_does_not_tell_is_not_found():
    rng = np.random.default_rng(0)
    times = np.arange(0.0, 20.0, 0.1)
    line = np.column_stack([50 + 9 * times, 40 + 5 * times])
    noisy = [TimedPath(times, line + 0.3 * rng.standard_normal(line.shape)) for _ in range(2)]
    assert search_offset([tuple(noisy)]) is None
    still = [TimedPath(times, 100 + 0.3 * rng.standard_normal(line.shape)) for _ in range(2)]
    assert search_offset([tuple(still)]) is None
    assert search_offset([]) is None


def test_a_straight_drive_away_tells_no_offset_where_only_its_far_points_are_compared():
    """A shift in time is one on the plane then, and far from two seconds off only distant points have a partner."""
    times = np.arange(0.0, 4.95, 0.1)
    for seed in (33, 39, 123, 144):
        rng, pairs = np.random.default_rng(seed), []
        for y in (-0.12, 0.12):
            x, both = 0.9 + 0.2 * times, []
            for side in (0.25, -0.25):
                depth = x + 0.3 * side
                across = y + side + 0.1 * x * np.sign(side)
                uv = np.column_stack([160 + 300 * across / depth, 60 + 75 / depth])
                both.append(TimedPath(times, uv + 0.3 * rng.standard_normal(uv.shape)))
            pairs.append(tuple(both))
        assert search_offset(pairs) is None


def test_wheels_are_timed_to_the_bound_that_is_predicted():
    """A robot that drives and turns at will, with wheels that slip, before a camera that looks down at an angle."""
    rng = np.random.default_rng(3)
    team, instants = reference_team(), np.arange(-1.0, 21.0, 0.02)
    observer, mover = team["A"], team["C"]
    T_camera_body = se3_inverse(observer.mount.T_body_camera)
    off = []
    for _ in range(6):
        turning = np.sin(2 * np.pi * np.outer(instants, [0.05, 0.13, 0.21]) + rng.uniform(0, 6, 3)).sum(axis=1)
        yaw, speed = np.cumsum(0.02 * turning), 0.1 + 0.05 * np.sin(instants + rng.uniform(0, 6))
        xy = np.cumsum(0.02 * speed[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], axis=1), axis=0)
        xy += (1.5, 0.0) - xy.mean(axis=0)
        path = Path(instants, np.column_stack([xy, yaw]), instants[:1], np.zeros((1, 2)))
        late = rng.uniform(-0.5, 0.5)
        wheels = odometry(path, [(0.0, 20.0)], rng).records("C", -1.0, 21.0, late)
        times = np.arange(1.0, 19.0, 0.25)
        T = floor_pose(*path.planar_at(times).T)
        tracks = []
        for p in mover.markers.p_body:
            p_camera = (T[:, :3, :3] @ p + T[:, :3, 3]) @ T_camera_body[:3, :3].T + T_camera_body[:3, 3]
            uv = observer.camera.project(p_camera)[0] + 0.3 * rng.standard_normal((len(times), 2))
            C = np.broadcast_to(0.09 * np.eye(2), (len(times), 2, 2))
            tracks.append((Track("A", "", times, uv, C, np.zeros(len(times))), p[:2]))
        found = refine_wheel_offset(tracks, WheelTrack("C", wheels), observer.camera, late + rng.uniform(-0.02, 0.02))
        assert found.sigma < 0.01
        off.append((found.value - late) / found.sigma)
    low, high = chi2.ppf([0.001, 0.999], len(off))
    assert low < np.square(off).sum() < high


@pytest.mark.parametrize("seed", [0, 1, 2, 3, 5])
def test_wheels_are_not_timed_by_a_track_of_something_else(seed):
    """A reflection that wanders while the robot drives straight: a homography of all its points is sought in vain."""
    rng, team = np.random.default_rng(seed), reference_team()
    instants, times = np.arange(-1.0, 21.0, 0.05), np.linspace(1.0, 19.0, 60)
    path = Path(
        instants,
        np.column_stack([1.5 + 0.03 * instants, 0.01 * instants, np.full_like(instants, 0.3)]),
        instants[:1],
        np.zeros((1, 2)),
    )
    wheels = odometry(path, [(0.0, 20.0)], rng).records("C", -1.0, 21.0, 0.0)
    uv = np.array([160.0, 120.0]) + np.cumsum(rng.standard_normal((60, 2)), axis=0)
    wandering = Track("A", "", times, uv, np.broadcast_to(0.09 * np.eye(2), (60, 2, 2)), np.zeros(60))
    point = team["C"].markers.p_body[0][:2]
    assert refine_wheel_offset([(wandering, point)], WheelTrack("C", wheels), team["A"].camera, 0.0) is None


def test_an_offset_that_leaves_the_paths_apart_is_none():
    """As odometry of another point of the body than the one that carries the marker."""
    pairs = seen(np.random.default_rng(1), 0.3)
    assert search_offset(pairs, max_residual=1.0) is not None
    assert search_offset(pairs, max_residual=0.1) is None
