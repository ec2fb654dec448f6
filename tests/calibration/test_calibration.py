"""Cameras and mounts from the corners of a board: what is found, whether its sigmas are true, what is rejected."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from msgspec.structs import replace

from coloc_graph.calibration import View, Views, calibrate_camera, calibrate_mount, find_boards, make_board, verdict
from coloc_graph.calibration.bundle import adjust, rms, start_pose
from coloc_graph.calibration.camera import places
from coloc_graph.calibration.corners import image_paths, neighbours
from coloc_graph.calibration.fusion import Estimates, disagreement, fuse, fuse_scaled
from coloc_graph.calibration.lens import ray_sigmas
from coloc_graph.calibration.residuals import noise_and_shared
from coloc_graph.calibration.verdict import GOOD
from coloc_graph.errors import DegenerateGeometry, InputError
from coloc_graph.geometry.lie import rotation_y, rotation_z, se3
from coloc_graph.simulation.boards import floor_poses, held_poses, seen_corners
from coloc_graph.team import Camera, Floor, Mount

BOARD = make_board("8x5", 0.03)
CAMERA = Camera(width=640, height=480, fx=480.0, fy=482.0, cx=322.0, cy=236.0, distortion=(-0.12, 0.05, 5e-4, -8e-4))
TRUE = np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, *CAMERA.distortion])
MOUNT = Mount(height=0.41, tilt_deg=22.0, roll_deg=-1.5, yaw_deg=4.0, x=0.05, y=-0.01)


def held(rng, images=14, noise=0.1, camera=CAMERA, bend=0.0, **how):
    return seen_corners(rng, camera, BOARD, held_poses(rng, camera, BOARD, images, **how), noise, bend)


def lying(rng, images, noise=0.1, mount=MOUNT, floor=None, camera=CAMERA):
    return list(seen_corners(rng, camera, BOARD, floor_poses(rng, camera, mount, BOARD, images, floor), noise).views)


def with_view(seen, index, view):
    views = list(seen.views)
    views[index] = view
    return Views(seen.width, seen.height, tuple(views))


# --- the camera


def opencv(seen):
    points = [view.points.astype(np.float32) for view in seen.views]
    corners = [view.uv.astype(np.float32)[:, None] for view in seen.views]
    stated, K, lens, R, t, sigmas, *_ = cv2.calibrateCameraExtended(
        points, corners, (seen.width, seen.height), None, None, flags=cv2.CALIB_FIX_K3
    )
    off = [
        view.uv - cv2.projectPoints(view.points, *pose, K, lens)[0][:, 0]
        for view, *pose in zip(seen.views, R, t, strict=True)
    ]
    assert rms(off) == pytest.approx(stated, rel=1e-5)
    return stated, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *lens.ravel()[:4]]), sigmas.ravel()[:8]


def test_no_camera_explains_the_corners_better_and_independent_sigmas_are_opencvs(rng):
    seen = held(rng)
    found = calibrate_camera(seen, BOARD, 4)
    off, intrinsics, sigmas = opencv(seen)
    assert off * (1 - 1e-4) < found.bundle.rms <= off * (1 + 1e-9)
    np.testing.assert_allclose(found.bundle.intrinsics, intrinsics, atol=1e-3 * found.sigmas.max(), rtol=1e-4)
    np.testing.assert_allclose(np.sqrt(np.diag(found.independent_covariance)), sigmas, rtol=0.02)


def test_the_bundle_comes_to_the_same_end_from_far_off(rng):
    seen = held(rng)
    found = calibrate_camera(seen, BOARD, 4).bundle
    far = np.array([600.0, 600.0, 300.0, 260.0, 0, 0, 0, 0])
    again = adjust(seen.views, far, np.array([start_pose(view, far) for view in seen.views]))
    assert again.rms == pytest.approx(found.rms, rel=1e-9)
    np.testing.assert_allclose(again.intrinsics, found.intrinsics, rtol=1e-5, atol=1e-6)
    assert np.abs(again.influence.sum(axis=0) / np.sqrt(np.diag(again.information))).max() < 1e-3


@pytest.mark.parametrize("bend", [0.0, 3e-4])
def test_sigmas_are_true_where_corners_of_an_image_share_errors_too(bend):
    rng = np.random.default_rng(3)
    ours, independent = [], []
    for _ in range(8):
        found = calibrate_camera(held(rng, 12, bend=bend), BOARD, 4)
        off = found.bundle.intrinsics - TRUE
        ours.append(off / found.sigmas)
        independent.append(off / np.sqrt(np.diag(found.independent_covariance)))
    assert 0.7 < np.sqrt(np.mean(np.square(ours))) < 1.35
    if bend:
        assert np.sqrt(np.mean(np.square(independent))) > 1.7  # or the case would show nothing


@pytest.mark.parametrize(("lens", "coefficients"), [((), 0), ((-0.12, 0.05, 5e-4, -8e-4), 4)])
def test_the_evidence_decides_how_many_coefficients_there_are(rng, lens, coefficients):
    found = calibrate_camera(held(rng, 12, camera=replace(CAMERA, distortion=lens)), BOARD)
    assert len(found.camera.distortion) == coefficients
    assert [trial.coefficients for trial in found.trials] == [0, 4, 5, 8]
    assert [trial.coefficients for trial in found.trials if trial.rejected is None] == [coefficients]


def test_coefficients_that_are_asked_for_are_not_decided_on(rng):
    asked = calibrate_camera(held(rng, 12), BOARD, 5)
    assert len(asked.camera.distortion) == 5 and len(asked.trials) == 1


def test_noise_and_what_corners_share_are_told_apart(rng):
    alone = calibrate_camera(held(rng, 20, noise=0.2), BOARD, 4)
    assert alone.camera.noise_px == pytest.approx(0.2, rel=0.06) and alone.shared_px == 0
    assert alone.camera.bias_px == pytest.approx(alone.lens_px)
    both = calibrate_camera(held(rng, 20, noise=0.1, bend=2e-4), BOARD, 4)
    assert 0.09 < both.camera.noise_px < 0.14 and both.shared_px > 0.04
    assert both.camera.bias_px > both.shared_px


def test_what_a_fit_took_is_not_missed_in_what_corners_share(rng):
    """Of each image the mean is taken; left are 1 px of each corner, and a slope with 0.05 px^2 alike of neighbours."""
    n = len(BOARD.points)
    slope = BOARD.points[:, 0] - BOARD.points[:, 0].mean()
    first, second = neighbours(BOARD.points, BOARD.square).T
    slope *= np.sqrt(0.05 / (slope[first] * slope[second]).mean())
    mean = np.kron(np.ones((n, 1)), np.eye(2)) / np.sqrt(n)
    views, residuals = [View("", BOARD.points, np.zeros((n, 2)))] * 500, []
    for _ in views:
        r = rng.normal(size=(n, 2)) + rng.normal(size=2) * slope[:, None]
        residuals.append(r - r.mean(axis=0))
    alone, shared = noise_and_shared(views, residuals, [mean] * 500, BOARD.square)
    assert shared**2 == pytest.approx(0.05, abs=0.012)
    assert alone**2 + shared**2 == pytest.approx(1 + (slope**2).mean(), rel=0.015)


def test_a_rays_sigma_is_how_far_its_pixel_is_off_but_for_a_turn(rng):
    found = [calibrate_camera(held(rng, 10), BOARD, 4) for _ in range(10)]
    grid = np.stack(np.meshgrid(np.linspace(100, 540, 6), np.linspace(90, 390, 5)), -1).reshape(-1, 2)
    ratios = []
    for one in found:
        rays = np.column_stack([CAMERA.normalise(grid), np.ones(len(grid))])
        uv = one.camera.project(rays)[0]
        # the turn that explains most of it
        turned = np.array([(one.camera.project(rays @ cv2.Rodrigues(1e-5 * e)[0].T)[0] - uv) / 1e-5 for e in np.eye(3)])
        turn = np.linalg.lstsq(turned.reshape(3, -1).T, (grid - uv).ravel(), rcond=None)[0]
        off = grid - uv - np.einsum("k,kni->ni", turn, turned)
        ratios.append(off / ray_sigmas(one.bundle.intrinsics, one.covariance, grid)[:, None])
    assert 0.65 < np.sqrt(np.mean(np.square(ratios))) < 1.35


def test_an_image_of_another_board_is_refused_by_name_and_changes_nothing(rng):
    seen = held(rng)
    view = seen.views[5]
    smeared = with_view(seen, 5, View("moved.png", view.points, view.uv + rng.normal(scale=2.0, size=view.uv.shape)))
    found = calibrate_camera(smeared, BOARD, 4)
    (rejected,) = found.rejected
    assert rejected.name == "moved.png" and "another board, or one that moved" in rejected.rejected
    without = Views(seen.width, seen.height, tuple(one for one in seen.views if one is not view))
    np.testing.assert_allclose(
        found.bundle.intrinsics, calibrate_camera(without, BOARD, 4).bundle.intrinsics, rtol=1e-6, atol=1e-7
    )


def test_many_images_that_contradict_are_no_calibration(rng):
    seen = held(rng, 9)
    for index in range(4):
        view = seen.views[index]
        off = rng.normal(scale=4.0, size=view.uv.shape)
        seen = with_view(seen, index, View(view.name, view.points, view.uv + off))
    with pytest.raises(InputError, match=r"of 9 images contradict the others \(image"):
        calibrate_camera(seen, BOARD, 4)


def test_too_few_images_or_places_are_refused_with_their_number(rng):
    with pytest.raises(InputError, match=r"8x5 inner corners is in 5 of 5 images, but at least 6"):
        calibrate_camera(held(rng, 5), BOARD)
    few = held(rng, 3)
    again = [View(f"again{i}", v.points, v.uv + rng.normal(scale=0.1, size=v.uv.shape))
             for i, v in enumerate(few.views * 3)]  # fmt: skip
    with pytest.raises(InputError, match="in only 3 places"):
        calibrate_camera(Views(640, 480, (*few.views, *again)), BOARD)


def test_images_of_a_board_that_did_not_move_do_not_count_as_more(rng):
    seen = held(rng, 12, bend=3e-4)
    twice = [View(f"{v.name} again", v.points, v.uv[::-1].copy() + rng.normal(scale=0.02, size=v.uv.shape))
             for v in seen.views]  # fmt: skip
    assert places((*seen.views, *twice), BOARD.square).tolist() == [*range(12), *range(12)]
    once, both = (calibrate_camera(Views(640, 480, views), BOARD, 4)
                  for views in (seen.views, (*seen.views, *twice)))  # fmt: skip
    assert both.places == 12
    assert (both.sigmas[:4] / once.sigmas[:4]).min() > 0.9  # taken for independent: 0.71


def test_a_board_that_was_never_tilted_gives_no_focal_length(rng):
    with pytest.raises(DegenerateGeometry, match="tilt the board"):
        calibrate_camera(held(rng, 12, tilt_deg=0.0), BOARD)


# --- the verdict


def test_the_verdict_names_what_is_not_covered(rng):
    seen = held(rng, 120, reach=0.3)
    middle = [view for view in seen.views if (np.abs(view.uv - (320, 240)) < (150, 130)).all()]
    middle = verdict(calibrate_camera(Views(640, 480, tuple(middle[:15])), BOARD, 4))
    assert any("corners of the image are not covered: hold the board at the upper left" in said for said in middle)
    left = held(rng, 60)
    left = Views(640, 480, tuple(view for view in left.views if view.uv[:, 0].max() < 430))
    said = " ".join(verdict(calibrate_camera(left, BOARD, 0)))
    assert "upper right" in said and "lower right" in said and "upper left" not in said


def test_the_verdict_says_that_a_board_was_not_tilted(rng):
    said = verdict(calibrate_camera(held(rng, 25, tilt_deg=12.0, noise=0.05), BOARD, 0))
    assert said[0].startswith("the board was never tilted by more than") and "the focal length is uncertain" in said[0]
    flat, tilted = held(rng, 20, tilt_deg=10.0), held(rng, 40)
    tilted = [view for view in tilted.views if _tilt(view) > 30][:2]
    said = verdict(calibrate_camera(Views(640, 480, (*flat.views, *tilted)), BOARD, 0))
    assert said[0].startswith("the board was tilted in only 2 of 22 images")


def _tilt(view):
    R = cv2.Rodrigues(start_pose(view, TRUE)[:3])[0]
    return np.rad2deg(np.arccos(abs(R[2, 2])))


def test_the_verdict_is_good_where_nothing_is_to_be_done(rng):
    assert verdict(calibrate_camera(held(rng, 40), BOARD, 4)) == (GOOD,)


def test_the_verdict_says_where_a_lens_is_uncertain_and_that_corners_are_bad(rng):
    said = " ".join(verdict(calibrate_camera(held(rng, 8, noise=1.5), BOARD, 4)))
    assert "px: the images are blurred" in said and "the lens is uncertain by" in said and "only 8 places" in said


# --- the mount


def error_of(found, mount=MOUNT):
    return np.array([
        found.mount.height - mount.height,
        *np.deg2rad([found.mount.tilt_deg - mount.tilt_deg, found.mount.roll_deg - mount.roll_deg]),
    ])  # fmt: skip


@pytest.mark.parametrize("images", [1, 4])
def test_a_mount_is_found_without_noise_and_the_rest_of_it_stays(rng, images):
    facing = replace(MOUNT, yaw_deg=0.0, x=0.0, y=0.0)  # which a board on the floor does not say
    views = lying(rng, images, noise=0.0, mount=facing)
    found = calibrate_mount(views, CAMERA, replace(MOUNT, height=1.0, tilt_deg=0.0), BOARD.square).mount
    assert (found.height, found.tilt_deg, found.roll_deg) == pytest.approx((0.41, 22.0, -1.5), abs=1e-7)
    assert (found.yaw_deg, found.x, found.y) == (4.0, 0.05, -0.01)
    thick = calibrate_mount(views, CAMERA, MOUNT, BOARD.square, thickness=0.004).mount
    assert thick.height == pytest.approx(0.414, abs=1e-7) and thick.tilt_deg == pytest.approx(22.0)
    # corners that are counted the other way round have the board's z down
    mirrored = [View(view.name, view.points * [1, -1, 1], view.uv) for view in views]
    found = calibrate_mount(mirrored, CAMERA, MOUNT, BOARD.square).mount
    assert (found.height, found.tilt_deg, found.roll_deg) == pytest.approx((0.41, 22.0, -1.5), abs=1e-7)


def test_yaw_and_place_on_the_body_change_nothing(rng):
    a, b = (
        calibrate_mount(lying(np.random.default_rng(5), 3, mount=mount), CAMERA, mount, BOARD.square).mount
        for mount in (MOUNT, replace(MOUNT, yaw_deg=0.0))
    )
    assert abs(a.tilt_deg - b.tilt_deg) < 4 * a.tilt_sigma_deg and abs(a.roll_deg - b.roll_deg) < 4 * a.roll_sigma_deg
    assert a.yaw_deg == 4.0 and b.yaw_deg == 0.0


KNOWN = np.diag(np.array([0.8, 0.8, 1.0, 1.0, 0.003, 0.006, 5e-4, 5e-4]) ** 2)


@pytest.mark.parametrize(("known", "floor"), [
    (np.zeros((8, 8)), None),
    (KNOWN, None),
    (KNOWN, Floor(tilt_sigma_deg=0.2, height_sigma=0.001)),
], ids=["exact", "camera", "camera and floor"])  # fmt: skip
def test_a_mounts_sigmas_are_true(known, floor):
    rng = np.random.default_rng(11)
    nees, chi2, dof = [], 0.0, 0
    for _ in range(40):
        off = rng.multivariate_normal(np.zeros(8), known)
        stated = replace(CAMERA, fx=TRUE[0] + off[0], fy=TRUE[1] + off[1], cx=TRUE[2] + off[2], cy=TRUE[3] + off[3],
                         distortion=tuple(TRUE[4:] + off[4:]))  # fmt: skip
        mount = Mount(height=rng.uniform(0.35, 0.45), tilt_deg=rng.uniform(15, 30), roll_deg=rng.normal())
        found = calibrate_mount(lying(rng, 4, mount=mount, floor=floor), stated, Mount(height=0.4), BOARD.square,
                                floor=floor, intrinsics_covariance=known)  # fmt: skip
        error = error_of(found, mount)
        nees.append(error @ np.linalg.solve(found.covariance, error) / 3)
        chi2, dof = chi2 + found.chi2, dof + found.dof
        assert not found.rejected
    assert 0.65 < np.mean(nees) < 1.4  # 120 numbers: 1 +- 0.13
    assert chi2 / dof == pytest.approx(1.0, abs=0.2)


def test_without_a_calibration_a_cameras_bias_is_in_the_mounts_sigmas(rng):
    views = lying(rng, 4)
    exact, biased = (
        calibrate_mount(views, replace(CAMERA, bias_px=bias), MOUNT, BOARD.square).mount for bias in (0.0, 0.4)
    )
    by_bias = np.sqrt(biased.tilt_sigma_deg**2 - exact.tilt_sigma_deg**2)
    assert by_bias == pytest.approx(np.rad2deg(0.4 / CAMERA.fy), rel=0.3)


def test_a_floor_that_tilts_a_board_does_so_about_its_middle():
    """By how far the camera is from over there, its height is off then, and by as much its own tilts are."""
    facing = replace(MOUNT, yaw_deg=0.0, x=0.0, y=0.0)
    T = np.linalg.inv(facing.T_body_camera) @ se3(rotation_z(0.4), [0.6, 0.15, 0.0])
    T[:3, 3] -= T[:3, :3] @ BOARD.points.mean(axis=0)
    (view,) = seen_corners(np.random.default_rng(0), CAMERA, BOARD, T[None], 0.0).views
    found = calibrate_mount([view], CAMERA, facing, BOARD.square, floor=Floor(tilt_sigma_deg=0.2, height_sigma=0.0))
    height, tilt, roll = np.sqrt(found.covariance.diagonal()) / np.deg2rad(0.2)
    assert height == pytest.approx(np.hypot(0.6, 0.15), rel=1e-3)
    assert (tilt, roll) == pytest.approx((np.sqrt(2), np.sqrt(2)), rel=0.1)  # under the board, and under the robot


def test_boards_that_are_bent_make_a_mount_no_surer_than_it_is():
    """Errors that neighbours share: taken for each corner's own, the NEES is 1.6."""
    rng, nees = np.random.default_rng(4), []
    for _ in range(30):
        mount = Mount(height=rng.uniform(0.35, 0.45), tilt_deg=rng.uniform(15, 30), roll_deg=rng.normal())
        poses = floor_poses(rng, CAMERA, mount, BOARD, 4)
        views = seen_corners(rng, CAMERA, BOARD, poses, noise=0.05, bend=3e-4).views
        found = calibrate_mount(views, CAMERA, Mount(height=0.4), BOARD.square)
        error = error_of(found, mount)
        nees.append(error @ np.linalg.solve(found.covariance, error) / 3)
    assert 0.15 < np.mean(nees) < 1.1


def lifted(view, mount, deg=1.5):
    """The same board with a pencil under its edge."""
    R, T = mount.T_body_camera[:3, :3], mount.T_body_camera[:3, 3]
    p = (view.points - view.points.mean(axis=0)) @ (rotation_y(np.deg2rad(deg)) @ rotation_z(0.3)).T + [0.7, 0.0, 0.004]
    return View("lifted.png", view.points, CAMERA.project((p - T) @ R)[0])


def test_a_board_that_is_not_on_the_floor_is_refused_by_name(rng):
    facing = replace(MOUNT, yaw_deg=0.0, x=0.0, y=0.0)
    views = lying(rng, 5, mount=facing)
    found = calibrate_mount([*views[:2], lifted(views[2], facing), *views[3:]], CAMERA, facing, BOARD.square)
    (rejected,) = found.rejected
    assert rejected.name == "lifted.png" and "not in the plane of the others, by" in rejected.rejected
    assert np.abs(error_of(found, facing) / np.sqrt(np.diag(found.covariance))).max() < 4
    with pytest.raises(InputError, match=r"lifted.png contradict each other by .* one board was not flat"):
        calibrate_mount([views[0], lifted(views[1], facing)], CAMERA, facing, BOARD.square)
    moved = View("moved.png", views[0].points, views[0].uv + rng.normal(scale=2.0, size=views[0].uv.shape))
    (rejected,) = calibrate_mount([*views, moved], CAMERA, facing, BOARD.square).rejected
    assert rejected.name == "moved.png" and "one that moved" in rejected.rejected


def test_where_all_boards_are_a_little_off_sigmas_are_larger_and_none_is_refused(rng):
    uneven = Floor(tilt_sigma_deg=0.3, height_sigma=0.001)
    found = calibrate_mount(lying(rng, 8, floor=uneven), CAMERA, MOUNT, BOARD.square)  # nobody said that it is
    flat = calibrate_mount(lying(rng, 8), CAMERA, MOUNT, BOARD.square)
    assert flat.scale == 1.0 and found.scale > 3 and not found.rejected
    assert found.mount.tilt_sigma_deg > 2 * flat.mount.tilt_sigma_deg


def test_how_far_one_of_many_is_from_the_others_counts_what_they_share_once(rng):
    """By sampling: errors that all have alike say nothing of a difference, and each value's own are of its own size."""
    n, m = 4, 2
    own = np.array([k * np.array([[2.0, 0.5], [0.5, 1.0]]) for k in range(1, n + 1)])
    loads = 3 * (rng.normal(size=(m, 3)) + 0.3 * rng.normal(size=(n, m, 3)))  # of three errors that all share
    said = Estimates(np.zeros((n, m)), own, np.einsum("nip,mjp->nimj", loads, loads))
    drawn = rng.multivariate_normal(np.zeros(n * m), said.covariance(), size=600).reshape(-1, n, m)
    found = np.mean([disagreement(Estimates(values, own, said.common)) for values in drawn], axis=0)
    np.testing.assert_allclose(found / m, 1.0, atol=0.13)
    fused = np.array([fuse(Estimates(values, own, said.common)).value for values in drawn])
    np.testing.assert_allclose(np.cov(fused.T), fuse(said).covariance, rtol=0.2, atol=0.5)


def test_where_values_disagree_their_own_errors_are_as_much_larger_as_they_scatter(rng):
    own = np.tile(0.01 * np.eye(3), (40, 1, 1))
    said = Estimates(rng.normal(size=(40, 3)), own, np.zeros((40, 3, 40, 3)))  # ten sigmas each
    fused = fuse_scaled(said, 0.01)
    assert fused.scale == pytest.approx(100, rel=0.4) and fused.scale == pytest.approx(fused.chi2 / fused.dof)
    np.testing.assert_allclose(fused.covariance, fused.scale * fuse(said).covariance)


def test_a_board_on_the_ceiling_is_refused():
    T = se3(rotation_z(0.2), [0, 0, 1.0]) @ se3(rotation_y(0.0), np.zeros(3))
    T[:3, :3] = np.array([[1.0, 0, 0], [0, 0.3, -0.954], [0, 0.954, 0.3]]) @ T[:3, :3]
    seen = seen_corners(np.random.default_rng(0), CAMERA, BOARD, T[None], 0.0)
    upside = [View("up.png", v.points, v.uv) for v in seen.views]
    with pytest.raises(DegenerateGeometry, match=r"up.png: .*lay it flat on the floor"):
        calibrate_mount(upside, CAMERA, MOUNT, BOARD.square)


# --- real images


def real_images():
    folder = Path(os.environ.get("COLOC_DATA", "")) / "stereo_board"
    if "COLOC_DATA" not in os.environ or not folder.is_dir():
        pytest.skip("COLOC_DATA does not name a folder with stereo_board/left*.jpg")
    return sorted(folder.glob("left*.jpg"))


def test_real_images_are_explained_to_a_sixth_of_a_pixel_and_halves_agree():
    seen, board = find_boards(image_paths(real_images()), make_board("9x6", 0.02423))
    found = calibrate_camera(seen, board)
    assert len(seen.views) == 29 and not found.rejected and len(found.camera.distortion) == 4
    assert found.bundle.rms < 0.165 and found.bundle.rms <= opencv(seen)[0] * (1 + 1e-9)
    ratios = []
    for split in range(6):
        order = np.random.default_rng(split).permutation(29)
        a, b = (calibrate_camera(Views(640, 360, tuple(seen.views[i] for i in part)), board, 4)
                for part in (order[:14], order[14:]))  # fmt: skip
        ratios.append((a.bundle.intrinsics - b.bundle.intrinsics) / np.hypot(a.sigmas, b.sigmas))
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.4
