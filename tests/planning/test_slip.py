"""Slip at the end of leaps: what is planned with is what emulated wheels do."""

import math

import numpy as np
import pytest

from coloc_graph.planning.slip import MIN_MARGIN, WheelErrors, view_margins
from coloc_graph.robot_io.create.odometry import ENCODER, SLIP, WHEELS
from coloc_graph.robot_io.create.physics import Body, Physics


def test_a_heading_after_a_metre_is_off_as_stated():
    off = []
    for seed in range(30):
        body = Body(1, Physics(seed=seed, step=0.01), 0.0, wanted=(0.5, 0.5))
        body.advance(2.25)
        (left, right), distance = body.counted, body.x
        off.append((body.yaw - (right - left) / WHEELS[1].base) / math.sqrt(distance))
    errors = WheelErrors.of_wheels(math.hypot(SLIP, ENCODER), WHEELS[1].base)
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(errors.veer, rel=0.35)


def test_margins_grow_with_the_leap_and_those_known_to_stand_need_none():
    wheels = WheelErrors.of_wheels(0.01, 0.235)
    margins = view_margins([0.5, 1.5], 300.0, wheels, 3, known=True)
    assert margins.shape == (2, 3, 2) and (margins[:, :2] == MIN_MARGIN).all()
    assert (margins[1, 2] > margins[0, 2]).all() and margins[1, 2, 0] > 2 * margins[1, 2, 1]
    assert (view_margins(0.5, 300.0, wheels, 3, known=False) == margins[0, 2]).all()
