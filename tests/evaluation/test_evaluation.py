"""Estimate against truth: zeros, known errors, invariances, NEES, and truth that does not cover the estimate."""

import dataclasses

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from coloc_graph.errors import InputError
from coloc_graph.evaluation import PLANAR, RobotAccuracy, Spread, align, evaluate, nees_of, true_poses
from coloc_graph.evaluation.truth import nearest_true_poses
from coloc_graph.geometry.lie import floor_pose, rotation_x, se3, so3_exp
from coloc_graph.geometry.trajectory import Trajectory

TIMES = 1_700_000_000.0 + np.arange(5) * 10.0


def trajectory(robot, x0=0.0, y0=0.0, times=TIMES, covariances=None):
    k = np.arange(len(times))
    return Trajectory(robot, times, floor_pose(x0 + 0.5 * k, y0 + 0.1 * k, 0.2 * k), k, covariances)


def moved(one, T, **changes):
    """The same trajectory in another world: every pose with T before it."""
    fields = {"robot": one.robot, "times": one.times, "T_world_body": T @ one.T_world_body} | changes
    return Trajectory(**fields)


@pytest.fixture
def team():
    return {"A": trajectory("A"), "B": trajectory("B", 0.0, 0.7)}


@pytest.mark.parametrize("on_floor", [True, False])
def test_identical_trajectories_have_no_error_at_all(team, on_floor):
    accuracy = evaluate(team, align(team, team, "A", on_floor=on_floor), on_floor=on_floor)
    assert accuracy.ate == accuracy.end_position_error == accuracy.heading_error_deg == 0.0
    assert accuracy.anees is None and accuracy.nees_poses == 0
    for row in accuracy.robots:
        assert row.length_error == row.ate == 0.0 and row.length_error_percent == 0.0
        assert row.true_length == pytest.approx(np.hypot(2.0, 0.4))


@pytest.mark.parametrize("T", [floor_pose(3, -2, 2.5), se3(so3_exp([0.3, -0.2, 1.0]), [1.0, 2.0, 3.0])])
def test_the_world_in_which_truth_was_taken_does_not_matter(team, T):
    truth = {name: moved(one, T) for name, one in team.items()}
    at = align(team, truth, "A", on_floor=False)
    for name, one in team.items():
        np.testing.assert_allclose(at[name], one.T_world_body, atol=1e-12)
    assert evaluate(team, at, on_floor=False).ate < 1e-12


def test_on_the_floor_a_tilted_reference_does_not_tilt_the_world(team):
    tilted = team["A"].T_world_body.copy()
    tilted[0] = tilted[0] @ se3(rotation_x(0.02), [0, 0, 0.001])
    truth = team | {"A": Trajectory("A", TIMES, tilted)}
    np.testing.assert_allclose(align(team, truth, "A", on_floor=True)["B"], team["B"].T_world_body, atol=1e-12)
    assert np.abs(align(team, truth, "A", on_floor=False)["B"] - team["B"].T_world_body).max() > 0.01


def test_a_known_offset_and_rotation_are_what_is_reported(team):
    """B is 3 cm off to the left and 4 cm high everywhere, and at the end turned by 5 deg besides."""
    off = team["B"].T_world_body.copy()
    off[:, :3, 3] += (0, 0.03, 0.04)
    off[-1, :3, :3] = off[-1, :3, :3] @ so3_exp([0, 0, np.deg2rad(5)])
    estimate = team | {"B": Trajectory("B", TIMES, off)}
    accuracy = evaluate(estimate, align(estimate, team, "A", on_floor=True), on_floor=True)
    a, b = accuracy.robots
    assert (a.ate, a.heading_error_deg) == (0.0, 0.0)
    assert b.ate == pytest.approx(0.05) and b.end_position_error == pytest.approx(0.05)
    assert b.heading_error_deg == pytest.approx(5)
    assert b.length_error == pytest.approx(0, abs=1e-12)
    assert accuracy.ate == pytest.approx(0.05 / np.sqrt(2))  # over A's poses too
    assert accuracy.heading_error_deg == pytest.approx(5) and accuracy.end_position_error == pytest.approx(0.05)


def test_headings_either_side_of_180_degrees_are_near_each_other():
    estimate = {"A": Trajectory("A", TIMES[:2], floor_pose([0, 1], [0, 0], [0, np.deg2rad(179)]))}
    truth = {"A": Trajectory("A", TIMES[:2], floor_pose([0, 1], [0, 0], [0, np.deg2rad(-179)]))}
    accuracy = evaluate(estimate, align(estimate, truth, "A", on_floor=True), on_floor=True)
    assert accuracy.heading_error_deg == pytest.approx(2)


def test_a_stretched_path_is_that_many_percent_long(team):
    stretched = team["A"].T_world_body.copy()
    stretched[:, :3, 3] *= 1.02
    estimate = {"A": Trajectory("A", TIMES, stretched)}
    (row,) = evaluate(estimate, align(estimate, team, "A", on_floor=True), on_floor=True).robots
    assert row.length_error_percent == pytest.approx(2)
    assert row.length_error > 0


def test_a_robot_that_stood_has_no_percentage():
    nothing = Spread(0, 0, 0, 0)
    for true, estimated, percent in ((0.0, 0.01, None), (0.04, 0.05, None), (1.0, 0.99, pytest.approx(1))):
        assert RobotAccuracy("A", true, estimated, 0, 0, nothing, nothing).length_error_percent == percent


def test_truth_is_the_latest_at_or_before_each_pose(team):
    dense = np.concatenate([TIMES - 2, TIMES, TIMES + 3])
    order = np.argsort(dense)
    wrong = floor_pose(9.0, 9.0, 0.0)
    poses = np.concatenate([np.tile(wrong, (5, 1, 1)), team["A"].T_world_body, np.tile(wrong, (5, 1, 1))])
    estimate = {"A": team["A"]}
    for late in (0.0, 5e-7):  # times of floats and of nanoseconds differ in the last digits
        truth = {"A": Trajectory("A", dense[order] + late, poses[order])}
        assert evaluate(estimate, align(estimate, truth, "A", on_floor=True), on_floor=True).ate < 1e-6


@pytest.mark.parametrize("on_floor", [True, False])
def test_nees_of_errors_drawn_from_the_covariance_is_one(rng, on_floor):
    n = 400
    scale = np.array([0.005, 0.004, 0.02, 0.03, 0.02, 0.01])
    A = rng.normal(size=(n, 6, 6)) * scale[:, None]
    C = A @ A.transpose(0, 2, 1) / 6 + np.diag(0.05 * scale) ** 2
    T_estimated = floor_pose(rng.normal(size=n), rng.normal(size=n), rng.normal(size=n))
    if on_floor:  # the floor decides the rest
        C[:, [0, 1, 5], :] = C[:, :, [0, 1, 5]] = 0
    xi = np.array([rng.multivariate_normal(np.zeros(6), one, method="svd") for one in C])
    T_true = np.array([T @ gtsam.Pose3.Expmap(x).matrix() for T, x in zip(T_estimated, xi, strict=True)])
    estimated = Trajectory("A", np.arange(n, dtype=float), T_estimated, np.arange(n), C)
    components = PLANAR if on_floor else list(range(6))
    values = nees_of(estimated, T_true, components)
    assert len(values) == n
    dof = n * len(components)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], dof) / dof
    assert low < values.mean() < high
    # and covariances that promise twice the accuracy are found out
    boastful = Trajectory("A", estimated.times, T_estimated, estimated.stances, C / 4)
    assert nees_of(boastful, T_true, components).mean() > 2 * high


def test_nees_counts_a_held_pose_once_and_the_worlds_own_never():
    T = floor_pose([0, 1, 1, 2], [0, 0, 0, 0], [0, 0, 0, 0])
    C = np.tile(1e-4 * np.eye(6), (4, 1, 1))
    C[0] = 1e-12 * np.eye(6)
    estimated = Trajectory("A", np.arange(4.0), T, np.arange(4), C)
    true = T.copy()
    true[:, 0, 3] += 0.01  # one sigma along x
    np.testing.assert_allclose(nees_of(estimated, true, PLANAR), [1 / 3, 1 / 3], rtol=1e-6)


@pytest.mark.parametrize(
    ("truth", "words"),
    [
        (lambda team: {"C": team["A"]}, "the truth holds C, and the estimate A, B: give the truth of a robot"),
        (
            lambda team: {"B": trajectory("B", times=TIMES + 100)},
            "robot B has no truth at the times of its poses: the estimate reaches from 1700000000.000 to "
            "1700000040.000 s, the truth from 1700000100.000",
        ),
        (lambda team: {"B": team["B"]}, "there is no truth of the reference robot A .* align the team"),
    ],
)
def test_truth_of_no_pose_is_refused_in_words(team, truth, words):
    with pytest.raises(InputError, match=words) as refusal:
        align(team, truth(team), "A", on_floor=True)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    "truth_of_b", [None, Trajectory("B", np.empty(0), np.empty((0, 4, 4))), trajectory("B", times=TIMES + 100)]
)
def test_a_robot_without_truth_is_named_and_the_others_are_evaluated(team, truth_of_b):
    truth = {"A": team["A"]} | ({} if truth_of_b is None else {"B": truth_of_b})
    accuracy = evaluate(team, align(team, truth, "A", on_floor=True), on_floor=True)
    assert [row.robot for row in accuracy.robots] == ["A"] and accuracy.ate == 0
    assert accuracy.warnings == ("robot B is not evaluated: it has no truth at the times of its 5 poses",)


def test_truth_that_begins_late_is_aligned_by_the_first_pose_that_has_it():
    covariances = np.tile(1e-4 * np.eye(6), (5, 1, 1))
    estimate = {
        robot: Trajectory(robot, TIMES, floor_pose(np.arange(5), y, 0), 5 + np.arange(5), covariances)
        for robot, y in {"A": 0, "B": 1}.items()
    }
    late = np.array([0, 0, 1, 1, 1], bool)
    truth = {robot: moved(one, floor_pose(3, -2, 2.5)).where(late) for robot, one in estimate.items()}
    true = align(estimate, truth, "A", on_floor=True)
    accuracy = evaluate(estimate, true, on_floor=True, reference="A")
    assert accuracy.ate < 1e-12 and accuracy.robots[0].true_length == pytest.approx(2)
    assert len(accuracy.warnings) == 3 and accuracy.warnings[0].startswith("robot A: 2 of 5 poses are not evaluated")
    assert "begins after the estimate: aligned by its pose at stance 7, and without NEES" in accuracy.warnings[2]
    assert accuracy.anees is None and accuracy.nees_poses == 0
    # a robot that had not moved until then still defines the world
    held = floor_pose([0, 0, 0, 1, 2], 0, 0)
    estimate["A"] = Trajectory("A", TIMES, held, 5 + np.arange(5), covariances)
    truth["A"] = moved(estimate["A"], floor_pose(3, -2, 2.5)).where(late)
    accuracy = evaluate(estimate, align(estimate, truth, "A", on_floor=True), on_floor=True, reference="A")
    assert len(accuracy.warnings) == 2 and accuracy.nees_poses > 0


def test_the_nees_of_a_team_counts_each_pose_and_on_a_floor_heading_x_and_y_only():
    def off(robot, n, sigmas):
        T = floor_pose(0.5 * np.arange(n), 0, 0)
        true = T @ se3(rotation_x(0.03), np.zeros(3))  # three sigmas of roll, which a floor decides
        true[:, 0, 3] += 0.01 * sigmas
        return Trajectory(robot, np.arange(n) * 1.0, T, np.arange(n), np.tile(1e-4 * np.eye(6), (n, 1, 1))), true

    team = {"A": off("A", 30, 1.0), "B": off("B", 10, 3.0)}
    estimated, true = ({robot: pair[k] for robot, pair in team.items()} for k in range(2))
    planar, free = (evaluate(estimated, true, on_floor=on_floor) for on_floor in (True, False))
    assert planar.nees_poses == free.nees_poses == 40
    assert planar.anees == pytest.approx((30 * 1 / 3 + 10 * 9 / 3) / 40)
    assert free.anees == pytest.approx((30 * (9 + 1) / 6 + 10 * (9 + 9) / 6) / 40)


def test_an_estimate_without_its_reference_is_refused(team):
    with pytest.raises(InputError, match="does not hold the reference robot C"):
        align(team, team, "C", on_floor=True)


def test_robots_that_stayed_are_measured_by_the_distance_between_them(short_solution):
    from coloc_graph.results.writer import assess

    assert assess(short_solution)[0].distances == ()
    trajectories = short_solution.estimate.trajectories
    still = {
        robot: dataclasses.replace(one, T_world_body=one.T_world_body[:1].repeat(len(one), 0))
        for robot, one in trajectories.items()
    }
    true = {robot: one.T_world_body.copy() for robot, one in still.items()}
    true["B"][:, :3, 3] *= 1.1  # A is at the origin
    (row,) = evaluate(still, true, on_floor=True).distances
    apart = np.linalg.norm(still["B"].positions[0])
    assert (row.robot_i, row.robot_j) == ("A", "B")
    assert row.true == pytest.approx(1.1 * apart) and row.error == pytest.approx(-0.1 * apart)
    # robots that were aligned each by itself are in no one world
    assert evaluate(still, true, on_floor=True, alignment="robot").distances == ()


def test_the_truth_of_a_robot_that_drives_is_followed_between_its_samples():
    times = np.array([0.0, 1.0, 1.1, 1.2, 9.0])
    poses = floor_pose([0, 0, 0.02, 0.06, 0.5], [0, 0, 0, 0.02, 0.5], [0, 0, 0.1, 0.3, 0])
    truth = {"A": Trajectory("A", times, poses)}
    when = np.array([0.5, 1.05, 1.15, 1.2, 5.0, 9.0])
    asked = Trajectory("A", when, np.tile(np.eye(4), (6, 1, 1)), np.arange(6))
    # between samples that are near: half way, by the shortest turn; between others it stood at the earlier one
    expected = floor_pose([0, 0.01, 0.04, 0.06, 0.06, 0.5], [0, 0, 0.01, 0.02, 0.02, 0.5], [0, 0.05, 0.2, 0.3, 0.3, 0])
    np.testing.assert_allclose(true_poses(truth, asked), expected, atol=1e-12)
    # without stances nobody says that it stood: there is no truth between samples that are far apart
    found = true_poses(truth, dataclasses.replace(asked, stances=None))
    np.testing.assert_allclose(found[[1, 2, 3, 5]], expected[[1, 2, 3, 5]], atol=1e-12)
    assert np.isnan(found[[0, 4]]).all()
    # unless it is said that it drove evenly
    found = true_poses(truth, dataclasses.replace(asked, stances=None), max_gap=8.0)
    share = 3.8 / 7.8
    np.testing.assert_allclose(found[4, :3, 3], [0.06 + 0.44 * share, 0.02 + 0.48 * share, 0], atol=1e-12)


def test_poses_outside_of_the_truth_are_left_out_and_counted(team):
    truth = team | {"B": team["B"].where(np.array([0, 1, 1, 1, 0], bool))}
    off = team["B"].T_world_body.copy()
    off[1:4, 0, 3] += 0.01
    off[[0, 4], 0, 3] += 99.0
    estimate = {"A": team["A"], "B": Trajectory("B", TIMES, off, np.arange(5))}
    true = align(estimate, truth, "A", on_floor=True)
    accuracy = evaluate(estimate, true, on_floor=True)
    assert true["B"].shape == (5, 4, 4) and np.isnan(true["B"][[0, 4]]).all()
    assert accuracy.warnings == (
        "robot B: 2 of 5 poses are not evaluated: they have no truth at their times "
        "(1 before it begins, 1 after it ends, 0 in its gaps)",
    )
    # what is wrong where there is no truth counts nowhere
    assert accuracy.robots[1].translation == Spread(*[pytest.approx(0.01)] * 4)
    assert accuracy.end_position_error == pytest.approx(0.01) and accuracy.robots[0].ate == 0


def test_the_nearest_stamp_is_taken_as_evo_takes_it():
    """A robot at 0.2 m/s with truth every 0.1 s: up to 1 cm beside where it was, and nothing beyond 0.01 s."""

    def straight(times):
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        poses[:, 0, 3] = 0.2 * np.asarray(times)
        return Trajectory("A", np.asarray(times, float), poses)

    truth = {"A": straight(np.arange(0, 10, 0.1))}
    asked = straight([0.951, 1.0, 1.049, 1.052, 9.5, 9.6, 30.0])
    found = nearest_true_poses(truth, asked, 0.06)[:, 0, 3]
    np.testing.assert_allclose(found, [0.2, 0.2, 0.2, 0.22, 1.9, 1.92, np.nan], atol=1e-9)
    assert np.isnan(nearest_true_poses(truth, asked, 0.01)[[0, 2, 3], 0, 3]).all()
    # of the shorter trajectory each pose has a partner, as evo's are
    few = {"A": straight([1.0, 1.004, 2.0])}
    found = nearest_true_poses(few, straight(np.arange(0, 3, 0.01)), 0.01)[:, 0, 3]
    assert np.flatnonzero(np.isfinite(found)).tolist() == [100, 200]
    assert found[100] == 0.2
    two = {"A": straight([0.951, 1.0])}
    true = align(two, truth, on_floor=False, alignment="none", nearest=0.06)
    assert evaluate(two, true, on_floor=False, alignment="none").ate == pytest.approx(0.2 * 0.049 / 2**0.5)
