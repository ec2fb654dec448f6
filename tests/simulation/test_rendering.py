"""What the simulated sensor does to light."""

import numpy as np
import pytest

from coloc_graph.simulation import Sensor, build_world, hallway, render, spots
from coloc_graph.simulation.rendering import add_spots, fill
from coloc_graph.simulation.scenery import backdrop, frames, make_scenery
from coloc_graph.simulation.world import stream


def light(lights, size=(64, 48)):
    field = np.zeros((size[1], size[0]), np.float32)
    add_spots(field, lights)
    return field


def centroid(field):
    v, u = np.mgrid[: field.shape[0], : field.shape[1]]
    return np.array([(u * field).sum(), (v * field).sum()]) / field.sum()


@pytest.mark.parametrize("radius", [0.3, 0.7, 1.5, 3.3])
@pytest.mark.parametrize("phase", [(0.0, 0.0), (0.5, 0.5), (0.25, 0.8), (-0.37, 0.11)])
@pytest.mark.parametrize("motion", [(0.0, 0.0), (0.6, -0.3), (3.0, 1.0)])
def test_the_centroid_of_a_spot_is_its_projected_centre(radius, phase, motion):
    uv = np.array([30.0, 22.0]) + phase
    assert centroid(light(spots(uv, radius, 240.0, motion))) == pytest.approx(uv, abs=2e-3)


def test_all_of_a_spots_light_reaches_the_image_wherever_it_falls():
    for uv in ((30.0, 22.0), (30.5, 22.3)):
        assert light(spots(uv, 1.5, 240.0)).sum() == pytest.approx(240 * np.pi * 1.5**2, rel=1e-4)


def test_a_pixel_inside_a_large_spot_has_the_leds_level():
    assert light(spots((30.0, 22.0), 8.0, 240.0)).max() == pytest.approx(240, rel=0.03)


def test_a_near_led_is_brighter_and_larger_than_a_far_one():
    near, far = (light(spots((30.0, 22.0), 301 * 0.005 / z, 240.0)) for z in (1.0, 2.2))
    assert 170 < near.max() < 230
    assert 40 < far.max() < 110
    assert (near > 20).sum() > (far > 20).sum()


def test_a_spot_beyond_the_border_is_clipped_and_one_far_outside_is_nothing():
    assert 0 < light(spots((0.0, 22.0), 1.5, 240.0)).sum() < 240 * np.pi * 1.5**2
    assert light(spots([(-50.0, 22.0), (30.0, 1e6), (np.nan, 3.0)], 1.5, 240.0)).sum() == 0


def test_motion_draws_a_spot_out_along_its_way():
    still, moved = (light(spots((30.0, 22.0), 1.0, 240.0, (m, 0.0))) for m in (0.0, 4.0))
    assert (moved.sum(axis=0) > 20).sum() > (still.sum(axis=0) > 20).sum()
    assert (moved.sum(axis=1) > 20).sum() == (still.sum(axis=1) > 20).sum()
    assert moved.sum() == pytest.approx(still.sum(), rel=1e-4)


def test_saturation_clips_at_255_and_darkness_at_0():
    image = render(spots((160.0, 120.0), 3.0, 900.0), background=20.0)
    assert image.max() == 255
    assert (image == 255).sum() > 5
    assert image[0, 0] == 20
    dark = render(spots(np.zeros((0, 2)), 1.0, 1.0), background=0.0, rng=np.random.default_rng(1))
    assert dark.min() == 0


@pytest.mark.parametrize("level", [20.0, 120.0])
def test_noise_has_the_mean_and_the_variance_that_the_sensor_states(level):
    sensor = Sensor()
    none = spots(np.zeros((0, 2)), 1.0, 1.0)
    image = render(none, background=level, sensor=sensor, rng=np.random.default_rng(3)).astype(float)
    variance = sensor.read_noise**2 + sensor.shot_gain * level + 1 / 12  # the last is of rounding
    n = image.size
    assert image.mean() == pytest.approx(level, abs=4 * np.sqrt(variance / n))
    assert image.var() == pytest.approx(variance, rel=4 * np.sqrt(2 / n))
    assert 2.0 < np.sqrt(variance) < 4.5


def test_an_image_without_noise_is_the_same_each_time_and_with_other_noise_is_another():
    lamp = spots((160.3, 99.8), 1.5, 240.0)
    assert (render(lamp) == render(lamp)).all()
    a, b, c = (render(lamp, background=20.0, rng=np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert (a == b).all()
    assert (a != c).any()


def test_fill_paints_only_what_is_inside():
    field = np.full((48, 64), 20.0, np.float32)
    fill(field, [(10, 10), (20, 10), (20, 30), (10, 30)], 6.0)
    assert field[20, 15] == 6
    assert field[20, 25] == field[5, 15] == 20
    fill(field, [(-30, -30), (-20, -30), (-20, -20)], 6.0)
    assert field[0, 0] == 20


@pytest.fixture(scope="module")
def world():
    return build_world(hallway(2), depth="images", points=60, seed=4)


def test_in_90_percent_of_frames_both_observers_see_all_markers(world):
    for captures in world.captures:
        seen = [c.view.project(world.markers_world("C", c.times))[1].all(axis=1) for c in captures]
        assert np.mean(seen[0] & seen[1]) > 0.9


def test_an_led_in_a_frame_is_where_the_true_marker_projects(world):
    capture = world.captures[0][0]
    uv, _ = capture.view.project(world.markers_world("C", capture.times))
    quiet = Sensor(read_noise=0.0, shot_gain=0.0, led_level=200.0)
    errors = []
    for image, centres in zip(frames(world, 0, capture, make_scenery(world), quiet), uv, strict=True):
        if np.linalg.norm(centres[0] - centres[1]) < 15:
            continue
        for centre in centres:
            u, v = np.rint(centre).astype(int)
            patch = image.pixels[v - 4 : v + 5, u - 4 : u + 5].astype(float) - 30  # above any background
            errors.append(centroid(np.clip(patch, 0, None)) - 4 + (u, v) - centre)
    assert len(errors) > 20
    assert np.abs(np.median(errors, axis=0)).max() < 0.05
    assert np.sqrt(np.mean(np.square(errors))) < 0.15


def test_a_body_is_dark_and_the_background_smooth_and_dim(world):
    capture = world.captures[0][0]
    field = backdrop(capture.view.camera, capture.view.T_world_camera, make_scenery(world), stream(4, "sensor"))
    assert 8 < np.median(field) < 32
    image = next(frames(world, 0, capture, make_scenery(world), Sensor(read_noise=0.0, shot_gain=0.0))).pixels
    uv, inside = capture.view.project(world.paths["C"].pose_at(capture.times[:1])[0, :3, 3] + (0, 0, 0.06))
    assert inside
    u, v = np.rint(uv).astype(int)
    assert image[v, u] == 6


def test_both_depth_and_scenery_hold_still_between_frames(world):
    capture = world.captures[0][1]
    quiet = Sensor(read_noise=0.0, shot_gain=0.0)
    first, second = [
        f.pixels for _, f in zip(range(2), frames(world, 0, capture, make_scenery(world), quiet), strict=False)
    ]
    assert (first == second).mean() > 0.9
