"""Breaks in odometry are found where no wheel can have made them, and nowhere else."""

import numpy as np
import pytest

from coloc_graph.run.odometry_breaks import find_breaks, join_breaks


def drive(seed, n=600, dt=0.05, top=0.4):
    """Stop-and-go driving with turns: times (n,), poses (n, 3)."""
    rng = np.random.default_rng(seed)
    legs = rng.integers(10, 40, n)
    v = np.repeat(rng.choice([0.0, 0.3 * top, top], n), legs)[:n]
    w = np.repeat(rng.choice([0.0, 0.0, 0.8, -1.5], n), legs)[:n]
    yaw = np.cumsum(w * dt)
    x, y = np.cumsum(v * dt * np.cos(yaw)), np.cumsum(v * dt * np.sin(yaw))
    t = 1e9 + dt * np.arange(n) + rng.uniform(-0.01, 0.01, n)
    return np.sort(t), np.column_stack([x, y, wrapped(yaw)])


def rotation(yaw):
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])


def wrapped(yaw):
    return np.remainder(yaw + np.pi, 2 * np.pi) - np.pi


@pytest.mark.parametrize("seed", range(20))
def test_driving_is_no_break(seed):
    t, p = drive(seed)
    assert find_breaks(t, p) == []
    assert find_breaks(t[::10], p[::10]) == [] and find_breaks(t[:1], p[:1]) == []


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("at", [150, 599])
def test_a_driver_that_restarts_is_found_and_what_follows_goes_on_from_before(seed, at):
    t, p = drive(seed)
    whole = p.copy()
    if np.hypot(*whole[at - 1, :2]) < 0.3:
        pytest.skip("it stood near the origin of its odometry")
    p[at:, :2] = (p[at:, :2] - p[at, :2]) @ rotation(p[at, 2])
    p[at:, 2] = wrapped(p[at:, 2] - p[at, 2])
    (one,) = find_breaks(t, p)
    assert one.index == at and one.to_origin and "restarted at the origin" in str(one) and one.sigmas[0] < 0.2
    again = join_breaks(p, [one])
    assert again[at] == pytest.approx(again[at - 1]) and again[:at] == pytest.approx(whole[:at])
    turned = wrapped(again[at:, 2] - whole[at:, 2])  # by what it turned in the step that is lost
    assert np.ptp(turned) < 1e-9 and abs(turned[0]) < 0.1
    way = (whole[at:, :2] - whole[at, :2]) @ rotation(turned[0]).T
    assert again[at:, :2] - again[at, :2] == pytest.approx(way)


def test_a_jump_elsewhere_and_a_turn_on_the_spot_are_breaks_and_a_short_slip_is_none():
    t, p = drive(3)
    p[300:, 0] += 0.5
    p[400:, 2] += 1.2
    p[500:, 1] += 0.02
    assert [one.index for one in find_breaks(t, p)] == [300, 400]
    assert not any(one.to_origin for one in find_breaks(t, p))


def test_two_samples_that_come_at_once_are_no_jump():
    t, p = drive(4)
    t[200] = t[199] + 1e-4
    assert find_breaks(t, p) == []
