"""Stances of a mission planned by the receding horizon, with a registry and without a network."""

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from coloc_graph.errors import InputError
from coloc_graph.geometry.se2 import between
from coloc_graph.missions.mission import mission_team
from coloc_graph.online.coordinator import Coordinator
from coloc_graph.online.horizon_planner import HorizonPlanner
from coloc_graph.online.leap_planner import Situation
from coloc_graph.online.mission import MissionOptions, in_world
from coloc_graph.online.record import Record
from coloc_graph.online.robot_registry import RobotRegistry
from coloc_graph.online.visibility import InView
from coloc_graph.pipeline.incremental import IncrementalSolver, measure_stance
from coloc_graph.planning.course import Course
from coloc_graph.planning.formation import Gait
from coloc_graph.planning.plan import Plan, PlannedStance
from coloc_graph.run import atomic_run, open_run
from coloc_graph.simulation import Imperfections, build_world, record
from coloc_graph.simulation.planned import planned
from coloc_graph.simulation.simulated_team import field_team, free_address

GAIT = Gait(0.8, 0.6, 20.0)


class Mission:
    """A team at the start of a mission."""

    def __init__(self, folder):
        self.team = field_team()
        starts, waypoints = in_world(self.team, "C", ((4.0, 0.0),))
        self.registry = RobotRegistry(Record(folder / "run.mcap", self.team), starts, lambda _: lambda t: t, 0, {})
        self.course = Course(waypoints)
        self.planner = self.make(("A", "B"))

    def make(self, observers):
        return HorizonPlanner(
            self.team, "C", observers, self.course, pace=24.0, speed=0.4, gait=GAIT
        )  # fmt: skip

    def plan(self, index, attempt=0, moved=(), missing=()):
        return self.planner.plan(Situation(index, attempt, self.registry.poses(), moved, missing))


@pytest.fixture
def mission(tmp_path):
    return Mission(tmp_path)


def test_the_first_stance_is_where_the_robots_stand_and_the_second_after_a_leap(mission):
    first = mission.plan(0)
    assert first.leap is None and first.duration > 3
    second = mission.plan(1)
    leaper, target = second.leap
    poses = mission.registry.poses()
    ways = {name: mission.course.way_of(poses[name]) for name in ("A", "B")}
    assert leaper == min(ways, key=ways.get)
    assert mission.course.way_of(target) > max(ways.values()) + 0.1
    assert second.drives(leaper, "C") and second.drives("C", "C")
    assert set(second.promise.covariances) == {"A", "B"} and second.promise.points > 50
    assert "mm expected at the goal" in second.promise.reason
    # the mover stays clear of where the observers then stand
    standing = {**poses, leaper: target}
    for waypoint in second.patrol:
        assert min(math.dist(waypoint, standing[name][:2]) for name in ("A", "B")) > 0.4


def test_in_further_attempts_one_that_leapt_turns_to_look_for_the_mover(mission):
    leaper = mission.plan(1).leap[0]
    for attempt, missing, turned in ((1, (), 0.0), (1, (leaper,), 0.35), (2, (leaper,), -0.35)):
        leap = mission.plan(1, attempt, (leaper,), missing).leap
        assert leap[1][2] - mission.planner._decision.ahead[0][1][2] == pytest.approx(turned)


def test_another_attempt_turns_the_drive_round_and_a_third_chooses_another_target(mission):
    mission.plan(0)
    plans = [mission.plan(1, attempt) for attempt in range(3)]
    assert plans[1].leap == plans[0].leap
    middle = plans[0].patrol[:-1].mean(axis=0)
    np.testing.assert_allclose(plans[0].patrol[-1], middle)
    assert math.dist(plans[0].patrol[0], mission.registry.poses()["C"][:2]) <= math.dist(
        plans[0].patrol[-2], mission.registry.poses()["C"][:2]
    )
    np.testing.assert_allclose(plans[1].patrol[0], middle)
    np.testing.assert_array_equal(plans[1].patrol[1:-1], plans[0].patrol[:-1][::-1])
    x, y, yaw = between(plans[0].leap[1], plans[2].leap[1])
    assert math.hypot(x, y) + abs(yaw) > 0.1


def test_a_target_from_which_stances_did_not_bring_the_team_on_is_not_chosen_again(mission):
    leaper, target = mission.plan(1).leap
    mission.planner._stood += [{**mission.registry.poses(("A", "B")), leaper: target}] * 3
    _, other = mission.plan(2).leap
    x, y, yaw = between(target, other)
    assert math.hypot(x, y) + abs(yaw) > 0.1


def test_a_stance_that_came_makes_the_team_better_known_and_spends_its_time(mission, tmp_path):
    plan = mission.plan(0)
    poses = mission.registry.poses()
    came = PlannedStance({name: poses[name] for name in ("A", "B")}, (), "C", tuple(map(tuple, plan.patrol)), 10.0)
    world = build_world(planned(Plan((came,))), team=mission.team, fps=15.0, imperfections=Imperfections(noise_px=0.2))
    with atomic_run(tmp_path / "came.mcap", mission.team) as writer:
        record(world, writer, "tracks")
    run = open_run(tmp_path / "came.mcap")
    solver = IncrementalSolver(mission.team)
    (stance,) = run.stances
    pairs = solver.measure(run, stance, measure_stance(run, stance, solver.options))
    entered = solver.enter(run, stance, pairs)
    left = mission.planner.seconds_left
    mission.planner.take(entered, poses)
    assert left - mission.planner.seconds_left == pytest.approx(stance.end - stance.start)
    assert mission.planner.belief.position_sigma(("B",)) < 0.01
    # later ones spend what they take, but a long halt costs the others no time
    for ends, spent in ((15.0, 15.0), (315.0, 20.0)):
        left, end = mission.planner.seconds_left, stance.end + ends
        later = replace(entered, stance=replace(stance, start=end - 10.0, end=end))
        mission.planner.take(later, poses)
        assert left - mission.planner.seconds_left == pytest.approx(spent, abs=0.2)
    # the noise of the next stances is that which was seen
    assert mission.planner.noise_px == pytest.approx(0.2, rel=0.2)


def test_four_observers_are_refused(mission):
    with pytest.raises(InputError, match="4 observers are to leap, and online plans are made for up to 3 and a mover"):
        mission.make(("A", "B", "D", "E"))


def test_the_mover_is_the_robot_of_which_the_others_promise_most_unless_one_is_named(tmp_path):
    A, B, C = field_team().robots
    team = msgspec.structs.replace(field_team(), robots=(A, B, msgspec.structs.replace(C, markers=None)))
    for mover, chosen in ((None, "B"), ("B", "B")):
        options = MissionOptions(formation="plan", mover=mover)
        with Coordinator(team, tmp_path / f"{mover}", options, listen=free_address()) as coordinator:
            assert coordinator._mission.mover == chosen and coordinator._mission.observers == ("A", "C")
    with pytest.raises(InputError, match="C is to move and has no markers"):
        Coordinator(team, tmp_path / "paper", MissionOptions(), listen=free_address())


def test_of_three_observers_the_one_that_leapt_and_one_that_stayed_are_to_see_the_whole_drive():
    team = mission_team(4)
    poses, waypoints = in_world(team, "D", ((4.0, 0.0),))
    planner = HorizonPlanner(team, "D", ("A", "B", "C"), Course(waypoints), pace=24.0, speed=0.4, gait=GAIT)
    x, y, yaw = poses["C"]
    with pytest.raises(InputError, match="A, B, C do not all see the same part of the floor where they stand"):
        planner.plan(Situation(0, 0, {**poses, "C": (x, y, yaw + 1.5)}))
    assert planner.plan(Situation(0, 0, poses)).watching == ("A", "B", "C")
    watching = []
    for index in range(1, 5):
        plan = planner.plan(Situation(index, 0, poses))
        leaper, target = plan.leap
        poses |= {leaper: target, "D": (*plan.patrol[-1].tolist(), 0.0)}
        view = InView(team, "D", {name: poses[name] for name in plan.watching})
        assert leaper in plan.watching and len(plan.watching) > 1
        assert all(view.covers(name, poses[name], plan.patrol) for name in plan.watching)
        watching.append(len(plan.watching))
    assert 2 in watching
    # one that has moved is none that stayed
    stayed = next(name for name in plan.watching if name != leaper)
    moved = tuple(name for name in "ABC" if name != stayed)
    assert stayed in planner.plan(Situation(4, 1, poses, moved)).watching


def test_one_that_has_leapt_and_fails_leaps_on_and_the_anchor_stays(mission):
    mission.plan(0)
    leaper, target = mission.plan(1).leap
    mission.registry[leaper].tracker.displace(math.inf, target)
    again = mission.plan(1, 1, (leaper,))
    assert again.leap == (leaper, target)
    other = mission.plan(1, 2, (leaper,))
    assert other.leap is not None and other.leap[0] == leaper
    x, y, yaw = between(target, other.leap[1])
    assert math.hypot(x, y) + abs(yaw) > 0.1


def test_where_no_anchor_is_left_nobody_leaps(mission):
    mission.plan(0)
    for attempt in range(3):
        assert mission.plan(1, attempt, ("A", "B")).leap is None


def test_where_one_was_pushed_so_that_none_shares_a_view_the_other_leaps_on(mission):
    mission.plan(0)
    leaper, target = mission.plan(1).leap
    (pushed,) = {"A", "B"} - {leaper}
    x, y, yaw = mission.registry.poses()[pushed]
    mission.registry[leaper].tracker.displace(math.inf, target)
    mission.registry[pushed].tracker.displace(math.inf, (x + 0.1, y, yaw + math.copysign(1.2, yaw)))
    plan = mission.plan(1, 1, ("A", "B"))
    assert plan.leap is not None and plan.leap[0] == leaper
    # it comes to where both see the drive
    views = InView(mission.team, "C", {**mission.registry.poses(("A", "B")), leaper: plan.leap[1]})
    height = mission.team["C"].markers.height
    places = np.column_stack([plan.patrol[:-1], np.full(len(plan.patrol) - 1, height)])
    assert all(view.project(places)[1].all() for view in views.views.values())


def test_an_observer_waits_until_the_mover_is_out_of_its_way(mission):
    mission.plan(0)
    plan = mission.plan(1)
    leaper, target = plan.leap
    start = mission.registry.poses()[leaper]
    x, y = np.mean([start[:2], target[:2]], axis=0)
    assert not plan.may_leap(start, (x, y, 0.0))
    ahead = plan.patrol[0] + (plan.patrol[0] - np.array(target[:2]))
    assert plan.may_leap(start, (*ahead.tolist(), 0.0)) or math.dist(plan.patrol[0], target[:2]) < plan.passing
