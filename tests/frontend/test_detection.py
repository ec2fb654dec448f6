"""Marker centres in rendered images: where the light is, how sure, what is doubtful, and nothing where nothing is."""

import time

import cv2
import numpy as np
import pytest

from coloc_graph.frontend import Detector, detect_hue, detect_leds, detector_for
from coloc_graph.frontend.images.components import components
from coloc_graph.run import Flag
from coloc_graph.simulation import Sensor, render, spots
from coloc_graph.team import Markers

SIZE = (64, 48)
EVEN = Sensor(read_noise=3.0, shot_gain=0.0)


def led_image(
    uv, radius=1.5, level=240.0, motion=(0.0, 0.0), *, psf=0.8, size=SIZE, sensor=EVEN, background=12.0, seed=0
):
    rng = np.random.default_rng(seed)
    return render(spots(uv, radius, level, motion, psf), size=size, background=background, sensor=sensor, rng=rng)


@pytest.fixture(scope="module", params=["even noise", "the sensor's noise"])
def measured(request):
    """Errors (n, 2) and stated covariances of 300 LEDs at random places between pixels."""
    rng = np.random.default_rng(1)
    sensor = EVEN if request.param == "even noise" else Sensor()
    errors, covariances = [], []
    for seed in range(300):
        uv = np.array([30.0, 22.0]) + rng.uniform(-0.5, 0.5, 2)
        blobs = detect_leds(led_image(uv, sensor=sensor, seed=seed))
        assert blobs.flags.tolist() == [Flag.NONE]
        errors.append(blobs.uv[0] - uv)
        covariances.append(blobs.covariance[0])
    return np.array(errors), np.mean(covariances, axis=0)


def test_the_centre_is_right_to_a_twentieth_of_a_pixel_and_has_no_bias(measured):
    errors, _ = measured
    assert (np.sqrt((errors**2).mean(axis=0)) < 0.05).all()
    assert (np.abs(errors.mean(axis=0)) < 0.02).all()


def test_the_bias_does_not_depend_on_where_between_pixels_the_centre_is():
    for phase in np.stack(np.meshgrid([0.0, 0.25, 0.5, 0.75], [0.0, 0.3, 0.6]), -1).reshape(-1, 2):
        uv = np.array([30.0, 22.0]) + phase
        blobs = detect_leds(render(spots(uv, 1.5, 240.0), size=SIZE, background=12.0))
        assert blobs.uv[0] == pytest.approx(uv, abs=0.02)


def test_the_stated_sigma_is_that_of_the_errors_to_35_percent(measured):
    errors, covariance = measured
    ratio = np.sqrt(np.diag(covariance)) / errors.std(axis=0)
    assert (ratio > 1 / 1.4).all()
    assert (ratio < 1.4).all()
    assert abs(covariance[0, 1]) < 0.1 * covariance[0, 0]


def near_another(radius, apart, level, n=120, seed=2):
    """Errors (n, 2) along and across the direction of another LED, and chi2 per number, of the centres of LEDs."""
    rng = np.random.default_rng(seed)
    errors, square = [], []
    for k in range(n):
        uv = np.array([30.0, 22.0]) + rng.uniform(-0.5, 0.5, 2)
        angle = rng.uniform(-np.pi, np.pi)
        along = np.array([np.cos(angle), np.sin(angle)])
        blobs = detect_leds(led_image([uv, uv + apart * along], radius, level, sensor=Sensor(), seed=k))
        assert len(blobs) == 2
        own = np.linalg.norm(blobs.uv - uv, axis=1).argmin()
        off = blobs.uv[own] - uv
        if blobs.flags[own] == Flag.NONE:
            errors.append((off @ along, along[0] * off[1] - along[1] * off[0]))
            square.append(off @ np.linalg.solve(blobs.covariance[own], off) / 2)
    assert len(errors) > 0.8 * n
    return np.array(errors), np.mean(square)


@pytest.mark.parametrize(
    ("radius", "apart", "level"), [(0.7, 3.75, 240.0), (0.7, 6.0, 240.0), (1.5, 8.0, 240.0), (4.0, 15.0, 200.0)]
)
def test_a_light_beside_another_is_where_it_would_be_without(radius, apart, level):
    errors, square = near_another(radius, apart, level)
    assert (np.abs(errors.mean(axis=0)) < 4 * errors.std(axis=0) / np.sqrt(len(errors))).all()
    assert square < 2.5


@pytest.mark.parametrize("slant_deg", [20, 45])
def test_the_dark_rim_of_a_body_behind_a_light_does_not_bias_its_centre(slant_deg):
    rng = np.random.default_rng(8)
    v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    normal = np.array([np.cos(np.deg2rad(slant_deg)), np.sin(np.deg2rad(slant_deg))])
    errors, deviations = [], []
    for seed in range(40):
        uv = np.array([30.0, 22.0]) + rng.uniform(-0.5, 0.5, 2)
        beyond = (u - uv[0]) * normal[0] + (v - uv[1]) * normal[1] - rng.uniform(1.0, 3.0)
        background = (20.0 - 14.0 * np.clip(beyond + 0.5, 0, 1)).astype(np.float32)
        blobs = detect_leds(led_image(uv, 0.62, sensor=Sensor(), background=background, seed=seed))
        errors += [(one - uv) @ normal for one in blobs.uv]
        deviations += [np.sqrt(normal @ one @ normal) for one in blobs.covariance]
    assert len(errors) > 30
    assert abs(np.mean(errors)) < np.mean(deviations)  # 1.7 times that with a Coons patch alone


def test_a_crowd_of_lights_is_deblended_at_once_and_right():
    uv = np.array([20.0, 10.0]) + 5.0 * np.stack(np.meshgrid(np.arange(4), np.arange(3)), -1).reshape(-1, 2)
    image = led_image(uv, 0.7, sensor=Sensor())
    assert len({id(one.group) for one in Detector().find(image)}) == 1
    blobs = detect_leds(image)
    off = np.linalg.norm(blobs.uv[:, None] - uv, axis=2)
    assert sorted(off.argmin(axis=1).tolist()) == list(range(len(uv)))
    assert off.min(axis=1).max() < 0.25


@pytest.mark.parametrize("share", [0.04, 0.15, 0.3])
def test_components_are_those_of_labels(share):
    rng = np.random.default_rng(6)
    for _ in range(5):
        above = (255 * (rng.random((40, 60)) < share)).astype(np.uint8)
        _, _, stats, _ = cv2.connectedComponentsWithStats(above, connectivity=8)
        found = components(above)
        assert sorted((*one.bounds, one.pixels) for one in found) == sorted(map(tuple, stats[1:].tolist()))
        for (left, top, width, height), _, (u, v) in found:
            assert left <= u < left + width
            assert top <= v < top + height


def test_lights_that_touch_are_said_to_or_are_where_they_are():
    rng = np.random.default_rng(4)
    two = believed = 0
    for seed in range(400):
        uv = np.array([30.0, 22.0]) + rng.uniform(-0.5, 0.5, 2)
        angle = rng.uniform(-np.pi, np.pi)
        both = np.array([uv, uv + 3.1 * np.array([np.cos(angle), np.sin(angle)])])
        blobs = detect_leds(led_image(both, 0.7, sensor=Sensor(), seed=seed))
        two += len(blobs) == 2
        for place, flag in zip(blobs.uv, blobs.flags, strict=True):
            if len(blobs) == 2 and flag == Flag.NONE:
                believed += 1
                assert np.linalg.norm(both - place, axis=1).min() < 0.3
    assert two > 20
    assert believed < 0.4 * two


def test_a_spot_as_sharp_as_a_pixel_is_found_where_it_is():
    rng = np.random.default_rng(5)
    square, errors = [], []
    for seed in range(200):
        uv = np.array([30.0, 22.0]) + rng.uniform(-0.5, 0.5, 2)
        blobs = detect_leds(led_image(uv, 0.7, psf=0.5, sensor=Sensor(), seed=seed))
        off = blobs.uv[0] - uv
        square.append(off @ np.linalg.solve(blobs.covariance[0], off) / 2)
        errors.append(off)
    # a window of the spot's own shape alone: 3.5 and 0.055 px
    assert np.mean(square) < 2.5
    assert np.sqrt(np.mean(np.square(errors))) < 0.045


def test_a_spot_of_two_pixels_is_as_sure_as_it_says():
    rng = np.random.default_rng(3)
    square = []
    for seed in range(200):
        uv = np.array([30.0, 22.0]) + rng.uniform(-0.5, 0.5, 2)
        blobs = detect_leds(led_image(uv, 0.62, sensor=Sensor(), seed=seed))
        for off, covariance in zip(blobs.uv - uv, blobs.covariance, strict=True):
            square.append(off @ np.linalg.solve(covariance, off) / 2)
    assert len(square) > 150
    assert 0.7 < np.mean(square) < 1.5


def test_a_light_in_the_glare_of_a_lamp_is_not_believed():
    for apart, flag in ((24.5, Flag.MERGED), (40, Flag.NONE)):
        image = render(spots([(30, 40), (30 + apart, 40)], (1.5, 20.0), 220.0), size=(160, 80), background=12.0)
        blobs = detect_leds(image)
        assert blobs.uv == pytest.approx(np.array([(30, 40)]), abs=0.5)
        assert blobs.flags.tolist() == [flag]


def test_a_dim_led_is_less_certain_than_a_bright_one():
    dim, bright = (detect_leds(led_image((30.2, 22.4), 0.7, level)) for level in (240.0, 700.0))
    assert dim.covariance[0, 0, 0] > 4 * bright.covariance[0, 0, 0]
    assert dim.peak[0] < bright.peak[0]


def test_a_spot_at_the_sensors_limit_is_saturated_and_still_centred():
    blobs = detect_leds(led_image((30.3, 22.4), 2.5, 600.0))
    assert blobs.flags[0] & Flag.SATURATED
    assert blobs.uv[0] == pytest.approx((30.3, 22.4), abs=0.1)


@pytest.mark.parametrize("uv", [(0.3, 22), (63.0, 22), (30, 0.4), (30, 46.9)])
def test_a_spot_at_the_border_of_the_image_is_clipped(uv):
    blobs = detect_leds(led_image(uv))
    assert len(blobs) == 1
    assert blobs.flags[0] & Flag.CLIPPED


@pytest.mark.parametrize("angle", [0, 30, 45, 60, 90, 135])
@pytest.mark.parametrize(("radius", "apart"), [(1.5, 5.0), (2.5, 7.0)])
def test_two_leds_that_touch_are_merged_at_whatever_angle(angle, radius, apart):
    off = apart / 2 * np.array([np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))])
    blobs = detect_leds(led_image(np.add((30.2, 22.3), [-off, off]), radius, 220.0))
    assert len(blobs) == 1
    assert blobs.flags[0] & Flag.MERGED


@pytest.mark.parametrize("angle", [0, 30, 45, 60, 90, 135])
def test_a_spot_drawn_out_by_motion_is_blurred_and_not_merged(angle):
    motion = 10.0 * np.array([np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))])
    blobs = detect_leds(led_image((30.2, 22.3), 1.0, 800.0, motion))
    assert blobs.flags.tolist() == [Flag.BLURRED]
    # a streak this faint is known to a tenth of a pixel along itself
    assert blobs.uv[0] == pytest.approx((30.2, 22.3), abs=4 * np.sqrt(np.linalg.eigvalsh(blobs.covariance[0])[1]))


def test_two_leds_apart_are_two():
    blobs = detect_leds(led_image([(20.2, 22.3), (29.7, 22.3)]))
    assert blobs.uv[np.argsort(blobs.uv[:, 0])] == pytest.approx(np.array([(20.2, 22.3), (29.7, 22.3)]), abs=0.1)
    assert not blobs.flags.any()


@pytest.mark.parametrize("shape", [(240, 320), (240, 320, 3)])
@pytest.mark.parametrize("level", [0, 12, 255])
@pytest.mark.parametrize(
    "find", [detector_for(None), detector_for(Markers(height=0, positions=((0, 0),), hue_deg=120))]
)
def test_an_even_image_holds_nothing(shape, level, find):
    blobs = find(np.full(shape, level, np.uint8), None)
    assert len(blobs) == 0
    assert blobs.uv.shape == (0, 2)
    assert blobs.covariance.shape == (0, 2, 2)
    assert len(find(np.full(shape, level, np.uint8), (10, 10, 50, 50))) == 0


def test_noise_holds_nothing_and_does_not_take_long():
    rng = np.random.default_rng(0)
    for sigma in (3, 8):
        assert len(detect_leds(np.clip(rng.normal(20, sigma, (240, 320)), 0, 255).astype(np.uint8))) == 0
    begin = time.process_time()
    assert len(detect_leds(rng.integers(0, 256, (240, 320)).astype(np.uint8))) == 0
    assert time.process_time() - begin < 10.0


def test_spots_measured_together_are_as_they_are_alone():
    rng = np.random.default_rng(4)
    radii = np.tile([0.8, 1.0, 1.5, 2.5, 4.0, 6.0, 8.0], 3)
    uv = np.stack(np.meshgrid(30.0 + 40 * np.arange(7), 20.0 + 38 * np.arange(3)), axis=-1).reshape(-1, 2)
    uv = [*(uv + rng.uniform(0, 1, uv.shape)), (36.5, 20.3), (316.0, 60.0), (316.4, 66.0)]  # these are near others
    lights = spots(uv, [*radii, 1.0, 1.5, 1.5], [*rng.uniform(80, 230, len(radii)), 200.0, 200.0, 150.0])
    image = render(lights, size=(320, 120), background=20.0, sensor=Sensor(), rng=rng)
    detector = Detector()
    candidates = detector.find(image)
    assert len({one.group.light.shape for one in candidates}) >= 4
    assert any(len(one.group.boxes) > 1 for one in candidates)
    together, real = detector.measure(candidates)
    assert real.sum() >= 20
    for index, one in enumerate(candidates):
        alone, its_real = detector.measure([one])
        assert its_real[0] == real[index] and alone.flags[0] == together.flags[index]
        assert alone.uv[0] == pytest.approx(together.uv[index], abs=1e-6)
        assert alone.covariance[0] == pytest.approx(together.covariance[index], rel=1e-5)
        assert alone.peak[0] == pytest.approx(together.peak[index], abs=1e-6)


def test_a_lamp_larger_than_any_marker_is_not_one():
    assert len(detect_leds(led_image((160, 120), 20.0, 200.0, size=(320, 240)))) == 0


def test_a_light_just_outside_the_box_is_known_too():
    image = led_image([(160.3, 120.2), (167.0, 121.0)], size=(320, 240), sensor=Sensor(read_noise=0, shot_gain=0))
    part = detect_leds(image, (140, 100, 161, 140))
    assert len(part) == 1
    assert part.uv[0] == pytest.approx((160.3, 120.2), abs=0.01)


@pytest.mark.parametrize("uv", [(160.3, 120.2), (141.0, 120.0), (178.9, 101.4)])
def test_a_box_gives_what_the_whole_image_gives_even_where_it_cuts_the_blob(uv):
    image = led_image([uv, (60.0, 60.0)], size=(320, 240))
    whole, part = detect_leds(image), detect_leds(image, (140, 100, 180, 140))
    nearest = np.linalg.norm(whole.uv - uv, axis=1).argmin()
    assert len(whole) == 2
    assert part.uv == pytest.approx(whole.uv[[nearest]], abs=2e-3)
    assert part.covariance == pytest.approx(whole.covariance[[nearest]], rel=0.02)
    assert part.flags.tolist() == [Flag.NONE]


def test_a_blob_outside_the_box_is_not_found_and_a_box_at_the_images_edge_clips():
    image = led_image([(0.2, 30.0), (30.0, 22.0)])
    assert len(detect_leds(image, (34, 10, 60, 40))) == 0
    assert detect_leds(image, (0, 10, 20, 48)).flags[0] & Flag.CLIPPED


def coloured(lights, seed=0):
    """A BGR image of (uv, (b, g, r)) lights."""
    rng = np.random.default_rng(seed)
    uv = np.array([one for one, _ in lights])
    channels = [
        render(spots(uv, 2.0, [bgr[c] for _, bgr in lights]), size=(160, 120), background=12, sensor=EVEN, rng=rng)
        for c in range(3)
    ]
    return np.stack(channels, axis=2)


@pytest.mark.parametrize(
    ("hue", "bgr"), [(0, (0, 0, 220)), (120, (0, 220, 0)), (240, (220, 0, 0)), (300, (220, 0, 220))]
)
def test_a_coloured_marker_is_found_among_other_colours_and_white_lamps(hue, bgr):
    others = [(0, 0, 220), (0, 220, 0), (220, 0, 0), (220, 0, 220), (220, 220, 220), (220, 220, 0)]
    lights = [((20.0 + 18 * n, 30.0 + 7 * n), other) for n, other in enumerate(others) if other != bgr]
    image = coloured([((100.3, 99.8), bgr), *lights])
    markers = Markers(height=0.15, positions=((0, 0),), hue_deg=float(hue))
    found = detector_for(markers)(image, None)
    assert len(found) == 1
    assert found.uv[0] == pytest.approx((100.3, 99.8), abs=0.15)
    in_box = detect_hue(image, (80, 80, 120, 120), hue_deg=hue)
    assert in_box.uv == pytest.approx(found.uv, abs=0.01)


def test_a_grey_image_holds_no_hue_and_white_leds_are_found_in_colour():
    image = coloured([((80.2, 60.4), (220, 220, 220))])
    assert len(detect_hue(image[..., 0], hue_deg=120)) == 0
    assert len(detect_hue(image, hue_deg=120)) == 0
    assert detect_leds(image).uv == pytest.approx(np.array([(80.2, 60.4)]), abs=0.1)


def test_an_image_of_very_many_lights_is_measured_in_part_and_says_so():
    places = np.stack(np.meshgrid(np.arange(20.0), np.arange(15.0)), -1).reshape(-1, 2) * 14 + 12
    radius = np.where(np.arange(300) < 200, 2.2, 1.2)
    rng = np.random.default_rng(0)
    image = render(spots(places, radius, 220.0), size=(320, 240), background=12.0, sensor=Sensor(), rng=rng)
    blobs = detect_leds(image)
    assert (len(blobs), blobs.left_out) == (200, 100)
    assert blobs.uv[:, 1].max() < places[200:, 1].max() - 10  # the large ones are measured
    few = detect_leds(image[:, :100])
    assert few.left_out == 0
