"""From a homography to where one body is in the other's frame; the plane it needs; and how sure both are."""

import gtsam
import numpy as np
import pytest
from planar_scene import CAMERA, MARKERS, MOUNT, Scene, mounted, pairs_of, small_homographies
from scipy.stats import chi2

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend import (
    decompose_svd,
    distance_from_span,
    fit_homography,
    on_plane,
    plane_from_mount,
    relative_pose,
)
from coloc_graph.geometry.lie import so3_exp
from coloc_graph.measurements import HomographyMeasurement, Plane
from coloc_graph.team import Floor, Markers, Mount

MOUNTS = [
    (MOUNT, MOUNT),
    (Mount(height=0.55, tilt_deg=25.0, roll_deg=2.0), Mount(height=0.35, tilt_deg=14.0, roll_deg=-3.0)),
    (Mount(height=0.4, tilt_deg=20.0, yaw_deg=6.0, x=0.08, y=-0.05), Mount(height=0.4, tilt_deg=20.0, yaw_deg=-7.0)),
]


def measurement(H, information):
    return HomographyMeasurement(
        stance=3, robot_i="A", robot_j="B", H_j_i=H, information=information, points=50, inliers=50,
        chi2=92.0, dof=92, overlap_px=0.0,
    )  # fmt: skip


def information_of(scene, points=100, noise=0.3):
    """What a fit to so many points tells."""
    rng = np.random.default_rng(0)
    return fit_homography(pairs_of(*scene.pixels(points, rng), noise)).information


def nees_of(pose, T_i_j):
    xi = gtsam.Pose3.Logmap(gtsam.Pose3(pose.T_i_j).between(gtsam.Pose3(T_i_j)))
    return float(xi @ np.linalg.solve(pose.covariance, xi))


def bounds(runs, dof=6, slack=0.06):
    low, high = chi2.ppf([0.025, 0.975], runs * dof) / (runs * dof)
    return low - slack, high + slack


@pytest.mark.parametrize("mounts", MOUNTS)
@pytest.mark.parametrize(("distance", "angle"), [(0.8, 35.0), (0.6, 0.0), (1.2, 40.0)])
def test_an_exact_homography_gives_the_exact_pose_between_the_bodies(mounts, distance, angle):
    scene = Scene(*mounts, distance=distance, angle_deg=angle)
    plane = plane_from_mount(scene.mount_i, MARKERS)
    assert pytest.approx(scene.N, abs=1e-12) == plane.N
    assert plane.d == pytest.approx(scene.d)
    pose = relative_pose(measurement(scene.H_j_i, 1e12 * np.eye(8)), *mounts, plane)
    assert pose.T_i_j == pytest.approx(scene.T_i_j, abs=1e-9)
    assert pose.T_ci_cj == pytest.approx(np.linalg.inv(scene.T_world_ci) @ scene.T_world_cj, abs=1e-9)
    assert (pose.stance, pose.robot_i, pose.robot_j) == (3, "A", "B")
    assert pose.normal_error < 1e-6
    assert decompose_svd(scene.H_j_i)[2][pose.solution] == pytest.approx(scene.N, abs=1e-6)


def test_a_known_normal_that_neither_solution_has_shows_as_normal_error():
    scene = Scene()
    plane = plane_from_mount(mounted(MOUNT, tilt_deg=25.0), MARKERS)
    pose = relative_pose(measurement(scene.H_j_i, 1e12 * np.eye(8)), MOUNT, MOUNT, plane)
    assert 1.0 < np.rad2deg(pose.normal_error) < 5.1


def test_the_covariance_is_that_of_the_errors():
    scene, rng, runs = Scene(*MOUNTS[1]), np.random.default_rng(1), 300
    information = information_of(scene)
    plane = plane_from_mount(scene.mount_i, MARKERS)
    values = [
        nees_of(relative_pose(measurement(scene.H_j_i @ E, information), *MOUNTS[1], plane), scene.T_i_j)
        for E in small_homographies(information, runs, rng)
    ]
    low, high = bounds(runs)
    assert low < np.mean(values) / 6 < high


def test_the_covariance_carries_the_tolerances_of_both_mounts():
    rng, runs = np.random.default_rng(2), 200
    nominal = [mounted(m, height_sigma=2e-3, tilt_sigma_deg=0.3, roll_sigma_deg=0.2) for m in MOUNTS[1]]
    information = information_of(Scene(*nominal))
    plane = plane_from_mount(nominal[0], MARKERS)
    values, without = [], []
    for E in small_homographies(information, runs, rng):
        true = [
            mounted(
                m,
                height=m.height + m.height_sigma * rng.normal(),
                tilt_deg=m.tilt_deg + m.tilt_sigma_deg * rng.normal(),
                roll_deg=m.roll_deg + m.roll_sigma_deg * rng.normal(),
            )
            for m in nominal
        ]
        scene = Scene(*true)
        pose = relative_pose(measurement(scene.H_j_i @ E, information), *nominal, plane)
        values.append(nees_of(pose, scene.T_i_j))
        blind = relative_pose(measurement(scene.H_j_i @ E, information), *MOUNTS[1], plane)
        without.append(nees_of(blind, scene.T_i_j))
    low, high = bounds(runs)
    assert low < np.mean(values) / 6 < high
    assert np.mean(without) / 6 > 2  # so that the tolerances are what is tested


def test_the_covariance_carries_a_floor_that_is_not_level_and_markers_of_another_height():
    rng, runs = np.random.default_rng(3), 200
    scene = Scene()
    floor = Floor(tilt_sigma_deg=0.2, height_sigma=2e-3)
    plane = plane_from_mount(MOUNT, Markers(height=0.15, positions=((0, 0),), height_sigma=1e-3), floor)
    assert plane.normal_sigma == pytest.approx(np.deg2rad(0.2))
    assert plane.d_sigma == pytest.approx(np.hypot(2e-3, 1e-3))
    across = np.linalg.svd(scene.N[None])[2][1:]
    information = information_of(scene)
    T_cj_ci = np.linalg.inv(scene.T_world_cj) @ scene.T_world_ci
    values = []
    for E in small_homographies(information, runs, rng):
        N = so3_exp(plane.normal_sigma * rng.normal(size=2) @ across) @ scene.N
        d = plane.d + plane.d_sigma * rng.normal()
        H = T_cj_ci[:3, :3] + np.outer(T_cj_ci[:3, 3], N) / d
        pose = relative_pose(measurement(H / np.cbrt(np.linalg.det(H)) @ E, information), MOUNT, MOUNT, plane)
        values.append(nees_of(pose, scene.T_i_j))
    low, high = bounds(runs)
    assert low < np.mean(values) / 6 < high


def test_swapping_the_observers_inverts_the_pose():
    scene = Scene(*MOUNTS[1])
    swapped = np.linalg.inv(scene.H_j_i)
    pose = relative_pose(
        measurement(swapped, 1e12 * np.eye(8)), *MOUNTS[1][::-1], plane_from_mount(scene.mount_j, MARKERS)
    )
    assert pose.T_i_j == pytest.approx(np.linalg.inv(scene.T_i_j), abs=1e-8)


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_no_baseline_is_refused_in_words(noise):
    scene = Scene(distance=1e-9)
    information = information_of(Scene())
    E = small_homographies(information, 1, np.random.default_rng(4))[0]
    H = scene.H_j_i @ (E if noise else np.eye(3))
    with pytest.raises(DegenerateGeometry, match=r"between A and B.*no baseline.*further apart"):
        relative_pose(measurement(H, information), MOUNT, MOUNT, plane_from_mount(MOUNT, MARKERS))


def test_a_homography_that_is_too_noisy_for_a_baseline_is_not_called_a_rotation():
    scene = Scene()
    information = 1e-5 * information_of(scene)
    with pytest.raises(DegenerateGeometry, match=r"between A and B, fitted to .* points, is too noisy .*record more"):
        relative_pose(measurement(scene.H_j_i, information), MOUNT, MOUNT, plane_from_mount(MOUNT, MARKERS))


@pytest.mark.parametrize("height", [0.15, 0.40])
def test_a_camera_that_is_not_above_the_markers_is_refused_in_words(height):
    with pytest.raises(DegenerateGeometry, match="not above the markers"):
        plane_from_mount(mounted(MOUNT, height=height), Markers(height=0.40, positions=((0, 0),)))


def test_on_plane_is_where_the_rays_meet_it_and_nan_above_the_horizon():
    scene = Scene()
    plane = plane_from_mount(MOUNT, MARKERS)
    points = np.array([[1.0, 0.2, 0.15], [2.0, -0.1, 0.15]])
    in_camera = (points - scene.T_world_ci[:3, 3]) @ scene.T_world_ci[:3, :3]
    assert on_plane(in_camera[:, :2] / in_camera[:, 2:], plane) == pytest.approx(in_camera)
    horizon = -np.tan(np.deg2rad(20.0))
    assert np.isnan(on_plane(np.array([[0.0, horizon - 0.01]]), plane)).all()
    assert np.isfinite(on_plane(np.array([[0.0, horizon + 0.01]]), plane)).all()


def two_markers(rng, n, span=0.25, noise=0.0):
    """Normalised coordinates in camera i of both markers of a robot at n poses."""
    scene = Scene()
    centre = np.column_stack([rng.uniform(0.8, 1.6, n), rng.uniform(-0.1, 0.3, n), np.full(n, 0.15)])
    heading = rng.uniform(-np.pi, np.pi, n)
    side = span / 2 * np.column_stack([-np.sin(heading), np.cos(heading), np.zeros(n)])
    uv = [scene.seen(centre + sign * side)[0] for sign in (1, -1)]
    return [CAMERA.normalise(one + noise * rng.normal(size=one.shape)) for one in uv]


def test_distance_from_a_span_is_exact_whatever_the_mount_says():
    plane = plane_from_mount(MOUNT, MARKERS)
    wrong = Plane(N=plane.N, d=1.7, normal_from_mount=True, d_from_mount=True)
    found = distance_from_span(wrong, *two_markers(np.random.default_rng(0), 30), MARKERS)
    assert found.d == pytest.approx(0.25, abs=1e-12)
    assert found.d_sigma == pytest.approx(0.0, abs=1e-12)
    assert not found.d_from_mount
    assert found.normal_from_mount


def test_an_instant_at_which_another_light_was_taken_for_a_marker_is_left_out():
    plane = plane_from_mount(MOUNT, MARKERS)
    a, b = two_markers(np.random.default_rng(0), 30, noise=0.3)
    right = distance_from_span(plane, a, b, MARKERS)
    b[7], a[11] = a[7] + 0.002, 3.0 * a[11]
    found = distance_from_span(plane, a, b, MARKERS)
    assert found.d == pytest.approx(right.d, abs=right.d_sigma)
    assert found.d_sigma < 1.1 * right.d_sigma


def test_distance_from_a_span_is_as_sure_as_it_says():
    rng, runs = np.random.default_rng(1), 300
    stated = Markers(height=0.15, positions=MARKERS.positions, span_sigma=5e-4)
    plane = plane_from_mount(MOUNT, stated)
    values = []
    for _ in range(runs):
        span = 0.25 + stated.span_sigma * rng.normal()
        found = distance_from_span(plane, *two_markers(rng, 40, span, noise=0.3), stated)
        values.append((found.d - 0.25) ** 2 / found.d_sigma**2)
    low, high = bounds(runs, dof=1, slack=0.1)
    assert low < np.mean(values) < high


def test_one_marker_has_no_span_and_says_so():
    plane = plane_from_mount(MOUNT, MARKERS)
    with pytest.raises(DegenerateGeometry, match="one marker"):
        distance_from_span(plane, np.zeros((5, 2)), np.zeros((5, 2)), Markers(height=0.15, positions=((0, 0),)))


def test_markers_that_are_never_seen_together_say_so():
    plane = plane_from_mount(MOUNT, MARKERS)
    with pytest.raises(DegenerateGeometry, match="never seen at once"):
        distance_from_span(plane, np.empty((0, 2)), np.empty((0, 2)), MARKERS)
