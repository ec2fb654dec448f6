"""One stance of a real run, from its file to the relative pose, at both depths."""

import dataclasses
from contextlib import nullcontext

import gtsam
import numpy as np
import pytest
from msgspec.structs import replace
from scipy.stats import chi2

from coloc_graph.errors import DegenerateGeometry, InputError
from coloc_graph.frontend import FrontendOptions, fit_homography, measure_pair
from coloc_graph.frontend.homography.fit_checks import require_agreement, require_determined
from coloc_graph.frontend.learnt_noise import NoiseBelief
from coloc_graph.geometry.lie import se3_inverse
from coloc_graph.run import Detections, Image, Planes, RunWriter, Stance, open_run, read_truth
from coloc_graph.run.recorded import Restated
from coloc_graph.simulation import EPOCH, Imperfections, reference_team, simulate
from coloc_graph.team import Markers

DEPTHS = ["tracks", "raw", "png"]
STANCE = Stance(0, EPOCH, EPOCH + 10.0, ("A", "B"), ("C",))


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A single-step run of each depth and format, with its true T_A_B."""
    out = {}
    for name in DEPTHS:
        path = tmp_path_factory.mktemp("stance") / f"{name}.mcap"
        if name == "tracks":
            simulate("single-step", path, seed=3, points=60)
        else:
            simulate("single-step", path, depth="images", seed=3, points=100, image_format=name)
        run, truth = open_run(path), read_truth(path)
        T_world = {}
        for robot in "AB":
            before = np.searchsorted(truth[robot].times, run.stances[0].start + 1e-6) - 1
            T_world[robot] = truth[robot].T_world_body[before]
        out[name] = run, se3_inverse(T_world["A"]) @ T_world["B"]
    return out


@pytest.mark.parametrize("depth", ["tracks", "raw", "png"])
@pytest.mark.parametrize("scale", ["heights", "span"])
@pytest.mark.parametrize("criterion", ["reprojection", "transfer"])
def test_a_stance_gives_the_pose_between_its_observers(runs, depth, scale, criterion):
    recorded, T_A_B = runs[depth]
    run = Restated(recorded, NoiseBelief.of(recorded.team).used(recorded.team))
    found = measure_pair(run, recorded.stances[0], "A", "B", FrontendOptions(criterion=criterion, scale=scale))
    H, pose = found.homography, found.relative_pose
    assert H.unusable is None
    assert (H.stance, H.robot_i, H.robot_j) == (0, "A", "B")
    asked = 60 if depth == "tracks" else 100
    assert 0.7 * asked <= H.points <= asked
    assert H.points == len(found.correspondences)
    assert H.inliers >= 0.9 * H.points
    assert 1000 < H.overlap_px < 320 * 240
    # the prior of the noise of images has a floor wider than what a rendered image has
    assert (0.5 if depth == "tracks" else 0.1) < H.residual < 2.0
    xi = gtsam.Pose3.Logmap(gtsam.Pose3(pose.T_i_j).between(gtsam.Pose3(T_A_B)))
    assert (np.abs(xi) < 4 * np.sqrt(np.diag(pose.covariance))).all()
    assert xi @ np.linalg.solve(pose.covariance, xi) < chi2.ppf(1 - 6e-5, 6)
    assert np.linalg.norm(xi[3:]) < 0.05
    assert np.sqrt(np.diag(pose.covariance)).max() < 0.05


def test_measured_the_other_way_round_it_is_the_inverse(runs):
    run, _ = runs["tracks"]
    a, b = (measure_pair(run, run.stances[0], *pair, FrontendOptions()).relative_pose for pair in ("AB", "BA"))
    xi = gtsam.Pose3.Logmap(gtsam.Pose3(a.T_i_j).compose(gtsam.Pose3(b.T_i_j)))
    assert np.abs(xi).max() < 4 * np.sqrt(np.diag(a.covariance + b.covariance).max())


def test_the_same_pixels_in_both_lossless_formats_give_the_same_measurement(runs):
    raw, png = (measure_pair(runs[f][0], runs[f][0].stances[0], "A", "B", FrontendOptions()) for f in ("raw", "png"))
    assert (raw.homography.H_j_i == png.homography.H_j_i).all()


def run_with_clock_offset(path, offset):
    simulate("single-step", path, seed=1, points=60, imperfections=Imperfections(clock_offset=offset))
    run = open_run(path)
    return measure_pair(run, run.stances[0], "A", "B", FrontendOptions())


def test_clocks_that_are_seconds_apart_are_said_in_words(tmp_path):
    found = run_with_clock_offset(tmp_path / "run.mcap", 3.0)
    assert "clocks" in found.homography.unusable


def test_clocks_50_ms_apart_give_the_right_pose_or_none(tmp_path, runs):
    found = run_with_clock_offset(tmp_path / "run.mcap", 0.05)
    if found.homography.unusable is None:
        xi = gtsam.Pose3.Logmap(gtsam.Pose3(found.relative_pose.T_i_j).between(gtsam.Pose3(runs["tracks"][1])))
        assert xi @ np.linalg.solve(found.relative_pose.covariance, xi) < chi2.ppf(1 - 6e-5, 6)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.8])
def test_an_observer_that_is_bumped_while_a_stance_is_taken_is_named(tmp_path, hallway, copied, share):
    first = open_run(hallway).stances[0]
    since = first.start + share * (first.end - first.start)

    def bumped(record):
        if not isinstance(record, Detections) or record.robot != "A" or record.time < since:
            return record
        return dataclasses.replace(record, uv=record.uv + np.array([12.0, -5.0]))

    run = open_run(copied(hallway, tmp_path / "run.mcap", change=bumped, stances=[first]))
    why = measure_pair(run, first, "A", "B", FrontendOptions()).homography.unusable
    assert "A or B was bumped, a clock stepped, or the tracks of two lights were swapped" in why
    said = float(why.split(" s after")[0].split()[-1])
    assert said == pytest.approx(since - first.start, abs=0.1 * (first.end - first.start))
    # the paper's chain composes every homography that can be fitted, and names the doubt
    chained = measure_pair(run, first, "A", "B", FrontendOptions(criterion="transfer", pose="eq2"))
    assert chained.homography.unusable is None and chained.relative_pose is not None
    assert "was bumped, a clock stepped" in chained.homography.doubt


def test_points_that_are_off_by_less_than_a_pixel_for_a_while_are_no_bump(hallway):
    run = open_run(hallway)
    found = measure_pair(run, run.stances[0], "A", "B", FrontendOptions()).correspondences
    early = found.times < np.quantile(found.times, 0.15)
    for off in (0.1, 10.0):  # in units of the homography's, which are of some 300 px
        fit = fit_homography(found.pairs)
        squared = np.where(early, (off / 300 / found.pairs.sigma) ** 2, fit.squared_residuals)
        fit = dataclasses.replace(fit, inliers=~early, squared_residuals=squared)
        with nullcontext() if off < 1 else pytest.raises(DegenerateGeometry, match="was bumped"):
            require_agreement(fit, found, "A or B", "")


@pytest.mark.parametrize("when", [1, -1])
def test_points_of_a_robot_that_stood_are_no_homography_and_no_bump(hallway, when):
    run = open_run(hallway)
    found = measure_pair(run, run.stances[0], "A", "B", FrontendOptions()).correspondences
    order, n = np.argsort(found.times), len(found)
    stood = order[::when][: int(0.6 * n)]
    uv = found.uv_i.copy()
    uv[stood] = np.where(found.markers[stood, None] == found.markers[0], (100.0, 80.0), (140.0, 90.0))
    agree = np.isin(np.arange(n), stood)
    squared = np.where(agree, 1.0, 1e8)
    fit = dataclasses.replace(fit_homography(found.pairs), inliers=agree, squared_residuals=squared)
    with pytest.raises(DegenerateGeometry, match="hardly moved"):
        require_agreement(fit, dataclasses.replace(found, uv_i=uv), "A or B", "")


def test_a_homography_with_an_open_direction_is_none(hallway):
    run = open_run(hallway)
    fit = fit_homography(measure_pair(run, run.stances[0], "A", "B", FrontendOptions()).correspondences.pairs)
    require_determined(fit)
    values, vectors = np.linalg.eigh(fit.information)
    values[0] *= 1e-12
    with pytest.raises(DegenerateGeometry, match="do not determine the homography"):
        require_determined(dataclasses.replace(fit, information=(vectors * values) @ vectors.T))


def write(tmp_path, paths, team=None, planes=None):
    """A run whose observers see markers at world points: paths maps a marker's name to (n, 3) [m]."""
    team = team or reference_team()
    rng = np.random.default_rng(0)
    poses = {"A": (0.0, 0.4, -0.3), "B": (0.0, -0.4, 0.3)}
    path = tmp_path / "run.mcap"
    with RunWriter(path, team) as writer:
        writer.write(STANCE)
        if planes is not None:
            writer.write(planes)
        for robot, (x, y, yaw) in poses.items():
            c, s = np.cos(yaw), np.sin(yaw)
            T = np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, 0], [0, 0, 0, 1]]) @ team[robot].mount.T_body_camera
            pixels = {}
            for name, points in paths.items():
                uv, inside = team[robot].camera.project((points - T[:3, 3]) @ T[:3, :3])
                assert inside.all()
                pixels[name] = uv + 0.3 * rng.normal(size=uv.shape)
            for k in range(len(next(iter(paths.values())))):
                uv = np.array([pixels[name][k] for name in paths])
                n = len(uv)
                covariance = np.broadcast_to(0.09 * np.eye(2), (n, 2, 2))
                flags, ones = np.zeros(n, np.uint8), np.ones(n)
                writer.write(Detections(robot, EPOCH + 0.1 * (k + 1), uv, covariance, tuple(paths), flags, ones, ones))
    return open_run(path)


def straight(n=60, y=0.0):
    return np.column_stack([np.linspace(0.9, 1.9, n), np.full(n, y), np.full(n, 0.15)])


def test_a_straight_line_is_unusable_and_the_remedy_is_named(tmp_path):
    run = write(tmp_path, {"C/0": straight()})
    found = measure_pair(run, STANCE, "A", "B", FrontendOptions())
    assert "let it turn" in found.homography.unusable
    assert found.relative_pose is None
    assert len(found.correspondences) == found.homography.points == 60
    assert np.isnan(found.homography.H_j_i).all()


def test_both_markers_on_a_straight_drive_are_two_lines_and_enough(tmp_path):
    run = write(tmp_path, {"C/0": straight(y=0.125), "C/1": straight(y=-0.125)})
    found = measure_pair(run, STANCE, "A", "B", FrontendOptions())
    assert found.homography.unusable is None
    assert found.relative_pose.T_i_j[0, 3] == pytest.approx(0.8 * np.sin(0.3), abs=0.02)
    assert found.relative_pose.T_i_j[1, 3] == pytest.approx(-0.8 * np.cos(0.3), abs=0.02)


def test_one_marker_has_no_span_for_the_scale(tmp_path):
    team = reference_team()
    alone = replace(team["C"], markers=Markers(height=0.15, positions=((0.0, 0.0),)))
    team = replace(team, robots=(*team.robots[:2], alone))
    s = np.linspace(0, 6, 60)
    points = np.column_stack([1.4 + 0.4 * np.cos(s), 0.2 * np.sin(2 * s), np.full(60, 0.15)])
    run = write(tmp_path, {"C/0": points}, team)
    assert measure_pair(run, STANCE, "A", "B", FrontendOptions()).homography.unusable is None
    assert "no span" in measure_pair(run, STANCE, "A", "B", FrontendOptions(scale="span")).homography.unusable


def test_a_stated_plane_goes_before_the_mount(tmp_path):
    paths = {"C/0": straight(y=0.125), "C/1": straight(y=-0.125)}
    tilt = np.deg2rad(20.0)
    nominal = (0.0, float(np.cos(tilt)), float(np.sin(tilt)), 0.5)  # twice the height
    planes = Planes(0, EPOCH, {"A": nominal})
    found = measure_pair(write(tmp_path, paths, planes=planes), STANCE, "A", "B", FrontendOptions())
    assert np.linalg.norm(found.relative_pose.T_ci_cj[:3, 3]) == pytest.approx(1.6, abs=0.04)


def test_an_observer_that_recorded_nothing_is_an_answer_in_words(tmp_path):
    path = tmp_path / "run.mcap"
    with RunWriter(path, reference_team()) as writer:
        writer.write(STANCE)
    found = measure_pair(open_run(path), STANCE, "A", "B", FrontendOptions())
    assert "never see a marker" in found.homography.unusable
    assert found.correspondences is None


def test_images_of_another_size_than_the_camera_are_refused(tmp_path):
    path = tmp_path / "run.mcap"
    with RunWriter(path, reference_team(), image_format="raw") as writer:
        writer.write(STANCE)
        writer.write(Image("A", EPOCH + 1.0, np.zeros((480, 640), np.uint8)))
    with pytest.raises(InputError, match=r"640 x 480.*320 x 240"):
        measure_pair(open_run(path), STANCE, "A", "B", FrontendOptions())
