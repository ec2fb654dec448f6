"""The pose graph: hand-solved cases, stay-put, covariances, and refusals in words."""

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from coloc_graph.backend import PoseGraph, StayPut, chain, smooth
from coloc_graph.backend.gtsam_version import require_gtsam
from coloc_graph.backend.solver import optimise
from coloc_graph.errors import ColocError, EstimationError
from coloc_graph.geometry.lie import floor_pose, so3_exp
from coloc_graph.measurements import RelativePose
from coloc_graph.run import Stance
from coloc_graph.team import Floor

CLEARANCE_SIGMAS = np.array([0.004, 0.005, 0.01, 0.02, 0.015, 0.01])


def relative(stance, i, j, T_i_j, sigmas=CLEARANCE_SIGMAS, covariance=None):
    """A measurement as the front end would give it."""
    C = np.diag(np.square(sigmas)) if covariance is None else covariance
    return RelativePose(stance, i, j, T_i_j, C)


def leapfrog(stances):
    """A and B take turns: in stance k the robot that stood as second in k-1 is the anchor and comes first."""
    names = [("A", "B") if k % 2 == 0 else ("B", "A") for k in range(stances)]
    return tuple(Stance(k, 10.0 * k, 10.0 * k + 5, pair, (), pair[:1] if k else ()) for k, pair in enumerate(names))


def graph_of(stances, poses, *, robots=("A", "B"), reference="A", floor=None):
    return PoseGraph(reference, robots, tuple(stances), tuple(poses), floor)


def steps(rng, count):
    """Relative poses in general position, (count,) of Pose3."""
    return [gtsam.Pose3(gtsam.Rot3(so3_exp(rng.normal(0, 0.4, 3))), rng.normal((0.5, 0, 0), 0.5)) for _ in range(count)]


def leapfrog_graph(rng, stances=6, floor=None):
    when = leapfrog(stances)
    return graph_of(
        when, [relative(s.index, *s.observers, T) for s, T in zip(when, steps(rng, stances), strict=True)], floor=floor
    )


def random_covariance(rng, size=6, scale=0.01):
    A = rng.normal(size=(size, size))
    return scale**2 * (A @ A.T + np.eye(size))


@pytest.mark.parametrize("method", [chain, smooth])
def test_three_poses_solved_by_hand(method):
    # A stands at the origin and sees B 1 m ahead, turned left by 90 deg: B = (1, 0, 90 deg). B stays put, A drives
    # off and is then 1 m ahead of B, turned right by 90 deg: B's x axis is the world's y, so A = (1, 1, 0 deg).
    #
    # Each measurement errs by 0.02 m an axis and 0.01 rad about z. In the world (A's body is parallel to it), the
    # second place errs by the two translations, 2 * 0.02^2 = 8e-4 an axis, and by the first angle w swinging the
    # second arm, 1 m long and pointing along +y, by w * 1 m towards -x:
    #   var x = 8e-4 + 1e-4 = 9e-4, var y = 8e-4, var yaw = 2e-4, cov(yaw, x) = -1e-4, cov(yaw, y) = 0
    sigmas = (1e-4, 1e-4, 0.01, 0.02, 0.02, 0.02)
    graph = graph_of(
        leapfrog(2),
        [
            relative(0, "A", "B", floor_pose(1.0, 0.0, np.pi / 2), sigmas),
            relative(1, "B", "A", floor_pose(1.0, 0.0, -np.pi / 2), sigmas),
        ],
    )
    estimate = method(graph)
    np.testing.assert_allclose(estimate.pose("A", 0).matrix(), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(estimate.pose("B", 0).matrix(), floor_pose(1, 0, np.pi / 2), atol=1e-9)
    np.testing.assert_allclose(estimate.pose("B", 1).matrix(), floor_pose(1, 0, np.pi / 2), atol=1e-9)
    np.testing.assert_allclose(estimate.pose("A", 1).matrix(), floor_pose(1, 1, 0), atol=1e-9)
    planar = estimate.covariance("A", 1)[np.ix_([2, 3, 4], [2, 3, 4])]  # yaw, x, y
    np.testing.assert_allclose(planar, [[2e-4, -1e-4, 0], [-1e-4, 9e-4, 0], [0, 0, 8e-4]], atol=1e-9)
    np.testing.assert_allclose(np.diag(estimate.covariance("B", 0))[2:5], [1e-4, 4e-4, 4e-4], rtol=1e-6)
    assert estimate.covariance("A", 0).max() < 1e-11
    assert estimate.dof == 0 and estimate.chi2 < 1e-12


@pytest.mark.parametrize("method", [chain, smooth])
@pytest.mark.parametrize("floor", [None, Floor(), Floor(tilt_sigma_deg=0.1, height_sigma=1e-3)])
def test_an_anchor_does_not_move_by_a_single_bit(rng, method, floor):
    estimate = method(leapfrog_graph(rng, floor=floor))
    assert len(estimate.graph.stay_puts) == 5
    for stay in estimate.graph.stay_puts:
        before, after = (estimate.pose(stay.robot, k).matrix() for k in (stay.before, stay.after))
        assert np.abs(before - after).max() == 0.0
        assert np.array_equal(*(estimate.covariance(stay.robot, k) for k in (stay.before, stay.after)))


def test_smoothing_without_redundancy_is_chaining(rng):
    graph = leapfrog_graph(rng, stances=12)
    chained, smoothed = chain(graph), smooth(graph)
    for robot in ("A", "B"):
        np.testing.assert_allclose(
            smoothed.trajectories[robot].T_world_body, chained.trajectories[robot].T_world_body, rtol=0, atol=1e-9
        )
    last = graph.stances[-1]
    for robot in last.observers:
        a, b = chained.covariance(robot, last.index), smoothed.covariance(robot, last.index)
        # the covariances are some 1e-3, the numbers agree to 1e-6 of that
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-6 * np.abs(a).max())


def test_two_measurements_of_one_pair_are_averaged_by_information():
    # 1.0 m with sigma 0.1 and 1.2 m with sigma 0.2 have informations 100 and 25:
    # (100 * 1.0 + 25 * 1.2) / 125 = 1.04 m, variance 1 / 125 = 0.008; chi2 = 0.2^2 / (0.1^2 + 0.2^2) = 0.8
    turn = (1e-3, 1e-3, 1e-3)
    estimate = smooth(
        graph_of(
            leapfrog(1),
            [
                relative(0, "A", "B", floor_pose(1.0, 0, 0), (*turn, 0.1, 0.1, 0.1)),
                relative(0, "A", "B", floor_pose(1.2, 0, 0), (*turn, 0.2, 0.2, 0.2)),
            ],
        )
    )
    np.testing.assert_allclose(estimate.pose("B", 0).translation(), [1.04, 0, 0], atol=1e-7)
    np.testing.assert_allclose(np.diag(estimate.covariance("B", 0))[3:], 0.008, rtol=1e-6)
    assert estimate.dof == 6
    assert estimate.chi2 == pytest.approx(0.8, rel=1e-6)


def test_a_measurement_read_from_the_other_side_says_the_same(rng):
    T = steps(rng, 1)[0]
    C = random_covariance(rng)
    # T_true = T exp(xi) has the inverse exp(-xi) T^-1 = T^-1 exp(-Ad_T xi)
    Ad = T.AdjointMap()
    forth = relative(0, "A", "B", T, covariance=C)
    back = relative(0, "B", "A", T.inverse(), covariance=Ad @ C @ Ad.T)
    for method in (chain, smooth):
        a, b = (method(graph_of(leapfrog(1), [one])) for one in (forth, back))
        np.testing.assert_allclose(a.pose("B", 0).matrix(), b.pose("B", 0).matrix(), atol=1e-9)
        np.testing.assert_allclose(a.covariance("B", 0), b.covariance("B", 0), atol=1e-9)


@pytest.mark.parametrize("method", [chain, smooth])
def test_covariances_are_those_of_repeated_experiments(rng, method):
    """Against Monte Carlo: T_true = T_estimated exp(xi) with xi from the covariance, in each of its directions."""
    true, when = steps(rng, 4), leapfrog(4)
    C = [random_covariance(rng, scale=2e-3) for _ in true]
    roots = [np.linalg.cholesky(one) for one in C]
    truth = chain(graph_of(when, [relative(s.index, *s.observers, T) for s, T in zip(when, true, strict=True)]))
    draws = 600
    doubled = 2 if method is smooth else 1  # smoothing is given every pair twice, so that there is something to weigh
    white = []
    for _ in range(draws):
        poses = [
            relative(s.index, *s.observers, T.compose(gtsam.Pose3.Expmap(-root @ rng.normal(size=6))), covariance=cov)
            for _ in range(doubled)
            for s, T, root, cov in zip(when, true, roots, C, strict=True)
        ]
        estimate = method(graph_of(when, poses))
        xi = gtsam.Pose3.Logmap(estimate.pose("A", 3).between(truth.pose("A", 3)))
        white.append(np.linalg.solve(np.linalg.cholesky(estimate.covariance("A", 3)), xi))
    sample = np.cov(np.array(white).T)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], draws - 1) / (draws - 1)
    assert low < np.linalg.eigvalsh(sample).mean() < high
    assert (np.diag(sample) > low).all() and (np.diag(sample) < high).all()
    # off the diagonal a correlation has sigma 1 / sqrt(n)
    assert np.abs(sample - np.diag(np.diag(sample))).max() < 5 / np.sqrt(draws)


def test_moves_are_counted_however_the_roles_rotate():
    """Three robots: who is not an anchor has moved, also where it was absent in between."""
    stances = (
        Stance(0, 0, 1, ("A", "B"), ("C",)),
        Stance(1, 2, 3, ("B", "C"), ("A",), ("B",)),
        Stance(2, 4, 5, ("C", "A"), ("B",), ("C",)),
        Stance(3, 6, 7, ("C", "A", "B"), (), ("C", "A")),
    )
    graph = graph_of(stances, [], robots=("A", "B", "C"))
    moves = {node: gtsam.mrsymbolIndex(graph.key(*node)) for node in graph.nodes}
    assert moves == {
        ("A", 0): 0,
        ("B", 0): 0,
        ("B", 1): 0,
        ("C", 1): 1,
        ("C", 2): 1,
        ("A", 2): 2,
        ("C", 3): 1,
        ("A", 3): 2,
        ("B", 3): 2,
    }
    assert graph.stay_puts == (StayPut("B", 0, 1), StayPut("C", 1, 2), StayPut("C", 2, 3), StayPut("A", 2, 3))
    keys = {graph.key(*at) for at in graph.nodes}
    assert len(keys) == 5


def test_numbers_of_stances_need_not_be_consecutive(rng):
    first, second = steps(rng, 2)
    stances = (Stance(4, 0, 1, ("A", "B")), Stance(9, 2, 3, ("B", "A"), (), ("B",)))
    estimate = smooth(graph_of(stances, [relative(4, "A", "B", first), relative(9, "B", "A", second)]))
    assert estimate.pose("A", 9).equals(first.compose(second), 1e-9)
    assert np.array_equal(estimate.trajectories["B"].stances, [4, 9])


@pytest.mark.parametrize("method", [chain, smooth])
def test_a_missing_measurement_leaves_out_what_it_would_tie_and_says_which(rng, method):
    when = leapfrog(4)
    poses = [relative(s.index, *s.observers, T) for s, T in zip(when, steps(rng, 4), strict=True) if s.index != 1]
    estimate = method(graph_of(when, poses))
    # A's second place, at stance 1 and held through stance 2, and all that was measured from it
    assert estimate.disconnected == (("A", 1), ("A", 2), ("B", 2), ("B", 3), ("A", 3))
    assert estimate.trajectories["A"].stances.tolist() == [0]
    assert estimate.trajectories["B"].stances.tolist() == [0, 1]
    with pytest.raises(EstimationError, match="robot A has no pose at stance 2"):
        estimate.pose("A", 2)


def test_the_order_of_measurements_does_not_decide_what_is_tied(rng):
    graph = leapfrog_graph(rng)
    backwards = graph_of(graph.stances, reversed(graph.relative_poses))
    for robot in ("A", "B"):
        a, b = (chain(g).trajectories[robot].T_world_body for g in (graph, backwards))
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_the_world_is_where_the_reference_stands_whichever_robot_that_is(rng):
    graph = leapfrog_graph(rng)
    other = PoseGraph("B", graph.robots, graph.stances, graph.relative_poses)
    for method in (chain, smooth):
        from_a, from_b = method(graph), method(other)
        assert from_b.pose("B", 0).equals(gtsam.Pose3(), 1e-9)
        a = from_a.pose("B", 0).between(from_a.pose("A", 5))
        assert a.equals(from_b.pose("A", 5), 1e-8)


def test_the_floor_keeps_heights_and_tilts_that_the_measurements_do_not_know(rng):
    when = leapfrog(6)
    poses = [relative(s.index, *s.observers, T) for s, T in zip(when, [floor_pose(0.4, 0.1, 0.3)] * 6, strict=True)]
    noisy = [
        relative(
            p.stance,
            p.robot_i,
            p.robot_j,
            gtsam.Pose3(p.T_i_j).compose(gtsam.Pose3.Expmap(rng.normal(0, CLEARANCE_SIGMAS))),
        )
        for p in poses
    ]
    estimate = smooth(graph_of(when, noisy, floor=Floor()))
    for trajectory in estimate.trajectories.values():
        assert np.abs(trajectory.T_world_body[:, 2, 3]).max() < 1e-4
        assert np.abs(trajectory.T_world_body[:, 2, :2]).max() < 1e-4
    # of six numbers a measurement, three are contradicted by the floor
    assert estimate.dof == 18
    low, high = chi2.ppf([1e-4, 1 - 1e-4], estimate.dof)
    assert low < estimate.chi2 < high


def test_a_reference_that_does_not_observe_at_first_is_refused_in_words():
    with pytest.raises(EstimationError, match=r"reference robot C does not observe at stance 0.*A, B") as refusal:
        graph_of(leapfrog(1), [], robots=("A", "B", "C"), reference="C")
    assert "\n" not in str(refusal.value)


def test_a_measurement_of_a_robot_that_does_not_observe_is_refused():
    with pytest.raises(EstimationError, match="relative pose of A and C at stance 1 names C, which is no observer"):
        graph_of(leapfrog(2), [relative(1, "A", "C", np.eye(4))], robots=("A", "B", "C"))


def test_no_stance_is_refused():
    with pytest.raises(EstimationError, match="no stance"):
        graph_of((), [])


def one_factor(T, sigma=0.1):
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    factors.add(gtsam.PriorFactorPose3(1, gtsam.Pose3(T), gtsam.noiseModel.Isotropic.Sigma(6, sigma)))
    values.insert(1, gtsam.Pose3())
    return factors, values


def test_optimise_refuses_what_is_not_a_number_and_solves_what_is():
    bad = np.eye(4)
    bad[0, 3] = np.nan
    with pytest.raises(EstimationError, match="not finite"):
        optimise(*one_factor(bad))
    factors, initial = one_factor(floor_pose(1, 2, 0.3))
    values, iterations = optimise(factors, initial)
    assert iterations > 0
    np.testing.assert_allclose(values.atPose3(1).matrix(), floor_pose(1, 2, 0.3), atol=1e-6)


def test_a_search_that_starts_at_the_optimum_has_not_given_up():
    """Two priors that disagree: the error stays, and no iteration can gain anything."""
    factors, values = one_factor(floor_pose(1, 2, 0.3), 0.01)
    factors.add(gtsam.PriorFactorPose3(1, gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 0.01)))
    first, _ = optimise(factors, values)
    second, _ = optimise(factors, first)
    assert factors.error(first) > 100
    assert second.atPose3(1).equals(first.atPose3(1), 1e-4)


def test_a_measurement_that_is_not_a_number_does_not_come_back_as_an_estimate():
    bad = floor_pose(1, 0, 0)
    bad[1, 3] = np.nan
    with pytest.raises(EstimationError, match="not finite"):
        smooth(graph_of(leapfrog(1), [relative(0, "A", "B", bad)]))


def test_a_long_straight_chain_with_tight_sigmas_is_solved():
    """Cholesky calls this indeterminate from step 81 on: the end's sigma is 2^12 times that of a step."""
    when = leapfrog(300)
    sigmas = (0.02, 0.02, 0.02, 0.002, 0.002, 0.002)
    estimate = smooth(graph_of(when, [relative(s.index, *s.observers, floor_pose(1, 0, 0), sigmas) for s in when]))
    last = when[-1]
    np.testing.assert_allclose(estimate.pose(last.observers[1], 299).translation(), [300, 0, 0], atol=1e-6)
    C = estimate.covariance(last.observers[1], 299)
    # the k-th turn swings the arm of 299 - k metres that is left: sum of squares 1^2 + ... + 299^2
    expected = 0.02**2 * sum(k**2 for k in range(300)) + 300 * 0.002**2
    assert C[4, 4] == pytest.approx(expected, rel=1e-4)
    assert not estimate.disconnected


def test_another_gtsam_is_refused_with_what_to_do():
    require_gtsam("4.3.0")
    require_gtsam()
    for other in ("4.2.2", "none", "4.30", "5.0"):
        with pytest.raises(ColocError, match=rf"found {other}; .* pip install 'gtsam>=4.3,<4.4'") as refusal:
            require_gtsam(other)
        assert "3.11 to 3.14" in str(refusal.value)
