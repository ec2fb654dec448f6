"""Programs of a simulated mission: they are started, killed, stopped and started again as processes are; `Programs`."""

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from coloc_graph.errors import ColocError
from coloc_graph.missions.faults import COORDINATOR
from coloc_graph.missions.field import Field, detector
from coloc_graph.missions.network import Network
from coloc_graph.missions.scheduler import Host, Process, Scheduler, Task
from coloc_graph.missions.system import Event
from coloc_graph.online.coordinator import Coordinator
from coloc_graph.online.devices import Devices
from coloc_graph.online.leap_planner import StancePlan
from coloc_graph.online.mission import MissionOptions
from coloc_graph.online.mission_states import MissionState
from coloc_graph.online.robot import RobotProgram
from coloc_graph.pipeline.incremental import EnteredStance
from coloc_graph.robot_io.create.driver import Create
from coloc_graph.team import Team

RESTART = 2.0  # time after which a program that ended with an error is started again [s]


class Watcher(Protocol):
    """Follows a mission."""

    def watch_coordinator(self, coordinator: Coordinator) -> None:
        """Take note of a new coordinator before it runs."""

    def take_plan(self, plan: StancePlan) -> None:
        """Take note of the plan of a stance."""

    def take_stance(self, one: EnteredStance) -> None:
        """Take note of a stance that has entered the estimate."""


class Programs:
    """The programs of a mission, shipped code, on simulated hosts.

    Parameters
    ----------
    scheduler, network, field
        Simulated time, network and robots.
    team, options
        The team and its mission.
    folder
        Folder for the mission's files.
    watcher
        Told of each coordinator, plan and stance.

    Attributes
    ----------
    processes
        Present process of each robot and of the coordinator, by name.
    state
        Last state of the mission; None while it goes on.
    errors
        Sentences with which programs ended.
    crashes
        Exceptions that are faults of the programs.
    """

    def __init__(
        self,
        scheduler: Scheduler,
        network: Network,
        field: Field,
        team: Team,
        options: MissionOptions,
        folder: Path,
        watcher: Watcher,
    ) -> None:
        self._scheduler, self._network, self._field = scheduler, network, field
        self._team, self.options, self.folder = team, options, folder
        self._watcher = watcher
        draw = scheduler.random
        self.hosts = {
            name: Host(name, draw.randrange(10**9, 10**13), draw.gauss(0.0, 20e-6), 1_800_000_000 * 10**9)
            for name in (*team.names, COORDINATOR)
        }
        self.jumps = dict.fromkeys(team.names, 0)
        self.processes: dict[str, Process] = {}
        self.mains: dict[str, Task] = {}
        self.state: MissionState | None = None
        self.coordinator: Coordinator | None = None
        self.errors: list[str] = []
        self.crashes: list[str] = []

    def leads_in(self, state: str) -> bool:
        """Return whether a coordinator runs and is in a state."""
        process = self.processes.get(COORDINATOR)
        return (
            self.coordinator is not None
            and process is not None
            and process.alive
            and self.coordinator._mission.states.now == state
        )

    def start(self, name: str) -> None:
        """Start a program, unless it runs."""
        before = self.processes.get(name)
        if (before is not None and before.alive) or self.state is not None:
            return
        process = self.processes[name] = Process(name, self.hosts[name])
        work = self._coordinate if name == COORDINATOR else self._robot
        self.mains[name] = self._scheduler.spawn(lambda: self._run(name, process, work), process, name)

    def _run(self, name: str, process: Process, work: Callable[[str, Process], None]) -> None:
        try:
            work(name, process)
        except ColocError as error:
            self.errors.append(f"{1e-9 * self._scheduler.now:.2f} s: {name}: {error}")
        except Exception as error:
            self.crashes.append(f"{name} crashed: {error!r}")
        self._scheduler.call_in(0.0, lambda: self._ended(name, process))

    def _ended(self, name: str, process: Process) -> None:
        """Start a program again that has ended by itself; its threads end with it."""
        self._scheduler.kill(process)
        if self.state is None:
            self._scheduler.call_in(RESTART, lambda: self.start(name))

    def _robot(self, name: str, process: Process) -> None:
        scheduler, field = self._scheduler, self._field
        host = self.hosts[name]

        def wheels(port: str, model: int | None, *, robot: str, epoch: float) -> Create:
            return Create(
                port, model, robot=robot, epoch=epoch, open_line=field.open_line(name, process), exit_hooks=False
            )

        program = RobotProgram(
            name,
            self._team,
            connect="tcp/127.0.0.1:7447",
            folder=self.folder / "robots",
            camera="world:simulated",
            wheels=name,
            model=2,
            clock=lambda: host.clock(scheduler.now) + self.jumps[name],
            devices=Devices(field.open_camera(process), detector, wheels, self._network.open(process, name)),
        )
        with program:
            program.run(Event(scheduler))  # type: ignore[arg-type]

    def _coordinate(self, name: str, process: Process) -> None:
        folder = self.folder / "mission"
        coordinator = Coordinator(
            self._team,
            folder,
            self.options,
            resume=(folder / "run.mcap").exists(),
            open_session=self._network.open(process, None),
            on_stance=self._watcher.take_stance,
            on_plan=self._watcher.take_plan,
        )
        self.coordinator = coordinator
        with coordinator:
            self._watcher.watch_coordinator(coordinator)
            state = coordinator.run(Event(self._scheduler))  # type: ignore[arg-type]
        self.state = state
