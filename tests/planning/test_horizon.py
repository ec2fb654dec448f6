"""The receding horizon: it arrives, keeps what it promises itself, stays off walls, and names what cannot be done."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from coloc_graph.errors import InputError
from coloc_graph.planning.beam import Node, different
from coloc_graph.planning.belief import Belief
from coloc_graph.planning.clearance import conflicts
from coloc_graph.planning.course import Course
from coloc_graph.planning.floor_map import FloorMap, read_floor_map
from coloc_graph.planning.formation import PAPER, Gait
from coloc_graph.planning.horizon import Horizon
from coloc_graph.planning.leaps import TO_WALL
from coloc_graph.planning.mission import leap_frog, stances_of
from coloc_graph.planning.mover_path import evenly_seen
from coloc_graph.planning.prediction import Predictor
from coloc_graph.planning.rollout import HEADING_ARM
from coloc_graph.planning.room import TO_ROBOT
from coloc_graph.simulation import Imperfections, reference_team
from coloc_graph.simulation.rig import stated_team

FIELD = Imperfections(mount_sigma_deg=1.0, height_sigma=0.005, span_sigma=1e-4, floor_sigma_deg=0.1)
CELL = 0.05
GAIT = Gait(0.9, 0.5, 25.0)


def corridor(width: float, corner: float = 4.0) -> FloorMap:
    """An L: along x from -1 m to past `corner`, then along y."""
    x, y = np.meshgrid(np.arange(-1.0, 8.0, CELL), np.arange(-3.0, 8.0, CELL))
    along = (np.abs(y) < width / 2) & (x < corner + width / 2)
    up = (np.abs(x - corner) < width / 2) & (y > -width / 2)
    return FloorMap.of_cells(along | up, CELL, (-1.0, -3.0))


def horizon(course, seconds=60.0, floor_map=None, **options):
    predictor = Predictor(stated_team(reference_team(), FIELD), fps=10.0, floor_map=floor_map)
    return Horizon(predictor, course, ("A", "B"), "C", seconds, gait=GAIT, **options)


def start(team):
    return Belief.start(team, {"A": PAPER.stop(0), "B": PAPER.stop(1), "C": (1.5, 0.0, 0.0)})


STRAIGHT = Course(((0.0, 0.0), (3.0, 0.0)))


@pytest.fixture(scope="module")
def straight():
    planner = horizon(STRAIGHT)
    return planner, planner.draft(start(planner.predictor.team))


def test_a_mission_arrives_with_its_seconds_spent_and_one_anchor_in_each_stance(straight):
    planner, mission = straight
    assert planner.arrived(mission.plan.stances[-1].standing)
    assert mission.capture_time == pytest.approx(60.0, abs=5.5)
    assert all(len(stance.anchors) == 1 for stance in mission.plan.stances[1:])
    assert all(promise.points > 50 for promise in mission.promises)


def test_what_it_expects_at_the_start_it_finds_at_the_end(straight):
    planner, mission = straight
    first = mission.promises[0].belief
    expected = planner.next(first, 60.0 - mission.plan.stances[0].duration).expected
    found = math.hypot(mission.end_sigma, HEADING_ARM * mission.heading_sigma)
    assert found == pytest.approx(expected, rel=0.1)


def test_refining_a_mission_promises_less_in_as_much_time_and_touches_nothing(straight):
    planner, draft = straight
    mission = planner.refined(draft)
    assert mission.end_sigma < 0.93 * draft.end_sigma
    assert mission.heading_sigma < draft.heading_sigma
    assert mission.capture_time <= draft.capture_time + 1e-9
    assert planner.arrived(mission.plan.stances[-1].standing)
    assert not conflicts(mission.plan)
    assert mission.plan.stances[0].standing == draft.plan.stances[0].standing


def test_no_second_that_is_left_is_free_to_spend(straight):
    planner, mission = straight
    belief = mission.promises[0].belief
    rollout = planner._rollout_of(belief.poses)
    rows = rollout.rows(belief)
    seconds = 40.0 * 1.02 ** np.arange(20)
    P = np.repeat(belief.covariance[np.ix_(rows, rows)][None], len(seconds), axis=0)
    poses = {name: np.repeat([belief.poses[name]], len(seconds), axis=0) for name in "AB"}
    fall = np.diff(np.log(rollout.end_variance(P, poses, "B", seconds)))
    assert (fall < -0.003).all()


def test_another_leap_is_chosen_only_if_its_planned_drive_promises_less_than_the_gait_s(straight, monkeypatch):
    planner, mission = straight
    seconds, belief = 60.0 - mission.plan.stances[0].duration, mission.promises[0].belief
    grown = planner._expand(Node(belief, mission.plan.stances[0].standing, seconds, 0.0), (), in_lane=False)
    own = next(node for node in sorted(grown, key=lambda node: node.score) if node.by_gait)
    worst = max((node for node in grown if not node.by_gait), key=lambda node: node.score)
    guessed = [replace(worst, score=0.0), own]
    variance, node, *_ = planner._finalist(belief, seconds, guessed)
    assert node is own, "a guess of 0 must not decide"
    monkeypatch.setattr("coloc_graph.planning.horizon.PREFERRED", 1e-9)
    assert planner._finalist(belief, seconds, guessed)[1] is guessed[0]
    assert math.sqrt(variance) == pytest.approx(planner.next(belief, seconds).expected, rel=0.1)


def test_few_plans_are_followed_however_late_the_gait_s_own_comes():
    nodes = [Node(None, {}, 0.0, n, (("A", (0.3 * n, 0.0, 0.0), 4.0),), by_gait=n >= 9) for n in range(20)]
    assert [node.score for node in different(nodes, 4)] == [0, 1, 2, 3, 9]
    assert [node.score for node in different(nodes[8:], 4)] == [8, 9, 10, 11]
    assert [node.score for node in different(nodes[:6], 4)] == [0, 1, 2, 3]


def test_it_promises_far_more_than_the_paper_s_formation_with_as_many_images(straight):
    planner, mission = straight
    seconds = 60.0 / stances_of(PAPER, 3.0)
    paper = leap_frog(planner.predictor, PAPER, 3.0, seconds, ("A", "B"), "C", designed=False)
    assert mission.end_sigma < 0.6 * paper.end_sigma


def test_a_target_that_failed_is_not_tried_again(straight):
    planner, mission = straight
    belief = mission.promises[0].belief
    _, target, _ = planner.next(belief, 40.0).ahead[0]
    other = planner.next(belief, 40.0, avoid=[target]).ahead[0][1]
    assert math.dist(target[:2], other[:2]) + abs(target[2] - other[2]) > 0.15


def test_round_a_corner_all_stand_clear_of_walls_and_of_each_other():
    floor_map = corridor(2.0, corner=2.0)
    planner = horizon(Course(((0.0, 0.0), (2.0, 0.0), (2.0, 1.4))), 50.0, floor_map)
    mission = planner.mission(start(planner.predictor.team))
    assert planner.arrived(mission.plan.stances[-1].standing)
    for stance, promise in zip(mission.plan.stances, mission.promises, strict=True):
        places = np.array([pose[:2] for pose in stance.standing.values()])
        assert floor_map.clear(places, TO_WALL - 1e-9).all()
        assert math.dist(*places) > TO_ROBOT
        assert floor_map.clear(np.array(stance.waypoints), 0.2).all()
        assert promise.points > 50


@pytest.mark.parametrize(
    ("course", "floor_map", "sentence"),
    [
        (((0.0, 0.0), (4.0, 3.0), (7.0, 3.0)), corridor(2.0), "the goal at 7.00, 3.00 is in a wall or beyond the map"),
        (((0.0, 0.0), (3.0, 0.0)), corridor(0.6), r"stands, 0\.\d m along .* the way is too narrow"),
    ],
)
def test_a_way_that_cannot_be_gone_is_one_sentence(course, floor_map, sentence):
    with pytest.raises(InputError, match=sentence):
        planner = horizon(Course(course), 40.0, floor_map)
        belief = start(planner.predictor.team)
        planner.next(belief, 30.0)


def test_a_team_that_only_changes_its_places_is_told_so(straight):
    planner, mission = straight
    stood = [stance.standing for stance in mission.plan.stances]
    planner.require_progress(stood)
    with pytest.raises(InputError, match=r"no observer can leap on from where the team stands, .* m along"):
        planner.require_progress([*stood[:2], *[stood[1]] * 6])


def test_walls_block_the_view():
    floor_map = corridor(2.0)
    eyes = np.array([0.0, 0.0])
    assert floor_map.blocked(eyes, np.array([[2.0, 0.5], [2.0, 2.0], [4.0, 3.0]])).tolist() == [False, True, True]


def test_a_ros_map_is_read_upside_up(tmp_path):
    cells = np.full((20, 40), 254, np.uint8)
    cells[:5] = 0  # the top rows, which are the largest y
    cv2.imwrite(str(tmp_path / "map.pgm"), cells)
    text = "image: map.pgm\nresolution: 0.1\norigin: [-1.0, -0.5, 0.0]\nnegate: 0\nfree_thresh: 0.2\n"
    (tmp_path / "map.yaml").write_text(text)
    floor_map = read_floor_map(tmp_path / "map.yaml")
    places = np.array([[0.0, 0.0], [0.0, 1.2], [-1.2, 0.0], [2.8, 0.7]])
    assert floor_map.clear(places, 0.05).tolist() == [True, False, False, True]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("just words", "names no `image`"),
        ("image: map.pgm\nresolution: 0.1\norigin: [0, 0]\nfree_thresh: 0.2", "`origin` is"),
        ("image: map.pgm\nresolution: -1\norigin: [0, 0, 0]\nfree_thresh: 0.2", "`resolution` is -1"),
        ("image: map.pgm\nresolution: 0.1\norigin: [0, 0, 1.5]\nfree_thresh: 0.2", "turned by 1.5 rad"),
        ("image: none.pgm\nresolution: 0.1\norigin: [0, 0, 0]\nfree_thresh: 0.2", "none.pgm"),
        ("{", "YAML cannot be read"),
    ],
)
def test_a_file_that_is_no_map_is_refused(tmp_path, text, sentence):
    (tmp_path / "map.yaml").write_text(text)
    cv2.imwrite(str(tmp_path / "map.pgm"), np.zeros((4, 4), np.uint8))
    with pytest.raises(InputError, match=sentence):
        read_floor_map(tmp_path / "map.yaml")


def test_an_observer_that_looks_at_a_wall_shares_no_view():
    predictor = Predictor(stated_team(reference_team(), FIELD), floor_map=corridor(1.2))
    standing = np.array([[[0.0, 0.3, 1.6], [0.5, -0.3, 0.0]]])
    information, count = evenly_seen(predictor.model(("A", "B"), "C"), standing, np.array([10.0]), predictor.free)
    assert count.tolist() == [0]
    assert not information.any()
