"""ATE, RPE and the interval of the NEES: what evo says of the same files, by hand, and by chance."""

import json
from pathlib import Path

import numpy as np
import pytest

from coloc_graph.evaluation import PLANAR, effective_poses, evaluate, nees, relative_errors, whitened
from coloc_graph.evaluation.pose_errors import pairs_of, relative_error
from coloc_graph.geometry.lie import floor_pose, se3_exp
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.results.comparison import of_files

EVO = Path(__file__).parent / "evo"
ANSWERS = json.loads((EVO / "evo.json").read_text())


def compared(alignment, **options):
    comparison = of_files([str(EVO / "est.tum")], [str(EVO / "true.tum")], alignment)
    return comparison.compare(rpe=(0.5, 1.0, 2.0), **options)[0]


@pytest.mark.parametrize("alignment", ["none", "reference", "team"])
def test_ate_is_evos(alignment):
    accuracy = compared(alignment)
    for ours, unit in ((accuracy.translation, "m"), (accuracy.rotation_deg, "deg")):
        theirs = ANSWERS[f"ATE {alignment} {unit}"]
        for name in ("rmse", "mean", "median", "max"):
            assert getattr(ours, name) == pytest.approx(theirs[name], rel=0, abs=1e-9), name


@pytest.mark.parametrize("pairs_from", ["estimate", "truth"])
@pytest.mark.parametrize("alignment", ["none", "team"])
def test_rpe_over_distances_is_evos(alignment, pairs_from):
    for one in compared(alignment, pairs_from=pairs_from).relative:
        translation, rotation = (ANSWERS[f"RPE {one.distance} {pairs_from} {unit}"] for unit in ("m", "deg"))
        assert one.pairs == translation["pairs"]
        assert one.translation == pytest.approx(translation["rmse"], rel=0, abs=1e-9)
        assert one.rotation_deg == pytest.approx(rotation["rmse"], rel=0, abs=1e-9)
        assert one.translation_percent == pytest.approx(100 * translation["rmse"] / one.distance)


def test_pairs_are_those_that_looking_at_all_of_them_finds(rng):
    steps = rng.uniform(0, 0.4, 300) * (rng.uniform(size=300) > 0.3)  # it stands at times
    positions = np.cumsum(steps)[:, None] * [1.0, 0.0, 0.0]
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    for distance in (0.3, 1.0, 7.0, 1000.0):
        expected = []
        for i in range(299):
            off = np.abs(path[i + 1 :] - path[i] - distance)
            if off.min() <= 0.1 * distance:
                expected.append((i, i + 1 + int(off.argmin())))
        assert list(zip(*(part.tolist() for part in pairs_of(positions, distance)), strict=True)) == expected


def test_a_path_that_is_one_percent_long_is_one_percent_wrong_over_every_distance():
    true = floor_pose(0.01 * np.arange(2000), 0, 0)
    estimated = floor_pose(0.0101 * np.arange(2000), 0, 0)
    for distance in (1.0, 5.0):
        one = relative_error(distance, [relative_errors(estimated, true, distance, "truth")])
        # the last pairs are up to a tenth shorter, as evo's are
        assert one.translation_percent == pytest.approx(1.0, rel=0.005)
        assert one.rotation_deg == pytest.approx(0, abs=1e-9)
    none = relative_error(50.0, [relative_errors(estimated, true, 50.0)])
    assert (none.pairs, none.translation, none.translation_percent, none.rotation_deg) == (0, None, None, None)


@pytest.mark.parametrize("n", [0, 1])
def test_a_robot_of_a_single_pose_has_no_pairs(n):
    one = relative_error(1.0, [relative_errors(*[floor_pose(np.zeros(n + 1), 0, 0)] * 2, 1.0)])
    assert one.pairs == 0


def walk(rng, n=60, sigma=0.01):
    """A robot's estimate that drifts as its covariances say, and the truth."""
    T_true = floor_pose(0.1 * np.arange(n), 0.05 * np.arange(n) ** 1.3, 0.05 * np.arange(n))
    error = np.cumsum(sigma * rng.normal(size=(n, 3)), axis=0)
    xi = np.zeros((n, 6))
    yaw = 0.05 * np.arange(n)
    # drift along the world's axes, written in the body's
    xi[:, 2] = error[:, 2]
    xi[:, 3] = np.cos(yaw) * error[:, 0] + np.sin(yaw) * error[:, 1]
    xi[:, 4] = -np.sin(yaw) * error[:, 0] + np.cos(yaw) * error[:, 1]
    covariances = np.zeros((n, 6, 6))
    for k in (2, 3, 4):
        covariances[:, k, k] = sigma**2 * np.arange(1, n + 1)
    estimated = Trajectory("A", np.arange(n, dtype=float), T_true @ se3_exp(-xi), None, covariances)
    return estimated, T_true


def test_the_interval_of_a_drifting_trajectory_holds_what_it_says():
    """Neighbours share errors: counting all poses, nine of ten honest runs would be called dishonest."""
    from scipy.stats import chi2

    rng = np.random.default_rng(1)
    inside, raw, effective = [], [], []
    low, high = chi2.ppf([0.025, 0.975], 3 * 60) / (3 * 60)
    for _ in range(400):
        found = nees(*walk(rng), PLANAR)
        inside.append(found.consistent)
        raw.append(low < found.mean < high)
        effective.append(found.effective)
    assert 0.86 < np.mean(inside) < 0.97
    assert np.mean(raw) < 0.4
    assert 1.5 < np.median(effective) < 3.5


def test_a_boast_is_found_out_for_all_that(rng):
    estimated, T_true = walk(rng)
    boast = Trajectory("A", estimated.times, estimated.T_world_body, None, estimated.covariances / 100)
    found = nees(boast, T_true, PLANAR)
    assert found.mean == pytest.approx(100 * nees(estimated, T_true, PLANAR).mean) and not found.consistent


def test_effective_poses_of_independent_errors_are_all_and_of_one_error_is_one(rng):
    assert effective_poses(rng.normal(size=(500, 3))) == pytest.approx(500, rel=0.05)
    assert effective_poses(np.tile(rng.normal(size=3), (500, 1))) == pytest.approx(1, rel=0.01)
    correlated = np.zeros((20000, 3))
    for k in range(1, 20000):
        correlated[k] = 0.9 * correlated[k - 1] + np.sqrt(1 - 0.81) * rng.normal(size=3)
    assert effective_poses(correlated) == pytest.approx(20000 * (1 - 0.81) / (1 + 0.81), rel=0.15)


def test_covariances_of_the_body_need_no_turning_into_the_truths_world(rng):
    """NEES is the same whatever world the truth was taken in, and whichever way the robot looks there."""
    estimated, T_true = walk(rng)
    T = floor_pose(3, -7, 2.1)
    moved = Trajectory("A", estimated.times, T @ estimated.T_world_body, None, estimated.covariances)
    before, after = (whitened(*one, PLANAR) for one in ((estimated, T_true), (moved, T @ T_true)))
    np.testing.assert_allclose((before**2).mean(), (after**2).mean(), rtol=1e-9)


def test_poses_whose_covariance_is_none_or_infinite_are_not_counted(rng):
    estimated, T_true = walk(rng)
    estimated.covariances[3] = np.nan
    estimated.covariances[4] = 0.0
    estimated.covariances[5, 2, :] = estimated.covariances[5, :, 2] = 0.0  # a heading without doubt: singular
    assert len(whitened(estimated, T_true, PLANAR)) == 57
    assert nees(estimated.where(np.arange(60) == 4), T_true[4:5], PLANAR) is None
    accuracy = evaluate({"A": estimated}, {"A": T_true}, on_floor=True)
    assert accuracy.nees_poses == accuracy.robots[0].nees.poses == 57
    assert accuracy.anees == pytest.approx(accuracy.robots[0].nees.mean)
