"""Odometry of the wheels, from encoder counts or distances: wrapping, gaps, and covariances that are true."""

import numpy as np
import pytest
from scipy.stats import chi2
from wheel_nees import nees

from coloc_graph.robot_io.create.odometry import (
    DeltaOdometry,
    EncoderOdometry,
    Odometer,
    _held,
    arc,
    arc_covariance,
    ticks_between,
)
from coloc_graph.robot_io.create.physics import Body, Physics
from coloc_graph.robot_io.create.protocol import Packet
from coloc_graph.robot_io.create.state import DELTAS


def test_counts_wrap():
    assert ticks_between(65530, 4) == 10 and ticks_between(4, 65530) == -10 and ticks_between(0, 0) == 0
    assert ticks_between(0, 32767) == 32767 and ticks_between(0, 32769) == -32767


def test_an_arc_by_hand():
    # a quarter turn to the left about a point 1 m away: outer wheel on 1.1 m, inner on 0.9 m
    left, right = 0.9 * np.pi / 2, 1.1 * np.pi / 2
    assert arc(left, right, 0.2) == pytest.approx((1.0, 1.0, np.pi / 2))
    assert arc(0.5, 0.5, 0.2) == (0.5, 0.0, 0.0)
    for wheel, other in ((left, right), (0.3, -0.2), (0.4, 0.4)):
        J = np.array([
            (np.array(arc(wheel + a, other + b, 0.2)) - arc(wheel - a, other - b, 0.2)) / 2e-6
            for a, b in ((1e-6, 0), (0, 1e-6))
        ]).T  # fmt: skip
        expected = J @ np.diag([1e-4 * abs(wheel), 1e-4 * abs(other)]) @ J.T
        np.testing.assert_allclose(arc_covariance(wheel, other, 0.2), expected, atol=2e-7)


def test_a_distance_that_a_coarse_count_allows_is_the_requested_one_with_its_error():
    # 3 % of the requested distance and 0.05 of a count; a uniform error of a count at most
    assert _held(0.0105, 10, 1e-3) == pytest.approx((0.0105, 1e-3 / 12**0.5))
    assert _held(0.0045, 4, 1e-3) == pytest.approx((0.0045, 0.03 * 0.0045 + 0.05 * 1e-3))
    assert _held(0.0, 0, 1e-3) == pytest.approx((0.0, 0.05 * 1e-3))
    # and beyond what the count allows the middle of that
    assert _held(0.02, 10, 1e-3) == pytest.approx((0.0105, 1e-3 / 12**0.5))


def test_counts_that_no_wheel_can_reach_are_left_out():
    way = EncoderOdometry()
    ticks = [(100, 100), (110, 110), (9000, 110), (120, 120), (5, 5), (5, 5), (5, 5), (10, 10)]
    told = [way.step({Packet.LEFT_TICKS: left, Packet.RIGHT_TICKS: right}, 0.015) for left, right in ticks]
    forward = [None if one is None else round(one[0][0] / 4.4459e-4) for one in told]
    assert forward == [0, 10, None, 10, -115, 0, 0, 5]
    way = EncoderOdometry()
    told = [way.step({Packet.LEFT_TICKS: n, Packet.RIGHT_TICKS: n}, 0.015) for n in (30000, 0, 3, 6, 9)]
    assert [one is None for one in told] == [False, True, True, False, False]


def test_a_robot_that_counts_anew_is_said_to_be_anywhere_it_could_have_come_to():
    way, odometer, samples = EncoderOdometry(), Odometer("A"), []
    for n, ticks in enumerate([30000, 30000, 0, 0, 0, *range(16, 200, 16)]):
        step = way.step({Packet.LEFT_TICKS: ticks, Packet.RIGHT_TICKS: ticks}, 0.3 if n == 2 else 0.015)
        samples += odometer.add(10 + 0.015 * n + 0.3 * (n > 1), *step) if step else []
    assert max(one.covariance[0, 0] for one in samples) > 0.15**2 > samples[-1].covariance[0, 0]


@pytest.mark.parametrize("before", [0, 1, 5])
def test_frames_that_were_held_up_lose_no_way(before):
    """A reader that was not run for 0.6 s finds `before` old frames, then one with all of the way."""
    way, odometer, samples = EncoderOdometry(), Odometer("A"), []
    late, speed = 0.6, 0.45
    written = np.arange(0.0, 3.0, 0.015)
    held = (written > 1.0) & (written < 1.0 + late)
    come = np.where(held, 1.0 + late, written)
    kept = ~held | (np.cumsum(held) <= before)
    previous = -0.015
    for at, now in zip(written[kept], come[kept], strict=True):
        ticks = int(speed * at / 4.44589e-4)
        step = way.step({Packet.LEFT_TICKS: ticks, Packet.RIGHT_TICKS: ticks}, now - previous)
        samples += odometer.add(100 + now, *step) if step else []
        previous = now
    rolled = np.array([one.pose[0] for one in samples])
    at = np.array([one.time - 100 for one in samples])
    assert rolled[-1] == pytest.approx(speed * at[-1], abs=1e-3)
    # nor is it told to have stood, and then to have leapt
    assert np.diff(rolled / speed - at).max() < 0.02


def simulated(model, seed, frames=167, period=0.03, **physics):
    """A random drive through the emulator's body without its clock: the samples, and the true poses at their ends."""
    rng = np.random.default_rng(seed)
    body = Body(model, Physics(seed=seed, step=0.01, **physics), 0.0)
    odometer = Odometer("A", late=0.1 if model == 2 else np.inf)
    way = EncoderOdometry() if model == 2 else DeltaOdometry()
    samples, asked = [], np.zeros(2)
    true_start = body.x, body.y, body.yaw
    for n in range(frames):
        if n % 33 == 0:
            v, w = rng.uniform(0.1, 0.35), rng.uniform(-1.2, 1.2)
            body.wanted = (v - w * body.base / 2, v + w * body.base / 2) if n < frames - 34 else (0.0, 0.0)
        body.advance((n + 1) * period + 1e-9)
        frame = {
            Packet.REQUESTED_LEFT: round(body.wanted[0] * 1e3),
            Packet.REQUESTED_RIGHT: round(body.wanted[1] * 1e3),
        }
        if model == 2:
            counts = [int(c // 4.44589e-4) for c in body.counted]
            frame |= {Packet.LEFT_TICKS: counts[0] % 65536, Packet.RIGHT_TICKS: counts[1] % 65536}
        elif n % 16 == 0 or n == frames - 1:
            left, right = body.counted
            counted = np.array([(left + right) / 2 * 1e3, np.degrees((right - left) / body.base)])
            whole, asked = np.trunc(counted - asked), counted
            frame |= dict(zip(DELTAS, whole.astype(int), strict=True))
        step = way.step(frame, period)
        samples += odometer.add(100 + (n + 1) * period, *step) if step else []
    return samples, true_start, (body.x, body.y, body.yaw)


@pytest.mark.parametrize(("model", "runs"), [(2, 30), (1, 50)])
def test_nees_of_odometry(model, runs):
    values = [nees(*simulated(model, seed))[0] for seed in range(runs)]
    low, high = chi2.ppf([0.005, 0.995], 3 * runs) / runs
    print(f"    model {model}: mean NEES {np.mean(values):.2f} of 3, interval {low:.2f} to {high:.2f}")
    assert np.mean(values) < high
    assert np.mean(values) > (low if model == 2 else 0.5)  # a Create 1 is too coarse to be believed more


def test_without_slip_the_way_is_true_to_the_tick():
    samples, _, true = simulated(2, 3, slip=0.0, encoder=0.0)
    np.testing.assert_allclose(samples[-1].pose, true, atol=4e-3)  # a tick is 0.4 mm, across the wheels 1.9 mrad


def test_at_rest_samples_are_few_and_the_rest_is_closed_before_a_movement():
    odometer, still = Odometer("A"), np.zeros((3, 3))
    samples = [one for n in range(200) for one in odometer.add(n * 0.015, (0.0, 0.0, 0.0), still)]
    assert [round(one.time, 2) for one in samples] == [0.0, 1.0, 2.01] or len(samples) in (3, 4)
    samples = [one for n in range(200, 220) for one in odometer.add(n * 0.015, (0.003, 0.0, 0.0), 1e-6 * np.eye(3))]
    assert samples[0].time == pytest.approx(199 * 0.015) and not samples[0].pose.any()
    np.testing.assert_allclose(np.diff([one.time for one in samples[1:]]), 0.06, atol=1e-9)
    assert samples[1].covariance[0, 0] == pytest.approx(4e-6, rel=0.01)
