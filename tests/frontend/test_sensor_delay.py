"""Measurements that are stamped late against odometry: found, corrected and named; nobody else is."""

import dataclasses

import mrclam_folder
import numpy as np
import pytest

from coloc_graph.exchange.mrclam import import_mrclam
from coloc_graph.frontend.keyframes import keyframes_of
from coloc_graph.frontend.sensor_delay import sensor_delay
from coloc_graph.run import open_run


def turning(rng, delay, seconds=60.0, n=400):
    """Measurements of landmarks by a robot that turns now and then, stamped `delay` late; and its odometry."""
    t = np.arange(0.0, seconds, 0.05)
    yaw = np.cumsum(np.repeat(rng.choice([-0.5, 0.0, 0.4], len(t)), rng.integers(20, 60, len(t)))[: len(t)] * 0.05)
    x, y = np.cumsum(0.006 * np.cos(yaw)), np.cumsum(0.006 * np.sin(yaw))

    def pose_at(times):
        return np.stack([np.interp(times, t, column) for column in (x, y, yaw)], axis=-1)

    places = rng.uniform(-4, 4, (5, 2))
    times, targets = np.sort(rng.uniform(1, seconds - 1, n)), rng.integers(0, 5, n)
    pose = pose_at(times)
    off = places[targets] - pose[:, :2]
    bearings = np.arctan2(off[:, 1], off[:, 0]) - pose[:, 2] + rng.normal(0, 0.03, n)
    ranges = np.hypot(*off.T) + rng.normal(0, 0.1, n)
    return times + delay, targets, ranges, np.remainder(bearings + np.pi, 2 * np.pi) - np.pi, pose_at


@pytest.mark.parametrize("delay", [-2.0, -0.3, 0.0, 0.2, 1.0, 2.5])
def test_a_delay_is_found_to_its_sigma(delay):
    off = []
    for seed in range(8):
        found = sensor_delay(*turning(np.random.default_rng(seed), delay))
        if delay == 0 and found is None:
            continue
        assert found is not None and abs(found.value - delay) < 0.1
        off.append((found.value - delay) / found.sigma)
    assert not off or np.sqrt(np.mean(np.square(off))) < 2.0


def test_a_robot_that_never_turns_tells_nothing():
    times, targets, ranges, bearings, _ = turning(np.random.default_rng(0), 0.5)
    assert sensor_delay(times, targets, ranges, bearings, lambda t: np.zeros((len(t), 3))) is None
    assert sensor_delay(times[:20], targets[:20], ranges[:20], bearings[:20], lambda t: np.zeros((len(t), 3))) is None


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("late")
    mrclam_folder.make(folder / "data")
    import_mrclam(folder / "data", folder / "run.mcap")
    return open_run(folder / "run.mcap")


@pytest.mark.parametrize("delay", [0.3, 0.5, -1.0])
def test_the_robot_whose_measurements_are_late_is_named_and_its_times_are_right(dataset, monkeypatch, delay):
    right = keyframes_of(dataset)
    assert right.warnings == ()
    genuine = type(dataset).ranges

    def late(self, robot, start=None, end=None):
        for one in genuine(self, robot):
            moved = dataclasses.replace(one, time=one.time + delay) if robot == "R2" else one
            if (start is None or moved.time >= start) and (end is None or moved.time < end):
                yield moved

    monkeypatch.setattr(type(dataset), "ranges", late)
    found = keyframes_of(dataset)
    (said,) = [one for one in found.warnings if "clock" in one]
    assert "the clock of R2's range sensor is" in said and ("ahead" if delay > 0 else "behind") in said
    own = found.measured.robot == 1
    others = ~own & np.isin(found.measured.robot, [0, 2])
    was = np.sort(right.measured.time[right.measured.robot == 1])
    n = min(own.sum(), len(was))
    assert np.abs(np.sort(found.measured.time[own])[-n:] - was[-n:]).max() < 0.06 and others.any()
