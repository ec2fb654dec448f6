"""Markers followed through images: where is looked, who is who, and when a track ends."""

import itertools

import numpy as np
import pytest

from coloc_graph.frontend import Detector, MarkerTracker, TrackerOptions
from coloc_graph.frontend.images.detection import Blobs
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.run import Detections, Image
from coloc_graph.simulation import Sensor, reference_team, render, spots
from coloc_graph.simulation.crowd import Faults, Seen, crowd
from coloc_graph.team.shared_view import View

T0 = 1_700_000_000.0
SIZE = (320, 240)


def frames(lights, seed=0, step=0.1):
    """Images of lights (k, n, 2) [px]; a light at NaN is dark."""
    rng = np.random.default_rng(seed)
    for k, uv in enumerate(lights):
        pixels = render(spots(uv, 1.5, 220.0), size=SIZE, background=12.0, sensor=Sensor(), rng=rng)
        yield Image("A", T0 + step * k, pixels)


def tracked(lights, options=None, detector=None):
    tracker = MarkerTracker("A", detector or Detector(), options or TrackerOptions(markers=lights.shape[1]))
    for image in frames(lights):
        tracker.step(image)
    return tracker.tracks()


def moving(k, start, velocity):
    return np.asarray(start, float) + np.arange(k)[:, None] * np.asarray(velocity)


def owner(track, lights):
    """Which light (n) each sample of a track is."""
    frame = np.rint((track.times - T0) / 0.1).astype(int)
    apart = np.linalg.norm(lights[frame] - track.uv[:, None], axis=2)
    assert np.nanmin(apart, axis=1).max() < 0.3
    return np.nanargmin(apart, axis=1)


def test_two_moving_leds_and_a_still_light_are_three_whole_tracks():
    n = 40
    lights = np.stack([moving(n, (40, 60), (5, 2)), moving(n, (60, 160), (4, -1)), moving(n, (300, 30), (0, 0))], 1)
    tracks = tracked(lights)
    assert [len(track) for track in tracks] == [n, n, n]
    owners = [owner(track, lights) for track in tracks]
    assert all((one == one[0]).all() for one in owners)
    assert {int(one[0]) for one in owners} == {0, 1, 2}
    still = next(track for track, one in zip(tracks, owners, strict=True) if one[0] == 2)
    assert still.extent < 1.0
    assert min(track.extent for track in tracks if track is not still) > 100
    for track in tracks:
        assert track.times == pytest.approx(T0 + 0.1 * np.arange(n))
        assert (np.linalg.eigvalsh(track.covariance) > 0).all()


def test_leds_that_pass_each_other_closely_keep_their_identity():
    n = 30
    lights = np.stack([moving(n, (40, 100), (8, 0)), moving(n, (280, 114), (-8, 0))], 1)
    tracks = tracked(lights)
    assert [len(track) for track in tracks] == [n, n]
    for track in tracks:
        one = owner(track, lights)
        assert (one == one[0]).all()


def test_a_patch_is_searched_where_the_led_would_be_if_it_went_on():
    boxes = []

    class Looking(Detector):
        def find(self, image, box=None):
            boxes.append(box)
            return super().find(image, box)

    lights = moving(9, (60, 60), (12, 7))[:, None]
    track = tracked(lights, TrackerOptions(patch=40, markers=1, reacquire_every=10.0), Looking())[0]
    assert boxes[0] is None
    assert len(boxes) == 9
    for k in range(2, 9):
        u, v = np.rint(2 * track.uv[k - 1] - track.uv[k - 2]).astype(int)
        assert boxes[k] == (u - 20, v - 20, u + 20, v + 20)


def test_an_led_that_two_overlapping_patches_see_is_one_and_whole():
    n = 12
    lights = np.stack([moving(n, (60, 60), (4, 0)), moving(n, (79.5, 60), (4, 0))], 1)
    tracks = tracked(lights)
    # 20 px apart and of unknown speed, which is which in the second image is anybody's guess: they begin there
    assert [len(track) for track in tracks] == [n - 1, n - 1]
    for track in tracks:
        assert np.unique(owner(track, lights)).size == 1
        assert np.linalg.norm(track.uv - lights[1:, owner(track, lights)[0]], axis=1).max() < 0.15


def test_an_led_that_is_dark_for_3_frames_stays_one_track():
    lights = moving(25, (40, 60), (4, 3))[:, None]
    lights[10:13] = np.nan
    (track,) = tracked(lights)
    assert len(track) == 22


def test_an_led_that_is_lost_for_5_frames_is_found_again_in_the_first_frame_it_shines():
    lights = np.stack([moving(30, (40, 60), (4, 3)), moving(30, (300, 200), (-3, 0))], 1)
    lights[10:15, 0] = np.nan
    tracks = tracked(lights)
    assert sorted(len(track) for track in tracks) == [10, 15, 30]
    again = next(track for track in tracks if len(track) == 15)
    assert again.times[0] == pytest.approx(T0 + 1.5)
    assert (owner(again, lights) == 0).all()


def test_an_led_that_comes_into_view_later_is_found_within_10_frames_though_all_others_are_tracked():
    lights = np.stack([moving(30, (40, 60), (3, 0)), moving(30, (60, 160), (3, 0))], 1)
    lights[:11, 1] = np.nan
    tracks = tracked(lights, TrackerOptions(markers=1))
    assert len(tracks) == 2
    assert tracks[1].times[0] <= T0 + 2.0 + 1e-6


def test_an_led_that_leaves_the_image_ends_its_track_there():
    lights = np.stack([moving(30, (270, 60), (6, 0)), moving(30, (60, 160), (3, 0))], 1)
    first, second = sorted(tracked(lights), key=len)
    assert len(second) == 30
    assert 7 <= len(first) <= 9
    assert first.uv[:, 0].max() < SIZE[0] - 2


def test_no_images_and_dark_images_give_no_track():
    tracker = MarkerTracker("A", Detector())
    assert tracker.tracks() == []
    for k in range(5):
        tracker.step(Image("A", T0 + k, np.zeros((240, 320), np.uint8)))
    assert tracker.tracks() == []


def in_crowd(seed, **faults):
    """The tracks of 5 robots in 10 s at 50 images a second, and the light of each of their samples."""
    team = reference_team()
    view = View(team["A"].camera, floor_pose(0.0, 0.4, -0.3) @ team["A"].mount.T_body_camera)
    (seen,), _ = crowd([view], team["C"].markers.p_body, seconds=10.0, fps=50.0, seed=seed, faults=Faults(**faults))
    tracker = MarkerTracker("A", Detector(), size=(320, 240))
    for one in seen.images:
        tracker.take(one.time, Blobs(one.uv, one.covariance, one.flags, one.peak, one.area))
    number = {one.time: k for k, one in enumerate(seen.images)}
    owners = []
    for track in tracker.tracks():
        own = []
        for time, uv in zip(track.times.tolist(), track.uv, strict=True):
            k = number[time]
            own.append(seen.lights[k][np.argmin(np.abs(seen.images[k].uv - uv).sum(axis=1))])
        owners.append(np.array(own))
    return owners, sum(int((one >= 0).sum()) for one in seen.lights)


@pytest.mark.parametrize("seed", range(3))
def test_ten_markers_that_cross_merge_and_are_missed_are_each_themselves(seed):
    owners, there = in_crowd(seed)
    pure = sum(np.bincount(own + 1)[1:].max() for own in owners)
    assert pure > 0.995 * sum(map(len, owners))
    assert pure > 0.99 * there
    assert all((own >= 0).mean() > 0.9 for own in owners)


def test_false_detections_alone_make_no_track():
    owners, _ = in_crowd(1, missed=1.0, false_detections=8.0)
    assert owners == []


def test_a_marker_that_stands_for_a_second_among_100_images_is_not_taken_for_a_lamp():
    tracker = MarkerTracker("A", Detector(), TrackerOptions(markers=1))
    for k in range(300):
        u = 50.0 + min(k, 100) + max(k - 200, 0)
        one = np.array([[u, 80.0]])
        flags, none = np.zeros(1, np.uint8), np.full(1, 200.0)
        tracker.take(T0 + 0.01 * k, Blobs(one, np.array([0.01 * np.eye(2)]), flags, none, none))
    (track,) = tracker.tracks()
    assert len(track) == 300


def test_a_light_that_blinks_is_one_track_and_nothing_is_taken_for_it_while_it_is_off():
    rng, on = np.random.default_rng(0), np.tile(np.repeat([1, 1, 1, 0], 10), 5).astype(bool)
    counts = []
    for off in (0.1, 0.0):
        tracker = MarkerTracker("A", Detector(), TrackerOptions(off=off, off_rate=3.0), size=(320, 240))
        for k, shines in enumerate(on):
            # what is false is as near as a light that changes its way may be
            uv = np.array([[60.0 + k, 80.0]] if shines else [[60.0 + k, 82.5]] if k % 10 == 5 else []).reshape(-1, 2)
            uv = uv + 0.1 * rng.standard_normal(uv.shape)
            flags, none = np.zeros(len(uv), np.uint8), np.full(len(uv), 200.0)
            covariance = np.broadcast_to(0.01 * np.eye(2), (len(uv), 2, 2))
            tracker.take(T0 + 0.01 * k, Blobs(uv, covariance, flags, none, none))
        counts.append([(len(track), len(track.missed)) for track in tracker.tracks()])
    assert counts[0] == [(150, 36)]  # what is near to something else says nothing
    assert counts[1] != counts[0]  # what is said to be on all the time takes it


@pytest.mark.parametrize("speed", [30.0, 60.0])
def test_a_marker_that_turns_back_at_once_is_followed(speed):
    tracker = MarkerTracker("A", Detector(), TrackerOptions(markers=1), size=(320, 240))
    flags, none = np.zeros(1, np.uint8), np.full(1, 200.0)
    for k in range(200):
        u = 100.0 + speed * 0.01 * (100 - abs(k - 100))
        tracker.take(T0 + 0.01 * k, Blobs(np.array([[u, 80.0]]), np.array([0.0025 * np.eye(2)]), flags, none, none))
        if k == 103:  # and three images on it knows how fast it goes
            assert tracker._filters.points[0].du == pytest.approx(-speed, abs=0.2 * speed)
    (track,) = tracker.tracks()
    assert len(track) == 200


def light_changes(track, seen):
    """How often the samples of a track change from one light to another."""
    number = {one.time: n for n, one in enumerate(seen.images)}
    of = []
    for time, uv in zip(track.times.tolist(), track.uv, strict=True):
        image, lights = seen.images[number[time]], seen.lights[number[time]]
        of.append(int(lights[np.argmin(np.abs(image.uv - uv).sum(axis=1))]))
    real = [one for one in of if one >= 0]
    return sum(a != b for a, b in itertools.pairwise(real))


@pytest.mark.parametrize("seed", [1, 17])
def test_tracks_that_are_checked_backward_are_cut_where_lights_were_swapped(seed):
    team = reference_team()
    view = View(team["A"].camera, floor_pose(0.0, 0.4, -0.3) @ team["A"].mount.T_body_camera)
    (seen,), _ = crowd([view], team["C"].markers.p_body, movers=5, seconds=20, fps=5, seed=seed)
    tracker = MarkerTracker("A", Detector(), size=SIZE)
    for one in seen.images:
        tracker.take(one.time, Blobs(one.uv, one.covariance, one.flags, one.peak, one.area))
    causal, checked = tracker.tracks(), tracker.checked_tracks()
    assert sum(light_changes(track, seen) for track in checked) == 0
    assert sum(light_changes(track, seen) for track in causal) > 0
    assert sum(map(len, checked)) > 0.9 * sum(map(len, causal))
    assert all((np.diff(track.times) > 0).all() for track in checked)


def followed(seen, width):
    tracker = MarkerTracker("A", Detector(), size=(width, width * 3 // 4))
    for one in seen.images:
        tracker.take(one.time, Blobs(one.uv, one.covariance, one.flags, one.peak, one.area))
    return [len(track) for track in tracker.tracks()]


@pytest.mark.parametrize("width", [320, 1280])
def test_the_tracker_adapts_to_the_size_of_the_images_and_to_the_motion_that_it_sees(width):
    """A light that turns sharply and fast, at the same pace of any image's width, is one track or few."""
    times = np.arange(120) / 20.0
    angle = 2.5 * times
    uv = width * (0.5 + 0.2 * np.stack([np.cos(angle), np.sin(2 * angle) / 2], axis=1)) * (1, 0.75)
    images = [
        Detections("A", T0 + t, np.array([p]), 0.09 * np.eye(2)[None], ("",), *np.zeros((3, 1), np.uint8))
        for t, p in zip(times.tolist(), uv, strict=True)
    ]
    lengths = followed(Seen(images, []), width)
    assert sum(lengths) > 110 and len(lengths) <= 2
