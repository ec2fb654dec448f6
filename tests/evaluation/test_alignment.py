"""Alignments of a team: what each undoes, what it does not, and where it cannot be fitted."""

import numpy as np
import pytest

from coloc_graph.errors import InputError
from coloc_graph.evaluation import ALIGNMENTS, align, evaluate, usual_alignment
from coloc_graph.geometry.lie import floor_pose, se3, se3_exp, so3_exp
from coloc_graph.geometry.trajectory import Trajectory

TIMES = 1_700_000_000 + np.arange(60) / 10
FREE = se3(so3_exp([0.4, -0.7, 2.0]), [10.0, -5.0, 3.0])
PLANAR = floor_pose(10.0, -5.0, 2.0)


def wound(rng, *, planar):
    """A path that is on no line."""
    sigma = np.array([0, 0, 0.1, 0.1, 0.05, 0] if planar else [0.05, 0.05, 0.1, 0.1, 0.05, 0.05])
    T = [se3_exp(3 * sigma * rng.normal(size=6))]
    for step in se3_exp(sigma * rng.normal(size=(59, 6)) + [0, 0, 0, 0.1, 0, 0]):
        T.append(T[-1] @ step)
    return np.array(T)


def team(rng, *, planar):
    return {robot: Trajectory(robot, TIMES, wound(rng, planar=planar)) for robot in "ABC"}


def in_world(one, T):
    return Trajectory(one.robot, one.times, T @ one.T_world_body)


def noisy(one, rng, *, planar):
    sigma = np.array([0, 0, 0.02, 0.03, 0.03, 0] if planar else [0.02] * 3 + [0.03] * 3)
    return Trajectory(one.robot, one.times, one.T_world_body @ se3_exp(sigma * rng.normal(size=(60, 6))))


def accuracy(estimated, truth, alignment, *, planar):
    true = align(estimated, truth, "A", on_floor=planar, alignment=alignment)
    return evaluate(estimated, true, on_floor=planar, alignment=alignment)


@pytest.mark.parametrize("planar", [True, False])
def test_a_team_that_is_moved_as_one_is_aligned_by_all_but_none(rng, planar):
    truth = team(rng, planar=planar)
    estimated = {robot: in_world(one, PLANAR if planar else FREE) for robot, one in truth.items()}
    for alignment in ("reference", "team", "robot"):
        found = accuracy(estimated, truth, alignment, planar=planar)
        assert found.translation.max < 1e-12 and found.rotation_deg.max < 1e-9, alignment
    assert accuracy(estimated, truth, "none", planar=planar).ate > 5


@pytest.mark.parametrize("planar", [True, False])
def test_robots_that_are_moved_each_its_own_way_are_aligned_each_on_its_own_only(rng, planar):
    truth = team(rng, planar=planar)
    worlds = dict(zip("ABC", (np.eye(4), floor_pose(1, 0, 0.3), floor_pose(0, 2, -1)), strict=True))
    estimated = {robot: in_world(one, worlds[robot]) for robot, one in truth.items()}
    assert accuracy(estimated, truth, "robot", planar=planar).translation.max < 1e-12
    for alignment in ("reference", "team", "none"):
        assert accuracy(estimated, truth, alignment, planar=planar).ate > 0.3, alignment


@pytest.mark.parametrize("planar", [True, False])
def test_the_fit_of_a_team_is_the_best_there_is(rng, planar):
    """No other small motion of the truth has smaller squares, and the fits of single robots are closer still."""
    truth = team(rng, planar=planar)
    estimated = {robot: in_world(noisy(one, rng, planar=planar), PLANAR) for robot, one in truth.items()}
    true = align(estimated, truth, on_floor=planar, alignment="team")

    def squares(T):
        return sum(((one.positions - (T @ true[robot])[:, :3, 3]) ** 2).sum() for robot, one in estimated.items())

    best = squares(np.eye(4))
    for axis in (2, 3, 4) if planar else range(6):
        for step in (-1e-3, 1e-3):
            assert squares(se3_exp(step * np.eye(6)[axis])) > best
    ates = {alignment: accuracy(estimated, truth, alignment, planar=planar).ate for alignment in ALIGNMENTS}
    assert ates["robot"] < ates["team"] < ates["reference"] < ates["none"]


def test_a_fit_on_a_floor_neither_tilts_nor_lifts(rng):
    truth = team(rng, planar=True)
    estimated = {robot: in_world(one, se3(so3_exp([0.1, 0, 0.5]), [1, 2, 0.3])) for robot, one in truth.items()}
    true = align(estimated, truth, on_floor=True, alignment="team")
    for T in true.values():
        np.testing.assert_allclose(T[:, 2, :], np.tile([0, 0, 1, 0], (60, 1)), atol=1e-12)
    free = align(estimated, truth, on_floor=False, alignment="team")
    np.testing.assert_allclose(free["B"], estimated["B"].T_world_body, atol=1e-12)


def test_one_alignment_serves_robots_that_were_seen_at_different_times(rng):
    """By time, not by place in the list: B's poses are fewer and later than A's."""
    truth = team(rng, planar=False)
    estimated = {robot: in_world(one, FREE) for robot, one in truth.items()}
    estimated["B"] = estimated["B"].where(np.arange(60) % 7 == 3)
    assert accuracy(estimated, truth, "team", planar=False).translation.max < 1e-12


@pytest.mark.parametrize("alignment", ["team", "robot"])
def test_nees_is_not_stated_of_what_was_fitted(rng, alignment):
    truth = team(rng, planar=False)
    covariances = np.tile(1e-3 * np.eye(6), (60, 1, 1))
    estimated = {
        robot: Trajectory(robot, TIMES, noisy(one, rng, planar=False).T_world_body, None, covariances)
        for robot, one in truth.items()
    }
    fitted = accuracy(estimated, truth, alignment, planar=False)
    assert fitted.anees is None and fitted.nees_poses == 0 and not any(row.nees for row in fitted.robots)
    assert accuracy(estimated, truth, "none", planar=False).anees > 0


def line(robot, n=60):
    return Trajectory(robot, TIMES[:n], floor_pose(0.1 * np.arange(n), 0, 0))


@pytest.mark.parametrize(
    ("estimated", "planar", "words"),
    [
        ({"A": Trajectory("A", TIMES, floor_pose(np.ones(60), 2, 0))}, True, "all poses of A are in one place"),
        ({"A": Trajectory("A", TIMES, floor_pose(np.ones(60), 2, 0))}, False, "all poses of A are in one place"),
        ({"A": line("A", 1)}, True, "in one place"),
        ({"A": line("A")}, False, "all poses of A are on one line.* or planar if they are on a floor"),
    ],
)
def test_what_has_no_rotation_to_fit_is_refused_in_words(estimated, planar, words):
    for alignment in ("team", "robot"):
        with pytest.raises(InputError, match=words) as refusal:
            align(estimated, estimated, on_floor=planar, alignment=alignment)
        assert "\n" not in str(refusal.value)
    align({"A": line("A")}, {"A": line("A")}, on_floor=True, alignment="team")  # a line has a direction on a floor


def test_the_usual_alignment_is_by_the_reference_where_there_are_stances(rng):
    one = line("A")
    at_stances = {"A": Trajectory("A", one.times, one.T_world_body, np.arange(60))}
    assert usual_alignment({"A": one}, {"A": one}, "A") == "team"
    assert usual_alignment(at_stances, {"A": one}, "A") == "reference"
    assert usual_alignment(at_stances, {"B": one}, "A") == "team"  # nobody knows where the reference was
