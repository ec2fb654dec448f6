"""A mover on an uneven floor lifts its markers: the error of the homography, over many floors."""

import math

import numpy as np
import pytest
from msgspec.structs import replace as new

from coloc_graph.backend.span_factor import SpanModel, Spans
from coloc_graph.frontend.homography.fit import fit_homography, persisting
from coloc_graph.frontend.homography.floor_tilt import FloorTilt
from coloc_graph.frontend.homography.marker_span import marker_spans
from coloc_graph.frontend.homography.plane import plane_from_mount
from coloc_graph.frontend.homography.refinement import PointPairs
from coloc_graph.frontend.pairing.correspondence import Correspondences
from coloc_graph.frontend.stance import FrontendOptions, measure_pair
from coloc_graph.geometry.lie import SL3_BASIS
from coloc_graph.planning.drive import drive_through, there_and_back
from coloc_graph.planning.plan import Plan, PlannedStance
from coloc_graph.run import atomic_run, open_run
from coloc_graph.simulation import Imperfections, build_world, record, reference_team
from coloc_graph.simulation.planned import planned
from coloc_graph.simulation.rig import stated_team
from coloc_graph.simulation.uneven_floor import UnevenFloor
from coloc_graph.simulation.world import standing_pose
from coloc_graph.team import Floor

TEAM = reference_team()
BOTH = (TEAM["A"].camera, TEAM["B"].camera)
SIGMA = math.radians(0.05)
NOISE = 0.03 / TEAM["A"].camera.fx
MOUNT, MARKERS = TEAM["A"].mount, TEAM["C"].markers
PLANES = (plane_from_mount(MOUNT, MARKERS), plane_from_mount(MOUNT, MARKERS))
CAMERAS = [standing_pose(pose, (0.0, 0.0)) @ MOUNT.T_body_camera for pose in ((0.0, 0.3, -0.2), (-1.0, -0.3, 0.2))]


def homography():
    T_j_i = np.linalg.inv(CAMERAS[1]) @ CAMERAS[0]
    H = T_j_i[:3, :3] + np.outer(T_j_i[:3, 3], PLANES[0].N) / PLANES[0].d
    return H / np.cbrt(np.linalg.det(H))


def seen(waypoints, duration, seed, sigma, fps=30.0, lone=0):
    """Correspondences of a drive on a floor; the second marker is hidden in the first `lone` images."""
    drive = drive_through(there_and_back(waypoints, duration, 0.4), 0.4)
    times = np.arange(0.0, duration, 1 / fps)
    T = UnevenFloor(sigma, np.random.default_rng((seed, 1))).pose(drive.at(times))
    points = np.stack([T[:, :3, 3] + T[:, :3, :3] @ p for p in MARKERS.p_body], axis=1).reshape(-1, 3)
    rng, x = np.random.default_rng((seed, 2)), []
    for T_world_camera in CAMERAS:
        p = (points - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
        x.append(p[:, :2] / p[:, 2:] + NOISE * rng.standard_normal((len(p), 2)))
    kept = np.ones(len(points), bool)
    kept[1 : 2 * lone : 2] = False
    (x_i, x_j), n = (one[kept] for one in x), int(kept.sum())
    C = np.broadcast_to(NOISE**2 * np.eye(2), (n, 2, 2))
    tracks = np.tile([0, 1], len(times))[kept]
    loads = np.zeros((n, 2))
    return Correspondences(x_i, x_j, np.repeat(times, 2)[kept], tracks, PointPairs(x_i, x_j, C, C), loads, loads)


def tilt_error(fit, found, sigma=SIGMA):
    """Covariance of a homography by the floor's slope."""
    of = fit.inliers
    return FloorTilt.of(fit, found, PLANES, BOTH, sigma).covariance(found.markers[of], found.times[of])


def error(fit):
    """The eight coordinates by which a fitted homography is off."""
    off = np.linalg.inv(fit.H) @ homography()
    return np.linalg.lstsq(np.reshape(SL3_BASIS, (8, 9)).T, (off - np.eye(3)).ravel(), rcond=None)[0]


AWAY = ((1.2, 0.0), (2.3, -0.1))
SHORT, ROUND = ((1.2, 0.2), (1.6, 0.0)), ((1.2, 0.4), (1.7, 0.3), (1.7, -0.3), (1.2, -0.3))


@pytest.mark.parametrize(("waypoints", "duration", "lone"), [
    (SHORT, 4.4, 0),
    (ROUND, 8.0, 0),
    (ROUND, 8.0, 60),
], ids=["short", "round", "a hidden marker"])  # fmt: skip
def test_the_covariance_of_a_homography_is_that_of_its_errors_over_many_floors(waypoints, duration, lone):
    squares = []
    for seed in range(60):
        found = seen(waypoints, duration, seed, SIGMA, lone=lone)
        fit = fit_homography(found.pairs)
        by_noise = np.linalg.inv(persisting(fit, found.pairs, found.markers, found.times).information)
        h = error(fit)
        whole = by_noise + tilt_error(fit, found)
        squares.append([h @ np.linalg.solve(C, h) / 8 for C in (by_noise, whole)])
    by_noise, whole = np.mean(squares, axis=0)
    assert by_noise > 2.0  # what the images alone say is too good
    assert 0.75 < whole < 1.3


@pytest.mark.parametrize(("waypoints", "duration"), [(SHORT, 4.4), (ROUND, 8.0), (AWAY, 12.0)],
                         ids=["short", "round", "away"])  # fmt: skip
def test_the_covariance_of_a_span_is_that_of_its_errors_over_many_floors(waypoints, duration):
    """Of 24 runs on a way of 21.5 m 11 rejected a right relative pose for the spans of a straight drive."""
    squares, n = [], (PLANES[0].N / PLANES[0].d)[None]
    for seed in range(60):
        found = seen(waypoints, duration, seed, SIGMA)
        fit = fit_homography(found.pairs)
        h, tilt = error(fit), FloorTilt.of(fit, found, PLANES, BOTH, SIGMA)
        row = []
        for known in (None, tilt):
            spans = marker_spans({"C": (0, 1)}, found, fit, np.zeros((len(found), 2, 0)), known)
            (model,) = SpanModel.near(spans, n, np.zeros(1), [MARKERS.span])
            off = Spans([model]).at(n, np.zeros(1))[0][0] + model.by_h @ h
            row.append(off @ off / 3)
        squares.append(row)
    by_noise, whole = np.mean(squares, axis=0)
    assert by_noise > 1.4  # of the short drives, 18
    assert 0.6 < whole < 1.2


def test_driving_there_and_back_longer_makes_the_floor_no_better_known():
    errors = []
    for duration in (4.0, 16.0):
        found = seen(SHORT, duration, 0, 0.0)
        errors.append(tilt_error(fit_homography(found.pairs), found))
    assert np.trace(errors[1]) == pytest.approx(np.trace(errors[0]), rel=0.1)


def test_a_floor_that_is_exact_adds_nothing():
    found = seen(SHORT, 4.0, 0, 0.0)
    assert not tilt_error(fit_homography(found.pairs), found, 0.0).any()


def test_points_taken_together_give_what_single_ones_do(monkeypatch):
    found = seen(ROUND, 8.0, 0, 0.0)
    fit = fit_homography(found.pairs)
    single = tilt_error(fit, found)
    monkeypatch.setattr("coloc_graph.frontend.homography.floor_tilt.MAX_BLOCKS", 200)
    np.testing.assert_allclose(tilt_error(fit, found), single, atol=0.1 * np.abs(single).max())


def test_a_measured_stance_contains_the_floor_under_its_mover(tmp_path):
    standing = {"A": (0.0, 0.3, -0.2), "B": (-0.5, -0.3, 0.2)}
    plan = Plan((PlannedStance(standing, (), "C", SHORT, 6.0),))
    team = stated_team(TEAM, Imperfections(noise_px=0.03, floor_sigma_deg=0.05))
    world = build_world(planned(plan), team=team, fps=15.0, imperfections=Imperfections(noise_px=0.03))
    with atomic_run(tmp_path / "run.mcap", team) as writer:
        record(world, writer, "tracks")
    run = open_run(tmp_path / "run.mcap")
    measured = measure_pair(run, run.stances[0], "A", "B", FrontendOptions())
    on_flat = measured.with_team(new(team, floor=Floor()))
    ratios = np.linalg.eigvals(np.linalg.solve(measured.homography.information, on_flat.homography.information))
    assert ratios.real.min() > 0.99 and ratios.real.max() > 3.0
