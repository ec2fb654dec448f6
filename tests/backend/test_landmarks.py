"""Landmarks in the graph: what they tie, what a map adds, what is refused; in results, on disk, and in the viewer."""

import dataclasses

import gtsam
import numpy as np
import pytest
from msgspec.structs import replace
from teams import graph_of_team, largest_difference, of_stance, planar_nees, team_of

from coloc_graph.backend import Estimator, PoseGraph, chain, diagnose, joint, smooth
from coloc_graph.backend.landmarks import MAP, StaticPose, landmarks_of, map_positions
from coloc_graph.errors import MeasurementError
from coloc_graph.exchange.dot import to_dot
from coloc_graph.exchange.g2o import read_g2o
from coloc_graph.exchange.g2o_writer import write_g2o
from coloc_graph.frontend import Track, plane_from_mount, sight
from coloc_graph.frontend.sighting import Marked
from coloc_graph.geometry.lie import floor_pose, se3_exp, se3_inverse
from coloc_graph.measurements import Odometry, Sighting
from coloc_graph.run import Stance
from coloc_graph.simulation import reference_team
from coloc_graph.team import Floor, Landmark, Markers, Mount, Tag

LIGHTS = Markers(height=0.15, positions=((0.0, 0.2), (0.0, -0.2)))
#: How well a landmark is sighted here: heading [rad], x, y [m].
SEEN = np.diag(np.square([0.01, 0.004, 0.004]))


def landmark(name, place=None, sigma=0.0, sigma_deg=0.0):
    if place is None:
        return Landmark(name=name, markers=LIGHTS)
    x, y, yaw = place
    return Landmark(name=name, markers=LIGHTS, position=(x, y), yaw_deg=float(np.rad2deg(yaw)),
                    position_sigma=sigma, yaw_sigma_deg=sigma_deg)  # fmt: skip


def sighted(team, observer, stance, place, name, rng=None, off=(0.0, 0.0, 0.0)):
    """A sighting of what stands at a place (x, y, yaw) in the world, by a robot at its true pose."""
    T_i_j = se3_inverse(team.T_world_body[observer, stance]) @ floor_pose(*place)
    xi = np.zeros(6)
    xi[2:5] = np.asarray(off) + (0 if rng is None else np.sqrt(SEEN.diagonal()) * rng.standard_normal(3))
    return Sighting(stance, observer, name, 10.0 * stance, gtsam.Pose3(T_i_j @ se3_exp(xi)), SEEN)


def with_landmarks(team, sightings, *landmarks):
    """The graph of a team with landmarks."""
    named = {one.name: one for one in landmarks}
    made = (*team.measurements, *sightings)
    return dataclasses.replace(graph_of_team(team), measurements=made, landmarks=named, on_map=map_positions(named))


def fed(graph, measurements=None):
    """An estimator that was given a graph stance by stance."""
    estimator = Estimator(graph.reference, graph.robots, graph.floor, graph.slips, None, graph.landmarks)
    for stance in graph.stances:
        estimator.add(stance, of_stance(measurements or graph.measurements, stance.index))
    return estimator


PLACES = {"L1": (1.0, 0.8, -2.0), "L2": (2.5, -0.7, 2.5)}


@pytest.fixture(scope="module")
def team():
    return team_of(3, 12, seed=3, rotating=False)


@pytest.fixture(scope="module")
def loop(team):
    """Sightings of two landmarks at the beginning, and of one again at the end."""
    rng = np.random.default_rng(8)
    when = [(0, "L1"), (1, "L1"), (4, "L2"), (5, "L2"), (10, "L1"), (11, "L1")]
    return [sighted(team, team.stances[k].observers[0], k, PLACES[name], name, rng) for k, name in when]


def test_a_landmark_that_two_robots_see_at_different_stances_ties_them():
    stances = (Stance(0, 0, 1, ("A",)), Stance(1, 2, 3, ("B",)))
    team = dataclasses.replace(team_of(3, 2), T_world_body={("A", 0): np.eye(4), ("B", 1): floor_pose(3.0, 1.0, 0.4)})
    seen = [sighted(team, "A", 0, PLACES["L1"], "L1"), sighted(team, "B", 1, PLACES["L1"], "L1")]
    graph = PoseGraph("A", ("A", "B"), stances, tuple(seen), Floor(), landmarks={"L1": landmark("L1")})
    assert not diagnose(graph) and diagnose(graph.without(seen[1:]))
    estimate = smooth(graph)
    np.testing.assert_allclose(estimate.pose("B", 1).matrix(), floor_pose(3.0, 1.0, 0.4), atol=1e-6)
    np.testing.assert_allclose(estimate.landmarks["L1"].T_world_body.matrix(), floor_pose(*PLACES["L1"]), atol=1e-6)
    # B's x, y: both sightings' noise, and their headings over the arm between B and the landmark
    sx, sy, _ = np.sqrt(estimate.landmarks["L1"].covariance_xy_yaw.diagonal())
    assert sx == pytest.approx(0.004, rel=1e-3) and sy == pytest.approx(0.004, rel=1e-3)


def test_a_map_s_doubt_is_of_heading_x_and_y_and_a_place_s_along_the_world_s_axes():
    (on_map,) = map_positions({"L1": landmark("L1", (1.0, 2.0, 0.5), sigma=0.03, sigma_deg=2.0), "L2": landmark("L2")})
    np.testing.assert_allclose(on_map.covariance, np.diag(np.square([np.deg2rad(2.0), 0.03, 0.03])))
    np.testing.assert_allclose(on_map.T_i_j, floor_pose(1.0, 2.0, 0.5), atol=1e-15)
    C = np.diag([9.0, 9.0, 0.2, 4.0, 1.0, 9.0])  # surest to its own side
    placed = StaticPose(gtsam.Pose3(floor_pose(1.0, 2.0, 0.5)), C)
    assert placed.planar == pytest.approx((1.0, 2.0, 0.5))
    c, s = np.cos(0.5), np.sin(0.5)
    expected = [[4 * c * c + s * s, 3 * s * c, 0], [3 * s * c, 4 * s * s + c * c, 0], [0, 0, 0.2]]
    np.testing.assert_allclose(placed.covariance_xy_yaw, expected, atol=1e-12)


def test_landmarks_that_nobody_saw_change_nothing_at_all(team):
    with_some, without = smooth(with_landmarks(team, [], landmark("L1"))), smooth(graph_of_team(team))
    assert not with_some.landmarks and with_some.map is None
    for robot, trajectory in without.trajectories.items():
        assert np.array_equal(with_some.trajectories[robot].T_world_body, trajectory.T_world_body)
        assert np.array_equal(with_some.trajectories[robot].covariances, trajectory.covariances)


def test_taking_a_landmark_out_gives_what_was_there_without_it(team, loop):
    graph = with_landmarks(team, loop, landmark("L1"), landmark("L2"))
    bare, without = smooth(graph.without(loop), reject=False), smooth(graph_of_team(team), reject=False)
    assert largest_difference(bare, without, without.graph.nodes) == 0.0


def test_the_paper_s_chain_ignores_landmarks(team, loop):
    graph = with_landmarks(team, loop, landmark("L1"), landmark("L2"))
    with_some, without = chain(graph), chain(graph_of_team(team))
    assert not with_some.landmarks
    for robot, trajectory in without.trajectories.items():
        assert np.array_equal(with_some.trajectories[robot].T_world_body, trajectory.T_world_body)


def test_what_is_seen_again_makes_the_end_surer(team, loop):
    graph = with_landmarks(team, loop, landmark("L1"), landmark("L2"))
    last = (team.stances[-1].observers[0], team.stances[-1].index)
    sigmas = [np.sqrt(np.trace(smooth(one).covariance(*last)[3:5, 3:5])) for one in (graph, graph.without(loop))]
    assert sigmas[0] < 0.8 * sigmas[1]


def test_covariances_with_landmarks_tell_the_truth():
    """NEES of the last pose and of the landmarks over independent teams: 3 degrees of freedom each."""
    nees, of_landmarks = [], []
    for seed in range(40):
        made, rng = team_of(3, 8, seed=seed, rotating=False), np.random.default_rng(seed)
        seen = [sighted(made, made.stances[k].observers[0], k, PLACES["L1"], "L1", rng) for k in (0, 3, 7)]
        estimate = smooth(with_landmarks(made, seen, landmark("L1")))
        assert not estimate.rejected
        nees.append(planar_nees(estimate, made, (made.stances[-1].observers[0], 7)))
        placed = estimate.landmarks["L1"]
        xi = gtsam.Pose3.Logmap(placed.T_world_body.between(gtsam.Pose3(floor_pose(*PLACES["L1"]))))[2:5]
        of_landmarks.append(xi @ np.linalg.solve(placed.covariance[2:5, 2:5], xi))
    for values in (nees, of_landmarks):
        assert 2.2 < np.mean(values) < 3.9  # 95 % of 40 means are in 2.3 to 3.8


@pytest.mark.parametrize("known", [False, True])
def test_incremental_with_landmarks_is_batch(team, loop, known):
    marks = [landmark(name, place if known else None, 0.005, 0.5) for name, place in PLACES.items()]
    graph = with_landmarks(team, loop, *marks)
    estimator, batch = fed(graph), smooth(graph)
    whole = estimator.estimate()
    assert largest_difference(whole, batch, batch.graph.nodes) < 1e-6
    placed = estimator.static_poses()
    assert set(placed) == ({"L1", "L2", MAP} if known else {"L1", "L2"})
    for name, one in batch.landmarks.items():
        assert one.T_world_body.equals(whole.landmarks[name].T_world_body, 1e-6)
        off = one.T_world_body.between(placed[name].T_world_body).translation()
        assert np.linalg.norm(off) < 0.1 * np.sqrt(np.trace(one.covariance[3:, 3:]))
    assert (batch.map is None) == (not known)


def test_an_estimator_with_landmarks_goes_on_where_it_was_saved(team, loop, tmp_path):
    marks = [landmark(name, place, 0.005, 0.5) for name, place in PLACES.items()]
    graph = with_landmarks(team, loop, *marks)
    half = Estimator(graph.reference, graph.robots, graph.floor, graph.slips, None, graph.landmarks)
    for stance in graph.stances[:6]:
        half.add(stance, of_stance(graph.measurements, stance.index))
    half.save(tmp_path / "point.json")
    resumed = Estimator.resume(tmp_path / "point.json")
    for stance in graph.stances[6:]:
        resumed.add(stance, of_stance(graph.measurements, stance.index))
    assert largest_difference(resumed.estimate(), smooth(graph), graph.nodes) < 1e-6
    assert resumed.static_poses().keys() == {"L1", "L2", MAP}


def test_what_is_taken_back_leaves_no_landmark_behind(team, loop):
    marks = [landmark(name, place, 0.005, 0.5) for name, place in PLACES.items()]
    graph = with_landmarks(team, loop[:3], *marks)
    estimator = Estimator(graph.reference, graph.robots, graph.floor, graph.slips, None, graph.landmarks)
    for stance in graph.stances[:5]:
        estimator.add(stance, of_stance(graph.measurements, stance.index))
    assert set(estimator.static_poses()) == {"L1", "L2", MAP}
    estimator.withdraw()
    assert set(estimator.static_poses()) == {"L1", MAP}
    estimator.add(graph.stances[4], of_stance(graph.measurements, 4))
    estimator.revoke(loop[2])
    assert set(estimator.static_poses()) == {"L1", MAP}
    estimator.insert(loop[2])
    assert set(estimator.static_poses()) == {"L1", "L2", MAP}


def test_a_map_holds_landmarks_to_each_other_and_leaves_the_world_where_it_is(team, loop):
    surveyed = [landmark(name, place) for name, place in PLACES.items()]
    # the same map, turned and elsewhere
    moved = [replace(one, position=(-one.position[1] + 40, one.position[0]), yaw_deg=one.yaw_deg + 90)
             for one in surveyed]  # fmt: skip
    free = smooth(with_landmarks(team, loop, landmark("L1"), landmark("L2")))
    for marks, T_world_map in ((surveyed, np.eye(4)), (moved, se3_inverse(floor_pose(40.0, 0.0, np.pi / 2)))):
        held = smooth(with_landmarks(team, loop, *marks))
        one, two = (held.landmarks[name].T_world_body for name in ("L1", "L2"))
        true = se3_inverse(floor_pose(*PLACES["L1"])) @ floor_pose(*PLACES["L2"])
        np.testing.assert_allclose(one.between(two).matrix(), true, atol=1e-4)
        x, y, yaw = held.pose("A", 0).x(), held.pose("A", 0).y(), held.pose("A", 0).rotation().yaw()
        assert np.abs([x, y, yaw]).max() < 1e-6
        at = held.map.T_world_body.matrix() @ se3_inverse(T_world_map)  # far off, a small turn is a long way
        np.testing.assert_allclose(at[:3, :3], np.eye(3), atol=0.02)
        assert largest_difference(held, free, held.graph.nodes) > 1e-4
    off = free.landmarks["L1"].T_world_body.between(free.landmarks["L2"].T_world_body).matrix()
    assert np.abs(off - true).max() > 1e-3


def test_the_same_map_drawn_elsewhere_gives_the_same_poses(team, loop):
    here = [landmark(name, place, 0.01, 1.0) for name, place in PLACES.items()]
    there = [replace(one, position=(-one.position[1] + 40, one.position[0]), yaw_deg=one.yaw_deg + 90) for one in here]
    a, b = (smooth(with_landmarks(team, loop, *marks)) for marks in (here, there))
    assert largest_difference(a, b, a.graph.nodes) < 1e-6 and a.chi2 == pytest.approx(b.chi2, rel=1e-6)


def test_one_landmark_on_a_map_says_nothing_but_where_the_map_is(team, loop):
    free = smooth(with_landmarks(team, loop, landmark("L1"), landmark("L2")))
    held = smooth(with_landmarks(team, loop, landmark("L1", (7.0, 8.0, 0.3), 0.01, 1.0), landmark("L2")))
    assert largest_difference(held, free, free.graph.nodes) < 1e-7
    assert held.dof == free.dof and held.chi2 == pytest.approx(free.chi2, rel=1e-6)
    T = held.landmarks["L1"].T_world_body.compose(gtsam.Pose3(floor_pose(7.0, 8.0, 0.3)).inverse())
    assert held.map.T_world_body.equals(T, 1e-4)
    # known no better than its landmark and the survey, at the landmark
    assert np.sqrt(held.map.covariance_xy_yaw[2, 2]) > np.deg2rad(1.0)


def test_a_place_on_the_map_that_is_wrong_is_refused_and_named(team, loop):
    rng = np.random.default_rng(2)
    places = PLACES | {"L3": (3.5, 0.6, -1.5), "L4": (0.4, -0.9, 1.2)}
    seen = [*loop, *(sighted(team, team.stances[k].observers[n], k, places[name], name, rng)
                     for k, name in ((8, "L3"), (9, "L3"), (0, "L4"), (2, "L4")) for n in range(2))]  # fmt: skip
    marks = [landmark(name, place, 0.005, 0.5) for name, place in places.items()]
    marks[3] = landmark("L4", (0.4, -0.5, 1.2), 0.005, 0.5)
    estimate = smooth(with_landmarks(team, seen, *marks))
    assert [str(one.measurement) for one in estimate.rejected] == ["position of L4 on the map"]
    assert not smooth(with_landmarks(team, seen, *(landmark(n, p, 0.005, 0.5) for n, p in places.items()))).rejected


def test_a_wrong_identity_is_refused_and_named_in_batch_and_as_it_comes(team, loop):
    wrong = sighted(team, team.stances[8].observers[0], 8, PLACES["L2"], "L1")
    graph = with_landmarks(team, [*loop, wrong], landmark("L1"), landmark("L2"))
    right = with_landmarks(team, loop, landmark("L1"), landmark("L2"))
    for estimate in (smooth(graph), fed(graph).estimate()):
        assert [one.measurement for one in estimate.rejected] == [wrong]
        assert largest_difference(estimate, smooth(right), right.nodes) < 1e-5
    assert "sighting of L1 by" in str(wrong)


def driven(turns, sigma, seed, off=0.0):
    """A robot that drives in circles by its wheels alone, watched by nobody, past a landmark once a turn."""
    rng, stances, made, T = np.random.default_rng(seed), [], [], {}
    C = np.diag(np.square([sigma, 2 * sigma, 2 * sigma]))
    at = np.eye(4)
    for k in range(20 * turns + 1):
        T["A", k] = at
        stances.append(Stance(k, 10.0 * k, 10.0 * k + 5, ("A",)))
        step = floor_pose(1.0, 0.0, 2 * np.pi / 20)
        xi = np.zeros(6)
        xi[2:5] = np.sqrt(C.diagonal()) * rng.standard_normal(3)
        made.append(Odometry("A", k, k + 1, gtsam.Pose3(step @ se3_exp(xi)), C))
        at = at @ step
    team = dataclasses.replace(team_of(3, 2), T_world_body=T)
    for turn in range(turns + 1):
        shift = (0.0, off, 0.0) if turn == turns else (0.0, 0.0, 0.0)
        made.append(sighted(team, "A", 20 * turn, (1.5, 0.3, 2.8), "L1", rng, shift))
    graph = PoseGraph("A", ("A",), tuple(stances), tuple(m for m in made if m.ends[1][1] < len(stances)), Floor(),
                      landmarks={"L1": landmark("L1")})  # fmt: skip
    return graph, team


@pytest.mark.parametrize("seed", range(3))
def test_a_loop_that_closes_far_off_what_drift_expects_is_judged_by_the_graph_s_own_doubt(seed):
    graph, _ = driven(3, 0.03, seed)
    estimator = fed(graph)
    drift = smooth(graph.without([m for m in graph.measurements if isinstance(m, Sighting)])).pose("A", 60)
    assert np.linalg.norm(drift.translation()) > 0.15  # of what was driven: without the landmark it is far off
    assert not estimator.rejected
    estimate, batch = estimator.estimate(), smooth(graph)
    assert largest_difference(estimate, batch, batch.graph.nodes) < 1e-5
    assert np.linalg.norm(batch.pose("A", 60).translation()) < 0.05
    # metres are more than drift makes of it
    wrong, _ = driven(3, 0.03, seed, off=6.0)
    refused = fed(wrong).rejected
    assert [one.measurement.ends[0] for one in refused] == [("A", 60)]


def seen_in_pixels(T_world_robot, stance, place, name, rng):
    """A sighting made of two pixels, with their rays: what the joint estimate goes on from."""
    robot = reference_team()["A"]
    T = se3_inverse(T_world_robot @ robot.mount.T_body_camera) @ floor_pose(*place)
    uv, inside = robot.camera.project(LIGHTS.p_body @ T[:3, :3].T + T[:3, 3])
    assert inside.all()
    uv = uv + 0.1 * rng.standard_normal((2, 2))
    C = 0.01 * np.eye(2)[None]
    tracks = [Track("A", f"{name}/{n}", np.array([10.0 * stance]), uv[n : n + 1], C, np.zeros(1)) for n in range(2)]
    plane = plane_from_mount(robot.mount, LIGHTS)
    return sight(Stance(stance, 10.0 * stance, 10.0 * stance + 5, ("A",)), robot, Marked(name, LIGHTS), tracks, plane)


def test_pixels_of_a_landmark_that_drift_has_put_behind_the_camera_close_the_loop_all_the_same():
    graph, team = driven(3, 0.05, 1)
    rng = np.random.default_rng(4)
    wheels = [m for m in graph.measurements if isinstance(m, Odometry)]
    seen = [seen_in_pixels(team.T_world_body["A", k], k, (0.6, 0.1, 2.8), "L1", rng) for k in (0, 60)]
    robot_models = {
        "A": replace(reference_team()["A"], mount_if_any=Mount(height=0.4, tilt_deg=20.0, tilt_sigma_deg=0.1))
    }
    graph = dataclasses.replace(graph, measurements=(*wheels, *seen), robot_models=robot_models)
    drift = smooth(graph.without(seen[1:]))
    expected = drift.pose("A", 60).between(drift.landmarks["L1"].T_world_body)
    off = np.linalg.norm(expected.translation() - seen[1].T_i_j[:3, 3])
    assert off > 0.4  # of a landmark 0.6 m away
    estimator = Estimator("A", ("A",), graph.floor, {}, robot_models, graph.landmarks)
    for stance in graph.stances:
        estimator.add(stance, of_stance(graph.measurements, stance.index))
    batch = joint(graph)
    assert not estimator.rejected and not batch.rejected
    for estimate in (batch, estimator.estimate()):
        assert np.linalg.norm(estimate.pose("A", 60).translation()) < 0.02
    assert largest_difference(batch, estimator.estimate(), graph.nodes) < 1e-5
    assert np.linalg.norm(estimator.pose("A", 60).translation() - batch.pose("A", 60).translation()) < 0.01


def test_a_landmark_neither_watches_nor_drives(team):
    graph = with_landmarks(team, [], landmark("L1"))
    T = gtsam.Pose3()
    for wrong, words in (
        (Odometry("L1", 0, 1, T, SEEN), "which does not move"),
        (Sighting(0, "L1", "A", 0.0, T, SEEN), "is no observer"),
        (Sighting(0, "A", "L9", 0.0, T, SEEN), "L9, which is not in the team"),
        (Sighting(99, "A", "L1", 0.0, T, SEEN), "stance 99, which is none"),
    ):
        with pytest.raises(MeasurementError, match=words):
            dataclasses.replace(graph, measurements=(wrong,))
    with pytest.raises(MeasurementError, match="L1, which is not in the team"):
        dataclasses.replace(graph, stances=(Stance(0, 0, 1, ("A", "L1")),))


def test_graph_files_hold_landmarks_and_the_map(team, loop, tmp_path):
    marks = [landmark(name, place, 0.005, 0.5) for name, place in PLACES.items()]
    estimate = smooth(with_landmarks(team, loop, *marks))
    write_g2o(estimate, tmp_path / "graph.g2o")
    read = read_g2o(tmp_path / "graph.g2o")
    assert set(read.landmarks.values()) == {"L1", "L2"}
    assert read.values.size() == len({estimate.graph.key(*node) for node in estimate.graph.nodes}) + 3
    (number,) = (key for key, name in read.landmarks.items() if name == "L2")
    assert read.values.atPose3(number).equals(estimate.landmarks["L2"].T_world_body, 1e-9)
    assert sum(number in read.factors.at(n).keys() for n in range(read.factors.size())) == 3  # noqa: SIM118
    dot = to_dot(estimate.graph)
    assert dot.count("shape=hexagon") == 3 and '[label="map"' in dot


def test_a_team_of_landmarks_is_told_what_is_wrong_with_it():
    for wrong, words in (
        ({"markers": Markers(height=0.1, positions=((0.0, 0.0),))}, "has one marker.*give it two"),
        ({"markers": LIGHTS, "position": (1.0, 2.0)}, "a `position` and no `yaw_deg`"),
        ({"markers": LIGHTS, "yaw_deg": 3.0}, "a `yaw_deg` and no `position`"),
        ({"markers": LIGHTS, "position": (1.0, 2.0), "yaw_deg": 3.0, "yaw_sigma_deg": 90.0}, "`yaw_sigma_deg` of 90"),
        ({"markers": LIGHTS, "tag": Tag(id=1, size=0.1, height=0.1)}, "markers and a tag"),
    ):
        with pytest.raises(ValueError, match=words):
            Landmark(name="L1", **wrong)
    assert Landmark(name="P", position=(1.0, 2.0)).seen_as is None  # a bare point needs no yaw


def test_a_tag_that_two_landmarks_have_is_named():
    tags = [Landmark(name=name, tag=Tag(id=7, size=0.1, height=0.1)) for name in ("L1", "L2")]
    with pytest.raises(ValueError, match="landmarks L1 and L2 have the same tag 7"):
        replace(reference_team(), landmarks=tuple(tags))
    team = replace(reference_team(), landmarks=tuple(tags[:1]))
    assert landmarks_of(team) == {"L1": tags[0]}
    assert team.landmarks[0].seen_as.positions == ((0.0, 0.05), (0.0, -0.05))
