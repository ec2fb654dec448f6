"""Poses on the floor, and angles."""

import math

import numpy as np
import pytest

from coloc_graph.geometry.lie import floor_pose, se3_between, se3_inverse, yaw
from coloc_graph.geometry.se2 import between, compose, inverse, wrap


def test_an_angle_is_brought_near_zero_and_keeps_its_digits():
    angles = np.array([0.0, 1e-17, 3.0, -3.0, 4.0, -4.0, 100.0])
    np.testing.assert_allclose(wrap(angles), np.arctan2(np.sin(angles), np.cos(angles)), rtol=1e-14, atol=1e-30)
    assert [wrap(float(angle)) for angle in angles] == pytest.approx(wrap(angles).tolist(), rel=1e-14)
    assert type(wrap(7.0)) is float and wrap(1e-17) == 1e-17
    assert wrap(3.0, math.pi) == pytest.approx(3.0 - math.pi) and wrap(np.array(3.0), math.pi) < 0


def test_poses_on_the_floor_are_composed_as_matrices_are():
    rng = np.random.default_rng(0)
    for a, b in rng.normal(0, 2, (20, 2, 3)).tolist():
        A, B = floor_pose(*a), floor_pose(*b)
        for found, T in (
            (compose(a, b), A @ B),
            (inverse(a), se3_inverse(A)),
            (between(a, b), se3_inverse(A) @ B),
        ):
            assert found[:2] == pytest.approx(T[:2, 3].tolist(), abs=1e-12)
            assert wrap(found[2] - float(yaw(T))) == pytest.approx(0.0, abs=1e-12)
        np.testing.assert_allclose(se3_between(A, B), se3_inverse(A) @ B, atol=1e-14)
