"""Teams of more than three robots: who drives, who leaps, who anchors, and the time that a decision takes."""

import msgspec
import numpy as np
import pytest

from coloc_graph.errors import InputError
from coloc_graph.planning.belief import Belief
from coloc_graph.planning.clearance import conflicts
from coloc_graph.planning.course import Course
from coloc_graph.planning.formation import Gait
from coloc_graph.planning.horizon import Horizon
from coloc_graph.planning.plan import Plan, PlannedStance
from coloc_graph.planning.prediction import Predictor
from coloc_graph.planning.progress import STRAGGLE
from coloc_graph.planning.roles import best_roles, roles_of
from coloc_graph.simulation import Imperfections, reference_team
from coloc_graph.simulation.rig import stated_team

FIELD = Imperfections(mount_sigma_deg=1.0, height_sigma=0.005, span_sigma=1e-4, floor_sigma_deg=0.1)
COURSE = Course(((0.0, 0.0), (3.0, 0.0)))
new = msgspec.structs.replace


def team_of(count):
    team = stated_team(reference_team(), FIELD)
    robots = tuple(new(team["A"], name=name, markers=team["C"].markers) for name in "ABCDEF"[:count])
    return new(team, robots=robots)


def horizon_of(count):
    predictor = Predictor(team_of(count), 10.0)
    observers, mover, _ = roles_of(predictor.team)
    planner = Horizon(predictor, COURSE, observers, mover, 90.0, timed=True, gait=Gait(1.0, 0.5, 25.0))
    return planner, Belief.start(predictor.team, {**planner.starts(), mover: (1.5, 0.0, 0.0)})


def test_four_robots_come_to_the_goal_together_and_clear_of_each_other():
    planner, start = horizon_of(4)
    mission = planner.mission(start)
    assert not conflicts(mission.plan)
    assert {name for stance in mission.plan.stances[1:] for name in stance.leapers} == {"A", "B", "C"}
    for stance, promise in zip(mission.plan.stances[1:], mission.promises[1:], strict=True):
        assert len(stance.leapers) == 1 and len(stance.anchors) == 2
        ways = [x for x, _, _ in stance.standing.values()]
        assert max(ways) - min(ways) < STRAGGLE + 1.0
        assert promise.points > 50
    assert np.mean([x for x, _, _ in stance.standing.values()]) > COURSE.length - 0.5
    # each is known as well as the others
    sigmas = [promise.belief.position_sigma([name]) for name in "ABC"]
    assert max(sigmas) < 0.01


def test_a_third_camera_promises_more_of_the_same_drive():
    planner, start = horizon_of(4)
    stance = planner.first(start).stance
    pair = new_stance(stance, {name: stance.standing[name] for name in "AB"}, ())
    sigmas = []
    for one in (pair, stance):
        promise = planner.predictor.of_stance(start, one)
        sigmas.append(promise.belief.position_sigma(["B"]))
    assert sigmas[1] < 0.99 * sigmas[0]


def test_the_robot_that_is_seen_best_drives():
    team = team_of(4)
    blurred = new(team["D"].markers, span_sigma=0.01)
    robots = (*team.robots[:3], new(team["D"], markers=blurred))
    assert best_roles(Predictor(team, 10.0))[1] == "D"
    assert best_roles(Predictor(new(team, robots=robots), 10.0))[1] == "C"


def test_conflicts_name_the_robots_and_the_stance():
    planner, start = horizon_of(4)
    first = planner.first(start).stance
    x, y, yaw = first.standing["A"]
    near = {**first.standing, "B": (x + 0.2, y, yaw)}
    plan = Plan((first, new_stance(first, near)))
    ((stance, sentence),) = [one for one in conflicts(plan) if "stand" in one[1]]
    assert stance == 1 and sentence == "A and B stand 0.20 m apart: they need 0.42 m"


@pytest.mark.parametrize(("leap", "drive", "near"), [
    (0.5, ((0.45, -1.0), (0.45, 1.0)), False),
    (4.0, ((0.45, -1.0), (0.45, 1.0)), True),  # it stops off by 4 cm
    (0.5, ((0.35, 0.0), (2.0, 0.0)), True),
])  # fmt: skip
def test_a_drive_keeps_off_a_robot_by_as_much_as_it_may_stop_off(leap, drive, near):
    before = PlannedStance({"A": (-leap, 0.0, 0.0), "B": (0.0, 2.0, 0.0)}, (), "C", ((3.0, 0.0), (3.0, 1.0)), 5.0)
    after = PlannedStance({**before.standing, "A": (0.0, 0.0, 0.0)}, ("B",), "C", drive, 5.0)
    assert conflicts(Plan((before, after))) == [(1, "the drive of C comes too near to a robot or a wall")] * near


def new_stance(stance, standing, anchors=("A", "C")):
    return type(stance)(standing, anchors, stance.mover, stance.waypoints, stance.duration)


def test_roles_without_enough_cameras_are_one_sentence():
    team = team_of(3)
    blind = new(team, robots=(team["A"], new(team["B"], camera_if_any=None, mount_if_any=None), team["C"]))
    with pytest.raises(InputError, match="needs two robots with cameras besides the mover C"):
        roles_of(blind)


def test_a_mover_without_two_markers_is_one_sentence():
    team = team_of(3)
    one_light = new(team, robots=(team["A"], new(team["B"], markers=None), team["C"]))
    with pytest.raises(InputError, match="the mover B carries fewer than two markers: give it two"):
        roles_of(one_light, "B")
    nobody = new(team, robots=tuple(new(robot, markers=None) for robot in team.robots))
    with pytest.raises(InputError, match="no robot carries two markers: give the mover two"):
        roles_of(nobody)
