"""Mounts that are turned, off the axis, or known less well, in what is planned and promised."""

import math

import msgspec
import numpy as np
import pytest
from test_prediction import FIELD, estimated, predicted, team_of

from coloc_graph.planning.belief import Belief
from coloc_graph.planning.course import Course
from coloc_graph.planning.formation import Gait
from coloc_graph.planning.horizon import Horizon
from coloc_graph.planning.mission import leap_frog
from coloc_graph.planning.prediction import Predictor

GAIT = Gait(0.8, 0.6, 20.0)
new = msgspec.structs.replace


def with_mounts(team, **changes):
    """The team with the mounts of A and B changed."""
    robots = tuple(
        new(robot, mount_if_any=new(robot.mount, **changes)) if robot.name in "AB" else robot for robot in team.robots
    )
    return new(team, robots=robots)


def gone(team):
    return leap_frog(Predictor(team, 10.0), GAIT, 1.6, 8.0, ("A", "B"), "C")


def test_where_cameras_are_turned_in_their_bodies_the_bodies_are_turned_back():
    straight, turned = gone(team_of()), gone(with_mounts(team_of(), yaw_deg=40.0))
    for one, other in zip(straight.plan.stances, turned.plan.stances, strict=True):
        for name, (x, y, yaw) in one.standing.items():
            np.testing.assert_allclose(other.standing[name], (x, y, yaw - math.radians(40.0)), atol=1e-9)
    assert turned.end_sigma == pytest.approx(straight.end_sigma, rel=0.03)


def test_the_horizon_turns_bodies_too():
    predictor = Predictor(with_mounts(team_of(), yaw_deg=-60.0), 10.0)
    horizon = Horizon(predictor, Course(((0.0, 0.0), (2.0, 0.0))), ("A", "B"), "C", 60.0, timed=True, gait=GAIT)
    belief = horizon.first(Belief.start(predictor.team, {**horizon.starts(), "C": (1.5, 0.0, 0.0)})).promise.belief
    decision = horizon.next(belief, 50.0)
    looks = decision.ahead[0][1][2] + math.radians(-60.0)
    assert abs(looks) < math.radians(45.0)
    assert decision.promise.points > 50


def test_a_camera_before_the_axis_sees_from_there():
    predictors = [Predictor(team, 10.0) for team in (team_of(), with_mounts(team_of(), x=0.15, y=0.05))]
    standing = np.array([[0.0, 0.3, -0.3], [0.0, -0.3, 0.3]])
    (_, eyes), (_, moved) = (one.model(("A", "B"), "C").views(standing) for one in predictors)
    c, s = np.cos(standing[:, 2]), np.sin(standing[:, 2])
    np.testing.assert_allclose((moved - eyes)[:, 0], 0.15 * c - 0.05 * s, atol=1e-12)
    np.testing.assert_allclose((moved - eyes)[:, 1], 0.15 * s + 0.05 * c, atol=1e-12)


def test_a_yaw_that_is_known_less_well_is_in_the_promise_as_in_the_estimate(tmp_path):
    plan = gone(team_of()).plan
    sigmas = []
    for yaw_sigma in (0.0, 0.5):
        imperfections = new_imperfections(yaw_sigma)
        world, estimate = estimated(plan, tmp_path, 3 + int(yaw_sigma > 0), imperfections)
        end = predicted(plan, world.team)[-1].belief
        for robot in ("A", "B"):
            C = estimate.trajectories[robot].covariances[-1]
            assert end.heading_sigma([robot]) == pytest.approx(math.sqrt(C[2, 2]), rel=0.15)
        sigmas.append(end.heading_sigma(("A", "B")))
    assert sigmas[1] > 2 * sigmas[0]


def new_imperfections(yaw_sigma):
    return type(FIELD)(**{**vars(FIELD), "mount_yaw_sigma_deg": yaw_sigma})
