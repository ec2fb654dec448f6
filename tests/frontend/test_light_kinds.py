"""LEDs whose brightness varies by four are told from lamps, glares and faint reflections."""

import numpy as np
import pytest

from coloc_graph.frontend import detect_leds
from coloc_graph.frontend.images.detection import Blobs
from coloc_graph.frontend.images.light_kinds import LED_PROBABILITY

SIZE = 240
V, U = np.mgrid[:SIZE, :SIZE]
LEDS = np.array([[40.3, 40.6], [100.2, 35.8], [160.7, 50.1], [45.5, 120.4], [120.1, 110.9], [180.4, 100.3]])
LAMP, GLARE, REFLECTION = [50.0, 200.0], [120.0, 190.0], [200.0, 180.0]


def spot(centre, peak, along, across=None, turn=0.0):
    """A Gaussian light."""
    du, dv = U - centre[0], V - centre[1]
    u, v = du * np.cos(turn) + dv * np.sin(turn), dv * np.cos(turn) - du * np.sin(turn)
    return peak * np.exp(-0.5 * ((u / along) ** 2 + (v / (across or along)) ** 2))


def picture(seed, dimmest):
    """LEDs from `dimmest` to four times that, all of one point spread, a lamp, a glare, and a reflection."""
    rng = np.random.default_rng(seed)
    light = 15.0 + 3.0 * rng.standard_normal((SIZE, SIZE))
    for centre, peak in zip(LEDS, dimmest * np.geomspace(1, 4, len(LEDS)), strict=True):
        light += spot(centre, peak, 2.0)
    light += np.where(np.hypot(U - LAMP[0], V - LAMP[1]) < 10, 0.8 * dimmest, 0)
    # a glare is as bright as an LED, and drawn out from its brightest end
    light += spot(GLARE, 2 * dimmest, 2.5) + spot(np.add(GLARE, [9.0, 5.0]), 0.9 * dimmest, 8.0, 3.5, 0.5)
    light += spot(REFLECTION, 0.45 * dimmest, 5.0, 2.0, 0.4)
    return np.clip(light, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("dimmest", [90.0, 150.0, 400.0])
def test_leds_are_told_from_other_lights(dimmest):
    for seed in range(3):
        blobs = detect_leds(picture(seed, dimmest))
        away = np.linalg.norm(LEDS[:, None] - blobs.uv, axis=2)
        led = blobs.led > LED_PROBABILITY
        assert led[away.argmin(axis=1)].all(), blobs.led.round(2)  # the brightest and the dimmest among them
        assert not led[away.min(axis=0) > 4].any(), blobs.led.round(2)
        assert (away.min(axis=0) > 4).sum() >= 2


def test_what_a_light_is_called_does_not_depend_on_which_are_asked_for():
    blobs = detect_leds(picture(0, 150.0))
    some = np.arange(len(blobs)) % 2 == 1
    assert (blobs[some].led == blobs.led[some]).all()


def test_records_without_pixels_tell_a_faint_light_from_leds():
    n = 5
    peak, area = np.array([200.0, 180.0, 220.0, 190.0, 40.0]), np.array([14.0, 13.0, 15.0, 14.0, 60.0])
    blobs = Blobs(np.zeros((n, 2)), np.zeros((n, 2, 2)), np.zeros(n, np.uint8), peak, area)
    assert blobs.led[:4].min() > 0.5 > LED_PROBABILITY > blobs.led[4]
    assert len(blobs[np.zeros(n, bool)].led) == 0
