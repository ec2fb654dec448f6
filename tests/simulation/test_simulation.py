"""Simulated worlds: the geometry they promise, and runs whose truth and detections agree."""

import numpy as np
import pytest

from coloc_graph.errors import InputError
from coloc_graph.evaluation.truth import true_poses
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.run import RunWriter, open_run, read_true_team, read_truth
from coloc_graph.simulation import (
    Imperfections,
    build_world,
    hallway,
    meander,
    observe,
    reference_team,
    simulate,
    single_step,
    six_step,
)
from coloc_graph.simulation.paths import SPEED, TURN_RATE, drive, tilt_rotation, travel
from coloc_graph.simulation.recording import record
from coloc_graph.team.shared_view import View

FAULTY = Imperfections(
    mount_sigma_deg=0.5, height_sigma=0.003, span_sigma=0.001, floor_sigma_deg=0.1, clock_offset=0.02, time_jitter=0.001
)


def test_the_reference_rig_is_that_of_the_design():
    team = reference_team()
    assert team.names == ("A", "B", "C")
    assert team.reference == "A"
    assert team["B"].markers.span == 0.25
    assert team["A"].mount.T_body_camera[2, 3] == 0.40


def test_table_1_has_the_papers_distances():
    xy = np.array(six_step().poses)[:, :2]
    cm = 100 * np.linalg.norm(np.diff(xy, axis=0), axis=1)
    assert cm == pytest.approx([77.14, 85.76, 78.29, 88.16, 80.47, 89.82], abs=1.0)
    assert 100 * np.linalg.norm(xy[6] - xy[0]) == pytest.approx(109.73, abs=0.01)


def test_the_hallway_has_40_stances_and_a_longer_one_begins_the_same():
    assert hallway().stances == 40
    longer, shorter = (hallway(n, np.random.default_rng(1)).poses for n in (9, 4))
    assert longer[:5] == shorter


def test_leap_frogging_robots_alternate_and_the_anchor_has_stayed_put():
    world = build_world(hallway(5), points=10)
    assert [s.anchors for s in world.stances] == [(), ("B",), ("A",), ("B",), ("A",)]
    for before, after in zip(world.stances, world.stances[1:], strict=False):
        assert set(before.observers) == set(after.observers) == {"A", "B"}
        assert before.movers == after.movers == ("C",)
        assert before.end < after.start
        anchor = world.paths[after.anchors[0]]
        poses = anchor.pose_at(np.linspace(before.start, after.end, 50))
        assert np.ptp(poses, axis=0).max() == 0
        mover = next(robot for robot in after.observers if robot not in after.anchors)
        moved = world.paths[mover].pose_at([before.end, after.start])[:, :3, 3]
        assert 0.2 < np.linalg.norm(moved[1] - moved[0]) < 0.6


def test_observers_stand_still_where_the_scenario_puts_them():
    world = build_world(six_step(), points=10, imperfections=FAULTY, seed=2)
    for k, stance in enumerate(world.stances):
        for robot, n in world.scenario.standing(k).items():
            poses = world.paths[robot].pose_at(np.linspace(stance.start, stance.end, 30))
            assert np.ptp(poses, axis=0).max() == 0
            assert poses[0, :3, 3] == pytest.approx([*world.scenario.poses[n][:2], 0.0], abs=1e-9)
            assert poses[0, :3, :3] @ poses[0, :3, :3].T == pytest.approx(np.eye(3), abs=1e-12)


def test_a_robot_neither_drives_nor_turns_faster_than_it_can():
    world = build_world(hallway(3), points=60)
    for robot, path in world.paths.items():
        speed, turn_rate = (meander.SPEED, meander.TURN_RATE) if robot == "C" else (SPEED, TURN_RATE)
        gone = np.diff(path.times) > 0
        step = np.diff(path.knots, axis=0)[gone] / np.diff(path.times)[gone, None]
        assert np.hypot(step[:, 0], step[:, 1]).max() <= speed * (1 + 1e-4)
        assert np.abs(step[:, 2]).max() <= turn_rate * (1 + 1e-4)
        assert np.diff(path.times).min() >= 0
        jump = np.diff(path.knots, axis=0)[~gone]
        assert np.abs(jump).max(initial=0) < 1e-6


def test_the_hallway_is_a_mission_of_at_most_20_minutes_with_its_points_spread_over_the_view():
    world = build_world(hallway(40), seed=3)
    assert 15 * 60 < world.stances[-1].end - world.stances[0].start < 20 * 60
    for k in range(0, 40, 13):
        for tracks in observe(world, k):
            assert tracks.seen.sum() == 100
            assert (tracks.uv[tracks.seen].std(axis=0) > (50, 10)).all()


def test_driving_reaches_every_pose_and_goes_where_it_faces():
    poses = np.array([(0, 0, 0), (1, 0, 2), (1, 1, -3), (-1, 0.5, 0), (-1, 0.5, 1)], float)
    for reverse in (False, True):
        leg, reached = drive(poses, 5.0, reverse)
        off = leg.knots[reached] - poses
        assert off[:, :2] == pytest.approx(np.zeros((5, 2)), abs=1e-12)
        assert np.cos(off[:, 2]) == pytest.approx(np.ones(5))
        step = np.diff(leg.knots, axis=0)
        facing = np.stack([np.cos(leg.knots[1:, 2]), np.sin(leg.knots[1:, 2])], axis=1)
        along = (step[:, :2] * facing).sum(axis=1)
        assert np.abs(along) == pytest.approx(np.hypot(*step[:, :2].T), abs=1e-12)
        assert reverse or (along > -1e-12).all()
    leg = travel(poses[:3, :2], 0.0).cut(2.0)
    assert leg.times[-1] == 2.0
    assert leg.knots[-1] == pytest.approx([0.4, 0, 0])


def test_tilting_is_pitch_about_y_then_roll_about_x():
    R = tilt_rotation(0.1, 0.2)
    assert pytest.approx([np.cos(0.2), 0, -np.sin(0.2)]) == R @ [1, 0, 0]
    assert np.linalg.det(R) == pytest.approx(1)


@pytest.mark.parametrize(("what", "points"), [(single_step(), 250), (six_step(), 101), (hallway(3), 100)])
def test_each_stance_has_exactly_the_points_asked_for(what, points):
    world = build_world(what, points=points, seed=5)
    for k in range(what.stances):
        first, second = observe(world, k)
        assert (first.seen & second.seen).sum() == points
        assert (first.stamps == second.stamps).all()
        box, (x, y) = what.box, what.middle(k)
        P = world.markers_world("C", world.captures[k][0].times)[first.seen]
        assert (P[:, 0] >= x + box.x[0] - 1e-6).all()
        assert (P[:, 0] <= x + box.x[1] + 1e-6).all()
        assert (np.abs(P[:, 1] - y) <= box.y[1] + 1e-6).all()


def test_marker_points_are_spread_evenly_over_the_common_view():
    found = []
    for seed in range(12):
        world = build_world(single_step(), points=250, seed=seed)
        tracks, _ = observe(world, 0)
        found.append(world.markers_world("C", world.captures[0][0].times)[tracks.seen][:, :2])
    views = [capture.view for capture in world.captures[0]]
    rng = np.random.default_rng(0)
    P = np.column_stack([rng.uniform(0.2, 2.5, 40_000), rng.uniform(-1.5, 1.5, 40_000), np.full(40_000, 0.15)])
    even = P[views[0].project(P)[1] & views[1].project(P)[1]][:, :2]
    points = np.concatenate(found)
    # 3000 points in pairs: the means of an even spread are good to 1.5 cm
    assert points.mean(axis=0) == pytest.approx(even.mean(axis=0), abs=0.05)
    assert points.std(axis=0) == pytest.approx(even.std(axis=0), abs=0.03)


def test_the_noise_of_detections_is_the_noise_stated():
    world = build_world(hallway(6), points=200, imperfections=FAULTY, seed=3)
    squares = []
    for k in range(6):
        for capture, tracks in zip(world.captures[k], observe(world, k), strict=True):
            true, _ = capture.view.project(world.markers_world("C", capture.times))
            squares.append((((tracks.uv - true) / tracks.sigma) ** 2)[tracks.seen].ravel())
    chi2 = np.concatenate(squares)
    assert chi2.mean() == pytest.approx(1, abs=4 * np.sqrt(2 / len(chi2)))


def test_other_noise_leaves_the_geometry_as_it_was():
    a, b = (build_world(hallway(2), points=50, imperfections=Imperfections(noise_px=n), seed=1) for n in (0.1, 1.0))
    assert (a.paths["C"].knots == b.paths["C"].knots).all()
    first, second = observe(a, 0)[0], observe(b, 0)[0]
    assert second.uv.std() > 0
    exact, _ = a.captures[0][0].view.project(a.markers_world("C", a.captures[0][0].times))
    assert second.uv - exact == pytest.approx(10 * (first.uv - exact), abs=1e-9)


def test_the_truth_is_drawn_from_the_tolerances_that_are_stated():
    spreads = []
    for seed in range(300):
        world = build_world(single_step(), points=6, imperfections=FAULTY, seed=seed)
        for stated, true in zip(world.team.robots, world.true_team.robots, strict=True):
            m, s = true.mount, stated.mount
            assert (s.tilt_deg, s.roll_deg, s.height) == (20.0, 0.0, 0.40)
            spreads.append(
                [
                    (m.tilt_deg - s.tilt_deg) / s.tilt_sigma_deg,
                    (m.roll_deg - s.roll_deg) / s.roll_sigma_deg,
                    (m.height - s.height) / s.height_sigma,
                    (true.markers.span - stated.markers.span) / stated.markers.span_sigma,
                ]
            )
    assert np.std(spreads, axis=0) == pytest.approx(np.ones(4), abs=0.1)
    assert np.mean(spreads, axis=0) == pytest.approx(np.zeros(4), abs=0.12)
    assert world.team.floor.tilt_sigma_deg == 0.1


def test_the_true_team_is_the_stated_one_where_nothing_is_imperfect():
    world = build_world(single_step(), points=6)
    assert world.true_team == world.team


def test_the_uneven_floor_tilts_standing_and_moving_robots_alike():
    world = build_world(hallway(20), points=20, imperfections=Imperfections(floor_sigma_deg=0.1), seed=1)
    for robot in "ABC":
        tilts = np.rad2deg(world.paths[robot].tilts)
        assert tilts.std() == pytest.approx(0.1, rel=0.25)


def test_late_clocks_shift_stamps_and_not_what_is_seen():
    on_time, late = (
        build_world(single_step(), points=30, imperfections=Imperfections(clock_offset=o), burst=3) for o in (0.0, 0.05)
    )
    for a, b in zip(on_time.captures[0], late.captures[0], strict=True):
        assert (a.times == b.times).all()
        assert b.stamps - a.stamps == pytest.approx(0.05 if a.robot == "B" else 0.0, abs=1e-6)
    assert (observe(on_time, 0)[1].uv == observe(late, 0)[1].uv).all()


def test_jittered_captures_see_the_marker_where_it_then_was():
    world = build_world(single_step(), points=60, imperfections=Imperfections(time_jitter=0.01, noise_px=0.0))
    a, b = world.captures[0]
    assert np.std(a.times - b.times) == pytest.approx(0.01 * np.sqrt(2), rel=0.3)
    for capture, tracks in zip((a, b), observe(world, 0), strict=True):
        exact, _ = capture.view.project(world.markers_world("C", capture.times))
        assert tracks.uv == pytest.approx(exact, abs=1e-9)
    # bursts, so that a track tells how fast it moves
    assert np.min(np.diff(np.sort(a.times))) < 0.1


def check_against_file(path, k, sigma):
    """Reduced chi2 of a stance's detections, by nothing but what is in the file (clocks must agree)."""
    run, truth, true = open_run(path), read_truth(path), read_true_team(path)
    stance, squares = run.stances[k], []
    path_c = truth["C"]
    for robot in stance.observers:
        at = int(np.argmin(np.abs(truth[robot].times - stance.start)))
        view = View(true[robot].camera, truth[robot].T_world_body[at] @ true[robot].mount.T_body_camera)
        for found in run.detections(robot, stance.start, stance.end):
            i = int(np.argmin(np.abs(path_c.times - found.time)))
            if abs(path_c.times[i] - found.time) > 0.004:  # 0.8 mm of way
                continue
            p_body = true["C"].markers.p_body[[int(name.split("/")[1]) for name in found.markers]]
            T = path_c.T_world_body[i]
            uv, _ = view.project(p_body @ T[:3, :3].T + T[:3, 3])
            squares.append(((found.uv - uv) / sigma).ravel() ** 2)
    assert len(squares) > 15
    return float(np.mean(np.concatenate(squares)))


def test_truth_and_detections_in_a_run_agree(tmp_path):
    out = tmp_path / "run.mcap"
    wrong = Imperfections(mount_sigma_deg=1.0, height_sigma=0.005, floor_sigma_deg=0.2, noise_px=1.0)
    simulate("hallway", out, stances=2, points=400, imperfections=wrong, seed=8)
    assert check_against_file(out, 1, 1.0) == pytest.approx(1.0, abs=0.35)
    run = open_run(out)
    assert not run.warnings
    assert run.team["A"].mount.tilt_deg == 20.0
    assert run.team["A"].mount.tilt_sigma_deg == 1.0
    assert read_true_team(out)["A"].mount.tilt_deg != 20.0
    for stance in run.stances:
        names = [d.markers for d in run.detections("A", stance.start, stance.end)]
        assert {name for markers in names for name in markers} == {"C/0", "C/1"}
        assert sum(map(len, names)) == 400


def increments(poses):
    """x, y, yaw of each planar pose in the one before."""
    step, yaw = np.diff(poses, axis=0), poses[:-1, 2]
    along = np.cos(yaw) * step[:, 0] + np.sin(yaw) * step[:, 1]
    across = np.cos(yaw) * step[:, 1] - np.sin(yaw) * step[:, 0]
    return np.column_stack([along, across, (step[:, 2] + np.pi) % (2 * np.pi) - np.pi])


def test_truth_is_exact_at_any_time_also_where_a_robot_turns_back(tmp_path):
    """At 10 Hz alone a mover that reverses was up to 10 mm off between two samples: 25 sigmas of its estimate."""
    world = build_world(hallway(3), seed=3)
    with RunWriter(tmp_path / "run.mcap", world.team) as writer:
        record(world, writer, "tracks")
    truth, path = read_truth(tmp_path / "run.mcap"), world.paths["C"]
    for stance in world.stances:
        times = np.linspace(stance.start, stance.end, 997)
        T_world_body = path.pose_at(times)
        assert np.abs(true_poses(truth, Trajectory("C", times, T_world_body)) - T_world_body).max() < 1e-9


def test_odometry_errs_as_much_as_its_covariance_says(tmp_path):
    out = tmp_path / "run.mcap"
    simulate("hallway", out, stances=3, points=60, seed=2)
    run, truth = open_run(out), read_truth(out)["C"]
    samples = list(run.odometry("C"))
    times = np.array([s.time for s in samples])
    at = np.searchsorted(truth.times, times - 1e-4)
    assert np.abs(truth.times[at] - times).max() < 1e-6
    T = truth.T_world_body[at]
    true = np.column_stack([T[:, 0, 3], T[:, 1, 3], np.arctan2(T[:, 1, 0], T[:, 0, 0])])
    error = increments(np.array([s.pose for s in samples])) - increments(true)
    variances = np.array([np.diag(s.covariance) for s in samples[1:]])
    assert (error**2 / variances).mean(axis=0) == pytest.approx(np.ones(3), abs=0.15)
    moving = [m.moving for m in run.motions("C")]
    assert moving == [True, False] * 5  # three stances, and twice between


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(tmp_path):
    for depth in ("tracks", "images"):
        files = [tmp_path / f"{depth}{i}.mcap" for i in range(3)]
        for file, seed in zip(files, (1, 1, 2), strict=True):
            simulate("six-step", file, depth=depth, stances=2, points=12, seed=seed, imperfections=FAULTY)
        one, same, other = (file.read_bytes() for file in files)
        assert one == same
        assert one != other


def test_a_run_of_images_has_frames_of_both_observers_in_every_stance(tmp_path):
    out, steps = tmp_path / "run.mcap", []
    world = simulate(
        "hallway",
        out,
        depth="images",
        stances=2,
        points=20,
        image_format="png",
        progress=lambda *done: steps.append(done),
    )
    assert steps == [(1, 2), (2, 2)]
    run = open_run(out)
    assert run.team["A"].camera.distortion
    assert not run.has_images("C")
    for k, stance in enumerate(run.stances):
        for capture in world.captures[k]:
            images = list(run.images(capture.robot, stance.start, stance.end))
            assert len(images) == 10
            assert [i.time for i in images] == pytest.approx(capture.stamps.tolist(), abs=1e-6)
            assert images[0].pixels.shape == (240, 320)
            assert images[0].pixels.max() > 60


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"scenario_name": "corridor"}, "corridor"),
        ({"points": 3}, "points"),
        ({"stances": 0}, "stances"),
        ({"depth": "video"}, "depth"),
        ({"image_format": "gif"}, "image_format"),
        ({"seed": -1}, "seed"),
        ({"fps": 0.0, "depth": "images"}, "fps"),
        ({"l": 0.5}, "single-step"),
        ({"scenario_name": "single-step", "l": -1.0}, "`l`"),
        ({"scenario_name": "single-step", "stances": 2}, "one stance"),
        ({"scenario_name": "six-step", "stances": 7}, "hallway"),
        ({"scenario_name": "single-step", "l": 1.0, "theta_deg": -90.0}, "no common view"),
        ({"scenario_name": "single-step", "theta_deg": -90.0, "depth": "images"}, "no common view"),
    ],
)
def test_a_wrong_argument_is_one_clear_sentence_and_leaves_no_file(tmp_path, arguments, says):
    arguments = {"scenario_name": "hallway", **arguments}
    with pytest.raises(InputError, match=says) as error:
        simulate(out=tmp_path / "run.mcap", **arguments)
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["mount_sigma_deg", "height_sigma", "span_sigma", "floor_sigma_deg", "noise_px"])
def test_a_negative_or_infinite_sigma_is_refused(name):
    with pytest.raises(InputError, match=name):
        Imperfections(**{name: -0.1})
    with pytest.raises(InputError, match=name):
        Imperfections(**{name: float("inf")})
