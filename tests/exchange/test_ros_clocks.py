"""Clocks of a bag's robots from stamps against reception, on drawn recordings with latency and jitter."""

import numpy as np
import pytest

from coloc_graph.exchange.ros_clocks import StampedTopic, bag_clocks

START = 1_800_000_000_000_000_000
KINDS = {"image": (10.0, 0.03), "odometry": (50.0, 0.002)}  # rate [Hz], least latency [s]


def topic(rng, robot, kind, error, seconds=60.0):
    """A topic of a robot whose clock is wrong by `error(t)` [s], received with random latency."""
    rate, least = KINDS[kind]
    t = np.arange(0.0, seconds, 1 / rate) + rng.uniform(0, 1 / rate)
    latency = least + rng.exponential(least / 2, len(t))
    received = START + np.rint(1e9 * (t + latency)).astype(np.int64)
    stamps = START + np.rint(1e9 * (t + error(t))).astype(np.int64)
    order = np.argsort(received, kind="stable")
    return StampedTopic(robot, kind, stamps[order], received[order])


def recording(seed, error, kinds=("image", "odometry"), seconds=60.0):
    """Three robots, of which B's clock has the error."""
    rng = np.random.default_rng(seed)
    right = np.zeros_like
    return {
        f"/{robot}/{kind}": topic(rng, robot, kind, error if robot == "B" else right, seconds)
        for robot in "ABC"
        for kind in (kinds if robot != "C" else kinds[-1:])
    }


def left(found, topics):
    """What correction leaves of B's error at each of its messages [s], by topic, less latency."""
    return {
        name: one.offsets - np.array([found.clocks[name].error(int(at)) for at in one.received]) / 1e9
        for name, one in topics.items()
    }


@pytest.mark.parametrize("offset", [-3.0, -1.0, -0.3, 0.3, 1.0, 3.0])
@pytest.mark.parametrize("kinds", [("image",), ("image", "odometry")])
def test_an_offset_is_found_to_what_latency_leaves(offset, kinds):
    topics = recording(1, lambda t: np.full_like(t, offset), kinds)
    found = bag_clocks(topics)
    assert {name for name, clock in found.clocks.items() if not clock.is_right} == {f"/B/{kind}" for kind in kinds}
    assert found.clocks["/B/image"].offsets == pytest.approx([offset], abs=2e-3 if len(kinds) == 2 else 5e-3)
    ahead = "ahead of" if offset > 0 else "behind"
    assert f"B's clock ({', '.join(found.clocks['/B/image'].topics)}) is {abs(offset):.1f}" in found.sentences()[0]
    assert ahead in found.sentences()[0] and found.sigma > 0


@pytest.mark.parametrize("step", [-1.0, 1.0, 0.4])
def test_a_clock_that_is_set_within_the_recording_is_found_and_undone(step):
    topics = recording(2, lambda t: np.where(t > 25.0, step, 0.0))
    found = bag_clocks(topics)
    clock = found.clocks["/B/odometry"]
    assert clock.steps == pytest.approx([START + 25e9], abs=0.1e9)
    assert clock.offsets == pytest.approx([0.0, step], abs=3e-3)
    said = " ".join(found.sentences())
    assert f"set {'back' if step < 0 else 'ahead'} by" in said and "B's clock" in said and "A's clock" not in said
    off = left(found, topics)["/B/odometry"]
    assert (np.abs(off - np.median(off)) > 0.1).mean() < 0.01


def test_a_drift_of_100_ppm_is_found_and_removed():
    topics = recording(3, lambda t: 1e-4 * t, seconds=300.0)
    found = bag_clocks(topics)
    assert found.clocks["/B/odometry"].drift == pytest.approx(1e-4, rel=0.1)
    assert found.clocks["/A/odometry"].drift == 0
    off = left(found, topics)["/B/odometry"]
    assert abs(np.median(off[:500]) - np.median(off[-500:])) < 2e-3


@pytest.mark.parametrize("seed", range(40))
def test_clocks_that_are_right_are_left_alone_whatever_the_latency(seed):
    topics = recording(100 + seed, np.zeros_like)
    found = bag_clocks(topics)
    assert all(clock.is_right for clock in found.clocks.values()) and not found.sentences() and found.sigma == 0


def test_a_robot_with_images_only_is_not_blamed_for_their_latency():
    rng = np.random.default_rng(4)
    topics = {
        "/A/image": topic(rng, "A", "image", np.zeros_like),
        "/B/image": topic(rng, "B", "image", np.zeros_like),
        "/C/odometry": topic(rng, "C", "odometry", np.zeros_like),
    }
    slow = dict(topics)
    for name in ("/A/image", "/B/image"):  # compressed on a slow computer: 0.4 s late
        one = topics[name]
        slow[name] = StampedTopic(one.robot, one.kind, one.stamps, one.received + 400_000_000)
    assert not bag_clocks(slow).sentences()


def test_reception_times_of_a_converted_bag_tell_nothing():
    topics = recording(5, lambda t: np.full_like(t, 1.0))
    fast = {
        name: StampedTopic(one.robot, one.kind, one.stamps, START + (one.received - START) // 20)
        for name, one in topics.items()
    }
    assert not bag_clocks(fast).clocks and not bag_clocks({}).clocks
