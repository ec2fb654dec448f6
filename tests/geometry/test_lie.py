"""Laws of the groups, and their maps against scipy's."""

import gtsam
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from coloc_graph.geometry.lie import (
    SL3_BASIS,
    closest_rotation,
    floor_pose,
    hat,
    quaternion,
    rotation_x,
    rotation_y,
    rotation_z,
    se3,
    se3_exp,
    se3_inverse,
    se3_log,
    sl3_exp,
    sl3_hat,
    sl3_log,
    sl3_normalise,
    sl3_vee,
    so3_exp,
    so3_log,
    yaw,
)

ANGLES = [0.0, 1e-14, 1e-12, 1e-9, 1e-6, 1e-3, 0.5, 2.0, 3.0, np.pi - 1e-3, np.pi - 1e-6, np.pi - 1e-9]


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def unit(rng, n):
    v = rng.normal(size=(n, 3))
    return np.concatenate([v / np.linalg.norm(v, axis=1, keepdims=True), np.eye(3), -np.eye(3)])


@pytest.mark.parametrize("angle", ANGLES)
def test_so3_log_undoes_exp_near_0_and_near_pi(rng, angle):
    w = angle * unit(rng, 50)
    assert so3_log(so3_exp(w)) == pytest.approx(w, rel=1e-6, abs=1e-14 if angle < 1e-3 else 1e-12)


@pytest.mark.parametrize("angle", [np.pi - 1e-12, np.pi, np.pi + 1e-9, 4.0, 2 * np.pi, 9.0])
def test_so3_exp_undoes_log_at_pi_and_beyond(rng, angle):
    R = so3_exp(angle * unit(rng, 50))
    w = so3_log(R)
    assert so3_exp(w) == pytest.approx(R, abs=1e-12)
    assert (np.linalg.norm(w, axis=1) <= np.pi + 1e-12).all()


def test_so3_agrees_with_scipy(rng):
    w = rng.uniform(-1.8, 1.8, (200, 3))
    reference = Rotation.from_rotvec(w)
    assert so3_exp(w) == pytest.approx(reference.as_matrix(), abs=1e-14)
    assert so3_log(reference.as_matrix()) == pytest.approx(reference.as_rotvec(), abs=1e-12)


def test_rotations_are_a_group(rng):
    v, w = rng.uniform(-2, 2, (2, 100, 3))
    R, Q = so3_exp(v), so3_exp(w)
    for M in (R, Q, R @ Q):
        assert M @ M.swapaxes(1, 2) == pytest.approx(np.broadcast_to(np.eye(3), M.shape), abs=1e-14)
        assert np.linalg.det(M) == pytest.approx(1.0, abs=1e-13)
    assert so3_exp(-v) == pytest.approx(R.swapaxes(1, 2), abs=1e-14)
    assert so3_exp(0.3 * v) @ so3_exp(0.7 * v) == pytest.approx(R, abs=1e-14)
    turned = (R @ w[..., None])[..., 0]
    assert R @ Q @ R.swapaxes(1, 2) == pytest.approx(so3_exp(turned), abs=1e-13)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.4, 2.5, np.pi - 1e-9, np.pi])
def test_quaternion_agrees_with_scipy_and_has_w_not_negative(rng, angle):
    for R in so3_exp(angle * unit(rng, 30)):
        q = np.array(quaternion(R))
        x, y, z, w = Rotation.from_matrix(R).as_quat()
        assert q[0] >= 0
        assert abs(q @ (w, x, y, z)) == pytest.approx(1.0, abs=1e-14)
        assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-15)
        assert Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix() == pytest.approx(R, abs=1e-14)


def test_hat_is_the_cross_product(rng):
    a, b = rng.normal(size=(2, 4, 5, 3))
    assert (hat(a) @ b[..., None])[..., 0] == pytest.approx(np.cross(a, b), abs=1e-14)
    assert (hat(a) == -hat(a).swapaxes(-1, -2)).all()
    assert so3_exp(0.3 * a) == pytest.approx(expm(hat(0.3 * a)), abs=1e-13)


def test_elementary_rotations_turn_the_right_way():
    for axis, make in zip("xyz", (rotation_x, rotation_y, rotation_z), strict=True):
        assert make(0.3) == pytest.approx(Rotation.from_euler(axis, 0.3).as_matrix(), abs=1e-15)
    assert rotation_z(np.pi / 2) @ (1, 0, 0) == pytest.approx([0, 1, 0], abs=1e-15)


def test_closest_rotation_is_a_rotation_and_none_is_closer(rng):
    M = rng.normal(size=(20, 3, 3))
    M[0] = np.diag([1.0, 1.0, -1.0])  # a reflection
    M[1] = 5 * rotation_x(0.4)
    R = closest_rotation(M)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-12)
    assert R[1] == pytest.approx(rotation_x(0.4), abs=1e-14)
    near = R @ so3_exp(1e-3 * rng.normal(size=(300, 1, 3)))
    assert (np.linalg.norm(near - M, axis=(2, 3)) >= np.linalg.norm(R - M, axis=(1, 2)) - 1e-9).all()


def test_poses_are_a_group(rng):
    T_a_b, T_b_c = (se3(so3_exp(rng.uniform(-2, 2, (6, 5, 3))), rng.normal(size=(6, 5, 3))) for _ in range(2))
    one = np.broadcast_to(np.eye(4), T_a_b.shape)
    assert se3_inverse(T_a_b) @ T_a_b == pytest.approx(one, abs=1e-13)
    assert T_a_b @ se3_inverse(T_a_b) == pytest.approx(one, abs=1e-13)
    assert se3_inverse(T_a_b @ T_b_c) == pytest.approx(se3_inverse(T_b_c) @ se3_inverse(T_a_b), abs=1e-13)
    assert se3_inverse(T_a_b) == pytest.approx(np.linalg.inv(T_a_b), abs=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 9e-4, 1.1e-3, 1.0, 3.1, np.pi - 1e-9])
def test_se3_log_undoes_exp_and_is_gtsams(rng, angle):
    w = rng.normal(size=(20, 3))
    xi = np.hstack([angle * w / np.linalg.norm(w, axis=1, keepdims=True), rng.normal(size=(20, 3))])
    T = se3_exp(xi)
    found = se3_log(T)
    assert found == pytest.approx(xi, abs=1e-8 if angle > 3.13 else 1e-12)
    if angle < 3:
        theirs = np.array([gtsam.Pose3.Logmap(gtsam.Pose3(one)) for one in T])
        assert found == pytest.approx(theirs, abs=1e-9)


def test_floor_pose_spreads_its_arguments_and_yaw_reads_it_back(rng):
    angles = rng.uniform(-np.pi, np.pi, (4, 3))
    T = floor_pose(1.0, 2.0, angles)
    assert yaw(T) == pytest.approx(angles)
    assert yaw(T[..., :3, :3]) == pytest.approx(angles)
    assert T[2, 1] == pytest.approx(se3(rotation_z(angles[2, 1]), (1.0, 2.0, 0.0)))


def test_sl3_vee_undoes_hat_and_removes_the_trace(rng):
    h = rng.normal(size=(7, 2, 8))
    assert sl3_vee(sl3_hat(h)) == pytest.approx(h, abs=1e-15)
    assert sl3_vee(sl3_hat(h) + 0.7 * np.eye(3)) == pytest.approx(h, abs=1e-14)
    assert np.trace(SL3_BASIS, axis1=1, axis2=2) == pytest.approx(0.0)
    assert np.linalg.matrix_rank(SL3_BASIS.reshape(8, 9)) == 8


@pytest.mark.parametrize("size", [0.0, 1e-10, 1e-4, 0.1, 1.0, 4.0])
def test_sl3_exp_is_the_matrix_exponential(rng, size):
    h = size * rng.uniform(-1, 1, (30, 8))
    wanted = np.array([expm(D) for D in sl3_hat(h)])
    assert sl3_exp(h) == pytest.approx(wanted, rel=1e-11, abs=1e-11 * np.abs(wanted).max())
    assert sl3_exp(h[0]) == pytest.approx(wanted[0], rel=1e-11, abs=1e-11 * np.abs(wanted[0]).max())


def test_homographies_of_determinant_1_are_a_group(rng):
    h = 0.5 * rng.normal(size=(30, 8))
    assert np.linalg.det(sl3_exp(h)) == pytest.approx(1.0, abs=1e-10)
    one = np.broadcast_to(np.eye(3), (30, 3, 3))
    assert sl3_exp(h) @ sl3_exp(-h) == pytest.approx(one, abs=1e-10)
    assert sl3_exp(0.4 * h) @ sl3_exp(0.6 * h) == pytest.approx(sl3_exp(h), abs=1e-10)


@pytest.mark.parametrize("scale", [1e-6, -1e-6, 3.0, -3.0])
def test_sl3_normalise_undoes_any_scale_and_sign(rng, scale):
    H = sl3_exp(0.5 * rng.normal(size=(10, 8)))
    assert sl3_normalise(scale * H) == pytest.approx(H, abs=1e-10)


def test_sl3_log_of_many_is_that_of_each_and_one_without_a_logarithm_spoils_no_other(rng):
    h = 0.5 * rng.normal(size=(20, 8)) * np.logspace(-4, 0, 20)[:, None]
    E = sl3_exp(h)
    E[3], E[5] = np.diag([1.0, -1.0, -1.0]), np.nan
    log = sl3_log(E)
    assert np.isnan(log[[3, 5]]).all()
    good = np.delete(np.arange(20), [3, 5])
    assert log[good] == pytest.approx(h[good], abs=1e-12)
    assert np.array([sl3_log(one) for one in E[good]]) == pytest.approx(h[good], abs=1e-12)
