"""Offsets of clocks up to seconds from one motion that two cameras saw, on drawn paths."""

import numpy as np
import pytest

from coloc_graph.frontend.pairing.offset_search import TimedPath, search_offset

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


def test_an_offset_that_the_motion_does_not_tell_is_not_found():
    rng = np.random.default_rng(0)
    times = np.arange(0.0, 20.0, 0.1)
    line = np.column_stack([50 + 9 * times, 40 + 5 * times])
    noisy = [TimedPath(times, line + 0.3 * rng.standard_normal(line.shape)) for _ in range(2)]
    assert search_offset([tuple(noisy)]) is None
    still = [TimedPath(times, 100 + 0.3 * rng.standard_normal(line.shape)) for _ in range(2)]
    assert search_offset([tuple(still)]) is None
    assert search_offset([]) is None


def test_an_offset_that_leaves_the_paths_apart_is_none():
    """As odometry of another point of the body than the one that carries the marker."""
    pairs = seen(np.random.default_rng(1), 0.3)
    assert search_offset(pairs, max_residual=1.0) is not None
    assert search_offset(pairs, max_residual=0.1) is None
