"""Promises of the online system, checked in a simulated mission with the truth at hand; `Checks`."""

import itertools
import json
import math
from collections import deque
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import ColocError
from coloc_graph.geometry.se2 import Planar, compose, inverse, wrap
from coloc_graph.missions.faults import COORDINATOR
from coloc_graph.missions.field import Field
from coloc_graph.missions.network import Network
from coloc_graph.missions.programs import Programs
from coloc_graph.missions.scheduler import Scheduler
from coloc_graph.online.coordinator import Coordinator
from coloc_graph.online.leap_planner import StancePlan
from coloc_graph.online.mission_states import MissionState
from coloc_graph.online.replay import replay
from coloc_graph.pipeline.incremental import EnteredStance
from coloc_graph.robot_io.create.physics import RADIUS
from coloc_graph.robot_io.deadlines import STAND_WITHIN
from coloc_graph.robot_io.link.coordinator_link import CoordinatorLink
from coloc_graph.robot_io.link.messages import Status
from coloc_graph.run import Run, open_run
from coloc_graph.team import Team

LOST_RECORD = 0.5  # newest part of the record that a killed coordinator may lose [s]
MARGIN = 0.02  # time between two checks of what moves [s]
PLANAR = [2, 3, 4]  # heading, x, y in a tangent vector
WELL_KNOWN = 1e12  # condition of a covariance above which it is none
REPLAYED = 4  # of this number of missions one is replayed, and all those that were continued
RESUMED = 1e-9  # difference between an estimate after a resume and an uninterrupted one [m]
ASTRAY = 0.2  # an observer that stands is at most this far from where the coordinator has it [m]
TURNED = 0.2  # the same of its heading [rad]
MORE = 2.5  # the mover may be this number of times as far from there


class Checks:
    """Watches a mission; `violations` are sentences about what was promised and not kept."""

    def __init__(self, scheduler: Scheduler, field: Field, network: Network, team: Team, mover: str, seed: int) -> None:
        self._scheduler, self._field, self._network, self._team, self._mover = scheduler, field, network, team, mover
        self._seed = seed
        self.programs: Programs
        self.violations: list[str] = []
        self.pushed = False
        self._coordinators = 0
        self.nees = (0.0, 0)
        self.ends: tuple[tuple[float, float], ...] = ()
        self._lost_since: dict[str, float | None] = dict.fromkeys(team.names)
        self._numbers: dict[tuple[str, str, type], int] = {}
        self._gaps = 0
        self._link: CoordinatorLink | None = None
        self._recorded: deque[tuple[float, int]] = deque(maxlen=200)
        self._ran = 0.0  # time for which coordinators were not stopped [s]
        self._origin: Planar | None = None
        self._newest: EnteredStance | None = None

    def look(self) -> None:
        """Check what moves now."""
        now, led = 1e-9 * self._scheduler.now, self._runs(COORDINATOR)
        moving = {name for name in self._team.names if self._field.fastest(name) > 0}
        for name in self._team.names:
            since = self._lost_since[name]
            line = self._field.lines.get(name)
            held = line is not None and line.lost is None
            alive = led and held and self._runs(name) and not self._network.conditions[name].cut
            if alive or name in self._field.unplugged:  # nobody stops a Create without its line
                self._lost_since[name] = None
            elif since is None:
                self._lost_since[name] = now
            elif now - since > STAND_WITHIN + MARGIN and name in moving:
                self._violate(f"the wheels of {name} turn {now - since:.2f} s after a loss")
        if moving >= set(self._team.names) - {self._mover}:
            self._violate("no observer stands")
        if moving:
            poses = self._field.poses()
            for a, b in itertools.combinations(poses, 2):
                if math.dist(poses[a][:2], poses[b][:2]) < 2 * RADIUS:
                    self._violate(f"{a} and {b} collide")
        coordinator, process = self.programs.coordinator, self.programs.processes.get(COORDINATOR)
        if coordinator is not None and process is not None and not process.stopped:
            record = coordinator._registry.record
            self._ran += MARGIN
            self._recorded.append((self._ran, sum(map(len, record._detections.values()))))

    def _runs(self, name: str) -> bool:
        """Return whether a program, of a robot or of the coordinator, runs."""
        process = self.programs.processes.get(name)
        return process is not None and process.alive and not process.stopped and not self.programs.mains[name].hung

    def watch_coordinator(self, coordinator: Coordinator) -> None:
        """Follow the messages that a new coordinator takes in."""
        self._count_lost()
        self._coordinators += 1
        self._numbers, self._gaps, self._link = {}, 0, coordinator.link
        self._recorded.clear()
        put = coordinator._inbox.put

        def watched(robot: str, message: object) -> None:
            if not isinstance(message, (bool, Status)):
                key = robot, message.session, type(message)  # type: ignore[attr-defined]
                number = message.number  # type: ignore[attr-defined]
                before = self._numbers.get(key, number - 1)  # earlier ones came before this was watched
                if number <= before:
                    self._violate(f"{type(message).__name__} {number} of {robot} came after {before}")
                self._gaps += number - before - 1
                self._numbers[key] = number
            put(robot, message)  # type: ignore[arg-type]

        for type_ in coordinator.link._calls:
            coordinator.link._calls[type_] = watched

    def take_plan(self, plan: StancePlan) -> None:
        """Compare where the coordinator has the robots, as it plans, with its estimate and with the truth."""
        coordinator = self.programs.coordinator
        assert coordinator is not None
        registry, one, stances = coordinator._registry, self._newest, coordinator._mission.stances
        if one is not None and plan.index <= one.stance.index:
            self._violate(f"stance {plan.index} is planned though stance {one.stance.index} has entered")
        if one is not None and stances and stances[-1].index == one.stance.index:
            if stances[-1] != one.stance:
                self._violate(f"stance {one.stance.index} is not the one that has entered")
            for name in _standing(one):
                tracker = registry[name].tracker
                if tracker._displaced <= one.stance.start:
                    off = _apart(tracker.pose(one.stance.start), _planar(one.estimate.poses[name].matrix()))
                    if max(off) > RESUMED:
                        self._violate(f"{name} is {off[0]:.2g} m, {off[1]:.2g} rad from where the last stance has it")
        if self.pushed or self._origin is None:
            return
        poses = self._field.poses()
        for name, robot in registry.robots.items():
            since, last = robot.stands_since(), registry.record.last_odometry(name)
            if since is None or last is None or last.time < registry.utc(since):
                continue  # the last metres of its way have not come yet
            if name in coordinator._mission._missing:
                continue  # it leapt and did not see the mover: that is being put right
            off = _apart(robot.tracker.pose(), self._in_world(poses[name]))
            more = MORE if name == self._mover else 1.0
            if off[0] > more * ASTRAY or off[1] > more * TURNED:
                self._violate(f"{name} stands {off[0]:.2f} m, {off[1]:.2f} rad from where the coordinator has it")

    def take_stance(self, one: EnteredStance) -> None:
        """Compare the estimate of a stance with the truth, while all robots stand."""
        poses, reference = self._field.poses(), self._team.reference
        if self._origin is None:
            self._origin = poses[reference]
        self._newest = one
        self.nees, self.ends = (0.0, 0), ()
        for name in _standing(one):
            if self.pushed or name not in one.estimate.poses or (name == reference and one.stance.index == 0):
                continue
            covariance = one.estimate.covariances[name][np.ix_(PLANAR, PLANAR)]
            T = one.estimate.poses[name].matrix()
            x, y, yaw = compose(inverse(_planar(T)), self._in_world(poses[name]))
            error = np.array([wrap(yaw), x, y])
            self.ends += ((math.hypot(x, y), abs(float(wrap(yaw)))),)
            if np.linalg.cond(covariance) < WELL_KNOWN:
                self.nees = self.nees[0] + float(error @ np.linalg.solve(covariance, error)), self.nees[1] + 3

    def _in_world(self, pose: Planar) -> Planar:
        """Convert a true pose to the world of the mission: the reference's body at the beginning."""
        assert self._origin is not None
        return compose(inverse(self._origin), pose)

    def look_at_record(self, folder: Path) -> None:
        """Check that the record of a coordinator that was killed now has all but the newest images."""
        path = folder / "run.mcap"
        before = [n for ran, n in self._recorded if ran <= self._ran - LOST_RECORD - MARGIN]
        self._recorded.clear()
        if not before:
            return
        try:
            run = open_run(path)
            kept = sum(1 for name in self._team.names for _ in run.detections(name))
        except ColocError as error:
            self._violate(f"the record of a killed coordinator cannot be read: {error}")
            return
        if kept < before[-1]:
            self._violate(f"a killed coordinator lost {before[-1] - kept} images older than {LOST_RECORD} s")

    def end(self, folder: Path, ended: bool) -> None:
        """Check what the mission left behind."""
        programs = self.programs
        if not ended:
            self._violate("the mission did not end")
        self._count_lost()
        for crash in programs.crashes:
            self._violate(crash)
        for name, error in self._scheduler.faults:
            self._violate(f"a thread failed, {name}: {error!r}")
        if programs.state is None:
            return
        rows = [json.loads(line) for line in (folder / "mission.jsonl").read_text().splitlines()]
        states = [row for row in rows if row["what"] == "state"]
        if programs.state == MissionState.FAILED and not states[-1]["reason"]:
            self._violate("the mission failed and does not say why")
        run = open_run(folder / "run.mcap")
        if not run.stances:
            return
        indices = [stance.index for stance in run.stances]
        if indices != list(range(len(indices))):
            self._violate(f"the record has the stances {indices}")
        asked = programs.options.stances
        if programs.state == MissionState.DONE and asked is not None and len(indices) != asked:
            self._violate(f"the mission is done after the stances {indices}")
        if run.warnings:
            self._violate(f"the record is damaged: {run.warnings[0]}")
        if self._coordinators > 1:
            self._compare_records(folder, run)
        if self._coordinators > 1 or self._seed % REPLAYED == 0:
            entered = {row["stance"] for row in rows if row["what"] == "entered"}
            self._compare_replay(folder, indices, entered)

    def _compare_records(self, folder: Path, run: Run) -> None:
        """Check that the last record goes on from the earlier ones, and has no image twice."""
        last = {name: _images(run, name) for name in self._team.names}
        for name, images in last.items():
            seen = [uv for _, uv in images if uv]  # noise makes each image another one
            if len(set(seen)) < len(seen):
                self._violate(f"the record has {len(seen) - len(set(seen))} images of {name} twice")
        for path in sorted(folder.glob("run.*.mcap")):
            before = open_run(path)
            for name, images in last.items():
                earlier = _images(before, name)
                if images[: len(earlier)] != earlier:
                    self._violate(f"the record of a continued mission lacks images of {name} that {path.name} has")

    def _compare_replay(self, folder: Path, indices: list[int], entered: set[int]) -> None:
        """Replay the mission, as if it had never been interrupted: it must give the same estimates, bit for bit."""
        stances = list(replay(folder, self.programs.options.solve))
        replayed = [one.entered.stance.index for one in stances]
        if replayed != indices:
            self._violate(f"the record has the stances {indices}, a replay {replayed}")
        for one in stances:
            index = one.entered.stance.index
            if one.same is False or (one.same is None and index in entered):
                self._violate(f"the estimate of stance {index} is another one when it is replayed")
        newest = stances[-1].entered if stances else None
        if self._newest is not None and newest is not None and newest.stance == self._newest.stance:
            for name, pose in self._newest.estimate.poses.items():
                off = np.abs(newest.estimate.poses[name].matrix() - pose.matrix()).max()
                if off > RESUMED:
                    self._violate(f"the pose of {name} differs by {off:.1g} from that without interruptions")

    def _count_lost(self) -> None:
        """Compare the gaps in what was delivered with what was counted as lost."""
        link = self._link
        if link is not None and link.counts.missed < self._gaps:
            self._violate(f"{self._gaps} messages are missing, {link.counts.missed} are counted as lost")

    def _violate(self, text: str) -> None:
        if len(self.violations) < 20:
            self.violations.append(f"{1e-9 * self._scheduler.now:.2f} s: {text}")


def _standing(one: EnteredStance) -> list[str]:
    """Return the robots that stood in a stance, whether they saw the mover or not."""
    return list(dict.fromkeys((*one.stance.observers, *one.stance.anchors)))


def _planar(T: NDArray[np.float64]) -> Planar:
    """Return x [m], y [m] and yaw [rad] of a pose (4, 4)."""
    return float(T[0, 3]), float(T[1, 3]), math.atan2(T[1, 0], T[0, 0])


def _apart(a: Planar, b: Planar) -> tuple[float, float]:
    """Distance between two poses [m], and angle between their headings [rad]."""
    return math.dist(a[:2], b[:2]), abs(float(wrap(a[2] - b[2])))


def _images(run: Run, robot: str) -> list[tuple[float, bytes]]:
    """Times and pixels of a robot's detections, one of each image."""
    return [(one.time, one.uv.tobytes()) for one in run.detections(robot)]
