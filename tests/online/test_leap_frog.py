"""The states of a mission without a network: robots are a registry and a commander that records."""

import math
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from coloc_graph.errors import RobotError
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.geometry.se2 import compose, inverse
from coloc_graph.online.commands import Commander, Stopped
from coloc_graph.online.decision_worker import DecisionWorker
from coloc_graph.online.estimation_worker import EstimationWorker
from coloc_graph.online.formation import STAGGER, Formation
from coloc_graph.online.inbox import Inbox
from coloc_graph.online.leap_frog import CALM, LeapFrog
from coloc_graph.online.leap_planner import LeapPlanner, Situation
from coloc_graph.online.mission import MissionOptions, in_world, roles
from coloc_graph.online.mission_log import MissionLog
from coloc_graph.online.mission_states import MissionState
from coloc_graph.online.proximity import require_clear_way, too_near
from coloc_graph.online.record import Record
from coloc_graph.online.robot_registry import RobotRegistry
from coloc_graph.online.visibility import InView
from coloc_graph.pipeline.incremental import IncrementalSolver
from coloc_graph.planning.course import Course
from coloc_graph.robot_io.link.messages import Capture, Drive, EndCapture, Event, Halt, Reply, Status, Wheels
from coloc_graph.run import Detections, OdometrySample, Stance
from coloc_graph.simulation.simulated_team import field_team

OPTIONS = MissionOptions(goals=((5.0, 0.0),))


class Link:
    """Answers every command, unless told otherwise, and counts permissions."""

    def __init__(self):
        self.asked, self.holds, self.answers = [], 0, {}

    def hold(self):
        self.holds += 1

    def ask_each(self, bodies, timeout, waiting=lambda: None):
        self.asked += bodies.items()
        waiting()
        return {name: self.answers.get(name, Reply(id="", ok=True)) for name in bodies}


class Mission:
    """A mission of robots that stand, none of which sees anything."""

    def __init__(self, folder, planner=None):
        self.team, self.inbox, self.link = field_team(), Inbox(), Link()
        self.record = Record(folder / "run.mcap", self.team)
        starts, waypoints = in_world(self.team, "C", OPTIONS.goals)
        self.registry = RobotRegistry(self.record, starts, lambda _: lambda stamp: stamp, 0, self.inbox.status_times)
        self.worker = EstimationWorker(self.record, IncrementalSolver(self.team))
        self.commander = Commander(self.link, self.registry, 0.3, lambda _: None)
        self.log = MissionLog(folder / "mission.jsonl", self.registry.utc)
        self.formation = Formation(Course(waypoints), roles(self.team, None)[1])
        self.synchronised = True
        planner = planner or LeapPlanner(self.team, "C", self.formation)
        self.decisions = DecisionWorker(planner)
        self.leap_frog = LeapFrog(
            self.team,
            OPTIONS,
            planner,
            decisions=self.decisions,
            registry=self.registry,
            commander=self.commander,
            worker=self.worker,
            log=self.log,
            synchronised=lambda _: self.synchronised,
        )

    def report(self, name, fault=None):
        now = time.monotonic_ns()
        status = Status(session=name, stamp=now, phase="idle", capture=None, moving=False, still_since=0, fault=fault,
                        camera_fault=None, hazards=[])  # fmt: skip
        self.inbox.put(name, status)
        robot = self.registry[name]
        robot.present = True
        robot.take_status(status)
        if not robot.tracker.known:
            wheels = Wheels(session=name, number=0, stamp=now, frame="f", pose=(0.0, 0.0, 0.0),
                            covariance=(1e-8, 0.0, 0.0, 1e-8, 0.0, 1e-8))  # fmt: skip
            self.registry.take_wheels(name, wheels)

    def step(self, state):
        """Step once from a state that has lasted for long."""
        self.leap_frog.states.since -= CALM + 0.1
        self.leap_frog.step()
        assert self.leap_frog.states.now == state

    def await_plan(self):
        until = time.monotonic() + 60
        while self.leap_frog.states.now == MissionState.PLANNING and time.monotonic() < until:
            self.leap_frog.step()
            time.sleep(0.002)

    def close(self):
        self.decisions.end()
        self.worker.end()
        self.log.__exit__(None, None, None)
        self.record.__exit__(None, None, None)


@pytest.fixture
def mission(tmp_path):
    one = Mission(tmp_path)
    yield one
    one.close()


def test_a_mission_places_its_robots_looks_and_holds_when_one_has_gone(mission):
    mission.step(MissionState.GATHERING)
    for name in "ABC":
        mission.report(name)
    mission.step(MissionState.SYNCHRONISING)
    mission.synchronised = False
    mission.step(MissionState.SYNCHRONISING)
    mission.synchronised = True
    mission.step(MissionState.PLANNING)
    mission.await_plan()
    ((name, drive),) = mission.link.asked  # nobody leaps into the first stance
    assert name == "C" and isinstance(drive, Drive)
    mission.step(MissionState.PLACING)
    mission.registry["C"].take_event(Event(session="C", number=0, stamp=0, kind="stopped", text=""))
    mission.step(MissionState.PLACING)
    assert mission.link.asked[-1] == ("C", drive)  # and is sent on
    mission.registry["C"].take_event(Event(session="C", number=1, stamp=0, kind="arrived", text=str(drive.number)))
    mission.step(MissionState.LOOKING)
    assert {name for name, body in mission.link.asked if isinstance(body, Capture)} == {"A", "B"}
    mission.registry["B"].present = False
    mission.step(MissionState.HOLDING)
    assert mission.link.asked[-4:] == [(n, body) for body in (Halt(), EndCapture()) for n in "AC"]
    assert mission.leap_frog.describe() == "stance 0: holding"


def test_a_mover_that_is_not_seen_at_the_border_of_a_view_is_sent_to_the_middle_first(mission):
    mission.step(MissionState.GATHERING)
    for name in "ABC":
        mission.report(name)
    mission.step(MissionState.SYNCHRONISING)
    mission.step(MissionState.PLANNING)
    mission.await_plan()
    for number, state in enumerate((MissionState.LOOKING, MissionState.LOOKING, MissionState.HOLDING)):
        name, drive = [(name, body) for name, body in mission.link.asked if isinstance(body, Drive)][-1]
        arrived = Event(session="C", number=number, stamp=0, kind="arrived", text=str(drive.number))
        mission.registry[name].take_event(arrived)
        mission.leap_frog.states.since -= 1.0
        mission.step(state)
    start, middle = [body.places for _, body in mission.link.asked if isinstance(body, Drive)]
    assert len(middle) == 1 and middle[0] not in start
    assert mission.leap_frog._missing == ("A", "B")
    assert "A and B did not see C where it should be" in (mission.record.path.parent / "mission.jsonl").read_text()


def test_an_ask_renews_the_permission_to_move_and_ends_when_the_mission_is_stopped(mission):
    mission.commander.ask("A", Halt())
    assert mission.link.holds == 1
    mission.link.answers = {"A": None}
    with pytest.raises(RobotError, match="A has not answered `Halt` within 1 s"):
        mission.commander.ask("A", Halt())
    mission.link.answers = {"A": Reply(id="", ok=False, text="no")}
    with pytest.raises(RobotError, match="A refuses: no"):
        mission.commander.ask("A", Halt())
    mission.commander.stop = threading.Event()
    mission.commander.stop.set()
    with pytest.raises(Stopped):
        mission.commander.ask("A", Halt())


def test_a_robot_whose_messages_wait_is_not_called_silent(mission):
    mission.report("A")
    mission.inbox.status_times["A"] -= 1.2
    assert "A has sent nothing for " in mission.registry["A"].trouble()
    mission.inbox.put("A", mission.registry["A"].status)  # it came, but the main loop was held up
    assert mission.registry["A"].trouble() is None


def test_a_leap_that_was_planned_or_begun_is_kept(mission):
    for name in "ABC":
        mission.report(name)
    planner, poses = LeapPlanner(mission.team, "C", mission.formation), mission.registry.poses()
    first = planner.plan(Situation(0, 0, poses))
    assert first.leap is None and first.drives("C", "C") and not first.drives("A", "C")
    plan = planner.plan(Situation(1, 0, poses))
    leaper, target = plan.leap
    assert plan.drives(leaper, "C") and planner.plan(Situation(1, 1, poses)).leap == plan.leap
    way = mission.formation.course.way_of(target)
    assert way == pytest.approx(max(mission.formation.ways(mission.registry.poses()).values()) + STAGGER)
    other = "AB".replace(leaper, "")
    assert planner.plan(Situation(2, 0, poses, (other,))).leap[0] == other  # it has set off already
    assert planner.plan(Situation(2, 1, poses, ("A", "B"))).leap is None  # no anchor would be left


class Passing(LeapPlanner):
    """The paper's formation, with a leap that must wait for the mover; it decides once it may."""

    may_decide = None

    def plan(self, situation):
        assert self.may_decide is None or self.may_decide.wait(60.0)
        return replace(super().plan(situation), leap=("A", (0.4, 0.0, 0.0)), passing=100.0)


def test_while_the_planner_decides_the_mission_goes_on_and_a_leap_waits_for_the_mover(tmp_path):
    team = field_team()
    _, waypoints = in_world(team, "C", OPTIONS.goals)
    planner = Passing(team, "C", Formation(Course(waypoints), roles(team, None)[1]))
    planner.may_decide = threading.Event()
    mission = Mission(tmp_path, planner)
    mission.step(MissionState.GATHERING)
    for name in "ABC":
        mission.report(name)
    mission.leap_frog.stances.append(Stance(0, 0.0, mission.registry.utc(), ("A", "B"), ("C",)))
    mission.step(MissionState.SYNCHRONISING)
    mission.step(MissionState.PLANNING)
    for _ in range(20):
        mission.leap_frog.step()
    assert mission.leap_frog.states.now == MissionState.PLANNING
    assert not mission.link.asked  # nobody moves before there is a plan
    planner.may_decide.set()
    mission.await_plan()
    mission.step(MissionState.PLACING)
    ((name, drive),) = mission.link.asked
    assert name == "C"
    mission.registry["C"].take_event(Event(session="C", number=1, stamp=0, kind="arrived", text=str(drive.number)))
    mission.step(MissionState.PLACING)  # now the observer is on its way
    assert [name for name, body in mission.link.asked if isinstance(body, Drive)] == ["C", "A"]
    leap = mission.link.asked[-1][1]
    mission.registry["A"].take_event(Event(session="A", number=1, stamp=0, kind="arrived", text=str(leap.number)))
    mission.step(MissionState.LOOKING)
    mission.close()


def test_nobody_leaps_without_an_anchor(tmp_path):
    team = field_team()
    _, waypoints = in_world(team, "C", OPTIONS.goals)
    mission = Mission(tmp_path, Passing(team, "C", Formation(Course(waypoints), roles(team, None)[1])))
    mission.step(MissionState.GATHERING)
    for name in "ABC":
        mission.report(name)
    mission.leap_frog.stances.append(Stance(0, 0.0, 1.0, ("A", "B"), ("C",)))
    mission.registry["B"].tracker.displace(math.inf, mission.registry["B"].tracker.pose())  # pushed
    mission.step(MissionState.SYNCHRONISING)
    mission.step(MissionState.PLANNING)
    mission.await_plan()
    assert mission.leap_frog.states.now == MissionState.HOLDING
    assert not any(isinstance(body, Drive) for _, body in mission.link.asked)
    mission.close()


def plan_after_one_stance(mission):
    """Have the stance after the first one planned, and its robots sent off."""
    mission.step(MissionState.GATHERING)
    for name in "ABC":
        mission.report(name)
    mission.leap_frog.stances.append(Stance(0, 0.0, mission.registry.utc(), ("A", "B"), ("C",)))
    mission.step(MissionState.SYNCHRONISING)
    mission.step(MissionState.PLANNING)
    mission.await_plan()


TARGET, DRIVE = (1.3, 0.1, -0.1), np.array([[2.2, -0.05], [2.4, 0.1], [2.3, 0.0]])


class Leaping(LeapPlanner):
    """A leaps to `TARGET` for a drive through `DRIVE`."""

    def plan(self, situation):
        return replace(super().plan(situation), leap=("A", TARGET), patrol=DRIVE)


@pytest.mark.parametrize(
    ("astray", "turns"), [((-0.1, 0.2, 0.25), True), ((0.02, -0.02, 0.01), False)], ids=["astray", "there"]
)
def test_an_observer_that_leapt_and_looks_past_the_drive_is_turned_as_another_sees_it(tmp_path, astray, turns):
    team = field_team()
    mission = Mission(tmp_path, Leaping(team, "C", Formation(Course(((0.0, 0.0), (5.0, 0.0))), ("A", "B"))))
    plan_after_one_stance(mission)
    # by their wheels both have arrived
    for name, place in (("A", TARGET), ("C", (*DRIVE[0], 0.3))):
        mission.registry[name].tracker.fix(mission.registry.utc(), place)
        mission.registry[name].arrived = True
    mission.leap_frog._leap = None
    mission.step(MissionState.LOOKING)
    truly = compose(TARGET, astray)
    places = {"A": truly, "B": mission.registry.poses()["B"]}
    view, capture, now = InView(team, "C", places), mission.leap_frog.attempt.capture, mission.registry.utc()
    for observer in "AB":
        uv = np.empty((0, 2))
        for name, place in (("A", truly), ("C", (*DRIVE[0], 0.3))):
            T = floor_pose(*place)
            seen, inside = view.views[observer].project(team[name].markers.p_body @ T[:3, :3].T + T[:3, 3])
            uv = np.concatenate([uv, seen[inside & (name != observer)]])
        n = len(uv)
        covariance, ones = np.tile(0.1 * np.eye(2), (n, 1, 1)), np.ones(n)
        image = Detections(observer, now, uv, covariance, ("",) * n, np.zeros(n, np.uint8), ones, ones)
        mission.leap_frog.take_image(capture, image)
    mission.step(MissionState.PLACING if turns else MissionState.CAPTURING)
    found = mission.registry.poses()["A"]
    assert found == pytest.approx(truly if turns else TARGET, abs=1e-6)
    if turns:
        assert not view.covers("A", truly, DRIVE)
        name, drive = mission.link.asked[-1]
        yaw = compose(compose(found, inverse(mission.registry["A"].tracker.in_odometry(found))), (0, 0, drive.yaw))[2]
        assert name == "A" and view.covers("A", (*truly[:2], yaw), DRIVE)
    mission.close()


class Through(LeapPlanner):
    """A leaps to beyond B."""

    def plan(self, situation):
        a, b = (situation.poses[name] for name in "AB")
        return replace(super().plan(situation), leap=("A", (2 * b[0] - a[0], 2 * b[1] - a[1], 0.0)), passing=None)


def test_a_robot_is_not_sent_off_where_another_stands_in_its_way(tmp_path):
    mission = Mission(tmp_path, Through(field_team(), "C", Formation(Course(((0.0, 0.0), (5.0, 0.0))), ("A", "B"))))
    plan_after_one_stance(mission)
    assert mission.leap_frog.states.now == MissionState.HOLDING
    assert not [name for name, body in mission.link.asked if isinstance(body, Drive) and name == "A"]
    assert "A is not sent off: B stands in its way" in (tmp_path / "mission.jsonl").read_text(encoding="utf-8")
    mission.close()


@pytest.mark.parametrize(("to", "stops"), [((0.45, 0.35), True), ((0.45, 0.37), False), ((0.3, 0.35), False)])
def test_a_robot_that_comes_too_near_to_another_is_stopped_and_one_that_drives_away_is_not(mission, to, stops):
    """C drives from a distance to another of A [m], as its tracked pose has it."""
    mission.step(MissionState.GATHERING)
    for name in "ABC":
        mission.report(name)
    mission.step(MissionState.SYNCHRONISING)
    mission.step(MissionState.PLANNING)
    mission.await_plan()
    mission.step(MissionState.PLACING)
    x, y, _ = mission.registry.poses()["A"]
    drove(mission, (to[0], to[0], to[1]), (x + to[0], y, 0.0))
    mission.leap_frog.step()
    halted = [name for name, body in mission.link.asked if isinstance(body, Halt)]
    assert (mission.leap_frog.states.now == MissionState.HOLDING) == stops == ("C" in halted)


def drove(mission, xs, start):
    """Let C have driven to these x in its odometry frame [m] within 0.6 s; it was at `start` in the world first."""
    tracker, now = mission.registry["C"].tracker, mission.registry.utc()
    frame = tracker.odometry_at(now)
    for time_, x in zip(np.linspace(now + 0.1, now + 0.7, len(xs)), xs, strict=True):
        tracker.add(OdometrySample("C", time_, np.array([x, frame[1], 0.0]), 1e-8 * np.eye(3)))
    tracker.fix(now + 0.1, start)
    time.sleep(0.6)


def test_a_robot_that_comes_too_near_to_a_wall_is_stopped_and_is_not_sent_through_one(mission):
    def free(places, distance):  # a wall at x = 1
        return 1.0 - np.asarray(places)[..., 0] > distance

    for name in "ABC":
        mission.report(name)
    mission.registry["C"].arrived = False
    drove(mission, (0.75, 0.75, 0.81), (0.75, 2.0, 0.0))
    assert too_near(mission.registry, free) == "C came nearer than 0.2 m to a wall"
    assert too_near(mission.registry, None) is None
    drove(mission, (0.5, 0.5, 0.56), (0.5, 2.0, 0.0))
    assert too_near(mission.registry, free) is None
    require_clear_way(mission.registry, "C", [(0.7, 3.0)], (), free)
    with pytest.raises(RobotError, match="C is not sent off: a wall is in its way"):
        require_clear_way(mission.registry, "C", [(0.85, 3.0)], (), free)
