"""The coordinator of a team in the field; `Coordinator`."""

import contextlib
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

from coloc_graph.geometry.lie import floor_pose
from coloc_graph.machine import machine
from coloc_graph.online.commands import Commander, Stopped
from coloc_graph.online.decision_worker import DecisionWorker
from coloc_graph.online.estimation_worker import EstimationWorker
from coloc_graph.online.formation import Formation
from coloc_graph.online.horizon_planner import HorizonPlanner, best_mover
from coloc_graph.online.inbox import Inbox, Message, linked
from coloc_graph.online.leap_frog import LeapFrog
from coloc_graph.online.leap_planner import LeapPlanner, StancePlan, StancePlanner
from coloc_graph.online.mission import MissionOptions, MissionStatus, in_world, roles
from coloc_graph.online.mission_folder import MissionFolder
from coloc_graph.online.mission_log import MissionLog
from coloc_graph.online.mission_states import MissionState
from coloc_graph.online.resume import restore
from coloc_graph.online.robot_registry import RobotRegistry
from coloc_graph.pipeline.incremental import EnteredStance, IncrementalSolver
from coloc_graph.planning.course import Course
from coloc_graph.planning.floor_map import read_floor_map
from coloc_graph.robot_io.link.messages import Event, Sample, Status, Wheels
from coloc_graph.robot_io.link.session import LinkSession, OpenSession
from coloc_graph.robot_io.link.zenoh_config import Tls
from coloc_graph.run.schemas import to_ns
from coloc_graph.team import Team

TICK = 0.03  # period of the main loop [s]
SHORT_TICK = 0.004  # the same while all robots wait for the estimate [s]
STATUS_PERIOD = 0.1  # time between two calls of `on_status` [s]


class Coordinator:
    """Coordinator of a mission: it leads a team along its goals; a context manager, at whose end all robots stand.

    Parameters
    ----------
    team
        The robots.
    folder
        Folder for the record, run.mcap, and the log of states and events, mission.jsonl.
    options
        Goals and limits of the mission.
    listen, tls, exposed
        Address for the robots, and who may connect; see `CoordinatorLink`.
    resume
        Continue the mission whose record is in the folder.
    open_session
        Opens the link's session; another than zenoh's in a simulation.
    on_stance
        Called with each stance that has entered the estimate.
    on_status
        Called with the mission's status ten times a second.
    on_plan
        Called with the plan of each stance, as soon as it is decided.

    Raises
    ------
    InputError
        If the mission cannot begin with such a team, or another coordinator holds the folder.
    RobotError
        If the address cannot be listened on.
    """

    def __init__(
        self,
        team: Team,
        folder: str | Path,
        options: MissionOptions | None = None,
        *,
        listen: str = "tcp/127.0.0.1:7447",
        tls: Tls | None = None,
        exposed: bool = False,
        resume: bool = False,
        open_session: OpenSession = LinkSession,
        on_stance: Callable[[EnteredStance], None] | None = None,
        on_status: Callable[[MissionStatus], None] | None = None,
        on_plan: Callable[[StancePlan], None] | None = None,
    ) -> None:
        options = options or MissionOptions()
        if options.formation == "plan" and options.mover is None:
            options = replace(options, mover=best_mover(team, options.speed))
        mover, observers = roles(team, options.mover)
        starts, waypoints = in_world(team, mover, options.goals)
        course = Course(waypoints)
        floor_map = None if options.map_path is None else read_floor_map(options.map_path)
        self._on_status, self._status_time = on_status, 0.0
        self._inbox = Inbox()
        self._solver = IncrementalSolver(team, options.solve)
        with contextlib.ExitStack() as undo:
            # the folder and the port are taken before anything of an earlier mission is touched
            held = undo.enter_context(MissionFolder(folder, resume=resume))
            link = undo.enter_context(
                linked(self._inbox, team, listen=listen, tls=tls, exposed=exposed, open_session=open_session)
            )
            record, self._before = held.open_record(team)
            undo.enter_context(record)
            # UTC when a mission begins; the record's time does not run backwards where the system's clock was set back
            epoch = max(machine.time_ns(), to_ns(record.newest())) - machine.monotonic_ns()
            self._registry = RobotRegistry(
                record, starts, lambda name: link.clocks[name].to_coordinator, epoch, self._inbox.status_times
            )
            self._log_path = held.log_path
            self._log = undo.enter_context(MissionLog(held.log_path, self._registry.utc))
            worker = EstimationWorker(record, self._solver)
            undo.callback(worker.end)
            self._commander = Commander(
                link,
                self._registry,
                options.speed,
                lambda name: self._log.note("drive resumed", robot=name),
                free=None if floor_map is None else floor_map.clear,
            )
            undo.callback(self._commander.halt_all)
            planner: StancePlanner
            if options.formation == "plan":
                planner = HorizonPlanner(
                    team, mover, observers, course,
                    pace=options.pace, speed=options.speed, floor_map=floor_map,
                )  # fmt: skip
            else:
                planner = LeapPlanner(team, mover, Formation(course, observers))
            decisions = DecisionWorker(planner)
            undo.callback(decisions.end)
            self._close = undo.pop_all()
        self.link = link
        self._mission = LeapFrog(
            team,
            options,
            planner,
            decisions=decisions,
            registry=self._registry,
            commander=self._commander,
            worker=worker,
            log=self._log,
            synchronised=lambda name: link.synchronised(name, options.clock_limit),
            on_stance=on_stance,
            on_plan=on_plan,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close.__exit__(kind, error, trace)

    @property
    def stances(self) -> int:
        """Number of stances in the estimate."""
        return len(self._mission.stances)

    @property
    def latencies(self) -> tuple[float, ...]:
        """Time of each stance from its last image to the estimate [s]."""
        return tuple(self._mission.latencies)

    def run(self, stop: threading.Event) -> MissionState:
        """Lead the team until the mission is done, has failed, or `stop` is set; return the last state."""
        mission = self._mission
        self._commander.stop = stop
        if self._before is not None:
            mission.stances += restore(self._before, self._log_path, self._solver, self._registry, stop)
            self._log.note("resumed", stances=len(mission.stances))
        with contextlib.suppress(Stopped):
            while not mission.ended and not stop.is_set():
                self._commander.renew()
                waiting = mission.states.now in (MissionState.COLLECTING, MissionState.ESTIMATING)
                for name, message in self._inbox.messages(SHORT_TICK if waiting else TICK):
                    self._take(name, message)
                    self._commander.renew()
                mission.step()
                self._tell()
        self._commander.halt_all()
        return mission.states.now

    def _take(self, name: str, message: Message) -> None:
        """Take in a message of a robot."""
        robot = self._registry[name]
        match message:
            case Sample():
                seen = self._registry.take_sample(name, message)
                if seen is not None:
                    self._mission.take_image(message.capture, seen)
            case Wheels():
                self._registry.take_wheels(name, message)
            case Status():
                if robot.take_status(message):
                    self._log.note("session", robot=name, session=message.session)
                self._registry.record.moves(name, self._registry.utc(), message.moving)
            case Event():
                self._log.note("event", robot=name, kind=message.kind, text=message.text)
                robot.take_event(message)
            case bool():
                robot.present = message
                self._log.note("presence", robot=name, present=message)

    def _tell(self) -> None:
        """Tell the listener the mission's status, now and then."""
        now = machine.monotonic()
        if self._on_status is None or now - self._status_time < STATUS_PERIOD:
            return
        self._status_time = now
        T = {name: floor_pose(*pose) for name, pose in self._registry.poses().items()}
        self._on_status(MissionStatus(self._registry.utc(), T, self._mission.describe()))
