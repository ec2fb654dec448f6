"""The viewer without a browser: scenes, pictures of them, picking, bad input, the server."""

import io
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from teams import graph_of_team, team_of
from whole_graph import replay

from coloc_graph.backend import smooth
from coloc_graph.cli import main
from coloc_graph.errors import InputError
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.measurements import Odometry, RelativePose, Sighting
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.run import Stance, open_run, read_truth
from coloc_graph.simulation import simulate
from coloc_graph.viewer import (
    LivePoses,
    LiveStance,
    Scene,
    Viewer,
    empty_scene,
    inspect,
    palette,
    scene_of_estimate,
    scene_of_result,
    scene_of_run,
    scene_of_solution,
    with_other,
)
from coloc_graph.viewer.cameras import seen_size
from coloc_graph.viewer.frame import MAX_POSES_MOVING, ViewState, dashed, frame_of, pick, thinned_rows
from coloc_graph.viewer.live import LiveScene
from coloc_graph.viewer.motion import extent, pose_at
from coloc_graph.viewer.panel import HOLD_SECONDS, set_value
from coloc_graph.viewer.plots import error_curves, residual_curves, with_cursor
from coloc_graph.viewer.prepared import ellipse_axes
from coloc_graph.viewer.scene import layer_of

COLOC = Path(sys.executable).with_name("coloc")


def shown(scene, row=None, **options):
    row = len(scene) - 1 if row is None else row
    names = frozenset(layer.name for layer in scene.layers)
    return frame_of(scene, ViewState(time=scene.middle(row), shown=names, **options))


@pytest.fixture(scope="module")
def scene(result):
    return scene_of_result(result)


@pytest.fixture(scope="module")
def solved(short_solution):
    return scene_of_solution(short_solution)


# scenes


def test_a_result_on_disk_is_what_was_solved(scene, solutions):
    estimate = solutions["joint"].estimate
    assert [layer.name for layer in scene.layers] == ["joint", "true"]
    base = scene.layers[0]
    for number, robot in enumerate(scene.robots):
        for row, stance in enumerate(scene.stances):
            assert np.allclose(base.xyz[number, row], estimate.pose(robot, stance.index).translation(), atol=1e-9)
    assert len(scene.edges) == len(solutions["joint"].measurements) and scene.edges.used.all()
    assert {(scene.robots[n], row) for n, row in scene.stayed} == {
        (stay.robot, stay.after) for stay in estimate.graph.stay_puts
    }
    assert (np.nanmax(scene.errors(base)) < 0.02 and scene.calibrated is None) or scene.calibrated.names == scene.robots


def test_all_methods_of_a_solution_are_layers_and_residuals_are_in_sigmas(solved):
    assert [layer.name for layer in solved.layers] == ["joint", "smoothed", "chained", "true"]
    assert solved.edges.of_what == "of the measurement in the estimate"
    assert ((solved.edges.sigmas > 0.1) & (solved.edges.sigmas < 3)).all()


def test_residuals_are_what_the_noise_is():
    """RMS over 8 rows of unit variance each: a median near 1, whatever the team."""
    team = team_of(4, 30, seed=2)
    drawn = scene_of_estimate(smooth(graph_of_team(team)))
    assert drawn.run is None and 0.5 < np.median(drawn.edges.sigmas) < 1.2


def test_a_wrong_measurement_is_a_refused_edge_with_its_reason():
    team = team_of(4, 6, seed=2, wrong=0.15)
    estimate = smooth(graph_of_team(team))
    drawn = scene_of_estimate(estimate)
    wrong = {one for one in drawn.edges.reason if one}
    assert len(estimate.rejected) == (~drawn.edges.used).sum() > 0 and all("outlier" in why for why in wrong)
    frame = shown(drawn)
    assert len(frame.rejected.points) > (~drawn.edges.used).sum()  # dashes


def test_nan_in_a_pose_names_robot_and_stance():
    stances = [Stance(n, 10.0 * n, 10.0 * n + 5, ("A", "B")) for n in range(3)]
    T = np.tile(np.eye(4), (3, 1, 1))
    T[1, 0, 3] = np.nan
    with pytest.raises(InputError, match="robot B at stance 1 is not finite"):
        layer_of("joint", ("A", "B"), stances, {"B": Trajectory("B", np.arange(3.0), T, np.arange(3))})


def test_a_pose_of_a_stance_that_is_not_there_is_refused():
    stances = [Stance(0, 0.0, 5.0, ("A",))]
    with pytest.raises(InputError, match="pose at stance 4, which the run does not hold"):
        layer_of("joint", ("A",), stances, {"A": Trajectory("A", np.zeros(1), np.eye(4)[None], np.array([4]))})


@pytest.mark.parametrize("stances", [0, 1])
def test_empty_and_tiny_scenes_have_a_picture(short, stances):
    empty = empty_scene(open_run(short), "joint")
    drawn = replace(empty, stances=open_run(short).stances[:stances])
    if stances:
        first = Trajectory("A", np.zeros(1), np.eye(4)[None], np.zeros(1, int), np.zeros((1, 6, 6)))
        drawn = replace(drawn, layers=(layer_of("joint", drawn.robots, drawn.stances, {"A": first}),))
    frame = shown(drawn)
    assert frame.row == stances - 1 and np.isfinite(frame.poses).all(axis=1).sum() == stances
    low, high = drawn.bounds
    assert np.isfinite([low, high]).all()


def test_scenes_without_any_layer_have_a_picture():
    assert frame_of(Scene(("A",), ()), ViewState()).row == -1


# pictures


def test_observers_stand_during_a_stance_and_walk_between():
    stances = (Stance(0, 0.0, 4.0, ("A",)), Stance(1, 10.0, 14.0, ("A",)))
    T = floor_pose([0.0, 1.0], [0.0, 0.0], [3.0, -3.0])
    one = layer_of("joint", ("A",), stances, {"A": Trajectory("A", np.array([0.0, 10.0]), T, np.arange(2))})
    drawn = Scene(("A",), stances, (one,))
    way = pose_at(drawn, one, 0, np.array([-5.0, 0.0, 3.9, 7.0, 10.0, 99.0]))
    assert np.allclose(way[:, 0], [0, 0, 0, 0.5, 1, 1])
    assert np.isclose(np.cos(way[3, 3]), -1)  # from 3 to -3 rad it turns the short way, by pi


def test_wheels_lead_from_pose_to_pose(scene):
    base, number = scene.layers[0], scene.robots.index("C")
    times = base.times[number]
    assert np.allclose(pose_at(scene, base, number, times)[:, :2], base.xyz[number, :, :2], atol=1e-9)
    dense = pose_at(scene, base, number, np.linspace(times[0], times[-1], 4000))
    steps = np.linalg.norm(np.diff(dense[:, :2], axis=0), axis=1)
    assert steps.max() < 0.1 * np.ptp(dense[:, 0]) and steps.sum() > 1.5 * np.linalg.norm(dense[-1] - dense[0])


def test_a_frame_shows_no_more_than_what_was(scene):
    frames = [shown(scene, row) for row in range(len(scene))]
    assert [frame.row for frame in frames] == list(range(len(scene)))
    assert [len(frame.edge_ids) for frame in frames] == [
        int((scene.edges.rows <= row).sum()) for row in range(len(scene))
    ]
    assert len(frames[0].rings.wxyz) == 0 < len(frames[-1].rings.wxyz)
    assert all(not frame.note for frame in frames)
    assert frames[3].roles == tuple(scene.roles(3, robot) for robot in scene.robots)
    assert set(frames[3].roles) == {"anchor", "observer", "mover"}


def test_ellipses_have_the_axes_of_their_covariances(rng):
    root = rng.normal(size=(5, 2, 2))
    covariance = root @ root.mT
    axes, direction = ellipse_axes(covariance)
    values, vectors = np.linalg.eigh(covariance)
    assert np.allclose(axes, np.sqrt(values[:, ::-1]))
    along = np.stack([np.cos(direction), np.sin(direction)], axis=1)
    assert np.allclose(np.abs((along * vectors[:, :, 1]).sum(axis=1)), 1)


@pytest.mark.parametrize(("row", "most"), [(0, 10), (9, 10), (10, 10), (5000, 100), (5000, 1)])
def test_thinning_keeps_the_last_ones_and_spreads_the_rest(row, most):
    rows = thinned_rows(row, most)
    assert rows[-1] == row and (np.diff(rows) > 0).all() and len(rows) <= most + 1
    if row + 1 > most > 1:
        assert rows[0] == 0 and (rows[-(most // 2) :] == np.arange(row - most // 2 + 1, row + 1)).all()


def test_dashes_lie_on_their_segment_and_are_not_too_many():
    whole = np.array([[[0.0, 0, 0], [1, 0, 0]]])
    cut, which = dashed(whole)
    assert not which.any()
    assert len(cut) == 9 and cut.min() == 0 and cut[:, :, 0].max() < 1
    assert 0.4 < (cut[:, 1] - cut[:, 0]).sum() < 0.6
    assert len(dashed(1e6 * whole)[0]) == 1


def huge(stances):
    """A scene of three robots that leap on and on, made of arrays."""
    robots = ("A", "B", "C")
    made = tuple(
        Stance(n, 10.0 * n, 10.0 * n + 5, ("A", "B"), ("C",), ("AB"[n % 2],) if n else ()) for n in range(stances)
    )
    n = np.arange(stances)
    C = np.tile(1e-4 * np.eye(6), (stances, 1, 1))
    paths = {
        robot: Trajectory(robot, 10.0 * n, floor_pose(0.3 * (n // 2), np.full(stances, 0.5 * k), 0.0 * n), n, C)
        for k, robot in enumerate(robots)
    }
    return Scene(robots, made, (layer_of("joint", robots, made, paths),))


def test_a_huge_scene_is_thinned_while_it_moves_and_says_so():
    drawn = huge(20_000)
    moving, resting = shown(drawn, rests=False), shown(drawn)
    assert len(moving.ellipses.wxyz) < MAX_POSES_MOVING < len(resting.trajectories["joint"].points)
    assert "of 20,000 stances are drawn" in moving.note and "more when time rests" in moving.note
    seconds = min(timed(lambda: shown(drawn, rests=False)) for _ in range(5))
    assert seconds < 0.05  # 3 ms on a machine that does nothing else


def timed(what):
    """The time of a processor that it takes this thread [s]."""
    started = time.thread_time()
    what()
    return time.thread_time() - started


# picking


def test_a_ray_finds_the_edge_or_the_robot_it_passes(scene):
    frame = shown(scene)
    eye = np.array([-1.0, -4.0, 3.0])
    for number in range(len(frame.edge_ids)):
        middle = frame.edge_points[number].mean(axis=0)
        if min(np.linalg.norm(middle[:2] - pose[:2]) for pose in frame.poses) > 0.45:
            assert pick(frame, eye, middle - eye) == ("edge", int(frame.edge_ids[number]))
    for number, pose in enumerate(frame.poses):
        assert pick(frame, eye, np.add(pose[:3], (0, 0, 0.2)) - eye) == ("robot", number)
    assert pick(frame, eye, (0, 0, 1)) is None and pick(frame, eye, (0, -1, 0)) is None


def test_robots_seen_from_afar_are_drawn_larger_are_met_as_drawn_and_it_is_said():
    assert [seen_size(d) for d in (0.0, 25.0, 49.0, 51.0, 210.0, 1e9, np.nan)] == [1, 1, 1, 2, 8, 64, 1]
    drawn = huge(4_000)
    with Viewer(drawn, port=0) as viewer:
        assert viewer.wait_idle()
        size, name = viewer.view.size, viewer.view._names[0]
        assert size >= 16 and viewer.view._bodies[0].scale == size and name.position[2] > 0.3 * size
        assert f"robots are drawn {size:.0f} times as large" in viewer.panel.status.content
        assert [one.visible for one in viewer.view._names] == [True, False, False] and name.text == "A, B, C"
        frame = viewer.frame
        beside = frame.poses[0, :3] + (0.0, -1.0, 0.2 * size)  # where the large body is, and the real one is not
        eye = np.add(beside, (-50.0, 0.0, 60.0))
        assert pick(frame, eye, beside - eye, size=size) == ("robot", 0) != pick(frame, eye, beside - eye)
        viewer.view.enlarge(1.0)
        assert np.isclose(name.position[2], 0.35) and viewer.view._anchors[0].scale == 1


def test_of_a_large_team_no_names_are_written_and_it_is_said():
    robots = tuple(f"R{n}" for n in range(17))
    made = (Stance(0, 0.0, 5.0, robots[:2], robots[2:]),)
    paths = {
        robot: Trajectory(
            robot, np.zeros(1), floor_pose(0.6 * np.arange(1) + n, np.zeros(1), np.zeros(1)), np.arange(1)
        )
        for n, robot in enumerate(robots)
    }
    drawn = Scene(robots, made, (layer_of("joint", robots, made, paths),))
    with Viewer(drawn, port=0) as viewer:
        assert viewer.wait_idle() and not any(name.visible for name in viewer.view._names)
        assert "are not shown: click one" in viewer.panel.status.content


# inspection


def test_an_edge_is_measured_again_and_decomposed_both_ways(scene, solutions):
    measured = solutions["joint"].measurements[2]
    found = inspect.examine(scene, 2)
    # measured with the noise that this stance alone teaches, not that learnt from the run
    assert np.allclose(found.measured.homography.H_j_i, measured.homography.H_j_i, atol=1e-3)
    taken = [n for n, one in enumerate(found.solutions) if one.chosen]
    assert taken == [measured.relative_pose.solution]
    assert found.solutions[taken[0]].normal_error_deg < found.solutions[1 - taken[0]].normal_error_deg
    error = np.deg2rad(found.solutions[taken[0]].normal_error_deg)
    assert np.isclose(error, measured.relative_pose.normal_error, atol=1e-4)
    assert found.picture.ndim == 3 and found.picture.std() > 5
    text = inspect.edge_report(scene, 2, found)
    for word in ("inliers", "overlap", "clock", "decomposition", "**chosen**", f"{measured.homography.points}"):
        assert word in text


def test_points_warped_by_the_homography_are_where_the_other_camera_sees_them(scene):
    found = inspect.examine(scene, 1).measured
    cameras = [scene.team[robot].camera for robot in (found.homography.robot_i, found.homography.robot_j)]
    warped = inspect.warp(found.homography.H_j_i, cameras[0].rays(found.correspondences.uv_i), cameras[1])
    assert np.median(np.linalg.norm(warped - found.correspondences.uv_j, axis=1)) < 1.0  # 0.3 px of noise in both


def test_marker_ways_of_both_observers_lie_on_each_other_and_where_the_driver_was(scene):
    row = 3
    found = [inspect.examine(scene, n).measured for n in np.flatnonzero(scene.edges.rows == row)]
    seen, estimated = inspect.marker_trajectories(scene, row, found, dark=False)
    driver = scene.robots.index(scene.stances[row].movers[0])
    way = pose_at(scene, scene.layers[0], driver, np.linspace(scene.starts[row], scene.ends[row], 500))
    for lines in (seen, estimated):
        points = lines.points.reshape(-1, 3)
        off = np.linalg.norm(points[:, None, :2] - way[None, :, :2], axis=2).min(axis=1)
        assert len(points) > 10 and np.median(off) < 0.3  # a marker is 0.125 m off the middle of its robot


def test_a_camera_shows_its_detections_where_there_are_no_images(scene):
    during = inspect.camera_image(scene.run, "A", scene.middle(0))
    assert during.shape == (240, 320, 3) and during.max() > 200
    assert inspect.camera_image(scene.run, "A", scene.starts[0] - 100) is None


def test_a_robot_is_told_in_numbers(scene):
    text = inspect.robot_report(scene, 1, 4)
    for word in ("Robot B, stance 4", "heading", "sigma x, y", "error (truth known)", "mount", "tilt"):
        assert word in text


def test_without_a_run_an_edge_says_what_is_missing():
    drawn = scene_of_estimate(smooth(graph_of_team(team_of(3, 4))))
    with pytest.raises(InputError, match="no run to measure this pair in"):
        inspect.examine(drawn, 0)


# live


def test_stances_that_are_published_make_the_scene(short_solution):
    start = empty_scene(short_solution.run, "joint")
    live, graph = LiveScene(start), short_solution.estimate.graph
    replay(graph, "joint", lambda *one: live.add(LiveStance(*one)))
    grown = live.scene()
    last = grown.layers[0].xyz[:, -1]
    for number, robot in enumerate(grown.robots):
        want = short_solution.estimate.pose(robot, graph.stances[-1].index).translation()
        assert np.allclose(last[number], want, atol=2e-3)
    assert len(grown.edges) == 3 and "at its insertion" in grown.edges.of_what and len(grown.stayed) == 2
    estimate = short_solution.estimate
    whole = [estimate.residual(m) for m in graph.measurements if isinstance(m, RelativePose)]
    assert grown.edges.sigmas[-1] == pytest.approx(whole[-1], rel=0.05)
    np.testing.assert_allclose(grown.edges.sigmas, whole, rtol=0.6)  # of what was known when each came in


def test_stances_are_shown_while_the_run_is_solved_and_what_cannot_be_used_too(short, collinear, copied, tmp_path):
    second = open_run(short).stances[1]
    bad = copied(short, tmp_path / "bad.mcap", change=lambda r: (
        collinear(r) if hasattr(r, "uv") and second.start - 1 <= r.time <= second.end + 1 else r
    ))  # fmt: skip
    run, rows = open_run(bad), []
    with Viewer(empty_scene(run, "joint"), port=0) as viewer:

        def entered(one):
            viewer.publish(LiveStance(one.stance, one.estimate, one.measurements, one.pairs))
            assert viewer.wait_idle()
            rows.append((len(viewer.scene), len(viewer.scene.edges), int(viewer.scene.edges.used.sum())))

        solve(run, SolveOptions(incremental=True), on_update=entered)
        assert rows == [(1, 1, 1), (2, 2, 1), (3, 3, 2)]
        assert "line" in viewer.scene.edges.reason[1] and len(viewer.frame.rejected.points)


def test_publishing_costs_the_estimator_less_than_a_millisecond(short_solution):
    entered = []
    replay(short_solution.estimate.graph, "joint", lambda *one: entered.append(LiveStance(*one)))
    with Viewer(empty_scene(short_solution.run, "joint"), port=0) as viewer:
        seconds = [timed(lambda one=one: viewer.publish(one)) for _ in range(100) for one in entered]
        assert np.median(seconds) < 1e-3
        assert viewer.wait_idle() and len(viewer.scene) == len(entered)


def at(x, y, angle):
    return floor_pose(x, y, angle)


def shows(viewer, robot, pose, timeout=60.0):
    """Whether a robot's handle comes to be at x, y, heading in time."""
    handle, ends = viewer.view.robots[viewer.scene.robots.index(robot)], time.monotonic() + timeout
    while time.monotonic() < ends:
        w, z = handle.wxyz[0], handle.wxyz[3]
        if handle.visible and np.allclose([*handle.position[:2], 2 * np.arctan2(z, w)], pose, atol=1e-5):
            return True
        time.sleep(0.02)
    return False


def test_robots_are_shown_where_they_are_between_stances(short_solution):
    final = scene_of_solution(short_solution)
    with Viewer(empty_scene(short_solution.run, "joint"), port=0) as viewer:
        assert viewer.wait_idle()
        viewer.publish(LivePoses(0.0, {"A": at(1.0, 2.0, 0.5)}, "on its way"))  # before there is any stance
        assert shows(viewer, "A", (1.0, 2.0, 0.5)) and "on its way" in viewer.panel.status.content
        replay(short_solution.estimate.graph, "joint", lambda *one: viewer.publish(LiveStance(*one)))
        assert viewer.wait_idle() and len(viewer.scene) == 3 and viewer.frame.row == 2
        edges = viewer.view._sent["edges points"]
        stood = viewer.frame.poses.copy()
        viewer.publish(LivePoses(1.0, {"B": at(1.5, 2.5, -0.5)}, "stance 3: capturing, 112 points"))
        assert shows(viewer, "B", (1.5, 2.5, -0.5))
        assert "stance 3: capturing, 112 points" in viewer.panel.status.content
        assert np.array_equal(viewer.frame.poses[0], stood[0])  # who is not named stands where the graph has it
        assert viewer.view._sent["edges points"] is edges  # the graph was not touched
        viewer.go(0)  # whoever looks at what was sees it
        base = viewer.scene.layers[0]
        assert shows(viewer, "B", [*base.xyz[1, 0, :2], base.yaw[1, 0]])
        viewer.publish(LivePoses(2.0, {"B": at(9.0, 9.0, 0.0)}))
        assert not shows(viewer, "B", (9.0, 9.0, 0.0), timeout=0.5)
        viewer.go(2)
        assert shows(viewer, "B", (9.0, 9.0, 0.0))
        viewer.publish(final)
        assert shows(viewer, "B", [*final.layers[0].xyz[1, 2, :2], final.layers[0].yaw[1, 2]])


def test_live_poses_cost_the_caller_nothing_and_only_the_newest_is_shown(short_solution):
    with Viewer(empty_scene(short_solution.run, "joint"), port=0) as viewer:
        assert viewer.wait_idle()
        seconds = [
            timed(lambda x=x: viewer.publish(LivePoses(x, {"A": at(x, 0.0, 0.0)}))) for x in np.linspace(0, 5, 1000)
        ]
        assert np.median(seconds) < 1e-3
        assert shows(viewer, "A", (5.0, 0.0, 0.0))


def test_live_poses_that_cannot_be_shown_are_named_and_the_others_shown(short_solution):
    robots = short_solution.run.team.names
    poses = LivePoses(0.0, {"A": at(1.0, 0.0, 0.0), "B": np.full((4, 4), np.nan), "Z": np.eye(4), "C": np.eye(3)})
    words = poses.problems(robots)
    assert "no robot Z" in words and "robot B is not a finite" in words and "robot C is not a finite" in words
    shown = poses.over(robots, np.zeros((3, 4)))
    assert np.allclose(shown[0, :2], (1, 0)) and not shown[1:].any()
    with Viewer(empty_scene(short_solution.run, "joint"), port=0) as viewer:
        viewer.publish(poses)
        assert shows(viewer, "A", (1.0, 0.0, 0.0)) and viewer.notifications == {words}


def test_an_instant_is_of_the_scenes_clock_whenever_its_first_stance_begins(scene):
    late = replace(scene, stances=tuple(replace(s, start=s.start + 1e9, end=s.end + 1e9) for s in scene.stances))
    with Viewer(late, port=0) as viewer:
        for row in (0, 2, 1):
            viewer.go_to(late.middle(row))
            assert viewer.wait_idle() and viewer.frame.row == row


def test_an_arrow_key_that_moves_the_slider_which_has_the_focus_steps_once(scene):
    """A browser sends both what the slider is and the command that is bound to the key."""
    with Viewer(scene, port=0) as viewer:
        panel = viewer.panel
        somebody = SimpleNamespace(client="a browser", target=panel.stance)
        viewer.go(0)
        assert viewer.wait_idle() and viewer.frame.row == 0
        set_value(panel.stance, 1)
        panel._on_slider(somebody, "stance")
        panel._on_hotkey("step", 1)
        assert viewer.wait_idle() and viewer.frame.row == 1
        time.sleep(HOLD_SECONDS)
        panel._on_hotkey("step", 1)
        assert viewer.wait_idle() and viewer.frame.row == 2 == panel.stance.value


def test_a_slider_that_was_just_moved_is_not_moved_back_by_a_picture_from_before(scene):
    with Viewer(scene, port=0) as viewer:
        assert viewer.wait_idle()
        last = viewer.frame.row
        set_value(viewer.panel.stance, 1)  # as a browser does, before anybody has heard of it
        viewer.pick(None)
        assert viewer.wait_idle() and viewer.frame.row == last and viewer.panel.stance.value == 1


# server and command


def test_help_imports_neither_viser_nor_anything_heavy():
    script = """
import sys, contextlib, io
from coloc_graph.cli import main
for command in ("view", "solve"):
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
        main([command, "--help"])
sys.exit(" ".join({"viser", "trimesh", "numpy", "gtsam", "matplotlib", "websockets"} & set(sys.modules)) or 0)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def started(arguments, **more):
    """A program as a user starts it: its output buffered, and Ctrl-C heard, which a shell's background job hands on."""
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    return subprocess.Popen(
        arguments,
        stderr=subprocess.PIPE,
        text=True,
        env=buffered,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        **more,
    )


def test_ctrl_c_ends_the_view_of_a_result(result, monkeypatch):
    class Interrupting(io.StringIO):
        def write(self, text):
            if "Ctrl-C ends it" in text:
                threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
            return super().write(text)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with monkeypatch.context() as patch:
            patch.setattr(sys, "stderr", said := Interrupting())
            assert main(["view", str(result), "--no-browser", "--port", "0"]) == 0
    finally:
        signal.signal(signal.SIGINT, before)
    assert re.fullmatch(r"the viewer is at http://127\.0\.0\.1:\d+/[\w-]{22} \(Ctrl-C ends it\)\n", said.getvalue())


def test_ctrl_c_ends_the_view_of_a_run_that_was_solved_without_a_word(short, tmp_path):
    arguments = [COLOC, "solve", short, "--out", tmp_path / "out", "--incremental", "--view", "--no-browser"]
    process = started([*arguments, "--port", "0"], stdout=subprocess.PIPE)
    try:
        said = next(line for line in process.stderr if "viewer" in line)
        assert re.match(r"the viewer is at http://127\.0\.0\.1:\d+/[\w-]{22} \(Ctrl-C ends it\)", said)
        solved = any("3 of 3 measurements used" in line for line in process.stdout)
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=30)
    finally:
        process.kill()
    assert solved and process.returncode == 0 and not [one for one in err.splitlines() if "stances measured" not in one]


def test_ctrl_c_while_it_is_solved_says_that_there_is_no_result(hallway, tmp_path):
    arguments = [COLOC, "solve", hallway, "--out", tmp_path / "out", "--incremental", "--view", "--no-browser"]
    process = started([*arguments, "--port", "0"])
    try:
        assert any("stances measured" in line for line in process.stderr)  # some are, and not all
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=30)
    finally:
        process.kill()
    assert process.returncode == 130 and err.splitlines()[-1] == "coloc: interrupted" and "Traceback" not in err
    assert not (tmp_path / "out" / "summary.json").exists()


@pytest.mark.parametrize("make", ["another run", "no result", "damaged"])
def test_bad_input_is_one_sentence(make, result, tmp_path, capsys):
    copy = tmp_path / "copy"
    if make == "no result":
        copy.mkdir()
        words = "is not a result"
    else:
        shutil.copytree(result, copy)
        words = "damaged"
        run = result.parent / "hallway.mcap"
        shutil.copy(run, tmp_path / "hallway.mcap")
        if make == "another run":
            simulate("hallway", tmp_path / "hallway.mcap", stances=2, seed=9, points=20)
            words = "is not the run of the result"
        else:
            (copy / "measurements.csv").write_text("stance,nothing\n1,2\n")
    assert main(["view", str(copy), "--no-browser", "--port", "0"]) == 2
    err = capsys.readouterr().err
    assert words in err and err.startswith("coloc: ") and err.count("\n") == 1


def test_another_result_is_compared_and_one_of_another_run_refused(scene, result, short_result):
    both = with_other(scene, result)
    assert [layer.aside for layer in both.layers] == [False, False, True]
    assert frame_of(scene, ViewState()) and both.beside.edges is both.other_edges
    beside, over = shown(both, aside=2.0), shown(both)
    name = both.layers[-1].name
    assert np.isclose(
        beside.trajectories[name].points[..., 1].mean() - shown(both).trajectories["joint"].points[..., 1].mean(),
        2,
        atol=0.5,
    )
    assert len(over.trajectories[name].points) > len(
        beside.trajectories[name].points
    )  # dashed where it lies over the first
    # edges and ellipses of both
    alone = shown(scene)
    assert len(beside.edge_ids) == 2 * len(alone.edge_ids) and len(over.ellipses.wxyz) == 2 * len(alone.ellipses.wxyz)
    own, others = np.split(beside.edge_points, 2)
    assert np.allclose(others - own, (0, 2, 0), atol=1e-6)
    # a click on one of the other's is one of the other's
    number = int(beside.edge_ids[-1])
    eye = np.array([-1.0, -4.0, 3.0])
    assert pick(beside, eye, others[-1].mean(axis=0) - eye) == ("edge", number)
    assert both.edge(number) == (both.beside, len(scene.edges) - 1) and both.edge(2) == (both, 2)
    assert both.edge(2 * len(scene.edges)) is None
    picked = shown(both, picked=number, aside=2.0).picked
    assert np.allclose(picked.points[0], others[-1])
    # and so are the curves
    assert residual_curves(both)[1].shape == (2, len(scene)) and error_curves(both)[1].shape == (6, len(scene))
    assert np.array_equal(*np.split(error_curves(both)[1], 2))
    text = inspect.robot_report(both, 1, 4)
    assert "| joint |" in text and "result: joint" in text
    with pytest.raises(InputError, match="is not the run of the result"):
        with_other(scene, short_result)


def test_sightings_and_odometry_are_read_back_as_what_they_were(scene, solutions):
    solved = scene_of_solution(solutions["joint"])
    measurements = solutions["joint"].estimate.graph.measurements
    for name, kind in (("sightings", Sighting), ("odometry", Odometry)):
        links, read = getattr(solved, name), getattr(scene, name)
        assert len(links) == sum(isinstance(one, kind) for one in measurements) > 0
        places = [
            {
                tuple(np.round([*base.xyz[i, a], *base.xyz[j, b]], 6))
                for i, a, j, b in zip(one.i, one.rows_i, one.j, one.rows_j, strict=True)
            }
            for one, base in ((links, solved.layers[0]), (read, scene.layers[0]))
        ]
        assert places[0] == places[1]
    off, on = shown(scene), shown(scene, sightings=True, odometry=True)
    assert not len(off.sightings.points) and not len(off.odometry.points)
    assert len(on.sightings.points) == len(scene.sightings) and len(on.odometry.points) == len(scene.odometry)
    first = shown(scene, row=0, sightings=True, odometry=True)
    assert len(first.sightings.points) == (scene.sightings.rows_j == 0).sum() and not len(first.odometry.points)


def test_truth_that_does_not_cover_the_estimate_is_said_to_be_left_out(short, copied, tmp_path, monkeypatch, capsys):
    partly = copied(short, tmp_path / "partly.mcap", truth=True)
    run = open_run(partly)
    late = {robot: one for robot, one in read_truth(partly).items() if robot != "B"}
    monkeypatch.setattr("coloc_graph.viewer.truth.read_truth", lambda *_: late)
    drawn = scene_of_run(run)
    assert drawn.true is not None and np.isnan(drawn.true.xyz[drawn.robots.index("B")]).all()
    assert len(drawn.notes) == 1 and drawn.notes[0].startswith("robot B is not evaluated: it has no truth")
    with Viewer(drawn, port=0) as viewer:
        assert viewer.wait_idle() and drawn.notes[0] in viewer.panel.status.content


def test_images_that_are_missing_are_said(short, copied, tmp_path):
    from coloc_graph.viewer.notes import missing_images

    blind = copied(short, tmp_path / "blind.mcap", change=lambda r: None if hasattr(r, "uv") and r.robot == "A" else r)
    assert missing_images(empty_scene(open_run(short), "joint")) == ""
    drawn = replace(empty_scene(open_run(blind), "joint"), stances=open_run(blind).stances)
    assert "neither images nor detections of A" in missing_images(drawn)


def test_without_a_browser_a_png_is_refused_with_the_way_out(result, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", os.fspath(tmp_path))
    assert main(["view", str(result), "--png", str(tmp_path / "view.png")]) == 2
    assert "rendered by Chromium" in (err := capsys.readouterr().err) and "--export" in err and err.count("\n") == 1


# colours and plots


def test_residuals_are_told_apart_and_unknown_ones_are_grey():
    colours = palette.residual_colours(np.array([0.0, 2.0, 3.0, 50.0, np.nan]), dark=False)
    assert (colours[2] == colours[3]).all() and (colours[4] == palette.grey(False)).all()
    assert np.abs(np.diff(colours[:3].astype(int), axis=0)).sum(axis=1).min() > 100


def test_the_cursor_is_a_line_at_the_slider():
    x, curve, spike = with_cursor(np.arange(5.0), np.array([1.0, 2, 3, 4, 5]), 2.0)
    assert (np.diff(x) >= 0).all() and np.isfinite(curve).all() and spike.max() == 5 and x[spike.argmax()] == 2
    assert np.isclose(curve[spike.argmax()], 3)


def test_the_camera_frames_what_the_last_observers_watch():
    stance = Stance(0, 0.0, 5.0, ("A", "B"), (), ())
    paths = {name: Trajectory(name, np.zeros(1), floor_pose(0.0, y, 0.0)[None], np.zeros(1, int), np.eye(6)[None])
             for name, y in (("A", 0.0), ("B", 0.6))}  # fmt: skip
    layer = layer_of("joint", ("A", "B"), (stance,), paths)
    low, high = extent(Scene(("A", "B"), (stance,), (layer,)))
    assert high[0] > 1.0 and (low <= 0.0).all() and high[1] >= 0.6
