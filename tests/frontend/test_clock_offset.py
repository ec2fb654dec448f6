"""The offset between two cameras' clocks: found where the motion shows it, told where it does not."""

import dataclasses

import gtsam
import msgspec
import numpy as np
import pytest
from planar_scene import CAMERA, Scene

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend import ClockOffset, FrontendOptions, measure_pair, share_clock_offsets
from coloc_graph.frontend.pairing.clock_offset import fuse, require_searchable
from coloc_graph.frontend.tracks.interpolation import MAX_GAP, Samples
from coloc_graph.geometry.lie import se3_inverse
from coloc_graph.pipeline.batch import solve
from coloc_graph.run import Detections, RunWriter, Stance, open_run
from coloc_graph.simulation import EPOCH, Imperfections, build_world, reference_team, scenario, simulate
from coloc_graph.simulation.rig import MILD_LENS
from coloc_graph.simulation.tracks import observe

OFFSET = 0.02


def samples(times, x, sigma=1e-3):
    return Samples([times], [x], [np.broadcast_to(sigma**2 * np.eye(2), (len(x), 2, 2))])


def at(samples_, times):
    times = np.asarray(times, float)
    found = samples_.at(np.zeros(len(times), np.int64), times)
    return found.position @ samples_.x, found


def cubic(t):
    return np.stack([1 + t - 2 * t**2 + 3 * t**3, 0.5 - t**3], axis=1)


def test_a_cubic_and_its_derivative_are_interpolated_exactly():
    t = EPOCH + np.arange(12) * 0.1
    s = samples(t, cubic(t - EPOCH))
    asked = EPOCH + np.array([0.0, 0.03, 0.1, 0.55, 1.07, 1.1])
    x, found = at(s, asked)
    u = asked - EPOCH
    assert found.valid.all()
    assert x == pytest.approx(cubic(u), abs=1e-6)
    derivative = np.stack([1 - 4 * u + 9 * u**2, -3 * u**2], axis=1)
    assert found.derivative @ s.x == pytest.approx(derivative, abs=1e-4)


def test_neither_gaps_nor_what_lies_outside_a_track_are_bridged():
    gap = MAX_GAP + 0.05
    t = np.concatenate([np.arange(4) * 0.05, 0.15 + gap + np.arange(4) * 0.05])
    x, found = at(samples(t, np.stack([t, -t], axis=1)), [-0.02, 0.02, 0.15, 0.2, 0.15 + gap - 0.02, 0.15 + gap, 0.6])
    assert found.valid.tolist() == [False, True, True, False, False, True, False]
    assert x[found.valid, 0] == pytest.approx([0.02, 0.15, 0.15 + gap])


def test_a_jerk_is_not_interpolated_across_and_noise_is_no_jerk(rng):
    t = np.arange(40) * 0.1
    x = np.stack([np.abs(t - 2.05), 0 * t], axis=1)
    assert not at(samples(t, x), [2.05])[1].valid[0]
    assert at(samples(t, x), [0.95])[1].valid[0]
    noisy = np.stack([t, t], axis=1) + 1e-3 * rng.normal(size=(40, 2))
    assert at(samples(t, noisy), np.arange(0.05, 3.9, 0.1))[1].valid.all()


def test_tracks_of_one_camera_are_kept_apart():
    t = np.arange(5) * 0.1
    C = np.broadcast_to(1e-6 * np.eye(2), (5, 2, 2))
    both = Samples([t, t], [np.ones((5, 2)), 2 * np.ones((5, 2))], [C, C])
    found = both.at(np.array([1, 0]), np.array([0.05, 0.4]))
    assert found.valid.all()
    assert (found.position @ both.x)[:, 0] == pytest.approx([2.0, 1.0])


def run_of(tmp_path, world, *, names=True):
    """A world's tracks as a run, without the names of the markers unless asked for."""
    path = tmp_path / f"{world.seed}-{names}.mcap"
    with RunWriter(path, world.team) as writer:
        for k, stance in enumerate(world.stances):
            writer.write(stance)
            for tracks in observe(world, k):
                for one in tracks.records():
                    nameless = dataclasses.replace(one, markers=("",) * len(one.markers))
                    writer.write(one if names else nameless)
    return open_run(path)


def hallway_world(seed, offset, stances=1, **options):
    imperfections = Imperfections(clock_offset=offset, noise_px=0.1)
    what = scenario("hallway", stances=stances, rng=np.random.default_rng(seed))
    options = {
        "depth": "images",
        "fps": 30.0,
        "points": 400,
        "stopping": True,
        "team": reference_team(MILD_LENS),
    } | options
    return build_world(what, seed=seed, imperfections=imperfections, **options)


def error_of(world, found, k=0):
    stance = world.stances[k]
    i, j = (world.paths[robot].pose_at([stance.start])[0] for robot in stance.observers)
    return gtsam.Pose3.Logmap(gtsam.Pose3(found.relative_pose.T_i_j).between(gtsam.Pose3(se3_inverse(i) @ j)))


@pytest.mark.parametrize("names", [True, False])
@pytest.mark.parametrize("offset", [OFFSET, -0.06])
def test_stop_and_go_shows_the_offset_with_or_without_names(tmp_path, names, offset):
    world = hallway_world(3, offset)
    run = run_of(tmp_path, world, names=names)
    found = measure_pair(run, run.stances[0], "A", "B", FrontendOptions())
    h = found.homography
    assert h.unusable is None and h.warning is None
    assert h.inliers > 0.8 * 400
    assert 0.8 < h.residual < 1.2
    assert 1e-4 < h.time_offset_sigma < 2e-3
    assert abs(h.time_offset - offset) < 4 * h.time_offset_sigma
    xi = error_of(world, found)
    assert xi @ np.linalg.solve(found.relative_pose.covariance, xi) < 30


def test_the_other_way_round_the_offset_is_the_opposite(tmp_path):
    run = run_of(tmp_path, hallway_world(4, OFFSET))
    there, back = (measure_pair(run, run.stances[0], *pair, FrontendOptions()).homography for pair in ("AB", "BA"))
    assert abs(there.time_offset + back.time_offset) < 2 * there.time_offset_sigma


def steady(tmp_path, place, clock_sigma, noise=0.2, n=200):
    """A run whose markers are at `place(t)` (n, 2) [m] at constant speed; B's clock is late by `OFFSET`."""
    rng, scene = np.random.default_rng(5), Scene()
    team = msgspec.structs.replace(reference_team(), clock_sigma=clock_sigma)
    t = np.arange(n) / 30.0
    stance = Stance(0, EPOCH - 0.5, EPOCH + t[-1] + 0.5, ("A", "B"), ("C",))
    points = [np.column_stack([place(t, side), np.full(n, 0.15)]) for side in (-0.125, 0.125)]
    path = tmp_path / "steady.mcap"
    with RunWriter(path, team) as writer:
        writer.write(stance)
        for robot, which in (("A", 0), ("B", 1)):
            uv = np.stack([scene.seen(p)[which] for p in points], axis=1)
            uv = uv + noise * rng.normal(size=uv.shape)
            C = np.broadcast_to(noise**2 * np.eye(2), (2, 2, 2))
            for time, pixels in zip(EPOCH + t + which * OFFSET, uv, strict=True):
                writer.write(
                    Detections(robot, time, pixels, C, ("C/0", "C/1"), np.zeros(2, np.uint8), np.ones(2), np.ones(2))
                )
    run = open_run(path)
    return measure_pair(run, run.stances[0], "A", "B", FrontendOptions())


def line(t, side):
    return np.column_stack([0.9 + 0.15 * t, np.full(len(t), side)])


def arc(t, side):
    return np.column_stack([1.3 + (0.3 + side) * np.cos(0.7 * t), (0.3 + side) * np.sin(0.7 * t)])


@pytest.mark.parametrize("place", [line, arc])
def test_constant_speed_is_told_and_its_doubt_is_in_the_pose(tmp_path, place):
    assert CAMERA.fx == reference_team()["A"].camera.fx
    found = steady(tmp_path, place, clock_sigma=OFFSET)
    h = found.homography
    assert "not observable" in h.warning and "stop and go" in h.warning
    assert found.offset_evidence is None
    assert h.time_offset_sigma == pytest.approx(OFFSET)
    xi = gtsam.Pose3.Logmap(gtsam.Pose3(found.relative_pose.T_i_j).between(gtsam.Pose3(Scene().T_i_j)))
    assert xi @ np.linalg.solve(found.relative_pose.covariance, xi) < 30
    sure = steady(tmp_path, place, clock_sigma=1e-4)
    assert np.trace(sure.relative_pose.covariance) < 0.7 * np.trace(found.relative_pose.covariance)


def test_all_stances_share_one_offset(tmp_path):
    world = hallway_world(6, OFFSET, stances=3, depth="tracks", points=100)
    run = run_of(tmp_path, world)
    alone = [measure_pair(run, stance, *stance.observers, FrontendOptions()) for stance in run.stances]
    shared, warnings = share_clock_offsets(alone, run.team.clock_sigma)
    assert warnings == []
    offsets = [one.homography.time_offset for one in shared]
    assert offsets[0] == pytest.approx(-offsets[1]) and offsets[0] == pytest.approx(offsets[2])
    sigma = shared[0].homography.time_offset_sigma
    assert sigma < 0.75 * min(one.homography.time_offset_sigma for one in alone)
    assert abs(offsets[0] - OFFSET) < 4 * sigma
    # a run learns the noise as well
    assert [one.homography.time_offset for one in solve(run).measurements] == pytest.approx(offsets, abs=0.1 * sigma)


def test_stances_that_disagree_are_told_and_trusted_less():
    prior = ClockOffset(0.0, 0.02)
    agreeing, chance = fuse([ClockOffset(0.010, 1e-3), ClockOffset(0.011, 1e-3)], prior)
    assert chance > 0.1
    assert agreeing.value == pytest.approx(0.0105, rel=0.01)
    assert agreeing.sigma == pytest.approx(1e-3 / np.sqrt(2), rel=0.01)
    apart, chance = fuse([ClockOffset(0.005, 1e-3), ClockOffset(0.015, 1e-3)], prior)
    assert chance < 1e-3
    assert apart.sigma > 4e-3
    assert fuse([], prior) == (prior, 1.0)


def test_clocks_that_nobody_set_are_refused_in_words():
    with pytest.raises(DegenerateGeometry, match="synchronise the clocks"):
        require_searchable(ClockOffset(0.0, 3.0))


def test_clocks_that_agree_are_left_alone(tmp_path):
    path = tmp_path / "run.mcap"
    simulate("hallway", path, stances=1, points=40, seed=2)
    run = open_run(path)
    found = measure_pair(run, run.stances[0], "A", "B", FrontendOptions())
    assert (found.homography.time_offset, found.homography.time_offset_sigma) == (0.0, 0.0)
    assert found.at_offset is None and found.offset_evidence is None
    assert share_clock_offsets([found], 0.0) == ((found,), [])
