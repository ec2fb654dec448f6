"""Kinematics of a camera's mount."""

import numpy as np
import pytest

from coloc_graph.geometry.lie import se3_inverse, so3_log
from coloc_graph.geometry.mounting import camera_rotation, roll_axis, tilt_and_roll, tilt_axis
from coloc_graph.team import Mount


def test_a_camera_that_is_not_turned_looks_ahead_and_tilt_is_down():
    np.testing.assert_allclose(camera_rotation(0.0, 0.0, 0.0) @ [0, 0, 1], [1, 0, 0], atol=1e-15)
    assert (camera_rotation(0.0, 0.3, 0.0) @ [0, 0, 1])[2] == pytest.approx(-np.sin(0.3))


def test_tilt_and_roll_come_back_from_the_vertical():
    up = camera_rotation(0.7, 0.4, -0.2).T @ [0.0, 0.0, 1.0]
    assert tilt_and_roll(up) == pytest.approx((0.4, -0.2), abs=1e-12)
    with pytest.raises(ValueError, match="upside down"):
        tilt_and_roll(-up)


def test_axes_are_those_about_which_small_errors_turn_a_camera():
    step = 1e-6
    R = camera_rotation(0.7, 0.4, -0.2)
    tilted = so3_log(R.T @ camera_rotation(0.7, 0.4 + step, -0.2)) / step
    rolled = so3_log(R.T @ camera_rotation(0.7, 0.4, -0.2 + step)) / step
    np.testing.assert_allclose(tilted, tilt_axis(-0.2), atol=1e-6)
    np.testing.assert_allclose(rolled, roll_axis(), atol=1e-6)


def test_a_mount_that_is_off_is_another_mount():
    mount = Mount(height=0.4, tilt_deg=20.0, roll_deg=1.0, yaw_deg=30.0, x=0.1, y=-0.05)
    other = Mount(height=0.41, tilt_deg=22.0, roll_deg=0.5, yaw_deg=30.0, x=0.1, y=-0.05)
    errors = np.array([[0.0, 0.0, 0.0], [0.01, *np.deg2rad([2.0, -0.5])]])
    for T, expected in zip(mount.off_by(errors), (mount, other), strict=True):
        np.testing.assert_allclose(T @ se3_inverse(expected.T_body_camera), np.eye(4), atol=1e-15)
