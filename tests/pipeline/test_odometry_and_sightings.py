"""What wheels say of a robot's way, and where a robot stands whose markers are seen."""

import dataclasses

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from coloc_graph.frontend import FrontendOptions, WheelTrack, measure_pair, sight, sight_movers
from coloc_graph.frontend.homography.plane import plane_from_mount
from coloc_graph.frontend.pairing.clock_offset import ClockOffset
from coloc_graph.frontend.tracks.track import Track
from coloc_graph.geometry.lie import floor_pose, se3_inverse
from coloc_graph.pipeline.batch import solve
from coloc_graph.run import OdometrySample, Stance, open_run, read_truth
from coloc_graph.simulation import reference_team
from coloc_graph.simulation.paths import PathBuilder, drive
from coloc_graph.simulation.wheels import odometry


def driven(seed, waypoints=((0, 0, 0), (1.5, 0.4, 0.8), (2.0, -0.5, -1.0))):
    """A robot's true path through places, and what its wheels made of it."""
    rng = np.random.default_rng(seed)
    builder = PathBuilder(100.0, waypoints[0], 0.0, rng)
    leg, _ = drive(np.array(waypoints, float), 101.0)
    builder.follow(leg)
    path, end = builder.path(), float(leg.times[-1])
    wheels = WheelTrack("A", odometry(path, [(101.0, end)], rng).records("A", 0.0, end + 1, 0.0))
    return path, wheels, end


def planar(T):
    return np.array([np.arctan2(T[1, 0], T[0, 0]), T[0, 3], T[1, 3]])


def test_nees_of_odometry_between_any_two_instants_is_inside_its_interval():
    nees = []
    for seed in range(150):
        path, wheels, end = driven(seed)
        for start, stop in ((100.0, end + 5), (101.0 + 0.31 * (end - 101), 101.0 + 0.77 * (end - 101))):
            way = wheels.between(0, 1, start, stop)
            T = path.pose_at(np.array([start, stop]))
            off = planar(se3_inverse(way.T_before_after) @ se3_inverse(T[0]) @ T[1])
            nees.append(off @ np.linalg.solve(way.covariance, off))
    for part in (nees[::2], nees[1::2]):  # the whole way, and one that begins and ends between samples
        low, high = chi2.ppf([0.005, 0.995], 3 * len(part))
        assert low < sum(part) < high


def test_a_way_by_hand():
    # 1 m ahead, then a left turn on the spot by 90 deg, then 1 m ahead: at the end (1, 1, 90 deg). Each increment
    # errs by 0.02 m along itself and the turn by 0.01 rad; in the body at the end, x is along the last metre: the
    # last increment's 0.02 along x, the first's 0.02 along -y, and the turn swings the last metre by 0.01 m along y.
    C = [np.diag([4e-4, 1e-12, 1e-12]), np.diag([1e-12, 1e-12, 1e-4]), np.diag([4e-4, 1e-12, 1e-12])]
    poses = [(1, 0, 0), (1, 0, np.pi / 2), (1, 1, np.pi / 2)]
    samples = [OdometrySample("A", 0.0, np.zeros(3), np.zeros((3, 3)))]
    samples += [
        OdometrySample("A", 1.0 + k, np.array(p, float), c) for k, (p, c) in enumerate(zip(poses, C, strict=True))
    ]
    way = WheelTrack("A", samples).between(3, 4, 0.0, 9.0)
    np.testing.assert_allclose(way.T_before_after, floor_pose(1, 1, np.pi / 2), atol=1e-12)
    expected = np.diag([1e-4, 4e-4, 4e-4 + 1e-4])
    expected[0, 2] = expected[2, 0] = 1e-4  # turned too far left, it ends too far left
    np.testing.assert_allclose(way.covariance, expected + np.diag([1e-6, 2.5e-7, 2.5e-7]), atol=1e-9)
    assert (way.robot, way.before, way.after) == ("A", 3, 4)


def test_without_samples_before_the_end_there_is_no_way():
    _, wheels, _ = driven(0)
    assert wheels.between(0, 1, 10.0, 20.0) is None
    assert WheelTrack("A", []).between(0, 1, 0.0, 1e9) is None


def test_where_a_robot_is_is_unknown_only_in_a_gap_in_which_it_drove():
    places = {0.0: 0.0, 1.0: 0.3, 5.0: 0.305, 9.0: 0.6, 9.5: 0.9}  # x [m] by time [s]
    track = WheelTrack("A", [OdometrySample("A", t, np.array([x, 0.0, 0.0]), np.eye(3)) for t, x in places.items()])
    at = np.array([-1.0, 0.0, 0.5, 3.0, 5.0, 7.0, 9.25, 9.5, 11.0])
    assert track.covers(at).tolist() == [True, True, True, True, True, False, True, True, True]
    assert WheelTrack("A", []).covers(at).all()


def test_clocks_that_differ_widen_the_way_of_a_robot_that_drives():
    _, wheels, end = driven(0)
    half = 101.0 + 0.31 * (end - 101)
    exact, late = (wheels.between(0, 1, 100.0, half, sigma) for sigma in (0.0, 0.05))
    at_rest = wheels.between(0, 1, 100.0, end + 5, 0.05)
    assert late.covariance[1, 1] > exact.covariance[1, 1]
    assert np.array_equal(at_rest.covariance, wheels.between(0, 1, 100.0, end + 5).covariance)


def seen_from(rng, observer, mover, T_observer_seen, names=("C/0", "C/1"), noise=0.3):
    """Tracks of two markers of a robot that stands still for an instant each at these poses (n, 4, 4)."""
    tracks = []
    T_camera_body = se3_inverse(observer.mount.T_body_camera)
    for name, p in zip(names, mover.markers.p_body, strict=True):
        at = T_observer_seen[:, :3, :3] @ p + T_observer_seen[:, :3, 3]
        uv, _ = observer.camera.project(at @ T_camera_body[:3, :3].T + T_camera_body[:3, 3])
        n = len(uv)
        C = np.broadcast_to(noise**2 * np.eye(2), (n, 2, 2))
        tracks.append(
            Track(observer.name, name, 0.1 * np.arange(n), uv + noise * rng.standard_normal((n, 2)), C, np.zeros(n))
        )
    return tracks


STANCE = Stance(0, 0.0, 100.0, ("A", "B"), ("C",))


@pytest.mark.parametrize("tolerance", [0.0, 0.3])
def test_nees_of_sightings_is_inside_its_interval(rng, tolerance):
    team = reference_team()
    observer, mover = team["A"], team["C"]
    mount = msgspec.structs.replace(
        observer.mount, tilt_sigma_deg=tolerance, roll_sigma_deg=tolerance, height_sigma=0.01 * tolerance
    )
    stated = msgspec.structs.replace(observer, mount_if_any=mount)
    plane = plane_from_mount(mount, mover.markers, team.floor)
    nees = []
    for _ in range(200):
        truth = floor_pose(rng.uniform(0.7, 1.6), rng.uniform(-0.2, 0.2), rng.uniform(-3, 3))
        tilt, roll, height = rng.standard_normal(3) * (tolerance, tolerance, 0.01 * tolerance)
        true_mount = msgspec.structs.replace(
            mount, tilt_deg=mount.tilt_deg + tilt, roll_deg=mount.roll_deg + roll, height=mount.height + height
        )
        tracks = seen_from(rng, msgspec.structs.replace(observer, mount_if_any=true_mount), mover, truth[None])
        seen = sight(STANCE, stated, mover, tracks, plane)
        off = planar(se3_inverse(seen.T_observer_seen) @ truth)
        nees.append(off @ np.linalg.solve(seen.covariance, off))
    low, high = chi2.ppf([0.005, 0.995], 3 * len(nees))
    assert low < sum(nees) < high


@pytest.mark.parametrize(("value", "seconds"), [(0.0, 0.1), (0.3, 0.02)])
def test_nees_of_a_mover_contains_the_uncertainty_of_the_clock_of_who_saw_it(rng, value, seconds):
    """It drives and turns: a pose at a time by the reference robot's clock is known no better than that clock."""
    team = reference_team()
    observer, mover = team["A"], team["C"]
    plane = plane_from_mount(observer.mount, mover.markers, team.floor)
    nees, stamps = [], 0.1 * np.arange(8)
    for _ in range(100):
        x, y, yaw, speed, turning = rng.uniform((0.8, -0.1, -3, -0.2, -0.5), (1.4, 0.1, 3, 0.2, 0.5))

        def at(times, x=x, y=y, yaw=yaw, speed=speed, turning=turning):
            return floor_pose(x, y, yaw) @ floor_pose(speed * times, 0.0, turning * times)

        late = value + seconds * rng.standard_normal()
        tracks = seen_from(rng, observer, mover, at(stamps - late), noise=0.1)
        seen = sight(STANCE, observer, mover, tracks, plane, clock=ClockOffset(value, seconds))
        off = planar(se3_inverse(seen.T_observer_seen) @ at(np.array(seen.time)))
        nees.append(off @ np.linalg.solve(seen.covariance, off))
    low, high = chi2.ppf([0.001, 0.999], 3 * len(nees))
    assert low < sum(nees) < high


def test_of_all_instants_the_one_that_is_seen_best_is_taken(rng):
    team = reference_team()
    poses = floor_pose(np.array([1.5, 0.8, 1.9]), 0.0, 0.0)
    tracks = seen_from(rng, team["A"], team["C"], poses)
    plane = plane_from_mount(team["A"].mount, team["C"].markers, team.floor)
    assert sight(STANCE, team["A"], team["C"], tracks, plane).time == pytest.approx(0.1)
    assert sight(STANCE, team["A"], team["C"], tracks, plane, at=0.19).time == pytest.approx(0.2)


@pytest.mark.parametrize("reverse", [False, True])
def test_lights_without_names_are_told_apart_by_the_way_the_wheels_drove(rng, reverse):
    """A robot that backs up looks the same as one that drives ahead with its markers exchanged, but for its wheels."""
    team = reference_team()
    x = np.linspace(0.8, 1.4, 30) if not reverse else np.linspace(1.4, 0.8, 30)
    poses = floor_pose(x, 0.05, 0.0)
    tracks = seen_from(rng, team["A"], team["C"], poses, names=("", ""))
    plane = plane_from_mount(team["A"].mount, team["C"].markers, team.floor)
    turned = 0.7  # of the odometry frame
    c, s = np.cos(turned), np.sin(turned)
    wheels = WheelTrack(
        "C", [OdometrySample("C", 0.1 * k, np.array([c * at, s * at, turned]), np.eye(3)) for k, at in enumerate(x)]
    )
    for given in (tracks, tracks[::-1]):
        seen = sight(STANCE, team["A"], team["C"], given, plane, wheels)
        assert abs(planar(seen.T_observer_seen)[0]) < 0.2
    assert sight(STANCE, team["A"], team["C"], tracks, plane) is None  # nothing tells
    still = WheelTrack("C", [OdometrySample("C", 0.1 * k, np.zeros(3), np.eye(3)) for k in range(30)])
    assert sight(STANCE, team["A"], team["C"], tracks, plane, still) is None


def test_a_robot_with_one_marker_has_no_heading_to_be_seen(rng):
    team = reference_team()
    markers = msgspec.structs.replace(team["C"].markers, positions=((0.0, 0.1),))
    one = msgspec.structs.replace(team["C"], markers=markers)
    plane = plane_from_mount(team["A"].mount, markers, team.floor)
    tracks = seen_from(rng, team["A"], team["C"], floor_pose(np.array([1.0]), 0.0, 0.0))
    assert sight(STANCE, team["A"], one, tracks, plane) is None


def test_markers_that_are_not_their_span_apart_are_no_robot(rng):
    team = reference_team()
    wide = msgspec.structs.replace(team["C"].markers, positions=((0.0, 0.4), (0.0, -0.4)))
    tracks = seen_from(rng, team["A"], team["C"], floor_pose(np.array([1.0]), 0.0, 0.0))
    plane = plane_from_mount(team["A"].mount, wide, team.floor)
    assert sight(STANCE, team["A"], msgspec.structs.replace(team["C"], markers=wide), tracks, plane) is None


def test_a_run_gives_one_sighting_of_the_mover_a_stance_near_its_truth(hallway):
    run = open_run(hallway)
    seen = []
    for stance in run.stances:
        seen += sight_movers(run, stance, [measure_pair(run, stance, *stance.observers, FrontendOptions())], {})
    assert [(one.stance, one.seen) for one in seen] == [(k, "C") for k in range(8)]
    truth = read_truth(hallway)
    for one in seen:
        poses = []
        for robot in (one.observer, "C"):
            index = np.searchsorted(truth[robot].times, one.time + 1e-6, side="right") - 1
            poses.append(truth[robot].T_world_body[index])
        off = planar(se3_inverse(one.T_observer_seen) @ se3_inverse(poses[0]) @ poses[1])
        assert np.abs(off[1:]).max() < 0.05  # the truth's samples are 2 cm apart


def test_images_give_the_mover_a_pose_too_though_its_lights_are_alike(tmp_path):
    from coloc_graph.results.writer import assess
    from coloc_graph.simulation import simulate

    simulate("hallway", tmp_path / "run.mcap", depth="images", stances=2, points=80, seed=2)
    solution = solve(open_run(tmp_path / "run.mcap"))
    assert not solution.warnings  # as of a clock, of which two short drives tell nothing
    accuracy, _ = assess(solution)
    (mover,) = [row for row in accuracy.robots if row.robot == "C"]
    assert mover.ate < 0.02 and mover.heading_error_deg < 4
    assert len(solution.estimate.trajectories["C"]) == 2


def test_without_a_floor_there_are_neither_sightings_nor_wheels(hallway, copied, tmp_path):
    team = msgspec.structs.replace(open_run(hallway).team, floor=None)
    solution = solve(open_run(copied(hallway, tmp_path / "run.mcap", team=team)))
    assert not [m for m in solution.estimate.graph.measurements if dataclasses.is_dataclass(m) and m.T_i_j is None]
    assert len(solution.estimate.graph.measurements) == len(solution.estimate.graph.relative_poses)
