"""Plans in the viewer: promised ellipses, what came of them, and robots that are dragged."""

# ruff: noqa: F811  the fixtures' names are imported, and are arguments

import json
import math
import time
from dataclasses import replace

import numpy as np
import pytest
from browser import browser, client_of, page_of, pixel_of, until  # noqa: F401  fixtures

from coloc_graph.planning.formation import Gait
from coloc_graph.planning.mission import leap_frog
from coloc_graph.planning.prediction import Predictor
from coloc_graph.simulation import Imperfections, reference_team
from coloc_graph.simulation.rig import stated_team
from coloc_graph.viewer import PlanEditor, ShownPlan, Viewer
from coloc_graph.viewer.frame import ViewState, frame_of
from coloc_graph.viewer.plan_scene import scene_of_plan
from coloc_graph.viewer.plans import planned_note, read_plans

FIELD = Imperfections(mount_sigma_deg=1.0, height_sigma=0.005, span_sigma=1e-4, floor_sigma_deg=0.1)
GOAL = (1.8, 0.0)


@pytest.fixture(scope="module")
def predictor():
    return Predictor(stated_team(reference_team(), FIELD), 10.0)


@pytest.fixture(scope="module")
def mission(predictor):
    return leap_frog(predictor, Gait(0.9, 0.5, 25.0), GOAL[0], 8.0, ("A", "B"), "C")


@pytest.fixture
def editor(predictor, mission):
    one = PlanEditor(predictor, mission.start, mission.plan, GOAL)
    yield one
    one.close()


def test_the_scene_of_a_plan_has_its_poses_and_promised_covariances(mission, predictor):
    scene = scene_of_plan(predictor.team, mission.plan, mission.promises)
    layer = scene.layers[0]
    assert len(scene) == len(mission.plan.stances)
    for k, stance in enumerate(mission.plan.stances):
        for name, (x, y, yaw) in stance.standing.items():
            n = scene.robots.index(name)
            np.testing.assert_allclose([*layer.xyz[n, k, :2], layer.yaw[n, k]], [x, y, yaw], atol=1e-9)
            promised = mission.promises[k].belief.position_covariance(name)
            np.testing.assert_allclose(layer.covariance[n, k], promised, atol=1e-12)
    assert "came" not in planned_note(scene, 0)


def test_promised_ellipses_are_drawn_as_large_as_their_sigmas_and_told_beside_those_that_came(mission, predictor):
    scene = scene_of_plan(predictor.team, mission.plan, mission.promises)
    plan = ShownPlan(0, {"A": np.zeros(3)}, {"A": np.diag([0.01**2, 0.02**2, 1e-6])}, np.zeros((0, 2)), None, "because")
    scene = replace(scene, plans=(plan,), layers=(replace(scene.layers[0], name="joint"),))
    frame = frame_of(scene, ViewState(time=scene.middle(0), k_sigma=30.0))
    points = frame.planned.points.reshape(-1, 3)
    ellipse = points[: 2 * (len(points) // 3)]  # the footprint and the line of sight come after it
    inside = ellipse[np.hypot(*(ellipse[:, :2] / (0.3, 0.6)).T) < 1.01]
    assert np.abs(inside[:, 1]).max() == pytest.approx(0.6, rel=0.02)
    assert np.abs(points[:20, 0]).max() <= 0.301
    assert not len(frame_of(scene, ViewState(time=scene.middle(0), plans=False)).planned.points)
    note = planned_note(scene, 0)
    came = 1e3 * math.sqrt(np.trace(scene.layers[0].covariance[0, 0]))
    assert f"A: 22.4 mm promised, {came:.1f} mm came" in note and "because" in note


def test_plans_are_read_from_the_log_of_a_mission_and_half_a_line_does_not_matter(tmp_path):
    promise = {"standing": {"A": [1, 2, 0.5]}, "covariances": {"A": np.eye(3).tolist()}, "points": 5, "reason": "r"}
    row = {"time": 0, "what": "planned", "stance": 1, "leap": ["A", [1, 2, 0.5]], "patrol": [[1, 1], [2, 2]]}
    lines = [json.dumps({**row, "promise": promise | {"reason": "an earlier attempt"}}), json.dumps(row)]
    lines += [json.dumps({**row, "promise": promise}), '{"time": 3, "what": "planned", "st']
    (tmp_path / "mission.jsonl").write_text("\n".join(lines))
    (plan,) = read_plans(tmp_path / "mission.jsonl")
    assert (plan.stance, plan.leaper, plan.reason) == (1, "A", "r")
    np.testing.assert_allclose(plan.standing["A"], [1, 2, 0.5])
    assert read_plans(tmp_path / "none.jsonl") == ()


def test_dragging_a_robot_changes_what_is_promised_of_the_next_stances(editor):
    before = editor.promises
    with Viewer(editor.scene, port=0) as viewer:
        editor.attach(viewer)
        assert viewer.wait_idle()
        leaper = editor.plan.stances[1].leapers[0]
        x, y, yaw = editor.plan.stances[1].standing[leaper]
        for step in range(1, 11):
            editor.drag(leaper, 1, (x - 0.03 * step, y, yaw))
            assert until(lambda step=step: editor.updates >= step, 10)
        moved = (x - 0.3, y, yaw)
        assert until(lambda: viewer.scene.plans[1].standing[leaper][0] == pytest.approx(x - 0.3))
        assert editor.plan.stances[1].standing[leaper] == moved == editor.plan.stances[2].standing[leaper]
        # rested, its drives are planned anew
        drive = editor.plan.stances[1].waypoints
        assert until(lambda: editor.plan.stances[1].waypoints != drive)
    sigmas = [[one.belief.position_sigma(("A", "B")) for one in promises] for promises in (before, editor.promises)]
    assert sigmas[0][0] == sigmas[1][0]
    assert all(a != b for a, b in zip(sigmas[0][1:], sigmas[1][1:], strict=True))


def test_a_robot_that_is_dragged_onto_another_is_named(editor):
    with Viewer(editor.scene, port=0) as viewer:
        editor.attach(viewer)
        stance = editor.plan.stances[1]
        (anchor,), (leaper,) = stance.anchors, stance.leapers
        x, y, yaw = stance.standing[anchor]
        editor.drag(leaper, 1, (x, y + 0.2, yaw))
        sentence = f"{anchor} and {leaper} stand 0.20 m apart: they need 0.42 m"
        assert until(lambda: any(sentence in note for note in viewer.scene.notes), 10)


@pytest.mark.long
def test_a_robot_is_dragged_in_a_browser(editor, page_of):
    with Viewer(editor.scene, port=0) as viewer:
        editor.attach(viewer)
        page = page_of(viewer.url, "/planned/A")
        client = client_of(viewer)
        viewer.go(1)
        assert viewer.wait_idle()
        leaper = editor.plan.stances[1].leapers[0]
        x, y, yaw = before = editor.plan.stances[1].standing[leaper]
        assert until(lambda: editor.shown == 1)
        # the square by which it is dragged over the floor
        c, s = math.cos(yaw), math.sin(yaw)
        for far in (0.15, 0.12, 0.18, 0.22):
            u, v = pixel_of(client, (x + far * (c - s), y + far * (c + s), 0.02))
            page.mouse.move(u, v)
            time.sleep(0.3)
            page.mouse.down()
            for step in range(1, 8):
                page.mouse.move(u + 5 * step, v)
            page.mouse.up()
            if until(lambda: editor.updates > 0, 3):
                break
        assert until(lambda: math.dist(editor.plan.stances[1].standing[leaper], before) > 0.05)
