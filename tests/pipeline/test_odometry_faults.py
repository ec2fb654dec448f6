"""Odometry that is wrong is mended or told, and no robot is blamed for it."""

from dataclasses import replace

import numpy as np
import pytest
from teams import ate, fed, graph_of_team, team_of

from coloc_graph.backend import smooth
from coloc_graph.geometry.lie import floor_pose, se3_inverse
from coloc_graph.measurements import Odometry, RelativePose, Sighting
from coloc_graph.pipeline.lever_arm import find_lever_arms, mend_lever_arms
from coloc_graph.pipeline.odometry_checks import Samples, checked
from coloc_graph.run import OdometrySample, Stance

STANCE = Stance(0, 10.0, 15.0, ("A", "B"), ("C",))
SMALL = np.diag([1e-6, 1e-6, 1e-6])


def samples(jump=0.0, covariance=SMALL, hung=False):
    """A robot that drives 2 m ahead in 20 s."""
    made = []
    for n in range(200):
        time = 0.1 * n
        x = 0.1 * (10.0 if hung and 10 <= time <= 15 else time) + (jump if time > 7 else 0.0)
        made.append(OdometrySample("C", time, np.array([x, 0.0, 0.0]), covariance))
    return made


def faults_of(recorded):
    mended, said = checked(Samples.of("C", recorded), [STANCE])
    return list(mended.between()), said


def test_odometry_that_is_right_is_passed_on_as_it_is():
    mended, said = faults_of(samples())
    assert not said
    assert all(np.array_equal(a.pose, b.pose) for a, b in zip(mended, samples(), strict=True))


def test_a_jump_is_cut_out_and_told():
    mended, (sentence,) = faults_of(samples(jump=0.5))
    assert "the odometry of C jumped by 0.5" in sentence
    assert mended[-1].pose[0] == pytest.approx(0.1 * 19.9, abs=0.02)
    assert max(one.covariance[0, 0] for one in mended) > 1e-4


@pytest.mark.parametrize(
    ("covariance", "told"),
    [
        (np.zeros((3, 3)), "a covariance of zero"),
        (np.diag([1e6, 1e6, 1e6]), "says nothing"),
        (np.diag([-1e-4, 1e-4, 1e-4]), "says nothing"),
    ],
)
def test_covariances_that_say_nothing_are_replaced_and_told(covariance, told):
    mended, (sentence,) = faults_of(samples(covariance=covariance))
    assert told in sentence and "the odometry of C" in sentence
    assert sum(one.covariance[0, 0] for one in mended[1:]) == pytest.approx(0.02**2 * 2, rel=0.1)


def test_odometry_that_hangs_while_its_robot_moves_is_not_used_there_and_told():
    mended, sentences = faults_of(samples(hung=True))
    assert any("does not change in stance 0" in one for one in sentences)
    assert max(one.covariance[0, 0] for one in mended if 10 <= one.time <= 15) == pytest.approx(1.0)


def pushed(measurements, node, T):
    """The measurements where a robot was pushed by T before a stance in which it stood, and drove on from there."""
    for m in measurements:
        i, j = (np.linalg.inv(T) if end == node else np.eye(4) for end in m.ends)
        name = {Odometry: "T_before_after", Sighting: "T_observer_seen", RelativePose: "T_i_j"}[type(m)]
        yield replace(m, **{name: i @ m.T_i_j @ np.linalg.inv(j)})


@pytest.mark.parametrize(("arm", "bumped"), [((0.4, 0.0), False), ((-0.3, 0.1), True)])
def test_odometry_of_another_point_of_the_body_is_found_and_moved_to_it(arm, bumped):
    """Also beside a bump, which is still told."""
    team = team_of(3, 11, 2)
    T = floor_pose(*arm, 0.0)
    made = [
        replace(m, T_before_after=se3_inverse(T) @ m.T_before_after @ T)
        if isinstance(m, Odometry) and m.robot == "B"
        else m
        for m in team.measurements
    ]
    if bumped:
        made = pushed(made, ("A", 6), floor_pose(0.3, -0.1, 0.2))
    arms, mended = find_lever_arms(smooth(graph_of_team(team, made)), smooth)
    assert list(arms) == ["B"] and (arms["B"].x, arms["B"].y) == pytest.approx(arm, abs=0.1)
    assert "the odometry of B is not that of its body's origin" in str(arms["B"])
    assert not mended.rejected
    assert [(one.stay_put.robot, one.stay_put.after) for one in mended.bumped] == ([("A", 6)] if bumped else [])
    if not bumped:
        assert ate(mended, team) < 1.5 * ate(smooth(graph_of_team(team)), team)


def test_odometry_of_another_point_is_moved_to_the_body_stance_by_stance():
    team = team_of(3, 14, 2)
    T = floor_pose(0.4, 0.1, 0.0)
    estimator = fed(
        team,
        [
            replace(m, T_before_after=se3_inverse(T) @ m.T_before_after @ T) if isinstance(m, Odometry) else m
            for m in team.measurements
        ],
    )
    before = len(estimator.rejected)
    arms, last = mend_lever_arms(estimator)
    assert before > 1 and len(arms) > 1 and last.stance == team.stances[-1].index
    assert len(estimator.rejected) < before
    assert ate(estimator.estimate(), team) < 1.5 * ate(smooth(graph_of_team(team)), team)


def test_odometry_of_the_body_has_no_lever_arm():
    estimate = smooth(graph_of_team(team_of(3, 14, 2)))
    assert find_lever_arms(estimate, smooth) == ({}, estimate)
