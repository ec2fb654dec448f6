"""The compiled kernel computes what the code in Python computes."""

import numpy as np
import pytest

from coloc_graph.frontend import detect_leds
from coloc_graph.frontend.compiled import kernel
from coloc_graph.frontend.images import centroid, components
from coloc_graph.frontend.images.detection import Detector
from coloc_graph.frontend.tracks import kalman

pytestmark = pytest.mark.skipif(kernel is None, reason="no compiled kernel: there was no C compiler at installation")


def scene(rng):
    """An image of spots, sharp or wide, close, cut off, saturated, drawn out, some beside a rim or a ring."""
    width, height = rng.integers(40, 130, 2)
    v, u = np.mgrid[:height, :width]
    light = np.full((height, width), 20.0)
    for _ in range(rng.integers(0, 9)):
        x, y = rng.uniform(-3, [[width + 3], [height + 3]], (2, 1)) - np.stack([u, v]).reshape(2, -1)
        angle, (along, across) = rng.uniform(0, 3), rng.uniform(0.4, 3, 2)
        p, q = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        spot = np.exp(-0.5 * ((p / along) ** 2 + (q / across) ** 2))
        light += rng.uniform(50, 400) * spot.reshape(light.shape)
    if rng.random() < 0.5:
        light += 60 * (u * np.cos(light[0, 0]) + v > rng.uniform(0, 100))
    if rng.random() < 0.2:
        light += 200 * (np.abs(np.hypot(u - 50, v - 50) - 16) < 4)
    light += rng.choice([0, 1.5, 4]) * rng.standard_normal(light.shape)
    return np.clip(light, 0, 255).astype(np.uint8), (5, 5, 5 + width // 2, 5 + height // 2)


def in_python(monkeypatch):
    for module in (components, centroid, kalman):
        monkeypatch.setattr(module, "kernel", None)


def test_blobs_are_the_same(monkeypatch):
    rng = np.random.default_rng(1)
    searches = [(image, box) for image, part in (scene(rng) for _ in range(25)) for box in (None, part)]

    def found():
        candidates = [sorted((c.uv, c.area, c.group.window, c.touched) for c in Detector().find(*s)) for s in searches]
        blobs = [detect_leds(*one) for one in searches]
        rows = [np.column_stack([b.uv, b.covariance.reshape(-1, 4), b.flags, b.peak, b.area]) for b in blobs]
        return candidates, np.concatenate([one[np.lexsort(one[:, :2].T)] for one in rows])

    candidates, blobs = found()
    in_python(monkeypatch)
    same_candidates, same_blobs = found()
    assert candidates == same_candidates
    assert len(blobs) > 60 and set(blobs[:, 6]) >= {0, 1, 2, 4, 8}
    assert blobs == pytest.approx(same_blobs, rel=1e-9, abs=1e-9)


def test_filters_are_the_same():
    rng = np.random.default_rng(0)
    ours, theirs = (one(3.0, 4.0, (0.3, 0.1, 0.2), 4e4) for one in (kernel.PointFilter, kalman.PointFilter))
    for k in range(50):
        u, v, dt = rng.normal(3, 5), rng.normal(4, 5), rng.uniform(0, 0.1)
        compared = []
        for one in (ours, theirs):
            one.predict(dt, 3e3)
            compared.append(one.compare(u, v, (0.5, -0.2, 0.4), 60.0, 25.0))
            if k % 5 == 0:
                one.allow_jerk(60.0)
            if k % 3:
                one.update(u, v, (0.5, -0.2, 0.4))
        assert compared[0] == (pytest.approx(compared[1]) if compared[1] else None)
        for name in ("u", "v", "du", "dv", "p", "b", "w", "unseen"):
            assert getattr(ours, name) == pytest.approx(getattr(theirs, name), rel=1e-9, abs=1e-12)


def test_what_does_not_fit_is_refused():
    light, inner, size = np.zeros((2, 11, 11)), np.zeros((2, 11, 11), bool), np.full((2, 2), 11)
    signal, out = np.empty((2, 11, 11)), np.empty((2, 14))
    good = [2, 11, light, size, inner, None, signal, out]
    kernel.measure_spots(*good, 35.0, 0.1)
    assert not out[:, 13].any()  # darkness
    wrong = {0: 3, 1: 12, 2: light[:1], 3: size + 1, 4: light, 5: np.zeros((2, 5)), 6: light[:, ::2], 7: out[:1]}
    for position, value in wrong.items():
        with pytest.raises((ValueError, BufferError)):
            kernel.measure_spots(*good[:position], value, *good[position + 1 :], 35.0, 0.1)
    for image in (np.zeros((3, 4, 3), np.uint8), np.zeros((4, 4)), np.zeros((4, 4), np.uint8)[:, ::-1]):
        with pytest.raises(ValueError):
            kernel.find_bright(image, (0, 0, 4, 4), 35.0, 1, 9)
    for size in ((4, 4), (0, 4), (4, 0)):
        assert kernel.find_bright(np.zeros(size, np.uint8), (9, 9, 9, 9), np.nan, 1, 9)[1] == []
