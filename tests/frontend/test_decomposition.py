"""Eq. (2) and both SVD solutions: exact on exact homographies, and lawful under changes of frame and scale."""

import cv2
import numpy as np
import pytest
from planar_scene import geometry, homography

from coloc_graph.frontend import choose_by_normal, decompose_svd, decompose_with_normal, metric_scale
from coloc_graph.geometry.lie import se3, se3_inverse, so3_exp, so3_log


@pytest.fixture
def exact():
    return geometry(np.random.default_rng(5), 300)


def second(R, T, N, d):
    """The plane in camera 2."""
    N2 = (R @ N[..., None])[..., 0]
    return N2, d + np.sum(N2 * T, -1)


def test_an_exact_homography_gives_the_exact_pose(exact):
    R, T, N, d = exact
    found_R, found_T = decompose_with_normal(homography(R, T, N, d), N, d)
    assert found_R == pytest.approx(R, abs=1e-10)
    assert found_T == pytest.approx(T, abs=1e-10)


def test_a_case_solved_by_hand():
    # camera 2 is half a metre to the right of camera 1; both look straight down from 2 m
    H = np.array([[1.0, 0, -0.25], [0, 1, 0], [0, 0, 1]])
    R, T = decompose_with_normal(H, [0, 0, 1.0], 2.0)
    assert pytest.approx(np.eye(3), abs=1e-12) == R
    assert pytest.approx([-0.5, 0, 0], abs=1e-12) == T


@pytest.mark.parametrize("factor", [-1.0, 5.0, -1e-4, 1e4])
def test_scale_and_sign_of_the_homography_do_not_matter(exact, factor):
    R, T, N, d = exact
    H = homography(R, T, N, d)
    found_R, found_T = decompose_with_normal(factor * H, N, d)
    assert found_R == pytest.approx(R, abs=1e-10)
    assert found_T == pytest.approx(T, abs=1e-10)
    assert metric_scale(factor * H) == pytest.approx(H, abs=1e-10)


def test_swapping_the_cameras_inverts_the_pose(exact):
    R, T, N, d = exact
    back_R, back_T = decompose_with_normal(np.linalg.inv(homography(R, T, N, d)), *second(R, T, N, d))
    assert se3(back_R, back_T) == pytest.approx(se3_inverse(se3(R, T)), abs=1e-9)


def test_a_scene_three_times_as_large_has_three_times_the_translation(exact):
    R, T, N, d = exact
    H = homography(R, T, N, d)
    assert decompose_with_normal(H, N, 3 * d)[1] == pytest.approx(3 * T, abs=1e-9)
    assert decompose_with_normal(H, N, 3 * d)[0] == pytest.approx(R, abs=1e-10)


def test_turning_camera_1_on_the_spot_changes_the_rotation_alone(exact):
    R, T, N, d = exact
    Q = so3_exp(np.random.default_rng(1).uniform(-2, 2, (len(R), 3)))
    turned_R, turned_T = decompose_with_normal(homography(R, T, N, d) @ Q.swapaxes(1, 2), (Q @ N[..., None])[..., 0], d)
    assert turned_T == pytest.approx(T, abs=1e-9)
    assert turned_R @ Q == pytest.approx(R, abs=1e-10)


def test_poses_along_three_cameras_compose():
    rng = np.random.default_rng(9)
    R21, T21, N1, d1 = geometry(rng, 100)
    N2, d2 = second(R21, T21, N1, d1)
    R32, T32 = so3_exp(rng.uniform(-0.6, 0.6, (100, 3))), rng.normal(size=(100, 3))
    T32 *= (0.5 * d2 / np.linalg.norm(T32, axis=1))[:, None]
    H21, H32 = homography(R21, T21, N1, d1), homography(R32, T32, N2, d2)
    one = se3(*decompose_with_normal(H32 @ H21, N1, d1))
    two = se3(*decompose_with_normal(H32, N2, d2)) @ se3(*decompose_with_normal(H21, N1, d1))
    assert one == pytest.approx(two, abs=1e-8)


def test_a_batch_is_its_members(exact):
    R, T, N, d = exact
    H = homography(R, T, N, d).reshape(20, 15, 3, 3)
    grid_N, grid_d = N.reshape(20, 15, 3), d.reshape(20, 15)
    batch = decompose_with_normal(H, grid_N, grid_d)
    both = decompose_svd(H)
    which, angle = choose_by_normal(both[2], grid_N)
    for at in ((0, 0), (7, 3), (19, 14)):
        for part, alone in zip(batch, decompose_with_normal(H[at], grid_N[at], grid_d[at]), strict=True):
            assert part[at] == pytest.approx(alone, abs=1e-12)
        for part, alone in zip(both, decompose_svd(H[at]), strict=True):
            assert part[(slice(None), *at)] == pytest.approx(alone, abs=1e-12)
        alone_which, alone_angle = choose_by_normal(decompose_svd(H[at])[2], grid_N[at])
        assert which[at] == alone_which
        assert angle[at] == pytest.approx(alone_angle, abs=1e-7)


def test_both_svd_solutions_reproduce_the_homography(exact):
    H = homography(*exact)
    R, T, N = decompose_svd(H)
    assert homography(R, T, N, np.ones(R.shape[:2])) == pytest.approx(np.stack([H, H]), abs=1e-9)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-12)
    assert np.linalg.norm(N, axis=-1) == pytest.approx(1.0, abs=1e-12)
    assert (N[..., 2] >= 0).all()


def test_one_svd_solution_is_the_truth_and_the_normal_tells_which(exact):
    R, T, N, d = exact
    solutions = decompose_svd(homography(R, T, N, d))
    which, angle = choose_by_normal(solutions[2], N)
    found_R, found_T, found_N = (part[which, np.arange(len(N))] for part in solutions)
    assert found_N == pytest.approx(N, abs=1e-8)
    assert found_R == pytest.approx(R, abs=1e-8)
    assert found_T * d[:, None] == pytest.approx(T, abs=1e-8)
    assert angle == pytest.approx(0.0, abs=1e-6)
    assert set(which) == {0, 1}


def test_both_svd_solutions_are_among_opencvs(exact):
    for H in homography(*exact)[:40]:
        _, Rs, Ts, Ns = cv2.decomposeHomographyMat(H, np.eye(3))
        for R, T, N in zip(*decompose_svd(H), strict=True):
            off = [
                np.abs(np.hstack([R - a, (T - b[:, 0])[:, None], (N - c[:, 0])[:, None]])).max()
                for a, b, c in zip(Rs, Ts, Ns, strict=True)
            ]
            assert min(off) < 1e-6


def test_a_pure_rotation_has_no_translation():
    R = so3_exp([0.1, -0.3, 0.2])
    assert np.linalg.norm(decompose_svd(R)[1], axis=-1) == pytest.approx(0.0, abs=1e-7)


def test_with_noise_the_error_is_of_the_size_of_the_noise(exact):
    R, T, N, d = exact
    H = homography(R, T, N, d) + 1e-6 * np.random.default_rng(2).normal(size=(300, 3, 3))
    found_R, found_T = decompose_with_normal(H, N, d)
    assert np.linalg.det(found_R) == pytest.approx(1.0, abs=1e-12)
    assert np.median(np.linalg.norm(so3_log(found_R.swapaxes(1, 2) @ R), axis=1)) < 1e-5
    assert np.median(np.linalg.norm(found_T - T, axis=1)) < 3e-5
