"""Plans as data: gaits, the CSV file, and the simulated team that follows one."""

import cv2
import numpy as np
import pytest

from coloc_graph.cli import main
from coloc_graph.errors import InputError
from coloc_graph.planning.drive import drive_through, there_and_back
from coloc_graph.planning.floor_map import read_floor_map
from coloc_graph.planning.formation import PAPER, Gait
from coloc_graph.planning.plan import Plan, PlannedStance, read_plan, write_plan
from coloc_graph.run import open_run
from coloc_graph.simulation import build_world, reference_team
from coloc_graph.simulation.planned import planned
from coloc_graph.team import write_team
from coloc_graph.team.shared_view import hidden

GAIT = Gait(0.8, 0.6, 10.0)


def straight_plan(stances: int = 3, gait: Gait = GAIT, duration: float = 8.0) -> Plan:
    names = ("A", "B")
    made = []
    for k in range(stances):
        anchor, leaper = names[k % 2], names[(k + 1) % 2]
        x = gait.leap * k
        drive = ((x + 1.2, 0.0), (x + 2.2, 0.5), (x + 2.2, -0.5))
        standing = {anchor: gait.stop(k), leaper: gait.stop(k + 1)}
        made.append(PlannedStance(standing, (anchor,) if k else (), "C", drive, duration))
    return Plan(tuple(made))


def test_a_gait_from_the_paper_s_numbers_has_that_distance_and_angle():
    gait = Gait.of_paper(l=1.2, theta_deg=20.0, leap=0.4)
    (x0, y0, yaw0), (x1, y1, yaw1) = gait.stop(0), gait.stop(1)
    assert np.hypot(x1 - x0, y1 - y0) == pytest.approx(1.2)
    assert abs(np.degrees(yaw1 - yaw0)) == pytest.approx(20.0)
    assert PAPER.apart == pytest.approx(0.743, abs=1e-3)


@pytest.mark.parametrize(
    ("numbers", "word"), [((3.0, 0.6, 0.0), "leap"), ((0.8, 0.1, 0.0), "abreast"), ((0.8, 0.6, 80.0), "toe-in")]
)
def test_an_impossible_gait_is_refused(numbers, word):
    with pytest.raises(InputError, match=word):
        Gait(*numbers)


def test_a_plan_comes_back_from_its_file_as_it_was_written(tmp_path):
    plan, path = straight_plan(), tmp_path / "plan.csv"
    write_plan(plan, path)
    path.write_text("\ufeff" + path.read_text())  # as a spreadsheet saves it
    again = read_plan(path)
    for one, other in zip(plan.stances, again.stances, strict=True):
        assert (one.anchors, one.mover, one.duration) == (other.anchors, other.mover, other.duration)
        np.testing.assert_allclose(one.waypoints, other.waypoints, atol=1e-6)
        for name, pose in one.standing.items():
            np.testing.assert_allclose(pose, other.standing[name], atol=1e-6)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda text: text.replace("stance,", "step,", 1), "first line must name the columns"),
        (lambda text: text.replace("anchor", "king", 1), r"line 7: give a value for each column, and a role"),
        (lambda text: text.replace("1.200000", "far", 1), r"line 4: `far` is not a number"),
        (lambda text: "\n".join(line for line in text.split("\n") if not line.startswith("1,")), "without gaps"),
        (lambda text: text.replace("1,B,anchor,0,0.8", "1,B,anchor,0,0.9"), "anchor B does not stand where it stood"),
    ],
)
def test_a_file_that_is_no_plan_is_refused_with_its_line(tmp_path, change, sentence):
    path = tmp_path / "plan.csv"
    write_plan(straight_plan(), path)
    path.write_text(change(path.read_text()))
    with pytest.raises(InputError, match=sentence):
        read_plan(path)


def test_the_simulated_team_stands_and_drives_as_planned_but_for_its_slip():
    plan = straight_plan()
    world = build_world(planned(plan, np.random.default_rng(3)), seed=3, fps=10.0)
    assert [stance.observers for stance in world.stances] == [("A", "B"), ("B", "A"), ("A", "B")]
    assert [stance.anchors for stance in world.stances] == [(), ("B",), ("A",)]
    for stance, aim in zip(world.stances, plan.stances, strict=True):
        for name, pose in aim.standing.items():
            off = world.paths[name].planar_at([stance.start])[0] - pose
            assert 0 < np.hypot(*off[:2]) < 0.2
        drive = drive_through(there_and_back(aim.waypoints, aim.duration))
        middle = (stance.start + stance.end) / 2
        began = stance.start + ((stance.end - stance.start) - aim.duration) / 2
        np.testing.assert_allclose(
            world.paths["C"].planar_at([middle])[0, :2], drive.at([middle - began])[0, :2], atol=1e-6
        )
    assert all(captures[0].recorded.sum() > 100 for captures in world.captures)


def test_a_body_hides_what_is_low_and_behind_it():
    eye, bodies = np.array([0.0, 0.0, 0.4]), np.array([[1.0, 0.0]])
    behind, beside, before = [1.5, 0.0, 0.15], [1.5, 0.8, 0.15], [0.7, 0.0, 0.15]
    assert hidden(eye, [behind, beside, before], bodies).tolist() == [True, False, False]


def test_a_robot_that_stands_in_the_way_costs_points():
    free = straight_plan(1, duration=20.0)
    (stance,) = free.stances
    blocked = Plan((PlannedStance({**stance.standing, "B": (1.1, 0.2, 0.0)}, (), "C", stance.waypoints, 20.0),))
    counts = [build_world(planned(plan), fps=10.0).captures[0][0].recorded.sum() for plan in (free, blocked)]
    assert counts[1] < 0.8 * counts[0]


def ros_map(path, pillar):
    """Write a map_server map, free from -1, -2 to 4, 2 but for a pillar x0, y0, x1, y1 [m]."""
    cells = np.full((80, 100), 254, np.uint8)
    x0, y0, x1, y1 = (round(20 * (number + 1 + k % 2)) for k, number in enumerate(pillar))
    cells[80 - y1 : 80 - y0, x0:x1] = 0
    cv2.imwrite(str(path.with_suffix(".pgm")), cells)
    fields = "resolution: 0.05\norigin: [-1.0, -2.0, 0.0]\nnegate: 0\nfree_thresh: 0.2\n"
    path.write_text(f"image: {path.with_suffix('.pgm').name}\n{fields}")
    return str(path)


def test_a_pillar_of_a_map_hides_the_mover_from_one_behind_it(tmp_path):
    plan = straight_plan(1, duration=20.0)
    floor_map = read_floor_map(ros_map(tmp_path / "map.yaml", (0.7, 0.3, 0.8, 0.4)))
    free, walled = (build_world(planned(plan, walls=one), fps=10.0).captures[0] for one in (None, floor_map))
    by_robot = {one.robot: (one.recorded.sum(), other.recorded.sum()) for one, other in zip(free, walled, strict=True)}
    assert by_robot["A"][1] < 0.9 * by_robot["A"][0]


def test_simulate_honours_a_map_or_says_why_not(tmp_path, capsys):
    write_plan(straight_plan(1, duration=3.0), tmp_path / "plan.csv")
    beside = ros_map(tmp_path / "beside.yaml", (0.7, 0.3, 0.8, 0.4))
    before = ros_map(tmp_path / "before.yaml", (1.2, 0.0, 1.4, 0.3))
    follow = ["--plan", str(tmp_path / "plan.csv")]
    start = ["simulate", "hallway", "--out", str(tmp_path / "run.mcap"), "--force"]
    assert main([*start, *follow, "--map", beside]) == 0
    capsys.readouterr()
    for arguments, sentence in (
        ([*follow, "--map", before], "stance 0 of the plan: the drive of C comes too near to a robot or a wall; plan"),
        (["--map", beside], "robots keep off the walls of a map by a plan: give one"),
        ([*follow, "--map", beside, "--depth", "images"], "walls of a map hide markers of robots at depth tracks"),
        ([*follow, "--map", str(tmp_path / "plan.csv")], "plan.csv is not a map"),
    ):
        assert main([*start, *arguments]) == 2
        error = capsys.readouterr().err
        assert sentence in error
        assert error.count("\n") == 1


def test_simulate_takes_a_gait_and_a_plan(tmp_path, capsys):
    run, plan = tmp_path / "run.mcap", str(tmp_path / "plan.csv")
    write_plan(straight_plan(2, duration=3.0), plan)
    assert main(["simulate", "hallway", "-l", "1.2", "--stances", "2", "--points", "40", "--out", str(run)]) == 0
    assert main(["simulate", "hallway", "--plan", plan, "--out", str(tmp_path / "p.mcap")]) == 0
    for name, *more in (
        ("six-step",),
        ("landmarks", "--length", "10", "--laps", "1"),
        ("team", "--robots", "4", "--stances", "2"),
    ):
        arguments = [
            "simulate",
            name,
            *more,
            "--points",
            "40",
            "--leap",
            "0.5",
            "-l",
            "0.9",
            "--out",
            str(tmp_path / f"{name}.mcap"),
        ]
        assert main(arguments) == 0
    for name in ("six-step", "single-step", "landmarks", "team"):
        out = str(tmp_path / f"{name} planned.mcap")
        assert main(["simulate", name, "--plan", plan, "--out", out]) == 0
    assert open_run(out).team.names == ("A", "B", "C")
    assert [landmark.name for landmark in open_run(tmp_path / "landmarks planned.mcap").team.landmarks]
    capsys.readouterr()
    assert main(["simulate", "single-step", "--leap", "1", "--out", str(tmp_path / "q.mcap")]) == 2
    assert "single-step has no leap" in capsys.readouterr().err
    both = ["--plan", str(tmp_path / "plan.csv"), "--stances", "3"]
    assert main(["simulate", "hallway", *both, "--out", str(tmp_path / "q.mcap")]) == 2
    assert "a plan has its own robots, stances, points and gait" in capsys.readouterr().err


def test_a_plan_of_four_robots_is_simulated_with_the_robots_of_its_team(tmp_path):
    team = reference_team(names=("A", "B", "C", "D"))
    places = {"A": (0.0, 0.3, -0.3), "B": (0.0, -0.3, 0.3), "C": (-0.7, 0.3, 3.1)}  # C looks away
    drive = ((1.0, 0.0), (1.8, 0.3), (1.8, -0.3))
    plan = Plan((PlannedStance(places, (), "D", drive, 8.0),))
    world = build_world(planned(plan), team=team, fps=10.0)
    by_robot = {capture.robot: capture.recorded.sum() for capture in world.captures[0]}
    assert by_robot["A"] > 50 and by_robot["B"] > 50 and by_robot["C"] == 0
    write_plan(plan, tmp_path / "plan.csv")
    write_team(team, tmp_path / "team.toml")
    arguments = ["simulate", "hallway", "--plan", str(tmp_path / "plan.csv"), "--out", str(tmp_path / "run.mcap")]
    assert main([*arguments, "--team", str(tmp_path / "team.toml")]) == 0
    assert open_run(tmp_path / "run.mcap").stances[0].observers == ("A", "B", "C")
