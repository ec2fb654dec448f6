"""The estimator while stances come in: equal to batch, transactional, late and early, revoked, resumed."""

import json
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from teams import fed, graph_of_team, largest_difference, of_stance, team_of
from whole_graph import replay

from coloc_graph.backend import Estimator, smooth
from coloc_graph.backend.chi2_test import agreement
from coloc_graph.backend.solver import covariance_root, isam_parameters
from coloc_graph.errors import EstimationError, InputError, MeasurementError
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.measurements import Odometry, RelativePose, Sighting
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.run import Stance, open_run


@pytest.fixture(scope="module")
def team():
    return team_of(6, 12, seed=4)


def paper(seed=0, **options):
    """The paper's three robots."""
    return team_of(3, 10, seed=seed, rotating=False, **options)


def state_of(estimator):
    """All that can be seen of an estimator, to the bit but for ISAM2's rounding."""
    graph = estimator.graph
    poses = {n: estimator.pose(*n).matrix() for n in graph.nodes}
    return (
        repr(estimator), graph.stances, tuple(map(id, estimator.measurements)), estimator.waiting,
        tuple(id(r.measurement) for r in estimator.rejected), poses,
    )  # fmt: skip


def assert_resumed(estimator, path):
    """A checkpoint gives the same poses and covariances, to the bit."""
    estimator.save(path)
    resumed = Estimator.resume(path)
    assert repr(resumed) == repr(estimator)
    for node in estimator.graph.nodes:
        np.testing.assert_array_equal(resumed.pose(*node).matrix(), estimator.pose(*node).matrix())
        np.testing.assert_array_equal(resumed.covariance(*node), estimator.covariance(*node))
    return resumed


def assert_same(before, after, atol=0.0):
    assert before[:-1] == after[:-1]
    for node, T in before[-1].items():
        np.testing.assert_allclose(after[-1][node], T, rtol=0, atol=atol)


@pytest.mark.parametrize("made", [team_of(6, 12, seed=4), paper(), team_of(3, 10), team_of(4, 8, floor=None)])
def test_incremental_at_the_end_is_batch(made):
    estimator, batch = fed(made), smooth(graph_of_team(made))
    whole = estimator.estimate()
    assert largest_difference(whole, batch, batch.graph.nodes) < 1e-6
    for node in batch.graph.nodes:
        np.testing.assert_allclose(whole.covariance(*node), batch.covariance(*node), rtol=1e-4, atol=1e-12)
        # what it holds between is never far off: a fraction of a sigma
        off = batch.pose(*node).between(estimator.pose(*node)).translation()
        assert np.linalg.norm(off) < 0.1 * np.sqrt(np.trace(batch.covariance(*node)[3:, 3:])) + 1e-6
    for stay in batch.graph.stay_puts:
        one, other = (estimator.pose(*end).matrix() for end in stay.ends)
        assert np.array_equal(one, other)


def test_an_incremental_solution_is_heard_of_stance_by_stance(hallway):
    run = open_run(hallway)
    heard = []
    solution = solve(run, SolveOptions(incremental=True), on_update=heard.append)
    assert [one.stance.index for one in heard] == [stance.index for stance in run.stances]
    assert heard[0].stance.anchors == () and len(heard[0].pairs) == 1
    assert sum(len(one.measurements) for one in heard) == len(solution.estimate.graph.measurements)
    # what was known when the last one came in is what is known at the end, but for what one step of ISAM2 leaves
    for robot, pose in heard[-1].estimate.poses.items():
        if robot in solution.estimate.trajectories:
            last = solution.estimate.trajectories[robot].T_world_body[-1]
            assert np.abs(pose.matrix() - last).max() < 1e-3


def test_what_is_measured_stance_by_stance_is_what_is_measured_at_once(hallway, solutions):
    at_once, by_stance = solutions["joint"], solve(open_run(hallway), SolveOptions(incremental=True))
    ways = [
        {m.ends: m for m in one.estimate.graph.measurements if isinstance(m, Odometry)} for one in (at_once, by_stance)
    ]
    assert ways[0].keys() == ways[1].keys() and len(ways[0]) > 10
    for ends, way in ways[0].items():
        assert np.allclose(way.T_before_after, ways[1][ends].T_before_after, atol=1e-12)
        assert np.allclose(way.covariance, ways[1][ends].covariance, rtol=1e-9)


def test_incremental_is_batch_on_a_run(hallway, solutions):
    solution = solve(open_run(hallway), SolveOptions(incremental=True))
    batch = solutions["joint"].estimate
    # the noise of a stance is that learnt before it
    assert largest_difference(solution.estimate, batch, batch.graph.nodes) < 5e-4
    assert len(solution.seconds_updates) == 8


def test_a_stance_gives_where_its_robots_stand(team):
    estimator = Estimator("A", team.robots, team.floor)
    for stance in team.stances:
        found = estimator.add(stance, of_stance(team, stance.index))
        assert found.stance == stance.index and set(found.poses) == set(team.robots) and not found.disconnected
        robot = stance.observers[-1]
        assert found.poses[robot].equals(estimator.pose(robot), 0.0)
        assert np.array_equal(found.covariances[robot], estimator.covariance(robot))


def test_a_stance_gives_covariances_and_residuals_of_the_last_step():
    made = team_of(3, 12, rotating=False)
    estimator = Estimator("A", made.robots, made.floor)
    for stance in made.stances:
        taken = of_stance(made, stance.index)
        found = estimator.add(stance, taken)
        for robot, C in found.covariances.items():
            alone = estimator._live.isam.marginalCovariance(estimator._pose_keys.key((robot, stance.index)))
            sigmas = np.sqrt(alone.diagonal())
            np.testing.assert_allclose(C / np.outer(sigmas, sigmas), alone / np.outer(sigmas, sigmas), atol=1e-8)
        for one, residual in zip(taken, found.residuals, strict=True):
            T_i, T_j = (estimator.pose(*node) for node in one.ends)
            e = np.asarray(gtsam.Pose3(one.T_i_j).localCoordinates(T_i.between(T_j)))
            e = e if len(one.covariance) == 6 else e[2:5]
            assert residual == pytest.approx(np.sqrt(e @ np.linalg.solve(one.covariance, e) / len(e)), rel=1e-6)


def test_measurements_are_tested_alike_where_the_position_is_known_to_metres_alone():
    """Far from where the heading was known, the covariance of two poses has no digits left of their relative one."""
    isam, factors, values = gtsam.ISAM2(isam_parameters()), gtsam.NonlinearFactorGraph(), gtsam.Values()
    i, j = gtsam.symbol("x", 0), gtsam.symbol("x", 1)
    far, step = gtsam.Pose3(floor_pose(60000.0, 9000.0, 0.7)), gtsam.Pose3(floor_pose(1.0, 0.2, 0.3))
    precise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-5)
    turned = far.inverse().AdjointMap()[:, 2:3] * 0.05  # rad, about the origin
    C = turned @ turned.T + np.diag(np.square([1e-3, 1e-3, 1e-4, 1e-3, 1e-3, 1e-3]))
    factors.add(gtsam.PriorFactorPose3(i, far, gtsam.noiseModel.Gaussian.Covariance(C)))
    between = [gtsam.BetweenFactorPose3(i, j, step.retract(np.full(6, off)), precise) for off in (-1e-5, 1e-5)]
    for one in between:
        factors.add(one)
    values.insert(i, far)
    values.insert(j, far.compose(step))
    isam.update(factors, values)
    off = agreement(between[:1], isam.calculateEstimate(), covariance_root(isam, [i, j]))
    assert off.dof == 6 and off.chi2 == pytest.approx(12, rel=1e-3)  # 6 rows, each off by root two of its sigmas


def test_a_stance_agrees_with_those_before_by_what_chi2_rises_when_it_comes(team):
    estimator = Estimator("A", team.robots, team.floor)
    for stance in team.stances:
        before = estimator.estimate() if estimator.stances else None
        off = estimator.add(stance, of_stance(team, stance.index)).agreement
        if before is not None:
            rise = estimator.estimate().chi2 - before.chi2
            assert off.chi2 == pytest.approx(rise, rel=0.05, abs=0.05) and 1e-4 < off.p_value() < 1


def test_late_measurements_give_the_same_as_those_in_time(team):
    late = [m for m in team.measurements if isinstance(m, RelativePose) and m.stance in (2, 5)][::2]
    held = set(map(id, late))
    estimator = fed(team, [m for m in team.measurements if id(m) not in held])
    estimator.insert(*late)
    batch = smooth(graph_of_team(team))
    assert largest_difference(estimator.estimate(), batch, batch.graph.nodes) < 1e-6


def test_stances_out_of_order_wait_for_the_one_they_follow(team):
    estimator = Estimator("A", team.robots, team.floor)
    order = [0, 2, 3, 1, 5, 4, *range(6, 12)]
    for index in order:
        found = estimator.add(team.stances[index], of_stance(team, index))
        if index == 3:
            assert estimator.waiting == (2, 3) and found.disconnected == team.stances[3].observers and not found.poses
            assert [s.index for s in estimator.stances] == [0]
        if index == 1:
            assert estimator.waiting == () and found.stance == 3
    batch = smooth(graph_of_team(team))
    assert largest_difference(estimator.estimate(), batch, batch.graph.nodes) < 1e-6


def test_a_stance_whose_successor_cannot_enter_does_not_enter_either(team):
    estimator = Estimator("A", team.robots, team.floor)
    for stance in team.stances[:3]:
        estimator.add(stance, of_stance(team, stance.index))
    estimator.add(replace(team.stances[4], anchors=()))
    before = state_of(estimator)
    for _ in range(2):
        with pytest.raises(MeasurementError, match=r"stance 4 has no anchor .* drop it by `discard\(4\)`"):
            estimator.add(team.stances[3], of_stance(team, 3))
        assert_same(before, state_of(estimator))
    estimator.discard(4)
    with pytest.raises(MeasurementError, match="stance 4 cannot be discarded"):
        estimator.discard(4)
    for stance in team.stances[3:]:
        estimator.add(stance, of_stance(team, stance.index))
    assert_same(state_of(fed(team)), state_of(estimator))


@pytest.mark.parametrize("order", [[1, 0], [2, 1, 0], [3, 2, 0, 1]])
def test_stances_that_come_before_the_first_wait_for_it(team, order):
    """None of them may become the world's origin for having come first."""
    estimator = Estimator("A", team.robots, team.floor)
    for index in [*order, *range(len(order), 12)]:
        estimator.add(team.stances[index], of_stance(team, index))
    assert estimator.waiting == () and [s.index for s in estimator.stances] == list(range(12))
    batch = smooth(graph_of_team(team))
    assert largest_difference(estimator.estimate(), batch, batch.graph.nodes) < 1e-6


def test_what_nothing_ties_waits_until_something_does():
    made = team_of(6, 6, seed=2, odometry=False, sightings=False)
    apart = {"E", "F"}
    bridges = [m for m in made.measurements if len({r for r, _ in m.ends} & apart) == 1]
    held = set(map(id, bridges))
    estimator = fed(made, [m for m in made.measurements if id(m) not in held])
    # E stays at its first place until stance 1
    with pytest.raises(EstimationError, match="robot E has no pose at stance 0"):
        estimator.pose("E", 0)
    estimator.insert(*bridges)
    batch = smooth(graph_of_team(made))
    assert (
        largest_difference(estimator.estimate(), batch, [n for n in batch.graph.nodes if n not in batch.disconnected])
        < 1e-6
    )


def test_a_revoked_measurement_is_as_if_it_had_never_come(team):
    estimator = fed(team)
    taken = [m for m in team.measurements if isinstance(m, RelativePose)][20]
    estimator.revoke(taken)
    without = smooth(graph_of_team(team, [m for m in team.measurements if m is not taken]))
    assert largest_difference(estimator.estimate(), without, without.graph.nodes) < 1e-6
    with pytest.raises(EstimationError, match="cannot be removed: it was not added"):
        estimator.revoke(taken)


def test_revoking_what_ties_a_robot_unties_it_and_it_can_come_back():
    made = team_of(3, 4, seed=1, sightings=False, odometry=False, rotating=False)
    estimator = fed(made)
    (tie,) = [m for m in made.measurements if m.stance == 2]
    whole = estimator.estimate()
    estimator.revoke(tie)
    with pytest.raises(EstimationError, match="robot B has no pose at stance 3"):
        estimator.pose("B", 3)
    estimator.insert(tie)
    assert largest_difference(estimator.estimate(), whole, whole.graph.nodes) < 1e-6


def test_a_withdrawn_stance_is_as_if_it_had_never_come_and_can_come_again():
    made = team_of(4, 8, seed=3, wrong=0.1)
    whole, estimator = fed(made), Estimator(made.robots[0], made.robots, made.floor)
    before = None
    for stance in made.stances:
        earlier = state_of(estimator) if before is not None else None
        follows = None if before is None else before.index
        estimator.add(stance, of_stance(made, stance.index), after=follows)
        if earlier is not None:
            assert estimator.withdraw() == stance
            assert_same(earlier, state_of(estimator), atol=1e-4)  # ISAM2 linearised elsewhere
            estimator.add(stance, of_stance(made, stance.index), after=follows)
        before = stance
    assert {id(one.measurement) for one in estimator.rejected} == {id(one.measurement) for one in whole.rejected}
    assert largest_difference(estimator.estimate(), whole.estimate(), whole.graph.nodes) < 1e-6
    with pytest.raises(EstimationError, match="the first stance"):
        for _ in made.stances:
            estimator.withdraw()


def test_wrong_homographies_are_refused_before_they_enter_and_leave_no_trace():
    made = team_of(6, 9, seed=1, wrong=0.1)
    estimator = fed(made)
    assert {id(r.measurement) for r in estimator.rejected} == set(map(id, made.wrong)) and len(made.wrong) >= 5
    right = smooth(graph_of_team(made, [m for m in made.measurements if m not in made.wrong]))
    assert largest_difference(estimator.estimate(), right, right.graph.nodes) < 1e-6
    assert all("sigmas from the other measurements" in r.reason for r in estimator.rejected)


@pytest.mark.parametrize("off", [0.03, 0.045])
def test_a_homography_that_is_a_little_wrong_is_refused_too(team, off):
    """So near what is expected that it enters at once, and is then taken out: 3 cm are 6 sigmas and more."""
    victim = [m for m in team.measurements if isinstance(m, RelativePose) and m.stance == 7][4]
    T = gtsam.Pose3(victim.T_i_j).compose(gtsam.Pose3(floor_pose(off, -off, 0.0)))
    spoilt = RelativePose(7, victim.robot_i, victim.robot_j, T, victim.covariance)
    estimator = fed(team, [spoilt if m is victim else m for m in team.measurements])
    assert [r.measurement for r in estimator.rejected] == [spoilt]
    right = smooth(graph_of_team(team, [m for m in team.measurements if m is not victim]))
    assert largest_difference(estimator.estimate(), right, right.graph.nodes) < 1e-6


def test_what_a_wrong_measurement_kept_out_comes_back_when_that_is_revoked():
    made = team_of(4, 1, seed=3, sightings=False)
    a, b = next(m for m in made.measurements if {r for r, _ in m.ends} == {"A", "B"}), None
    T = gtsam.Pose3(floor_pose(0.4, 0.3, 0.5)).compose(gtsam.Pose3(a.T_i_j))
    wrong = RelativePose(0, "A", "B", T, a.covariance)
    others = [m for m in made.measurements if m is not a]
    estimator = Estimator("A", made.robots, made.floor)
    estimator.add(made.stances[0], [wrong])
    estimator.insert(a, *others)
    b = {id(r.measurement) for r in estimator.rejected}
    assert id(a) in b
    estimator.revoke(wrong)
    assert not estimator.rejected
    batch = smooth(graph_of_team(made))
    assert largest_difference(estimator.estimate(), batch, batch.graph.nodes) < 1e-6


def test_a_checkpoint_resumes_as_if_nothing_had_happened(team, tmp_path):
    whole, half = fed(team), Estimator("A", team.robots, team.floor)
    for stance in team.stances[:6]:
        half.add(stance, of_stance(team, stance.index))
    half.add(team.stances[7], of_stance(team, 7))  # early
    resumed = assert_resumed(half, tmp_path / "half.json")
    assert resumed.waiting == (7,)
    for before, after in zip(half.measurements, resumed.measurements, strict=True):
        assert type(before) is type(after) and before.ends == after.ends
    for index in (6, 8, 9, 10, 11):
        resumed.add(team.stances[index], of_stance(team, index))
        half.add(team.stances[index], of_stance(team, index))
    for node in whole.graph.nodes:
        np.testing.assert_array_equal(resumed.pose(*node).matrix(), half.pose(*node).matrix())
        np.testing.assert_allclose(resumed.covariance(*node), half.covariance(*node), rtol=1e-9, atol=1e-18)
    assert largest_difference(resumed.estimate(), half.estimate(), whole.graph.nodes) == 0


def test_a_checkpoint_keeps_what_was_rejected_revoked_and_withdrawn(tmp_path):
    made = team_of(6, 10, seed=1, wrong=0.1)
    estimator = fed(made)
    resumed = assert_resumed(estimator, tmp_path / "fed.json")
    assert resumed.rejected and [(r.measurement.ends, r.reason) for r in resumed.rejected] == [
        (r.measurement.ends, r.reason) for r in estimator.rejected
    ]
    last = estimator.withdraw()
    estimator.revoke(estimator.rejected[0].measurement)
    late, *others = of_stance(made, last.index)
    estimator.add(last, others)
    estimator.insert(late)
    assert_resumed(estimator, tmp_path / "changed.json")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda text: text[:-30], "is not a checkpoint, or a damaged one"),
        (lambda text: "{}", "is not a checkpoint"),
        (lambda text: text.replace("checkpoint-7", "checkpoint-5"), "not a checkpoint of this version"),
        (lambda text: text.replace('"relative_pose"', '"guess"', 1), "no kind of measurement `guess`"),
        (lambda text: text.replace('"rejected":{}', '"rejected":{"9":"why"}'), "that is not there is rejected"),
        (lambda text: _with(text, "journal", json.loads(text)["checkpoint"]["journal"] * 2), "damaged checkpoint"),
    ],
)
def test_a_bad_checkpoint_is_one_sentence(team, tmp_path, spoil, words):
    estimator = Estimator("A", team.robots, team.floor)
    estimator.add(team.stances[0], of_stance(team, 0))
    path = tmp_path / "point.json"
    estimator.save(path)
    path.write_text(spoil(path.read_text()))
    with pytest.raises(InputError, match=words) as refusal:
        Estimator.resume(path)
    assert "\n" not in str(refusal.value)


def _with(text, name, value):
    file = json.loads(text)
    return json.dumps(file | {"checkpoint": file["checkpoint"] | {name: value}})


def test_a_checkpoint_that_is_not_there_or_cannot_be_written_is_one_sentence(team, tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        Estimator.resume(tmp_path / "none.json")
    estimator = Estimator("A", team.robots, team.floor)
    with pytest.raises(InputError, match="cannot be written"):
        estimator.save(tmp_path / "no" / "such" / "folder.json")


def bad(measured, *, T=None, covariance=None):
    T = measured.T_i_j if T is None else T
    C = measured.covariance if covariance is None else covariance
    return replace(measured, T_i_j=T, covariance=C)


def entry(matrix, at, value):
    out = np.array(matrix, float)
    out[at] = value
    return out


BAD = {
    "NaN in a pose": (lambda m: bad(m, T=entry(m.T_i_j, (0, 3), np.nan)), "is not finite"),
    "infinite": (lambda m: bad(m, T=entry(m.T_i_j, (1, 3), np.inf)), "is not finite"),
    "1e150": (lambda m: bad(m, T=entry(m.T_i_j, (1, 3), 1e150)), r"1e\+150 m away"),
    "no rotation": (lambda m: bad(m, T=entry(m.T_i_j, (0, 0), 2.0)), "no rigid motion"),
    "a reflection": (lambda m: bad(m, T=np.diag([1.0, 1, -1, 1])), "a reflection"),
    "NaN in a covariance": (lambda m: bad(m, covariance=np.full((6, 6), np.nan)), "covariance that is not finite"),
    "asymmetric": (lambda m: bad(m, covariance=entry(m.covariance, (0, 5), 1.0)), "not symmetric"),
    "indefinite": (lambda m: bad(m, covariance=-np.eye(6)), "not positive definite"),
    "known exactly": (lambda m: bad(m, covariance=np.zeros((6, 6))), "not positive definite"),
    "huge": (lambda m: bad(m, covariance=1e150 * np.eye(6)), "is possible"),
    "wrong shape": (lambda m: bad(m, covariance=np.eye(3)), r"shape \(3, 3\)"),
    "unknown robot": (lambda m: replace(m, robot_j="Z"), "names robot Z, which is not in the team"),
    "unknown stance": (lambda m: replace(m, stance=77), "names stance 77, which is none"),
    "itself": (lambda m: replace(m, robot_j=m.robot_i), "relates a robot to itself"),
    "the mover observes": (lambda m: replace(m, robot_j="?"), "which is no observer of stance"),
}


@pytest.mark.parametrize("what", BAD)
def test_what_is_no_measurement_is_refused_and_nothing_has_changed(team, what):
    estimator = Estimator("A", team.robots, team.floor)
    for stance in team.stances[:5]:
        estimator.add(stance, of_stance(team, stance.index))
    before = state_of(estimator)
    spoil, words = BAD[what]
    good = of_stance(team, 5)
    (victim, *_) = [m for m in good if isinstance(m, RelativePose)]
    spoilt = spoil(victim)
    if spoilt.robot_j == "?":
        spoilt = replace(spoilt, robot_j=team.stances[5].movers[0])
    with pytest.raises(MeasurementError, match=words) as refusal:
        estimator.add(team.stances[5], [*good, spoilt])
    assert "\n" not in str(refusal.value) and "relative pose of" in str(refusal.value)
    assert_same(before, state_of(estimator))
    estimator.add(team.stances[5], good)
    assert estimator.pose("B", 5).equals(fed(team).pose("B", 5), 0.05)
    # the same in batch
    with pytest.raises(MeasurementError, match=words):
        graph_of_team(team, [*team.measurements, spoilt])


@pytest.mark.parametrize(
    ("stance", "after", "words"),
    [
        (Stance(3, 30, 35, ("A", "B"), ("C",), ("A", "B")), None, "stance 3 was added before"),
        (Stance(5, 50, 55, ("A", "B"), ("C",)), None, "stance 5 has no anchor"),
        (Stance(5, 50, 55, ("A", "Z"), ("C",), ("A",)), None, "robot Z, which is not in the team"),
        (Stance(5, 50, 55, ("A", "B"), ("C",), ("A",)), 2, "follows stance 2, but so does stance 4"),
    ],
)
def test_what_is_no_stance_is_refused_and_nothing_has_changed(team, stance, after, words):
    estimator = Estimator("A", team.robots, team.floor)
    for one in team.stances[:5]:
        estimator.add(one, of_stance(team, one.index))
    before = state_of(estimator)
    with pytest.raises(MeasurementError, match=words):
        estimator.add(stance, (), after=after)
    assert_same(before, state_of(estimator))


def test_a_first_stance_without_the_reference_is_refused():
    with pytest.raises(EstimationError, match="reference robot A does not observe at stance 0"):
        Estimator("A", ("A", "B", "C")).add(Stance(0, 0, 1, ("B", "C")))
    with pytest.raises(EstimationError, match="reference robot Z is not one of A, B"):
        Estimator("Z", ("A", "B"))


def test_a_moving_robot_sighted_at_two_instants_of_a_stance_is_refused(team):
    estimator = fed(team)
    (seen,) = [m for m in team.measurements if isinstance(m, Sighting) and m.stance == 11]
    before = state_of(estimator)
    with pytest.raises(MeasurementError, match=r"is \+0.500 s from an earlier one"):
        estimator.insert(replace(seen, time=seen.time + 0.5))
    assert_same(before, state_of(estimator))


def test_planar_measurements_need_a_floor():
    made = team_of(3, 2)
    (way, *_) = [m for m in made.measurements if isinstance(m, Odometry)]
    estimator = Estimator("A", made.robots)
    with pytest.raises(MeasurementError, match=r"needs a floor.*\[floor\]"):
        estimator.add(made.stances[0], [way])


def test_a_solver_that_fails_leaves_the_estimator_as_it_was(team, monkeypatch):
    """ISAM2 itself keeps half of a failed update: after one everything enters anew, as it came."""
    estimator = Estimator("A", team.robots, team.floor)
    for stance in team.stances[:6]:
        estimator.add(stance, of_stance(team, stance.index))
    before = state_of(estimator)

    def fails(far, inside):  # ISAM2 has taken new poses and factors by then
        assert estimator._live.isam.valueExists(estimator._pose_keys.key((team.stances[6].observers[-1], 6)))
        raise RuntimeError("no")

    with monkeypatch.context() as broken:
        broken.setattr(estimator._live, "_enter_far", fails)
        with pytest.raises(EstimationError, match="cannot be solved with this, and was restored: no"):
            estimator.add(team.stances[6], of_stance(team, 6))
    assert_same(before, state_of(estimator))
    for stance in team.stances[6:]:
        estimator.add(stance, of_stance(team, stance.index))
    batch = smooth(graph_of_team(team))
    assert largest_difference(estimator.estimate(), batch, batch.graph.nodes) < 1e-6


def test_questions_about_what_is_not_there_are_answered_in_words(team):
    estimator = fed(team)
    with pytest.raises(EstimationError, match="robot Z is not in the team"):
        estimator.pose("Z")
    with pytest.raises(EstimationError, match="robot B has no pose at stance 99"):
        estimator.covariance("B", 99)
    with pytest.raises(EstimationError, match="no stance"):
        Estimator("A", ("A", "B")).estimate()
    with pytest.raises(MeasurementError, match="add one first"):
        Estimator("A", ("A", "B")).insert(*of_stance(team, 0))


@pytest.mark.parametrize("finer", [1, 100])
def test_a_straight_chain_of_1000_steps_is_followed(finer):
    sigmas = np.array([0.02] * 3 + [0.002] * 3) / finer
    C, T = np.diag(np.square(sigmas)), gtsam.Pose3(floor_pose(1, 0, 0))
    estimator = Estimator("A", ("A", "B"))
    for k in range(1000):
        pair = ("A", "B") if k % 2 == 0 else ("B", "A")
        found = estimator.add(
            Stance(k, 10.0 * k, 10.0 * k + 5, pair, (), pair[:1] if k else ()),
            [RelativePose(k, *pair, T, C, T, 0, 0.0)],
        )
    np.testing.assert_allclose(found.poses[pair[1]].translation(), [1000, 0, 0], atol=1e-5)
    expected = (0.02**2 * sum(k**2 for k in range(1000)) + 1000 * 0.002**2) / finer**2
    assert found.covariances[pair[1]][4, 4] == pytest.approx(expected, rel=1e-3)


def test_on_a_floor_a_stance_costs_what_it_costs_however_long_the_run():
    """Poses that start tilted make ISAM2 redo the whole chain at every step: none may be linearised anew far back."""
    made = team_of(3, 400, rotating=False, sightings=False)
    estimator = Estimator("A", made.robots, made.floor)
    counts = []
    for stance in made.stances:
        estimator.add(stance, of_stance(made, stance.index))
        counts.append(estimator._live.isam.update().getVariablesReeliminated())
    assert np.median(counts[300:]) < 20


def test_a_run_is_replayed_whatever_its_stances_are_numbered():
    made = team_of(3, 6)
    graph = graph_of_team(made)
    numbers = {stance.index: 10 * stance.index + 4 for stance in made.stances}
    stances = tuple(replace(stance, index=numbers[stance.index]) for stance in made.stances)

    def renumbered(m):
        if isinstance(m, Odometry):
            return replace(m, before=numbers[m.before], after=numbers[m.after])
        return replace(m, stance=numbers[m.stance])

    estimate, seconds = replay(replace(graph, stances=stances, measurements=tuple(map(renumbered, made.measurements))))
    batch = smooth(graph)
    assert len(seconds) == 6
    for robot, stance in batch.graph.nodes:
        assert estimate.pose(robot, numbers[stance]).equals(batch.pose(robot, stance), 1e-6)
