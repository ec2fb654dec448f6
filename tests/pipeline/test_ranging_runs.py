import json
import re
import runpy
from dataclasses import fields, replace

import gtsam
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from mrclam_folder import DELAY, DEPTH, LANDMARKS, ROBOT_OFFSET, SCALE, TURN_SCALE, make
from msgspec.structs import replace as with_fields

from coloc_graph.backend.fixed_lag import marginal_factor
from coloc_graph.backend.marginals import Marginals, tree_covariances
from coloc_graph.backend.planar import KeyframeEstimator, optimise_keyframes
from coloc_graph.backend.planar import incremental as incremental_module
from coloc_graph.backend.planar.factors import KeyframeFactors, State
from coloc_graph.backend.planar.filter import Models, filter_forward
from coloc_graph.backend.planar.initial_pose import RigidAlignmentRansac
from coloc_graph.backend.solver import eliminated
from coloc_graph.cli import main
from coloc_graph.errors import EstimationError, InputError, MeasurementError, RunError
from coloc_graph.exchange.g2o import read_g2o
from coloc_graph.exchange.mrclam import import_mrclam
from coloc_graph.exchange.pyfg import read_pyfg
from coloc_graph.exchange.range_graph import factors_of, key_of, values_of
from coloc_graph.exchange.ranging_factors import ranging_gtsam_files
from coloc_graph.exchange.ranging_graph import ranging_graph
from coloc_graph.frontend.keyframe_stream import KeyframeStream
from coloc_graph.frontend.keyframes import keyframes_of
from coloc_graph.measurements import RangeBearings
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.pipeline.inspection import Finding, inspect
from coloc_graph.pipeline.ranges import of_targets
from coloc_graph.results.writer import assess, assess_online, write_result
from coloc_graph.run import OdometrySample, Ranges, atomic_run, open_run
from coloc_graph.team import Landmark, Ranging, Robot, Team
from coloc_graph.viewer import scene_of_result


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("drives")


@pytest.fixture(scope="module")
def run(folder):
    made = make(folder / "data", seed=1, seconds=40.0)
    import_mrclam(made.path, folder / "run.mcap")
    return open_run(folder / "run.mcap")


@pytest.fixture(scope="module")
def unmapped(folder, run):
    import_mrclam(folder / "data", folder / "unmapped.mcap", map_known=False)
    return open_run(folder / "unmapped.mcap")


@pytest.fixture(scope="module")
def batch(run):
    return solve(run)


@pytest.fixture(scope="module")
def incremental(run):
    return solve(run, SolveOptions(incremental=True))


def rms(accuracy):
    return max(row.translation.rmse for row in accuracy.robots)


def test_robots_are_where_they_are_and_the_covariances_say_how_well(batch):
    accuracy = assess(batch)[0]
    assert rms(accuracy) < 0.05
    assert 0.4 < accuracy.anees < 1.5
    estimate = batch.estimate
    assert 0.6 < estimate.chi2 / estimate.dof < 1.3
    assert np.all((estimate.ranging.noise > 0.6) & (estimate.ranging.noise < 1.5))
    assert all("R2: range to robots not observable" in one for one in batch.warnings)  # it hardly sees another


def test_wheels_that_are_not_as_they_say_are_found_out(run, batch):
    for robot in run.team.names:
        errors, C = batch.estimate.calibration.sensors[robot].errors.wheels
        wheels = run.team[robot].wheels
        true = np.array([SCALE - wheels.scale, TURN_SCALE - wheels.turn_scale, DELAY - wheels.delay])
        assert np.all(np.abs(errors - true) < 4 * np.sqrt(np.diagonal(C)))
        assert np.sqrt(C[2, 2]) < wheels.delay_sigma / 2
    found = batch.estimate.calibration.of_team(run.team)
    stated, errors = run.team["R1"], batch.estimate.calibration.sensors["R1"].errors
    wheels, ranging = found["R1"].wheels, found["R1"].ranging
    at = [wheels.scale - stated.wheels.scale, wheels.turn_scale - stated.wheels.turn_scale]
    assert [*at, wheels.delay - stated.wheels.delay] == pytest.approx(errors.wheels[0].tolist())
    at = [ranging.offset, ranging.scale - 1, np.deg2rad(ranging.bearing_offset_deg), ranging.x, ranging.y]
    at += [ranging.depth - stated.ranging.depth, ranging.robot_offset]
    assert at == pytest.approx(errors.ranging[0].tolist())
    assert wheels.delay_sigma == pytest.approx(np.sqrt(errors.wheels[1][2, 2]))
    assert ranging.range_sigma == pytest.approx(stated.ranging.range_sigma * batch.estimate.ranging.noise[0, 0])


def test_each_robot_helps_the_others(run, batch):
    alone = solve(run, SolveOptions(between_robots=False))
    assert len(alone.estimate.ranging.keyframes.measured) < len(batch.estimate.ranging.keyframes.measured)

    def sigma(solution):
        return np.mean([np.sqrt(t.covariances[:, 3, 3]).mean() for t in solution.estimate.trajectories.values()])

    assert sigma(batch) < sigma(alone)


def test_as_it_happens_it_is_nearly_as_good(batch, incremental):
    of_batch, of_one, online = assess(batch)[0], assess(incremental)[0], assess_online(incremental)
    assert rms(of_one) < 1.2 * rms(of_batch)
    assert rms(online) < 0.12
    # nothing that comes later is in what was thought at the time
    assert rms(online) > rms(of_one)
    assert assess_online(batch) is None
    assert set(incremental.online) == set(incremental.estimate.trajectories)
    for robot, online in incremental.online.items():
        assert np.isfinite(online.covariances).all()
        smoothed = incremental.estimate.trajectories[robot]
        assert len(smoothed) == len(batch.estimate.trajectories[robot])


def test_without_a_map_robots_and_landmarks_are_found_up_to_where_the_map_lies(unmapped):
    solution = solve(unmapped)
    assert not solution.estimate.ranging.on_map
    start = solution.estimate.trajectories["R1"]
    assert np.allclose(start.T_world_body[0], np.eye(4), atol=1e-3)
    assert rms(assess(solution)[0]) < 0.06
    landmarks = solution.estimate.landmarks
    found = np.array([one.planar[:2] for one in landmarks.values()])
    true = np.array([LANDMARKS[int(name[1:])] for name in landmarks])
    p, q = found - found.mean(axis=0), true - true.mean(axis=0)
    angle = np.arctan2((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum(), (p * q).sum())
    c, s = np.cos(angle), np.sin(angle)
    off = p @ np.array([[c, s], [-s, c]]) - q
    sigmas = np.array([np.sqrt(np.trace(one.covariance_xy_yaw[:2, :2])) for one in landmarks.values()])
    assert np.all(np.hypot(*off.T) < 3 * sigmas)
    assert np.median(np.hypot(*off.T)) < 0.1
    (gauge,) = ranging_graph(solution.estimate, unmapped.team).priors
    assert gauge.name == "R0" and isinstance(gauge.value, gtsam.Pose2)
    known = solution.estimate.calibration.of_team(unmapped.team).landmarks[0]
    assert known.position == pytest.approx(next(iter(landmarks.values())).planar[:2])


def test_a_map_that_lies_elsewhere_moves_the_estimate_with_it_and_nothing_else(folder, batch):
    made = make(folder / "moved", seed=1, seconds=40.0, turned=1.0, shifted=(5.0, -2.0))
    import_mrclam(made.path, folder / "moved.mcap")
    moved = solve(open_run(folder / "moved.mcap"))
    T = np.eye(4)
    T[:2, :2] = [[np.cos(1.0), -np.sin(1.0)], [np.sin(1.0), np.cos(1.0)]]
    T[:2, 3] = 5.0, -2.0
    for robot, trajectory in batch.estimate.trajectories.items():
        off = moved.estimate.trajectories[robot].T_world_body - T @ trajectory.T_world_body
        assert np.abs(off).max() < 0.01
    assert moved.estimate.chi2 == pytest.approx(batch.estimate.chi2, rel=0.02)


def test_what_was_read_wrong_is_doubted_and_moves_nothing(run, batch):
    keyframes = batch.estimate.ranging.keyframes
    target, robots = keyframes.measured.target.copy(), len(keyframes.robots)
    landmarks = np.flatnonzero((target >= robots) & (keyframes.measured.share[:, 0] > 0.3))
    wrong = landmarks[10::8]
    target[wrong] = robots + (target[wrong] - robots + 3) % len(keyframes.landmarks)
    estimate = optimise_keyframes(run.team, replace(keyframes, measured=replace(keyframes.measured, target=target)))
    assert (
        set(wrong)
        == set(np.flatnonzero(estimate.ranging.outliers))
        == {one.measurement.row for one in estimate.rejected}
    )
    assert all(f"an outlier: {one.sigmas:.0f} sigmas" in one.reason for one in estimate.rejected)
    for robot, trajectory in batch.estimate.trajectories.items():
        off = estimate.trajectories[robot].positions - trajectory.positions
        assert np.sqrt((off**2).sum(axis=1).mean()) < 0.02


def test_joint_covariances_are_those_of_each_pose_and_of_the_step_between_them(batch, incremental):
    estimate = batch.estimate
    nodes = ("R1", 40), ("R1", 41), ("R2", 40)
    joint = estimate.joint_covariance((*nodes, nodes[0]))
    for n, node in enumerate(nodes):
        own = slice(6 * n, 6 * n + 6)
        assert np.allclose(joint[own, own], estimate.covariance(*node), rtol=0.02, atol=1e-8)
    assert np.allclose(joint[18:], joint[:6])
    # of a step the odometry says more than where it begins and ends
    a, b = (estimate.pose(*node) for node in nodes[:2])
    J = np.hstack([-a.between(b).inverse().AdjointMap(), np.eye(6)])
    step = J @ joint[:12, :12] @ J.T
    keyframes, own = estimate.ranging.keyframes, estimate.ranging.robots.index("R1")
    assert np.all(np.diagonal(step)[3:5] < 1.1 * np.diagonal(keyframes.steps[own].covariances[40])[:2])
    assert np.all(np.diagonal(step)[3:5] < 0.5 * np.diagonal(joint)[9:11])
    with pytest.raises(EstimationError, match="have no joint covariances incrementally: solve it in batch"):
        incremental.estimate.joint_covariance(nodes)


def test_the_filter_needs_no_first_poses(run):
    keyframes = keyframes_of(run)
    filtered = filter_forward(run.team, keyframes)
    assert set(filtered.placed_at) == {0, 1, 2}
    assert max(filtered.placed_at.values()) < 20
    assert filtered.used.mean() > 0.9


def test_that_a_range_is_a_depth_and_longer_to_robots_is_found_out(run, batch):
    sigmas = []
    for robot in run.team.names:
        errors, C = batch.estimate.calibration.sensors[robot].errors.ranging
        off = errors[5:] - (DEPTH - run.team[robot].ranging.depth, ROBOT_OFFSET)
        sigmas.append(np.sqrt(np.diagonal(C)[5:]))
        assert np.all(np.abs(off) < 4 * sigmas[-1])
    assert np.max(sigmas, axis=0)[0] < 0.04
    # one of them hardly sees another
    assert np.min(sigmas, axis=0)[1] < 0.025


@pytest.fixture(scope="module", params=["one-way", "two-way"])
def somewhere(unmapped, request):
    """Factors without a map, and a state that is far from their optimum."""
    keyframes, team = keyframes_of(unmapped), unmapped.team
    if request.param == "two-way":
        antennas = [with_fields(one.ranging, two_way=True, x=0.1, y=-0.2, offset=0.3) for one in team.robots]
        robots = [with_fields(one, ranging=ranging) for one, ranging in zip(team.robots, antennas, strict=True)]
        team = with_fields(team, robots=tuple(robots))
    factors = KeyframeFactors(keyframes, Models(team, keyframes))
    rng = np.random.default_rng(0)
    shared = rng.normal(size=len(factors.free)) * 0.05
    factors.landmarks(shared)[:] += 3 + rng.normal(size=(len(keyframes.landmarks), 2))
    return factors, State(rng.normal(size=(len(factors), 3)), shared)


def test_derivatives_are_those_of_the_residuals(somewhere):
    factors, state = somewhere
    of_robots, of_landmarks = (np.flatnonzero(factors.of_robot == of)[:3] for of in (True, False))
    index = np.concatenate([of_robots, of_landmarks])
    steps = np.array([3, factors.first[1] + 7])
    for rows_at in (lambda at: factors.steps(at, steps), lambda at: factors.measured(at, index)):
        J, columns, _ = rows_at(state)
        for n, k in np.ndindex(columns.shape):
            ends = []
            for step in (1e-6, -1e-6):
                both = np.concatenate([state.poses.ravel(), state.shared])
                both[columns[n, k]] += step
                moved = State(both[: state.poses.size].reshape(-1, 3), both[state.poses.size :])
                ends.append(rows_at(moved).residuals[n])
            slope = J[n, :, :-1] @ (columns[n] == columns[n, k])  # a landmark fills the columns of a heading, too
            assert np.allclose((ends[0] - ends[1]) / 2e-6, slope, atol=1e-5 * np.abs(J[n]).max())


def dense(factors, rows):
    """The normal equations of factors over all variables, by the book."""
    free = factors.keys.free
    A, b = [], []
    for one in rows:
        for J, columns in zip(one.jacobians, one.columns, strict=True):
            row = np.zeros((len(J), len(free)))
            np.add.at(row.T, columns, J[:, :-1].T)
            A.append(row * free)
            b.append(J[:, -1])
    A, b = np.concatenate(A), np.concatenate(b)
    return A.T @ A, A.T @ b


def test_a_linear_system_is_solved_and_summed_up_as_by_the_book(somewhere):
    factors, state = somewhere
    inside = factors.times < factors.times.min() + 12.0
    steps = np.flatnonzero(inside[:-1] & inside[1:] & (factors.robot[:-1] == factors.robot[1:]))
    measured = np.flatnonzero(inside[factors.observer] & (inside[factors.seen] | ~factors.of_robot))
    first = int(np.flatnonzero(inside)[0])
    gauge = factors.gauge(state, first, state.poses[first] + 0.1)
    rows = [factors.steps(state, steps), factors.measured(state, measured), gauge]
    H, g = dense(factors, rows)
    shared = 3 * len(factors) + np.flatnonzero(factors.free)
    off = np.concatenate([np.zeros(3 * len(factors)), state.shared - factors.start()])[shared]
    H[shared, shared] += factors.sigmas[factors.free] ** -2
    g[shared] += factors.sigmas[factors.free] ** -2 * off
    there = np.flatnonzero(H.any(axis=0))
    C = np.zeros_like(H)
    C[np.ix_(there, there)] = np.linalg.inv(H[np.ix_(there, there)])
    expected = -C @ g

    system = factors.linear(state, rows)
    ordering = gtsam.Ordering.ColamdGaussianFactorGraph(system)
    tree, name = eliminated(system, ordering)[0], int(factors.keys.names[first])
    step = factors.keys.step(tree.optimize(), system.keyVector())
    assert np.allclose(step, expected, rtol=1e-5, atol=1e-6)
    marginals = Marginals(system, factors.keys.size, ordering)
    at = slice(3 * first, 3 * first + 3)
    assert np.allclose(marginals.covariance(name), C[at, at], rtol=1e-4, atol=1e-12)
    poses = there[there < 3 * len(factors)].reshape(-1, 3)
    by_tree = tree_covariances(tree, factors.keys.names[poses[:, 0] // 3].tolist(), factors.keys.size)
    assert np.allclose(by_tree, C[poses[:, :, None], poses[:, None, :]], rtol=1e-4, atol=1e-12)
    of_shared = C[3 * len(factors) :, 3 * len(factors) :]
    assert np.allclose(factors.shared_covariance(marginals), of_shared, rtol=1e-4, atol=1e-9)
    for index, parts in factors.keys.blocks(rows[1]):
        keys, jacobians = zip(*((factors.keys.names[key], one) for key, one in parts), strict=True)
        A, columns = rows[1].jacobians[index, :, :-1], rows[1].columns[index]
        taken = np.einsum("nij,njk,nik->ni", A, C[columns[:, :, None], columns[:, None, :]], A)
        assert np.allclose(marginals.variances(keys, jacobians), taken, rtol=1e-4, atol=1e-9)

    moved = factors.moved(state, tree.optimize().scale(0.3), system.keyVector())
    # in two goes: what the first poses say of the rest is all they have to say
    gone = factors.times < factors.times.min() + 5.0
    early = [gone[steps] | gone[steps + 1], gone[factors.observer[measured]]]
    early[1] |= gone[factors.seen[measured]] & factors.of_robot[measured]
    system = factors.linear(state, [rows[0].of(np.flatnonzero(early[0])), rows[1].of(np.flatnonzero(early[1])), gauge])
    values = factors.values(state, system.keyVector())
    before = marginal_factor(system, values, factors.keys.names[np.flatnonzero(gone & inside)].tolist())
    # evaluated elsewhere it says the same: the optimum is where it was
    late = [rows[0].of(np.flatnonzero(~early[0])), rows[1].of(np.flatnonzero(~early[1]))]
    for one in late:
        one.jacobians[:, :, -1] += 0.3 * np.einsum("nij,nj->ni", one.jacobians[:, :, :-1], expected[one.columns])
    system = factors.linear(state, late, priors=False)
    system.push_back(before.linearize(factors.values(moved, before.keys())))
    tree, _ = eliminated(system, gtsam.Ordering.ColamdGaussianFactorGraph(system))
    again = factors.keys.step(tree.optimize(), system.keyVector())
    kept = np.setdiff1d(there, (3 * np.flatnonzero(gone)[:, None] + np.arange(3)).ravel())
    assert np.allclose(again[kept], 0.7 * expected[kept], rtol=1e-4, atol=1e-5)


def test_factors_that_leave_a_variable_open_are_one_sentence(somewhere):
    factors, state = somewhere
    system = factors.linear(state, [factors.steps(state, np.array([3]))])
    with pytest.raises(EstimationError, match="does not determine"):
        eliminated(system, gtsam.Ordering.ColamdGaussianFactorGraph(system))


def test_steps_in_recent_poses_alone_are_those_in_the_whole_window(run, monkeypatch):
    keyframes, latest = keyframes_of(run), []
    for recent in (incremental_module.RECENT, 0.0):
        monkeypatch.setattr(incremental_module, "RECENT", recent)
        one = KeyframeEstimator(run.team, lag=24.0, calibrating=15.0)
        start = keyframes.measured.time[0]
        latest.append([one.add(keyframes.between(start + n, start + n + 1)).poses for n in range(30)])
        counts = one._inside().sum(), np.isfinite(one._state.poses[:, 0]).sum()
        assert counts[0] < 0.6 * counts[1]
    sigmas = []
    for n, (found, expected) in enumerate(zip(*latest, strict=True)):
        assert set(found) == set(expected)
        for robot, (pose, C) in expected.items():
            off = (found[robot][0] - pose) / np.sqrt(np.diagonal(C))
            sigmas.append(np.abs(off).max())
            if n % 3 == 0:  # the whole window was corrected just now
                assert sigmas[-1] < 0.02
                assert np.allclose(np.diagonal(found[robot][1]), np.diagonal(C), rtol=0.02)
    assert np.median(sigmas) < 0.05 and max(sigmas) < 1.0


def test_what_has_left_the_window_is_not_forgotten(run, batch):
    keyframes = keyframes_of(run)
    one, forgetful = (
        KeyframeEstimator(run.team, lag=10.0, calibrating=12.0, forgets=forgets) for forgets in (False, True)
    )
    start = keyframes.measured.time[0]
    for second in range(42):
        latest = one.add(keyframes.between(start + second, start + second + 1))
        again = forgetful.add(keyframes.between(start + second, start + second + 1))
        for robot, (pose, C) in latest.poses.items():  # the same numbers, with and without what has left
            np.testing.assert_array_equal(again.poses[robot][0], pose)
            np.testing.assert_array_equal(again.poses[robot][1], C)
    assert set(latest.poses) == set(run.team.names)
    assert max(times[-1] - times[0] for times in forgetful._keyframes.times) < 16.0 and not forgetful._came
    with pytest.raises(EstimationError, match="forgotten all before the keyframes in its window"):
        forgetful.estimate()
    late = keyframes.between(start + 42, start + 43)
    row = replace(keyframes.measured.of(slice(0, 1)), time=np.array([start + 42]))
    for wrong, why in (
        (keyframes.between(start + 20, start + 21), "begin with number"),
        (replace(late, measured=row), "has left the window"),
        (replace(late, landmarks=()), "are not of the team's robots and landmarks"),
        (replace(late, times=tuple(np.append(times, times[-1]) for times in late.times)), "do not increase"),
    ):
        with pytest.raises(MeasurementError, match=why):
            forgetful.add(wrong)
    new = replace(forgetful._keyframes.measured.of(slice(-1, None)), range=np.array([np.nan]))
    with pytest.raises(MeasurementError, match="has a range that is not finite"):
        forgetful.add(replace(late, measured=new))
    estimate = one.estimate()
    for robot in run.team.names:
        # of wheels and sensors as much is known as in batch
        for kind in ("wheels", "ranging"):
            found, C = getattr(estimate.calibration.sensors[robot].errors, kind)
            best, best_C = getattr(batch.estimate.calibration.sensors[robot].errors, kind)
            assert np.all(np.abs(found - best) < 1.5 * np.sqrt(np.diagonal(best_C)))
            assert np.allclose(np.sqrt(np.diagonal(C)), np.sqrt(np.diagonal(best_C)), rtol=0.3)
        off = estimate.trajectories[robot].positions - batch.estimate.trajectories[robot].positions
        assert len(off) == len(batch.estimate.trajectories[robot])
        assert 1e-4 < np.sqrt((off**2).sum(axis=1).mean()) < 0.03


def test_keyframes_that_are_made_as_records_come_are_those_of_the_whole_run(run):
    whole, stream, parts = keyframes_of(run), KeyframeStream(run.team), []
    records = [one for name in run.team.names for of in (run.odometry, run.ranges) for one in of(name)]
    begin = min(one.time for one in records)
    for second in range(44):
        stream.add(*(one for one in records if second <= one.time - begin < second + 1))
        parts.append(stream.take(begin + second - 1.0))  # odometry may be late by its delay
        assert max(map(len, stream._odometry)) < 400
    joined = parts[0].followed_by(*parts[1:])
    assert joined.begins == whole.begins
    for found, expected in zip(joined.times, whole.times, strict=True):
        np.testing.assert_array_equal(found, expected)
    for found, expected in zip(joined.steps, whole.steps, strict=True):
        np.testing.assert_allclose(found.twists, expected.twists, atol=1e-12)
        np.testing.assert_allclose(found.covariances, expected.covariances, rtol=1e-6)
    for one in fields(RangeBearings):
        np.testing.assert_array_equal(getattr(joined.measured, one.name), getattr(whole.measured, one.name))


def test_errors_that_last_count_by_how_long_they_do(run):
    keyframes = keyframes_of(run)
    m, memory = keyframes.measured, run.team["R1"].ranging.range_memory
    pair = np.flatnonzero((m.robot == 0) & (m.target == m.target[m.robot == 0][0]))
    assert m.share[pair[0]].tolist() == [1.0, 1.0]
    gaps = np.diff(m.time[pair])
    assert np.allclose(m.share[pair[1:], 0], np.tanh(gaps / (2 * memory)))


def test_a_robot_is_placed_by_points_that_agree_and_not_by_those_that_do_not():
    rng = np.random.default_rng(3)
    local = rng.uniform(-2, 2, (8, 2))
    c, s = np.cos(0.7), np.sin(0.7)
    world = local @ np.array([[c, s], [-s, c]]) + (1.0, -2.0)
    placing = RigidAlignmentRansac()
    for n in range(3):
        placing.add(tuple(local[n]), tuple(world[n]))
    assert placing.pose() is None  # too few to be sure
    placing.add(tuple(local[3]), tuple(world[3] + 3.0))  # read wrong
    for n in range(4, 8):
        placing.add(tuple(local[n]), tuple(world[n]))
    assert placing.pose() == pytest.approx((1.0, -2.0, 0.7))


def test_a_robot_is_not_placed_by_landmarks_of_unknown_positions(tmp_path):
    names = ("K1", "K2", "U")
    places = {"K1": (0.0, 3.0), "K2": (4.0, 3.0), "U": (2.0, -2.5)}  # m; that of U is not stated
    landmarks = tuple(Landmark(name=name, position=None if name == "U" else places[name]) for name in names)
    sensor = Ranging(range_sigma=0.05, bearing_sigma_deg=1.0)
    team = Team(reference="A", robots=tuple(Robot(name=name, ranging=sensor) for name in "AB"), landmarks=landmarks)
    start, path = np.array([1.0, -0.5]), tmp_path / "run.mcap"
    with atomic_run(path, team) as writer:
        for k in range(40):
            xy = np.array([0.1 * k, 0.0])  # by its wheels, which count from its start
            writer.write(OdometrySample("A", 100.0 + k, np.array([*xy, 0.0]), np.eye(3) * 1e-6))
            # U alone is measured at first, and is at no place of the map yet
            for name in ("U",) if k < 20 else names:
                d = np.subtract(places[name], start + xy)
                writer.write(Ranges("A", 100.0 + k, (name,), np.hypot(*d)[None], np.arctan2(d[1], d[0])[None]))
    keyframes = keyframes_of(open_run(path))
    found = filter_forward(team, keyframes)
    assert found.placed_at[0] >= 20
    assert found.whole()[0][0] == pytest.approx([*start, 0.0], abs=0.02)
    assert found.landmark(keyframes.landmarks.index("U")) == pytest.approx(places["U"], abs=0.05)


def write(path, *, odometry=True, target="L", ranging=True, away=False):
    sensor = Ranging(range_sigma=0.05, bearing_sigma_deg=0.5) if ranging else None
    robots = tuple(Robot(name=name, ranging=sensor or Ranging(range_sigma=1, bearing_sigma_deg=1)) for name in "AB")
    team = Team(reference="A", robots=robots, landmarks=(Landmark(name="L", position=(1.0, 0.0)),))
    with atomic_run(path, team) as writer:
        for k in range(20):
            if odometry:
                writer.write(OdometrySample("A", 100.0 + k, np.array([0.1 * k, 0.0, 0.0]), np.eye(3) * 1e-4))
            time = 100.0 + k + (1000.0 if away else 0.0)
            writer.write(Ranges("A", time, (target,), np.array([1.0]), np.array([0.0])))
    return path


def test_a_run_without_odometry_says_so(tmp_path):
    run = open_run(write(tmp_path / "run.mcap", odometry=False))
    with pytest.raises(InputError, match="robot A measured ranges, but has no odometry"):
        keyframes_of(run)


def test_ranges_of_who_is_not_in_the_team_cannot_be_written(tmp_path):
    with pytest.raises(RunError, match="name `X`, which is neither another robot nor a landmark"):
        write(tmp_path / "run.mcap", target="X")
    with pytest.raises(RunError, match="name `A`, which is neither"):
        write(tmp_path / "run.mcap", target="A")
    assert not list(tmp_path.iterdir())


def test_ranges_where_there_is_no_odometry_are_left_out_and_counted(tmp_path, capsys):
    run = open_run(write(tmp_path / "run.mcap", away=True))
    with pytest.raises(InputError, match="no range was measured while there is odometry"):
        keyframes_of(run)
    main(["info", str(run.path)])
    assert "no range was measured while there is odometry" in capsys.readouterr().out


def test_one_landmark_alone_places_nobody(tmp_path, capsys):
    path = write(tmp_path / "run.mcap")
    assert main(["solve", str(path), "--out", str(tmp_path / "result")]) == 2
    why = "no robot can be localised, as A: measure it together with two robots or landmarks of known positions"
    assert why in capsys.readouterr().err
    assert not (tmp_path / "result").exists()
    main(["info", str(path)])
    assert "run: robot A has no pose: measure it together with two robots" in capsys.readouterr().out


def test_a_robot_that_nothing_ties_is_named_by_info_as_by_solve(run, copied, tmp_path):
    others = {"R1", "R2", *(one.name for one in run.team.landmarks)}
    records = [one for robot in ("R1", "R2") for one in of_targets(run.ranges(robot), others)]
    alone = open_run(copied(run.path, tmp_path / "run.mcap", more=records[:150]))
    (why,) = solve(alone).without_pose.values()
    assert Finding("run", f"robot R3 has no pose: {why}") in inspect(alone)


def test_a_robot_needs_a_camera_or_a_sensor_of_ranges():
    with pytest.raises(ValueError, match="no `camera` with its `mount`, no `ranging`"):
        Robot(name="A")
    with pytest.raises(ValueError, match="`range_sigma` is 0"):
        Ranging(range_sigma=0.0, bearing_sigma_deg=1.0)


def test_what_stands_in_a_result(run, folder, capsys, tmp_path):
    out = tmp_path / "result"
    assert main(["solve", str(run.path), "--out", str(out), "--lag", "30"]) == 2
    assert "a lag applies to incremental estimates only" in capsys.readouterr().err
    assert main(["solve", str(run.path), "--out", str(out), "--incremental", "--lag", "30"]) == 0
    assert "lag = 30" in (out / "config.toml").read_text()
    printed = capsys.readouterr().out
    assert "RMS position" in printed and "3 robots" not in printed
    summary = json.loads((out / "summary.json").read_text())
    assert (
        summary["format"] == 1
        and summary["method"] == "ranging"
        and summary["incremental"]
        and summary["world"] == "map"
    )
    assert summary["online_accuracy"]["ate_m"] > summary["accuracy"]["ate_m"] > 0
    rows = (out / "measurements.csv").read_text().splitlines()
    assert len(rows) == 1 + summary["measurements"]["used"] + summary["measurements"]["rejected"]
    assert {one.name for one in out.iterdir()} == {
        *("summary.json", "config.toml", "team.toml", "report.html", "landmarks.csv", "measurements.csv"),
        *("trajectories", "online", "graph.jrl", "factors.zip"),
    }
    report = (out / "report.html").read_text()
    assert "the map of the landmarks" in report
    assert report.count("<svg") >= 2
    assert main(["evaluate", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ate_m"] == pytest.approx(summary["accuracy"]["ate_m"])
    assert main(["solve", str(run.path), "--out", str(out), "--method", "chain"]) == 2
    capsys.readouterr()
    used = summary["measurements"]["used"]
    for form, lost in (
        ("g2o", f"left out: {used} ranges and bearings and {len(LANDMARKS)} landmarks"),
        ("pyfg", " bearings between robots, which PyFG cannot express"),
        *(("dot", "one box is all poses of a robot"), ("jrl", "robots R = R1"), ("gtsam", "")),
    ):
        assert main(["export", form, str(out), "--out", str(tmp_path / f"x.{form}")]) == 0
        assert lost in capsys.readouterr().out
    poses = read_g2o(tmp_path / "x.g2o")
    assert poses.values.size() == summary["poses"] and len(poses.ends) == summary["poses"] - 3
    assert sum(int(n) for n in re.findall(r'-- .*label="(\d+)"', (tmp_path / "x.dot").read_text())) == used
    graph = read_pyfg(tmp_path / "x.pyfg")
    assert len(graph.ranges) + len(graph.relatives) - len(poses.ends) == used
    assert main(["export", "ros2", str(out), "--out", str(tmp_path / "x.mcap")]) == 0
    assert main(["export", "foxglove", str(out), "--out", str(tmp_path / "f.mcap")]) == 0
    with (tmp_path / "f.mcap").open("rb") as file:
        scenes = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages(topics=["/scene"])
        lines = [one for *_, scene in scenes for one in scene.entities if one.id == "measurements"]
    drawn = sum(len(line.points) for one in lines for line in one.lines) / 2
    assert drawn == summary["measurements"]["used"]  # each range, to a robot or a landmark
    landmarks = (out / "landmarks.csv").read_text().splitlines()
    assert (
        landmarks[0].startswith("name,x,y,yaw_deg,x_sigma,y_sigma")
        and ",," in landmarks[1]
        and len(landmarks) == 1 + len(LANDMARKS)
    )
    assert main(["info", str(run.path)]) == 0
    page = tmp_path / "page.html"
    assert main(["view", str(out), "--export", str(page)]) == 0 and page.stat().st_size > 100_000
    (out / "measurements.csv").write_text("\n".join([*rows[:9], rows[9].replace(rows[9].split(",")[3], "soon")]) + "\n")
    assert main(["view", str(out), "--export", str(page), "--force"]) == 2
    assert "measurements.csv is damaged" in capsys.readouterr().err


def test_factors_for_gtsam_have_the_estimate_as_optimum_and_its_covariances(run, batch, tmp_path):
    text = ranging_gtsam_files(batch.estimate, run.team)
    for name, content in text.items():
        (tmp_path / name).write_text(content)
    script = runpy.run_path(str(tmp_path / "solve.py"))
    factors, exact, names = script["load"]()
    found, _ = script["solve"](factors, exact)
    covariances = script["covariances"](factors, found, names)
    assert np.nanmax(np.abs(batch.estimate.ranging.residuals)) > 4.0  # robust weights are active
    for robot, letter in zip(run.team.names, "RAB", strict=True):
        trajectory = batch.estimate.trajectories[robot]
        for n in range(0, len(trajectory), 9):
            x, y, yaw = found.atPose2(key := key_of(f"{letter}{n}")).localCoordinates(exact.atPose2(key))
            sigmas = np.sqrt(trajectory.covariances[n].diagonal()[[3, 4, 2]])
            assert np.all(np.abs([x, y, yaw]) < 0.02 * sigmas)
            np.testing.assert_allclose(np.sqrt(covariances[key].diagonal()), sigmas, rtol=0.005)


def test_the_graph_of_a_ranging_run_has_the_estimate_as_optimum(run, batch):
    graph = ranging_graph(batch.estimate, run.team)
    start = values_of(graph.initial)
    found = gtsam.LevenbergMarquardtOptimizer(factors_of(graph), start).optimize()
    for robot, letter in zip(run.team.names, "RAB", strict=True):
        trajectory = batch.estimate.trajectories[robot]
        solved = np.array([found.atPose2(key_of(f"{letter}{n}")).translation() for n in range(len(trajectory))])
        off = np.hypot(*(solved - trajectory.positions[:, :2]).T)
        assert np.all(off < 0.02 * np.sqrt(trajectory.covariances[:, 3, 3]))


def test_the_viewer_shows_where_each_was_and_what_it_measured(run, batch, tmp_path):
    write_result(batch, tmp_path / "result")
    table = tmp_path / "result" / "measurements.csv"
    head, *rows = table.read_text().splitlines()
    doubted = np.arange(len(rows)) % 100 < 50
    rows = [
        row.replace("range,yes,", "range,no,doubtful") if off else row for row, off in zip(rows, doubted, strict=True)
    ]
    table.write_text("\n".join([head, *rows]) + "\n")
    scene = scene_of_result(tmp_path / "result")
    estimated, true = scene.layers
    truth = assess(batch)[1]
    trajectories = batch.estimate.trajectories
    for number, robot in enumerate(scene.robots):
        rows = estimated.rows[number]
        at = np.searchsorted(trajectories[robot].times, estimated.times[number, rows] - 1e-5)
        # the first of each second, as it is in the estimate; and the truth at that time
        np.testing.assert_allclose(trajectories[robot].times[at], estimated.times[number, rows], atol=1e-5)
        np.testing.assert_allclose(trajectories[robot].positions[at], estimated.xyz[number, rows], atol=1e-6)
        second = np.floor(trajectories[robot].times - scene.starts[0] + 1e-9)
        np.testing.assert_array_equal(at, np.unique(second, return_index=True)[1])
        known = truth[robot][at]
        there = np.isfinite(true.yaw[number, rows])
        assert there.sum() > 20
        np.testing.assert_allclose(true.xyz[number, rows][there], known[there][:, :3, 3], atol=1e-6)
    links, seen = scene.sightings, scene.landmarks.sightings
    assert len(scene.landmarks) == len(LANDMARKS) and len(links) > 10 and len(seen) > 20
    m, names = batch.estimate.ranging.keyframes.measured, batch.estimate.ranging.names
    used = batch.estimate.ranging.used & ~doubted
    told = {
        (int(np.floor(m.time[n] - scene.starts[0] + 1e-9)), names[m.robot[n]], names[m.target[n]])
        for n in np.flatnonzero(used)
    }
    shown = {(int(k), scene.robots[i], scene.robots[j]) for k, i, j in zip(links.rows_j, links.i, links.j, strict=True)}
    shown |= {
        (int(k), scene.robots[i], scene.landmarks.names[j]) for k, i, j in zip(seen.rows_j, seen.i, seen.j, strict=True)
    }
    assert shown == told
    known = {name: one.planar[:2] for name, one in batch.estimate.landmarks.items()}
    for name, place in zip(scene.landmarks.names, scene.landmarks.xy, strict=True):
        np.testing.assert_allclose(place, known[name], atol=1e-6)


def test_exact_wheels_and_sensors_are_no_variables(run):
    exact = with_fields(
        run.team,
        robots=tuple(
            with_fields(
                robot,
                wheels=with_fields(
                    robot.wheels, scale=SCALE, delay=DELAY, scale_sigma=0.0, turn_scale_sigma=0.0, delay_sigma=0.0
                ),
                ranging=Ranging(range_sigma=0.05, bearing_sigma_deg=0.5),
            )
            for robot in run.team.robots
        ),
    )
    estimate = optimise_keyframes(exact, keyframes_of(replace(run, team=exact)), calibrate_noise=False)
    assert not estimate.calibration
    assert set(estimate.trajectories) == set(run.team.names)
