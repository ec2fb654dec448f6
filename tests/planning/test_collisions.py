"""Planned missions on floors with walls: what robots touch is checked against rectangles, not by the planner's map."""

import math

import numpy as np
import pytest

from coloc_graph.planning.belief import Belief
from coloc_graph.planning.clearance import conflicts
from coloc_graph.planning.course import Course
from coloc_graph.planning.formation import Gait
from coloc_graph.planning.horizon import Horizon
from coloc_graph.planning.mover_path import cells, evenly_seen
from coloc_graph.planning.prediction import Predictor
from coloc_graph.planning.route import route
from coloc_graph.planning.slip import stop_sigma
from coloc_graph.simulation import Imperfections, build_world, reference_team
from coloc_graph.simulation.floor_plans import FLOOR_PLANS, FloorPlan
from coloc_graph.simulation.planned import planned
from coloc_graph.simulation.rig import stated_team

FIELD = Imperfections(mount_sigma_deg=1.0, height_sigma=0.005, span_sigma=1e-4, floor_sigma_deg=0.1)
RADIUS = 0.17  # of a Create [m]
DRAWS = 100
# a doorway of 1.4 m, of which one post is the corner of a room
DOOR = FloorPlan(
    ((-2.0, -2.3, 6.0, -2.0), (-2.0, 2.0, 6.0, 2.3), (-2.3, -2.3, -2.0, 2.3), (6.0, -2.3, 6.3, 2.3),
     (1.2, -2.0, 1.5, -0.7), (1.2, 0.7, 1.5, 2.0)),
    ((2.4, 0.0),),
)  # fmt: skip


def places_along(points):
    at = np.asarray(points, float)
    far = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(at, axis=0).T))])
    along = np.linspace(0.0, far[-1], int(far[-1] / 0.03) + 2)
    return np.column_stack([np.interp(along, far, column) for column in at.T])


@pytest.fixture(scope="module")
def mission():
    predictor = Predictor(stated_team(reference_team(), FIELD), 10.0, floor_map=DOOR.floor_map())
    horizon = Horizon(predictor, Course(((0.0, 0.0), *DOOR.goals)), ("A", "B"), "C", 90.0, timed=True,
                      gait=Gait(0.8, 0.5, 25.0))  # fmt: skip
    start = Belief.start(predictor.team, {**horizon.starts(), "C": (1.0, 0.0, 0.0)})
    return predictor, horizon.mission(start)


def test_through_a_doorway_no_robot_touches_another_or_a_wall_wherever_it_stops(mission):
    predictor, mission = mission
    assert not conflicts(mission.plan, predictor.free)
    rng, to_robot, to_wall = np.random.default_rng(1), math.inf, math.inf
    for _ in range(DRAWS):
        stood, at = {}, (1.0, 0.0)
        for stance in mission.plan.stances:
            ways = [places_along([at, *route(at, stance.waypoints[0], list(stood.values()), predictor.free)])]
            before = dict(stood)
            near = [(ways[0], list(stood.values()))]
            for name in stance.leapers:
                x, y, _ = stance.standing[name]
                leapt = math.dist((x, y), stood[name]) if name in stood else 0.0
                stood[name] = (x, y) + rng.standard_normal(2) * float(stop_sigma(leapt))
            for name in stance.leapers:
                others = [place for other, place in stood.items() if other != name]
                if name in before:
                    near.append((places_along([before[name], stood[name]]), others))
            near.append((places_along(stance.waypoints), list(stood.values())))
            at = stance.waypoints[-1]
            for way, others in near:
                to_wall = min(to_wall, float(DOOR.distance(way).min()))
                for other in others:
                    to_robot = min(to_robot, float(np.hypot(*(way - other).T).min()))
    assert to_robot > 2 * RADIUS
    assert to_wall > RADIUS


def test_what_is_planned_through_a_doorway_is_seen_in_a_world_with_those_walls(mission):
    _, mission = mission
    world = build_world(planned(mission.plan, walls=DOOR), fps=10.0)
    points = [captures[0].recorded.sum() for captures in world.captures]
    assert min(points) > 30
    assert sum(points) == pytest.approx(sum(promise.points for promise in mission.promises), rel=0.2)


def test_a_common_view_that_is_a_line_is_no_stance():
    predictor = Predictor(stated_team(reference_team(), FIELD), 10.0, floor_map=FLOOR_PLANS["L"].floor_map())
    model, margins = predictor.model(("B", "A"), "C"), predictor.margins(0.0, ("B", "A"))
    # before the end of a corridor 0.35 m of floor are left; a track of one marker there is a line
    end = np.array([(4.22, 4.05, 1.57), (3.77, 4.71, 0.92)])
    assert len(cells(model, end, margins, predictor.free).places) == 3
    assert evenly_seen(model, end[None], margins[None], predictor.free)[1] == 0


@pytest.mark.parametrize("name", FLOOR_PLANS)
def test_a_floor_plan_is_its_map(name):
    floor_plan = FLOOR_PLANS[name]
    floor_map = floor_plan.floor_map()
    rng = np.random.default_rng(0)
    places = rng.uniform((-1.4, -0.9), (5.0, 2.0), (5000, 2))
    far = floor_plan.distance(places)
    assert floor_map.clear(places[far > 0.335], 0.3).all()  # to less than a cell of 5 cm, and to the safe side
    assert not floor_map.clear(places[far < 0.299], 0.3).any()
    eye = np.zeros(2)
    blocked, mapped = floor_plan.blocked(eye, places), floor_map.blocked(np.broadcast_to(eye, places.shape), places)
    assert (blocked == mapped).mean() > 0.97  # all but those that pass within a cell of an edge
    assert blocked.any() and not blocked.all()
