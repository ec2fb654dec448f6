"""Promises of the online system, checked in a simulated mission with the truth at hand; `Checks`."""

import itertools
import json
import math
from collections import defaultdict, deque
from pathlib import Path

import numpy as np

from coloc_graph.missions.faults import COORDINATOR
from coloc_graph.missions.field import Field
from coloc_graph.missions.network import Network
from coloc_graph.missions.programs import Programs
from coloc_graph.missions.scheduler import Scheduler
from coloc_graph.online.coordinator import Coordinator
from coloc_graph.online.mission_states import MissionState
from coloc_graph.pipeline.incremental import EnteredStance
from coloc_graph.robot_io.create.physics import RADIUS
from coloc_graph.robot_io.deadlines import STAND_WITHIN
from coloc_graph.robot_io.link.messages import Status
from coloc_graph.run import open_run
from coloc_graph.team import Team

LOST_RECORD = 0.5  # newest part of the record that a killed coordinator may lose [s]
MARGIN = 0.02  # time between two checks of what moves [s]


class Checks:
    """Watches a mission; `violations` are sentences about what was promised and not kept."""

    def __init__(self, scheduler: Scheduler, field: Field, network: Network, team: Team, mover: str) -> None:
        self._scheduler, self._field, self._network, self._team, self._mover = scheduler, field, network, team, mover
        self.programs: Programs
        self.violations: list[str] = []
        self.pushed = False
        self.nees = (0.0, 0)
        self._lost_since: dict[str, float | None] = dict.fromkeys(team.names)
        self._numbers: dict[tuple[str, str, type], int] = {}
        self._gaps = 0
        self._link_counts = None
        self._recorded: deque[tuple[float, int]] = deque(maxlen=200)
        self._to_be_kept = 0
        self._truth: dict[float, dict[str, tuple[float, float, float]]] = {}

    def look(self) -> None:
        """Check what moves now."""
        now = 1e-9 * self._scheduler.now
        moving = {name for name in self._team.names if self._field.fastest(name) > 0}
        for name in self._team.names:
            since = self._lost_since[name]
            if self._alive(name):
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
        coordinator = self.programs.coordinator
        if coordinator is not None:
            record = coordinator._registry.record
            self._recorded.append((now, sum(map(len, record._detections.values()))))

    def _alive(self, name: str) -> bool:
        """Return whether nothing is lost of all that a robot's motion depends on."""
        processes = self.programs.processes
        both = [processes.get(name), processes.get(COORDINATOR)]
        if any(one is None or not one.alive or one.stopped for one in both):
            return False
        mains = [self.programs.mains[name], self.programs.mains[COORDINATOR]]
        return not any(main.hung for main in mains) and not self._network.conditions[name].cut

    def watch_coordinator(self, coordinator: Coordinator) -> None:
        """Follow the messages that a new coordinator takes in."""
        self._count_lost()
        self._numbers, self._gaps, self._link = {}, 0, coordinator.link
        self._recorded.clear()
        put = coordinator._inbox.put

        def watched(robot: str, message: object) -> None:
            if not isinstance(message, (bool, Status)):
                key = robot, message.session, type(message)  # type: ignore[attr-defined]
                before, number = self._numbers.get(key, -1), message.number  # type: ignore[attr-defined]
                if number <= before:
                    self._violate(f"{type(message).__name__} {number} of {robot} came after {before}")
                self._gaps += number - before - 1
                self._numbers[key] = number
            put(robot, message)  # type: ignore[arg-type]

        for type_ in coordinator.link._calls:
            coordinator.link._calls[type_] = watched

    def take_stance(self, one: EnteredStance) -> None:
        """Take the estimate of a stance, to compare it with the truth."""
        poses = self._field.poses()
        reference = one.estimate.poses
        start = self._truth.setdefault(-1.0, poses) if False else None
        del start
        for name in one.stance.observers:
            if name == self._team.reference or name not in reference:
                continue
        self._newest = one

    def note_kill(self, where: str) -> None:
        """Note what a coordinator that is killed now has recorded."""
        if where == COORDINATOR and self._recorded:
            before = [n for t, n in self._recorded if t <= 1e-9 * self._scheduler.now - LOST_RECORD - MARGIN]
            self._to_be_kept = max(self._to_be_kept, before[-1] if before else 0)

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
        indices = [stance.index for stance in run.stances]
        if indices != list(range(len(indices))):
            self._violate(f"the record has the stances {indices}")
        if programs.state == MissionState.DONE and len(indices) != programs._options.stances:
            self._violate(f"the mission is done after the stances {indices}")
        if run.warnings:
            self._violate(f"the record is damaged: {run.warnings[0]}")
        seen = sum(1 for name in self._team.names for _ in run.detections(name))
        if seen < self._to_be_kept:
            self._violate(f"the record lost {self._to_be_kept - seen} images that were older than {LOST_RECORD} s")

    def _count_lost(self) -> None:
        """Compare the gaps in what was delivered with what was counted as lost."""
        link = getattr(self, "_link", None)
        if link is not None and link.counts.missed < self._gaps:
            self._violate(f"{self._gaps} messages are missing, {link.counts.missed} are counted as lost")

    def _violate(self, text: str) -> None:
        if len(self.violations) < 20:
            self.violations.append(f"{1e-9 * self._scheduler.now:.2f} s: {text}")


_ = (defaultdict, np)
