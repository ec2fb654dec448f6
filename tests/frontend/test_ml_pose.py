"""The most likely relative pose, and the fits in batches that it and the experiments stand on."""

import cv2
import gtsam
import numpy as np
import pytest
from msgspec.structs import replace
from scipy.stats import chi2

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend import (
    PointPairs,
    fit_homography,
    least_squares,
    most_likely_pose,
    plane_from_mount,
    refine,
    relative_pose,
)  # fmt: skip
from coloc_graph.geometry.lie import floor_pose, se3_inverse, sl3_log
from coloc_graph.measurements import HomographyMeasurement
from coloc_graph.team import Floor, Markers, Mount

F = 301.0  # px
NOISE = 0.3 / F
MARKERS = Markers(height=0.15, positions=((0.0, 0.125), (0.0, -0.125)))
MOUNT_I = Mount(height=0.40, tilt_deg=20.0)
MOUNT_J = Mount(height=0.38, tilt_deg=22.0, roll_deg=1.0, yaw_deg=2.0, x=0.02)
T_I_J = floor_pose(0.1, -0.75, 0.6)
PLANAR = [2, 3, 4]


def seen(T_body, mount, points):
    camera = (se3_inverse(T_body @ mount.T_body_camera) @ np.c_[points, np.ones(len(points))].T).T
    return camera[:, :2] / camera[:, 2:3]


def pairs_of(n=80, noise=0.0, seed=0, mounts=(MOUNT_I, MOUNT_J)):
    points = np.c_[np.random.default_rng(3).uniform((0.7, -1.0), (2.2, 0.3), (n, 2)), np.full(n, MARKERS.height)]
    rng = np.random.default_rng(seed)
    x_i, x_j = seen(np.eye(4), mounts[0], points), seen(T_I_J, mounts[1], points)
    C = np.broadcast_to(np.eye(2) * NOISE**2, (n, 2, 2))
    return PointPairs(x_i + noise * rng.normal(size=x_i.shape), x_j + noise * rng.normal(size=x_j.shape), C, C)


def measured(pairs):
    fit = fit_homography(pairs)
    n = len(pairs)
    return HomographyMeasurement(0, "A", "B", fit.H, fit.information, n, n, fit.chi2, fit.dof, 0.0)


def error(pose):
    return gtsam.Pose3(pose.T_i_j).localCoordinates(gtsam.Pose3(T_I_J))


@pytest.mark.parametrize("floor", [None, Floor(), Floor(tilt_sigma_deg=0.1, height_sigma=1e-3)])
def test_without_noise_it_is_exact(floor):
    plane = plane_from_mount(MOUNT_I, MARKERS, floor)
    pose = most_likely_pose(measured(pairs_of()), MOUNT_I, MOUNT_J, plane, floor)
    assert np.abs(error(pose)).max() < 1e-7
    assert np.linalg.eigvalsh(pose.covariance)[0] > 0


@pytest.mark.parametrize("floor", [None, Floor()])
def test_its_covariance_is_that_of_its_errors_and_it_beats_eq_2(floor):
    plane = plane_from_mount(MOUNT_I, MARKERS)
    nees, ours, eq2, runs = [], [], [], 150
    for seed in range(runs):
        measurement = measured(pairs_of(noise=NOISE, seed=seed))
        pose = most_likely_pose(measurement, MOUNT_I, MOUNT_J, plane, floor)
        parts = PLANAR if floor else list(range(6))  # the level floor decides the rest
        xi = error(pose)[parts]
        nees.append(xi @ np.linalg.solve(pose.covariance[np.ix_(parts, parts)], xi))
        ours.append(error(pose)[PLANAR])
        eq2.append(error(relative_pose(measurement, MOUNT_I, MOUNT_J, plane))[PLANAR])
    dof = runs * len(parts)
    low, high = chi2.ppf([0.001, 0.999], dof) / dof
    assert low < np.mean(nees) / len(parts) < high
    assert (np.std(ours, axis=0) < (0.75 if floor else 0.9) * np.std(eq2, axis=0)).all()


def test_what_is_uncertain_of_the_mounts_is_in_the_covariance():
    def drawn(mount, rng):
        d = rng.normal(size=3)
        return replace(
            mount,
            tilt_deg=mount.tilt_deg + 0.3 * d[0],
            roll_deg=mount.roll_deg + 0.2 * d[1],
            height=mount.height + 0.002 * d[2],
        )

    sigmas = {"tilt_sigma_deg": 0.3, "roll_sigma_deg": 0.2, "height_sigma": 0.002}
    stated_i, stated_j = (replace(mount, **sigmas) for mount in (MOUNT_I, MOUNT_J))
    plane = plane_from_mount(stated_i, MARKERS)
    nees, runs = [], 200
    for seed in range(runs):
        rng = np.random.default_rng((1, seed))
        measurement = measured(pairs_of(noise=NOISE, seed=seed, mounts=(drawn(MOUNT_I, rng), drawn(MOUNT_J, rng))))
        pose = most_likely_pose(measurement, stated_i, stated_j, plane, Floor())
        xi = error(pose)[PLANAR]
        nees.append(xi @ np.linalg.solve(pose.covariance[np.ix_(PLANAR, PLANAR)], xi) / 3)
    low, high = chi2.ppf([0.001, 0.999], 3 * runs) / (3 * runs)
    assert low < np.mean(nees) < high


def test_a_homography_that_no_pose_explains_is_no_pose():
    measurement = measured(pairs_of())
    nonsense = HomographyMeasurement(
        0, "A", "B", np.diag([1.0, -1.0, -1.0]), measurement.information, 80, 80, 0.0, 152, 0.0
    )
    with pytest.raises(DegenerateGeometry):
        most_likely_pose(nonsense, MOUNT_I, MOUNT_J, plane_from_mount(MOUNT_I, MARKERS), Floor())


def off_in_sigma(H, H_true, information):
    h = sl3_log(np.linalg.inv(H) @ H_true)
    return float(np.sqrt(h @ information @ h))


def test_a_fit_that_starts_at_the_least_squares_answer_still_goes_all_the_way():
    pairs = pairs_of(n=40, noise=3 * NOISE)  # coarse enough for the second order to show
    H, information, _ = refine(pairs, least_squares(pairs))
    H_end = H
    for _ in range(5):
        H_end, _, _ = refine(pairs, H_end)
    assert off_in_sigma(H, H_end, information) < 0.02
    # from the answer itself, where the first step is short because the true places are not yet found
    again, _, _ = refine(pairs, H_end)
    assert off_in_sigma(again, H_end, information) < 0.002


@pytest.mark.parametrize("criterion", ["transfer", "reprojection"])
def test_many_fits_at_once_are_those_one_by_one(criterion):
    each = [pairs_of(n=30, noise=NOISE, seed=seed) for seed in range(7)]
    fields = ("x_i", "x_j", "covariance_i", "covariance_j")
    together = PointPairs(*(np.stack([getattr(one, name) for one in each]) for name in fields))
    start = least_squares(together)
    H, information, _ = refine(together, start, criterion)
    for k, one in enumerate(each):
        H_one, information_one, _ = refine(one, start[k], criterion)
        assert off_in_sigma(H[k], H_one, information_one) < 0.05
        assert information[k] == pytest.approx(information_one, rel=0.02, abs=1e-3 * np.abs(information_one).max())


def test_least_squares_is_what_opencv_finds():
    pairs = pairs_of(noise=NOISE)
    theirs, _ = cv2.findHomography(F * pairs.x_i, F * pairs.x_j, 0)
    theirs = np.diag([1 / F, 1 / F, 1.0]) @ theirs @ np.diag([F, F, 1.0])
    _, information, _ = refine(pairs, least_squares(pairs), "transfer")
    assert off_in_sigma(least_squares(pairs), theirs / np.cbrt(np.linalg.det(theirs)), information) < 0.05
