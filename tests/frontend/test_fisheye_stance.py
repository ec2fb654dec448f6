"""Fisheyes: a stance whose mover passes beside and behind the cameras, measured and estimated."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from coloc_graph.evaluation import align, evaluate
from coloc_graph.frontend import FrontendOptions, measure_pair
from coloc_graph.frontend.homography.plane_view import between_cameras, view_of_plane
from coloc_graph.geometry.lie import se3_inverse, so3_log
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.run import RunWriter, open_run, read_truth
from coloc_graph.simulation import Imperfections, build_world, hallway, record
from coloc_graph.simulation.rig import wide_team
from coloc_graph.simulation.scenarios import Box

AROUND = Box((-1.0, 2.0), (-1.6, 1.6))  # m, of the mover, from the middle between the observers


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A hallway of 200 deg lenses in which the mover drives all around the observers, with its world."""
    path = tmp_path_factory.mktemp("fisheye") / "run.mcap"
    world = build_world(
        replace(hallway(4, np.random.default_rng(5)), box=AROUND), seed=5, points=120, team=wide_team(200.0),
        imperfections=Imperfections(mount_sigma_deg=0.3, height_sigma=0.002),
    )  # fmt: skip
    with RunWriter(path, world.team) as writer:
        record(world, writer, "tracks")
    return open_run(path), read_truth(path), world


def test_markers_beside_and_behind_the_cameras_are_used(recorded):
    run, _, _ = recorded
    found = measure_pair(run, run.stances[0], "A", "B", FrontendOptions())
    assert found.homography.unusable is None
    rays = run.team["A"].camera.rays(found.correspondences.uv_i)
    assert (rays[found.fit.inliers, 2] < 0).sum() > 5
    assert found.fit.inliers.mean() > 0.95
    assert found.fit.chi2 == pytest.approx(found.fit.dof, abs=4 * np.sqrt(2 * found.fit.dof))
    # the homography is of the cameras themselves: it takes rays of i to rays of j
    rays_j = run.team["B"].camera.rays(found.correspondences.uv_j)
    mapped = rays @ found.homography.H_j_i.T
    mapped *= np.sign(np.linalg.det(found.homography.H_j_i)) / np.linalg.norm(mapped, axis=1)[:, None]
    off = np.arccos(np.clip((mapped * rays_j).sum(axis=1), -1, 1))[found.fit.inliers]
    assert np.rad2deg(np.median(off)) < 0.5


def test_the_relative_pose_agrees_with_the_truth_within_its_covariance(recorded):
    run, _, world = recorded
    for stance in run.stances:
        i, j = stance.observers
        pose = measure_pair(run, stance, i, j, FrontendOptions()).relative_pose
        T_i, T_j = (world.paths[robot].pose_at(np.array([stance.start]))[0] for robot in (i, j))
        off = se3_inverse(pose.T_i_j) @ se3_inverse(T_i) @ T_j
        xi = np.concatenate([so3_log(off[:3, :3]), off[:3, 3]])
        assert xi @ np.linalg.pinv(pose.covariance, rcond=1e-9) @ xi < chi2.ppf(0.9999, 6)


def test_the_joint_estimate_is_consistent(recorded):
    run, truth, _ = recorded
    solution = solve(run, SolveOptions())
    true = align(solution.estimate.trajectories, truth, "A", on_floor=True)
    accuracy = evaluate(solution.estimate.trajectories, true, on_floor=True)
    assert accuracy.anees < 2.5
    assert max(robot.end_position_error for robot in accuracy.robots) < 0.02


def test_a_view_of_the_plane_looks_along_its_normal():
    camera = wide_team(160.0)["A"].camera
    for N in np.array([[0.0, 0.96, 0.28], [0.6, 0.0, 0.8], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]):
        R = view_of_plane(camera, N).R_camera_view
        assert R[:, 2] == pytest.approx(N)
        assert pytest.approx(np.eye(3)) == R.T @ R
        assert np.linalg.det(R) == pytest.approx(1.0)


def test_a_homography_between_views_is_one_between_cameras():
    camera = wide_team(160.0)["A"].camera
    views = [view_of_plane(camera, np.array(N)) for N in ([0.0, 0.96, 0.28], [0.6, 0.0, 0.8])]
    H = np.array([[1.0, 0.1, 0.2], [-0.1, 1.1, 0.1], [0.05, 0.02, 1.0]])
    ray = np.array([0.3, -0.2, 1.0])
    in_camera = between_cameras(H, *views) @ views[0].R_camera_view @ ray
    assert in_camera == pytest.approx(views[1].R_camera_view @ H @ ray)
