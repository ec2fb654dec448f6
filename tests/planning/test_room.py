"""Distances that allow for the slip of the wheels for which a plan is made."""

import math
from dataclasses import replace

import numpy as np
import pytest

from coloc_graph.online.horizon_planner import CREATE
from coloc_graph.planning.belief import Belief
from coloc_graph.planning.course import Course
from coloc_graph.planning.formation import Gait
from coloc_graph.planning.horizon import Horizon
from coloc_graph.planning.leaps import possible_leaps
from coloc_graph.planning.prediction import Predictor
from coloc_graph.planning.room import SIGMAS, Room
from coloc_graph.planning.route import clear_way, route
from coloc_graph.planning.slip import stop_sigma
from coloc_graph.simulation import Imperfections, reference_team
from coloc_graph.simulation.floor_plans import FloorPlan
from coloc_graph.simulation.rig import stated_team

WRONG = Imperfections(mount_sigma_deg=1.0, height_sigma=0.005, span_sigma=1e-4, floor_sigma_deg=0.1)
TEAM = stated_team(reference_team(names=("A", "B", "C", "D")), WRONG)
RADIUS = 0.17  # of a Create [m]
POSES = {"A": (0.0, 0.3, -0.3), "B": (0.5, -0.3, 0.3), "C": (1.2, 0.3, -0.3), "D": (2.0, 0.0, 0.0)}
GAIT = Gait(0.8, 0.5, 20.0)


def predictor_of(floor=None):
    return Predictor(TEAM, 10.0, wheels=CREATE, floor_map=floor and floor.floor_map(), anew=True)


def needed(driven, sigmas=4.5):
    """Distance from where a Create is after it has driven, by the errors of its wheels alone [m]."""
    return 2 * RADIUS + sigmas * CREATE.veer * np.sqrt(np.asarray(driven) ** 3 / 3)


def test_where_a_create_stops_is_known_as_its_wheels_veer():
    rng, leapt, steps = np.random.default_rng(0), 2.0, 400
    heading = np.cumsum(rng.standard_normal((2000, steps)) * CREATE.veer * math.sqrt(leapt / steps), axis=1)
    heading += rng.standard_normal((2000, 1)) * CREATE.turned / math.sqrt(2)
    off = (np.sin(heading) * leapt / steps).sum(axis=1)
    found = math.hypot(float(off.std()), float(stop_sigma(leapt)))
    assert float(stop_sigma(leapt, CREATE)) == pytest.approx(found, rel=0.06)


def test_leaps_end_and_pass_where_a_create_that_slips_touches_no_other():
    poses = {"A": (0.0, 0.0, 0.0), "B": (1.0, -0.75, 0.3), "C": (1.0, 0.95, -0.3), "D": (3.0, 0.0, 0.0)}
    belief, course = Belief.start(TEAM, poses), Course(((0.0, 0.0), (7.2, 0.0)))

    def targets(predictor):
        return possible_leaps(belief, "A", course, GAIT, ("A", "B", "C"), predictor).targets[:, :2]

    places = targets(predictor_of())
    leapt = np.hypot(*places.T)
    assert leapt.max() > 1.5
    assert len(places) < len(targets(replace(predictor_of(), sigmas=1.0)))
    for name in "BC":
        other = np.array(poses[name][:2])
        assert (np.hypot(*(places - other).T) > needed(leapt)).all()
        for target, length in zip(places, leapt, strict=True):
            driven = np.arange(0.0, length, 0.1)
            way = driven[:, None] / length * target
            assert (np.hypot(*(way - other).T) > needed(driven) - 0.01).all()


def test_a_way_keeps_the_further_from_robots_the_further_it_has_driven():
    room, way = Room(CREATE), [(0.0, 0.0), (3.0, 0.0)]
    for x in (0.5, 1.5, 2.5):
        near = float(needed(x))
        assert not clear_way(way, [(x, near - 0.02)], room=room)
        assert clear_way(way, [(x, float(room.apart(3.0)) + 0.01)], room=room)
    rooms = [Room(CREATE, sigmas) for sigmas in SIGMAS]
    round_it = route((0.0, 0.0), (4.0, 0.0), [(2.0, 0.45)], rooms=rooms)
    assert len(round_it) > 1 and len(route((0.0, 0.0), (4.0, 0.0), [(2.0, 0.45)])) == 1
    between = [(2.0, y) for y in (-1.8, -1.2, -0.6, 0.6, 1.2, 1.8)]  # where there is little room, nearer to them
    walls = [(2.0, y) for y in np.arange(-6.0, 6.1, 0.6) if abs(y) > 0.5]
    assert route((0.0, 0.0), (4.0, 0.0), [*between, *walls], rooms=rooms)[-1] == (4.0, 0.0)


def test_where_a_way_is_narrow_distances_allow_for_fewer_sigmas_and_the_decision_says_so():
    # A has to pass between B and C, and there is no way round them
    floor = FloorPlan(((-1.8, -1.15, 8.3, -0.85), (-1.8, 0.85, 8.3, 1.15)), ((6.4, 0.0),))
    poses = {"A": (0.0, 0.0, 0.0), "B": (1.2, -0.48, 0.3), "C": (1.2, 0.48, -0.3), "D": (2.0, 0.0, 0.0)}
    belief, course = Belief.start(TEAM, poses), Course(((0.0, 0.0), (6.4, 0.0)))
    horizon = Horizon(predictor_of(floor), course, ("A", "B", "C"), "D", 200.0, gait=GAIT)
    decision = horizon.next(belief, 100.0, leaper="A")
    sigmas = horizon.predictor.sigmas
    assert sigmas in SIGMAS[1:]
    assert f"allow for {sigmas:g} sigmas of slips" in decision.reason
    _, target, _ = decision.ahead[0]
    assert min(math.dist(target[:2], poses[name][:2]) for name in "BC") > needed(math.hypot(*target[:2]), sigmas)
    far = {**poses, "B": (1.2, -1.2, 0.3), "C": (1.2, 1.2, -0.3)}
    wide = Horizon(predictor_of(), course, ("A", "B", "C"), "D", 200.0, gait=GAIT)
    assert "sigmas" not in wide.next(Belief.start(TEAM, far), 100.0, leaper="A").reason


def test_a_mission_planned_as_a_whole_keeps_what_the_simulation_s_robots_slip():
    predictor = replace(predictor_of(), anew=False)
    assert predictor.room == Room() and predictor.rooms == []
    assert [*predictor.ever_nearer()] == [4.5]
