"""Who is blamed: odometry that is wrong and anchors that were bumped are told apart, or both are named."""

from dataclasses import replace

import numpy as np
import pytest
from teams import graph_of_team, planar_nees, team_of

from coloc_graph.backend import blame, outliers, smooth
from coloc_graph.backend.optimize import fit_graph
from coloc_graph.backend.solver import MAX_GAUSS_NEWTON, ROUGH_ITERATIONS
from coloc_graph.geometry.lie import floor_pose, se3_inverse
from coloc_graph.measurements import Odometry, RelativePose, Sighting


def with_wrong_odometry(team, rng):
    """The measurements with the odometry of one robot off by 30 cm and 10 deg once, and which it is."""
    ways = [m for m in team.measurements if isinstance(m, Odometry) and m.after < team.stances[-1].index]
    wrong = ways[rng.integers(len(ways))]
    yaw = rng.uniform(-3, 3)
    jump = floor_pose(0.3 * np.cos(yaw), 0.3 * np.sin(yaw), 0.17)
    bad = replace(wrong, T_before_after=wrong.T_before_after @ jump)
    return [bad if m is wrong else m for m in team.measurements], bad


def with_bump(team, stance):
    """The measurements as they are where the anchor of a stance was bumped before it, and who that is."""
    bump = floor_pose(0.06, -0.05, 0.12)
    robot = team.stances[stance].anchors[0]
    made = []
    for m in team.measurements:
        if isinstance(m, RelativePose) and m.stance == stance and robot in (m.robot_i, m.robot_j):
            m = replace(m, T_i_j=se3_inverse(bump) @ m.T_i_j if m.robot_i == robot else m.T_i_j @ bump)
        elif isinstance(m, Odometry) and m.robot == robot and m.before == stance:
            m = replace(m, T_before_after=se3_inverse(bump) @ m.T_before_after)
        made.append(m)
    return made, robot


@pytest.mark.parametrize("robots", [3, 4])
@pytest.mark.parametrize("seed", range(3))
def test_wrong_odometry_is_named_alone_or_beside_a_bump_and_no_innocent_robot_alone(robots, seed):
    team = team_of(robots, 10, seed)
    made, bad = with_wrong_odometry(team, np.random.default_rng(seed))
    estimate = smooth(graph_of_team(team, made))
    rejected = [one.measurement for one in estimate.rejected]
    named = any(one is bad for one in rejected)
    for bump in estimate.bumped:
        assert bump.alternative and any(bad.robot in one.robots for one in bump.alternative)
        assert "or else the odometry of" in str(bump) and "equally well" in str(bump)
        named |= any(bad in one.links for one in bump.alternative)
    assert named
    assert all(one is bad for one in rejected)
    last = team.stances[-1].index
    for node in (node for node in team.T_world_body if node[1] == last):
        assert planar_nees(estimate, team, node) < 30


def test_a_cause_that_one_step_underrates_is_fitted_where_no_likelier_one_explains_all(monkeypatch):
    team = team_of(4, 6, 0)
    made, bad = with_wrong_odometry(team, np.random.default_rng(0))
    predicted = blame._suspects

    def underrated(fit):
        rated = [
            (cause, replace(one, chi2=0.1 * one.chi2) if bad in cause.links else one) for cause, one in predicted(fit)
        ]
        return sorted(rated, key=lambda pair: -pair[1].chi2)

    monkeypatch.setattr(blame, "_suspects", underrated)
    estimate = smooth(graph_of_team(team, made))
    named = [one.measurement for one in estimate.rejected] + [
        link for bump in estimate.bumped for cause in bump.alternative for link in cause.links
    ]
    assert any(one is bad for one in named)


@pytest.mark.parametrize("robots", [3, 4])
@pytest.mark.parametrize("seed", range(2))
def test_a_bump_is_named_alone_or_beside_the_odometry_that_would_explain_it(robots, seed):
    team = team_of(robots, 10, seed)
    made, robot = with_bump(team, 5)
    estimate = smooth(graph_of_team(team, made))
    assert robot in {bump.stay_put.robot for bump in estimate.bumped}
    assert all(bump.stay_put.robot == robot or bump.alternative for bump in estimate.bumped)


def test_where_a_bump_and_wrong_odometry_explain_as_much_both_are_named_and_the_estimate_is_as_uncertain():
    team = team_of(3, 10, 7)
    made, bad = with_wrong_odometry(team, np.random.default_rng(7))
    estimate = smooth(graph_of_team(team, [m for m in made if not isinstance(m, Sighting)]))
    (bump,) = estimate.bumped
    assert (bad.robot,) in {one.robots for one in bump.alternative} and bump.stay_put.robot != bad.robot
    assert "or else the odometry of B" in str(bump) and "explain the measurements equally well" in str(bump)
    last = team.stances[-1].index
    far = float(np.linalg.norm(bump.T_before_after.translation()))
    sigma = max(
        float(np.sqrt(np.trace(estimate.covariance(*node)[3:5, 3:5]))) for node in team.T_world_body if node[1] == last
    )
    assert sigma > 0.5 * far


def test_in_a_run_of_two_stances_wrong_odometry_is_rejected_and_the_covariance_holds():
    team = team_of(3, 2, 3)
    ways = [m for m in team.measurements if isinstance(m, Odometry)]
    bad = replace(ways[-1], T_before_after=ways[-1].T_before_after @ floor_pose(0.3, 0.2, 0.0))
    estimate = smooth(graph_of_team(team, [bad if m is ways[-1] else m for m in team.measurements]))
    named = [one.measurement for one in estimate.rejected]
    named += [link for bump in estimate.bumped for cause in bump.alternative for link in cause.links]
    assert bad in named
    assert all(f"the wheels and clock of {bad.robot}" in one.reason for one in estimate.rejected)
    assert estimate.chi2 < 3 * max(estimate.dof, 1)
    assert all(planar_nees(estimate, team, node) < 30 for node in team.T_world_body)


@pytest.mark.parametrize("robots", [3, 4])
def test_a_camera_that_moved_within_a_stance_is_no_bump_to_and_fro(robots):
    team = team_of(robots, 10, 1)
    stance, robot = 5, team.stances[5].anchors[0]
    off = floor_pose(0.06, -0.05, 0.12)
    made = []
    for m in team.measurements:
        if isinstance(m, RelativePose) and m.stance == stance and robot in (m.robot_i, m.robot_j):
            m = replace(m, T_i_j=se3_inverse(off) @ m.T_i_j if m.robot_i == robot else m.T_i_j @ off)
        elif isinstance(m, Sighting) and m.stance == stance and m.observer == robot:
            m = replace(m, T_observer_seen=se3_inverse(off) @ m.T_observer_seen)
        made.append(m)
    estimate = smooth(graph_of_team(team, made))
    assert not [bump for bump in estimate.bumped if not bump.alternative]
    causes = [(one.measurement, one.alternative) for one in estimate.rejected]
    assert causes
    for m, alternative in causes:
        assert robot in {name for name, _ in m.ends} or any(robot in cause.robots for cause in alternative)


def test_among_many_outliers_a_search_does_not_wait_for_fits_to_converge(monkeypatch):
    team, rng = team_of(4, 10, 3), np.random.default_rng(3)
    made = []
    for m in team.measurements:
        if isinstance(m, RelativePose) and rng.random() < 0.5:
            m = replace(m, T_i_j=m.T_i_j @ floor_pose(*rng.uniform(-1, 1, 2), rng.uniform(-3, 3)))
        made.append(m)
    used = []

    def counted(*args, **kwargs):
        fit = fit_graph(*args, **kwargs)
        used.append(fit.iterations)
        return fit

    for module in (blame, outliers):
        monkeypatch.setattr(module, "fit_graph", counted)
    smooth(graph_of_team(team, made))
    assert max(used) <= MAX_GAUSS_NEWTON + ROUGH_ITERATIONS
