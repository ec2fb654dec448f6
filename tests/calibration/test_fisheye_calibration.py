"""Calibration of fisheyes: from corners, beside OpenCV, from rendered boards, and from a plane of LEDs."""

import cv2
import numpy as np
import pytest

from coloc_graph.calibration import calibrate_camera, make_board
from coloc_graph.calibration.bundle import start_pose
from coloc_graph.calibration.corners import find_board
from coloc_graph.calibration.led_grid import ordered_grid
from coloc_graph.calibration.projection import pose_by_rays, project
from coloc_graph.errors import InputError
from coloc_graph.frontend import detect_leds
from coloc_graph.geometry.lie import se3, so3_exp
from coloc_graph.simulation import Sensor, render, spots
from coloc_graph.simulation.boards import held_poses, render_boards, seen_corners
from coloc_graph.simulation.rig import wide_team

BOARD = make_board("9x6", 0.03)
CAMERA = wide_team(160.0)["A"].camera
TRUE = np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, *CAMERA.distortion])


@pytest.fixture(scope="module")
def corners():
    rng = np.random.default_rng(3)
    return seen_corners(rng, CAMERA, BOARD, held_poses(rng, CAMERA, BOARD, 12), 0.1)


@pytest.fixture(scope="module")
def calibrated(corners):
    return calibrate_camera(corners, BOARD, model="fisheye")


def test_projection_is_opencvs_with_its_derivatives():
    pose = np.array([0.3, -0.2, 0.1, 0.1, 0.05, 0.2])
    uv, A, B = project(TRUE, pose, BOARD.points, "fisheye")
    K = np.array([[TRUE[0], 0, TRUE[2]], [0, TRUE[1], TRUE[3]], [0, 0, 1]])
    wanted, J = cv2.fisheye.projectPoints(BOARD.points[:, None], pose[:3], pose[3:], K, TRUE[4:])
    assert uv == pytest.approx(wanted.reshape(-1, 2), abs=1e-9)
    assert pytest.approx(J[:, :8], abs=1e-6) == A  # fx, fy, cx, cy, k1 to k4
    assert pytest.approx(J[:, 8:14], abs=1e-5) == B


def test_a_board_beside_the_camera_has_its_pose_from_its_rays():
    pose = np.array([0.2, 1.6, -0.3, 0.4, 0.05, -0.03])  # its middle is beyond 90 deg
    p = BOARD.points @ so3_exp(pose[:3]).T + pose[3:]
    assert (p[:, 2] < 0).any()
    found = pose_by_rays(p / np.linalg.norm(p, axis=1)[:, None], BOARD.points)
    assert se3(so3_exp(found[:3]), found[3:]) == pytest.approx(se3(so3_exp(pose[:3]), pose[3:]), abs=1e-9)


def test_intrinsics_are_within_their_sigmas_and_opencvs(corners, calibrated):
    assert calibrated.camera.model == "fisheye"
    assert len(calibrated.camera.distortion) == 4  # chosen: none predicts held-out images worse
    assert calibrated.names == ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")
    found = calibrated.bundle.intrinsics
    off = found - TRUE
    assert off @ np.linalg.solve(calibrated.independent_covariance, off) < 26.1  # 99.9 % of chi-square with 8
    assert (np.abs(off) < 5 * calibrated.sigmas).all()
    assert calibrated.camera.noise_px == pytest.approx(0.1, rel=0.1)
    K, D = np.diag([230.0, 230.0, 1.0]), np.zeros((4, 1))
    K[:2, 2] = 320, 240
    points = [view.points.reshape(1, -1, 3) for view in corners.views]
    seen = [view.uv.reshape(1, -1, 2) for view in corners.views]
    flags = 1 | 2 | 8  # a guess of the intrinsics, extrinsics computed anew, no skew
    until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-12)
    cv2.fisheye.calibrate(points, seen, (640, 480), K, D, flags=flags, criteria=until)
    opencv = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *D.ravel()])
    assert (np.abs(found - opencv) < calibrated.sigmas).all()


def test_corners_are_found_in_rendered_boards(calibrated):
    rng = np.random.default_rng(0)
    poses = held_poses(rng, CAMERA, BOARD, 2, reach=0.6)
    for image, T in zip(render_boards(rng, CAMERA, BOARD, poses), poses, strict=True):
        view = find_board(image, BOARD)
        assert view is not None
        uv, _ = CAMERA.project(view.points @ T[:3, :3].T + T[:3, 3])
        turned = CAMERA.project(view.points[::-1] @ T[:3, :3].T + T[:3, 3])[0]
        assert min(np.abs(view.uv - uv).max(), np.abs(view.uv - turned).max()) < 0.3


def test_a_fisheye_has_no_five_coefficients(corners):
    with pytest.raises(InputError, match="a fisheye has no 5 lens coefficients; give 0 or 4"):
        calibrate_camera(corners, BOARD, 5, model="fisheye")


def test_a_plane_of_leds_is_ordered_and_gives_the_pose():
    board = make_board("7x5", 0.05, leds=True)
    assert str(board) == "a plane of 7x5 LEDs"
    T = held_poses(np.random.default_rng(5), CAMERA, make_board("7x5", 0.05), 1)[0]
    uv, _ = CAMERA.project(board.points @ T[:3, :3].T + T[:3, 3])
    image = render(
        spots(uv, 1.5, 220.0), size=(640, 480), background=12.0, sensor=Sensor(), rng=np.random.default_rng(1)
    )
    view = find_board(image, board, "a.png", lambda pixels: detect_leds(pixels).uv)
    assert view is not None
    assert min(np.abs(view.uv - uv).max(), np.abs(view.uv - uv[::-1]).max()) < 0.1
    pose = start_pose(view, TRUE, "fisheye")
    assert project(TRUE, pose, board.points, "fisheye")[0] == pytest.approx(view.uv, abs=1.0)


def test_lights_that_are_no_grid_are_not_ordered():
    uv = np.stack(np.meshgrid(np.arange(7.0), np.arange(5.0)), -1).reshape(-1, 2) * 20 + 100
    rng = np.random.default_rng(0)
    shuffled = rng.permutation(uv)
    assert ordered_grid(shuffled, 7, 5) == pytest.approx(uv)
    assert ordered_grid(shuffled[1:], 7, 5) is None
    assert ordered_grid(rng.uniform(0, 300, (35, 2)), 7, 5) is None
