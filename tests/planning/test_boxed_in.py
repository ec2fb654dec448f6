"""Teams that no leap along the course brings on: others make way, or it is said who stands in whose way."""

import math
from dataclasses import replace

import numpy as np
import pytest

from coloc_graph.errors import InputError
from coloc_graph.online.horizon_planner import CREATE
from coloc_graph.planning.beam import Node
from coloc_graph.planning.belief import OBSERVER, POSE, Belief
from coloc_graph.planning.course import Course
from coloc_graph.planning.formation import Gait
from coloc_graph.planning.horizon import Horizon
from coloc_graph.planning.leaps import steps_aside
from coloc_graph.planning.plan import PlannedStance
from coloc_graph.planning.prediction import Predictor
from coloc_graph.planning.room import TO_ROBOT
from coloc_graph.planning.slip import stop_sigma
from coloc_graph.planning.ways_out import require_way
from coloc_graph.simulation import Imperfections, reference_team
from coloc_graph.simulation.floor_plans import FLOOR_PLANS, FloorPlan
from coloc_graph.simulation.rig import stated_team

WRONG = Imperfections(mount_sigma_deg=1.0, height_sigma=0.005, span_sigma=1e-4, floor_sigma_deg=0.1)
TEAM = stated_team(reference_team(names=("A", "B", "C", "D")), WRONG)
RADIUS = 0.17  # of a Create [m]
# a corridor of 1.4 m, with an end
NARROW = FloorPlan(
    ((-1.8, -1.0, 4.3, -0.7), (-1.8, 0.7, 4.3, 1.0), (-1.8, -1.0, -1.5, 1.0), (4.0, -1.0, 4.3, 1.0)),
    ((3.4, 0.0),),
)
# C and B stand side by side in front of A, before the end
ABREAST = {"A": (2.017, 0.258, -0.108), "B": (3.119, -0.392, -0.241), "C": (2.941, 0.355, -0.003), "D": (3.7, 0.0, 0.0)}


def horizon_of(floor):
    predictor = Predictor(TEAM, 10.0, floor_map=floor.floor_map(), anew=True)
    course = Course(((0.0, 0.0), *floor.goals))
    return Horizon(predictor, course, ("A", "B", "C"), "D", 200.0, gait=Gait(0.8, 0.5, 20.0))


def leaps_along(horizon, belief):
    """True if any leap along the course is possible."""
    return next(horizon._ahead(belief, 100.0, (), None), None) is not None


def require_clear(floor, poses, decision):
    """Require that the leap and the drive touch neither the others nor walls, every 2 cm."""
    leaper, target, _ = decision.ahead[0]
    others = [poses[name][:2] for name in "ABC" if name != leaper]
    ways = [(np.array([poses[leaper][:2], target[:2]]), others)]
    ways.append((np.array(decision.stance.waypoints), [*others, target[:2]]))
    for points, standing in ways:
        far = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
        along = np.linspace(0.0, far[-1], int(far[-1] / 0.02) + 2)
        way = np.column_stack([np.interp(along, far, column) for column in points.T])
        assert floor.distance(way).min() > RADIUS
        assert min(float(np.hypot(*(way - other).T).min()) for other in standing) > 2 * RADIUS


def test_one_that_stands_in_another_s_way_steps_aside_and_the_other_leaps_on():
    horizon, belief = horizon_of(NARROW), Belief.start(TEAM, ABREAST)
    assert not leaps_along(horizon, belief)
    decision = horizon.next(belief, 100.0)
    leaper, target, _ = decision.ahead[0]
    assert leaper in decision.stance.leapers and len(decision.stance.anchors) == 2
    assert decision.reason.endswith(f"; {leaper} makes way for {decision.ahead[1][0]}")
    step = math.dist(target[:2], ABREAST[leaper][:2])
    assert step < 0.5
    # nearer to robots that are known to stand than on a long leap, and no nearer than it may stop off
    assert min(
        math.dist(target[:2], ABREAST[name][:2]) for name in "ABC" if name != leaper
    ) >= horizon.predictor.room.apart(step, least=0.0)
    require_clear(NARROW, ABREAST, decision)
    after = horizon.next(decision.promise.belief, 90.0)
    assert after.ahead[0][0] != leaper and "makes way" not in after.reason


def test_a_step_aside_needs_less_room_than_a_leap_and_touches_nothing():
    poses = {**ABREAST, "B": (3.0, -0.29, 0.0)}
    horizon, belief = horizon_of(NARROW), Belief.start(TEAM, poses)
    found = steps_aside(belief, "C", horizon.course, horizon.gait, horizon.observers, horizon.predictor).targets
    away = np.min([np.hypot(*(found[:, :2] - poses[name][:2]).T) for name in "AB"], axis=0)
    assert 2 * RADIUS + 0.04 < away.min() < TO_ROBOT
    assert NARROW.distance(found[:, :2]).min() > RADIUS + 0.03


def test_a_team_goes_on_from_where_one_looks_at_a_wall_after_a_corner():
    # the second one of a U
    poses = {"A": (2.762, 4.216, 2.647), "B": (3.687, 4.11, 2.747), "C": (3.639, 3.393, 1.36), "D": (1.864, 3.5, 0.0)}
    horizon, belief = horizon_of(FLOOR_PLANS["U"]), Belief.start(TEAM, poses)
    decision = horizon.next(belief, 100.0)
    assert len(decision.stance.anchors) == 2 and decision.promise.points > 30
    require_clear(FLOOR_PLANS["U"], poses, decision)


def test_once_the_front_is_at_the_goal_the_hindmost_comes_up_to_it():
    # ahead of A there is a wall; only A could turn where it stands, for ever
    poses = {"A": (4.25, 4.6, 2.037), "B": (3.351, 3.693, 1.103), "C": (3.746, 2.182, 1.135), "D": (4.116, 5.211, 0.0)}
    horizon, belief = horizon_of(FLOOR_PLANS["L"]), Belief.start(TEAM, poses)
    decision = horizon.next(belief, 20.0)
    assert decision.ahead[0][0] == "C" and horizon.arrived(decision.stance.standing)
    require_clear(FLOOR_PLANS["L"], poses, decision)


def test_where_there_is_no_way_out_the_message_names_who_stands_in_whose_way():
    poses = {"A": (2.629, -0.254, 0.014), "B": (3.324, 0.134, 0.184), "C": (3.187, -0.266, -0.06), "D": (3.7, 0.0, 0.0)}
    horizon, belief = horizon_of(NARROW), Belief.start(TEAM, poses)
    with pytest.raises(InputError, match=r"3\.0 m along the course: C stands in the way of A: set C aside"):
        horizon.next(belief, 100.0)


def test_a_mover_that_is_boxed_in_names_who_stands_in_its_way():
    poses = {**ABREAST, "C": (2.5, 0.2, 0.0), "B": (2.5, -0.3, 0.0), "D": (1.0, 0.0, 0.0)}
    stance = PlannedStance({name: poses[name] for name in "ABC"}, ("A", "B"), "D", ((3.3, 0.0), (3.5, 0.2)), 5.0)
    predictor = horizon_of(NARROW).predictor
    with pytest.raises(InputError, match=r"D finds no way to where it is to drive: .* in its way"):
        require_way(Belief.start(TEAM, poses), stance, "ABC", predictor)
    away = {**poses, "A": (-1.0, 0.3, 0.0), "B": (-0.4, 0.3, 0.0), "C": (0.2, 0.3, 0.0)}
    require_way(Belief.start(TEAM, away), stance, "ABC", predictor)


def test_of_plans_whose_drives_are_impossible_the_next_ones_are_tried():
    poses = {"A": (0.0, 0.3, -0.2), "B": (0.5, -0.3, 0.2), "C": (1.0, 0.3, -0.2), "D": (1.5, 0.0, 0.0)}
    horizon, belief = horizon_of(FLOOR_PLANS["L"]), Belief.start(TEAM, poses)
    node = Node(belief, {name: poses[name] for name in "ABC"}, 100.0, 0.0)
    blind = [node.after("A", (1.5, y, math.pi), 5.0, 95.0, 0.0, None, by_gait=False) for y in (-0.3, -0.5, 0.5, 0.6)]
    good = next(horizon._ahead(belief, 100.0, (), None))
    assert horizon._decided(belief, 100.0, [*blind, *good]).ahead[0][:2] in {one.choices[0][:2] for one in good}


def known(belief):
    """Team whose positions, headings and mounts are known to 0.3 mm, 0.1 mrad, and a tenth of what is stated."""
    covariance = belief.covariance.copy()
    for name in belief.robots:
        at = belief.index(name)
        covariance[at + 2 : at + 5, at + 2 : at + 5] = np.diag([1e-8, 1e-7, 1e-7])
        covariance[at + POSE : at + OBSERVER, at + POSE : at + OBSERVER] *= 0.01
    return replace(belief, covariance=covariance)


def followed(poses, decisions):
    """Pair that stands before the corner of the L, after decisions that robots follow exactly."""
    team = stated_team(reference_team(names=("A", "B", "C")), WRONG)
    predictor = Predictor(team, 10.0, wheels=CREATE, floor_map=FLOOR_PLANS["L"].floor_map(), anew=True)
    course = Course(((0.0, 0.0), *FLOOR_PLANS["L"].goals))
    horizon = Horizon(predictor, course, ("A", "B"), "C", 200.0, gait=Gait(1.0667, 0.5, 25.0))
    belief, leapers = known(Belief.start(team, poses)), []
    left = horizon.remaining(poses)
    for _ in range(decisions):
        decision = horizon.next(belief, 100.0)
        leapers.append(decision.ahead[0][0])
        x, y = decision.stance.waypoints[-1]
        after = {**decision.promise.belief.poses, "C": (x, y, 0.0)}
        belief = replace(decision.promise.belief, poses=after, leapt={})
    return leapers, left - horizon.remaining(belief.poses)


def test_one_leaps_on_beside_another_that_has_passed_a_corner_and_looks_back():
    # A has passed it, 0.5 m from B, and looks along the way that they came, where B sees nothing from beyond the corner
    poses = {"A": (3.58, 0.49, -0.63), "B": (3.58, 0.02, -0.03), "C": (4.29, 0.19, 0.0)}
    leapers, gained = followed(poses, 2)
    assert "B" in leapers and gained > 0.2


def test_no_robot_turns_to_and_fro_before_a_corner():
    # a leap of A beside the corner counts as one on, but comes to no further way along the course
    poses = {"A": (3.575, 0.245, -0.413), "B": (3.978, -0.657, -0.05), "C": (4.478, -0.682, 0.0)}
    _, gained = followed(poses, 3)
    assert gained > 0.3


def test_cameras_see_one_that_leaps_round_a_corner():
    # the two that stay share a view, too: nothing else asks that C looks there
    poses = {
        "A": (3.07, 0.179, -0.722),
        "B": (1.643, -0.16, 0.036),
        "C": (2.191, 0.302, -0.586),
        "D": (2.9, -0.47, 0.0),
    }
    predictor = Predictor(TEAM, 10.0, wheels=CREATE, floor_map=FLOOR_PLANS["L"].floor_map(), anew=True)
    course = Course(((0.0, 0.0), *FLOOR_PLANS["L"].goals))
    horizon = Horizon(predictor, course, ("A", "B", "C"), "D", 220.0, gait=Gait(1.0667, 0.5, 25.0))
    decision = horizon.next(known(Belief.start(TEAM, poses)), 104.0)
    leaper, target, _ = decision.ahead[0]
    by_wheels = float(stop_sigma(math.dist(poses[leaper][:2], target[:2]), CREATE))
    assert decision.promise.belief.position_sigma([leaper]) < 0.1 * by_wheels


def test_poses_in_which_a_team_does_not_come_on_are_avoided():
    poses = {"A": (3.75, 0.49, -0.45), "B": (3.96, -0.44, 0.4), "C": (4.6, -0.1, 0.0)}
    turned = {**poses, "A": (3.75, 0.49, -0.65)}
    horizon = horizon_of(FLOOR_PLANS["L"])
    before = {**poses, "A": (2.0, 0.3, 0.0)}
    assert not horizon.require_progress([before, poses, turned])
    idle = horizon.require_progress([before, poses, turned, poses])
    assert turned["A"] in idle and poses["A"] in idle and before["A"] not in idle
    onward = {**turned, "C": (4.2, 1.5, 1.5)}
    assert not horizon.require_progress([before, poses, turned, poses, onward])
