"""One simulated mission of a seed, with faults, and all that is promised of it checked; `run_mission`."""

import gc
import hashlib
import json
import logging
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import msgspec

from coloc_graph.machine import machine
from coloc_graph.missions.checks import Checks
from coloc_graph.missions.faults import COORDINATOR, NETWORK, Fault, draw_faults
from coloc_graph.missions.field import Field
from coloc_graph.missions.network import Network
from coloc_graph.missions.programs import Programs
from coloc_graph.missions.scheduler import Scheduler
from coloc_graph.missions.system import SimulatedSystem
from coloc_graph.online.mission import MissionOptions, in_world, roles
from coloc_graph.simulation.rig import reference_team, stated_team
from coloc_graph.simulation.simulated_team import FIELD
from coloc_graph.team import Team

FPS = 10.0  # images a second of a simulated camera
PACE = 17.0  # seconds of a mission to the end of a way for each metre, as of `coloc demo`
LIMIT = 1500.0  # simulated time after which a mission must have ended [s]
STATE_PERIOD = 0.02  # time between two looks at the coordinator's state [s]
SPAN = 10.0  # time of a stance in which faults are drawn [s]
MEMORY = "/dev/shm"  # a folder in memory, where there is one


@dataclass(frozen=True)
class Scenario:
    """A mission that one seed decides.

    Attributes
    ----------
    seed
        Seed of all that is drawn.
    stances
        Number of stances.
    faults
        Faults that happen.
    formation
        "paper" or "plan"; see `MissionOptions`.
    way
        Length of a mission that goes to its end, as `coloc demo --online` does [m]; 0 for one of some stances.
    robots
        Number of robots; the last one is the mover.
    """

    seed: int
    stances: int = 6
    faults: tuple[Fault, ...] = ()
    formation: str = "paper"
    way: float = 0.0
    robots: int = 3


@dataclass
class Outcome:
    """Outcome of a simulated mission.

    Attributes
    ----------
    scenario
        The mission.
    state
        Its last state, "" if it did not end.
    violations
        Sentences about promises that were broken.
    seconds
        Simulated time [s].
    cpu
        Time that it took to compute [s].
    digest
        Hash of all files of the mission.
    nees
        Normalised squared errors of observers' positions and headings, and their degrees of freedom.
    ends
        Errors of the observers' last positions [m] and headings [rad].
    attempts, entered
        Number of stances that were planned, and of those that entered the estimate.
    log
        Exceptions of programs.
    """

    scenario: Scenario
    state: str = ""
    violations: list[str] = field(default_factory=list)
    seconds: float = 0.0
    cpu: float = 0.0
    digest: str = ""
    nees: tuple[float, int] = (0.0, 0)
    ends: tuple[tuple[float, float], ...] = ()
    attempts: int = 0
    entered: int = 0
    log: list[str] = field(default_factory=list)


def scenario_of(
    seed: int,
    stances: int = 6,
    formation: str = "paper",
    faults: int | None = None,
    way: float = 0.0,
    robots: int = 3,
) -> Scenario:
    """Return the mission of a seed, with faults that it draws; every fourth has none."""
    count = (seed % 4) * 2 if faults is None else faults
    drawn = draw_faults(seed, mission_team(robots).names, count, SPAN * stances)
    return Scenario(seed, stances, drawn, formation, way, robots)


def mission_team(robots: int = 3) -> Team:
    """Return the team of simulated missions."""
    stated = stated_team(reference_team(names=tuple("ABCDEF"[:robots])), FIELD)
    new = msgspec.structs.replace
    return new(stated, robots=tuple(new(one, camera_if_any=new(one.camera, fps=FPS)) for one in stated.robots))


def run_mission(scenario: Scenario, folder: Path | None = None) -> Outcome:
    """Run a mission on simulated time; its files go into `folder`, into none that stays by default."""
    if folder is None:
        memory = MEMORY if Path(MEMORY).is_dir() else None
        with tempfile.TemporaryDirectory(prefix="coloc-", dir=memory) as temporary:
            return run_mission(scenario, Path(temporary))
    began, level = time.process_time(), logging.root.manager.disable
    scheduler = Scheduler(scenario.seed)
    before = machine.use(SimulatedSystem(scheduler))
    logging.disable(logging.CRITICAL)
    try:
        outcome = _run(scenario, scheduler, folder)
    finally:
        scheduler.close()
        gc.unfreeze()  # the estimator's worker freezes what a mission keeps
        logging.disable(level)
        machine.use(before)
    outcome.cpu = time.process_time() - began
    return outcome


def _run(scenario: Scenario, scheduler: Scheduler, folder: Path) -> Outcome:
    team = mission_team(scenario.robots)
    if scenario.way:
        goals, own = ((scenario.way, 0.0),), {"speed": 0.4, "pace": PACE}
    else:
        goals = ((100.0, 0.0),)
        own = {"stances": scenario.stances, "place_sigma": 0.02, "heading_sigma_deg": 0.8, "least_points": 20}
        own |= {"speed": 0.45, "longest": 3.0}
    options = MissionOptions(goals=goals, formation=scenario.formation, **own)  # type: ignore[arg-type]
    mover, _ = roles(team, None)
    starts, _ = in_world(team, mover, options.goals)
    field_, network = Field(scheduler, team, starts, scenario.seed), Network(scheduler, team.names)
    checks = Checks(scheduler, field_, network, team, mover, scenario.seed)
    programs = Programs(scheduler, network, field_, team, options, folder, checks)
    checks.programs = programs
    for name in (COORDINATOR, *team.names):
        scheduler.call_in(scheduler.random.uniform(0.0, 0.5), partial(programs.start, name))
    for fault in scenario.faults:
        begin = partial(_begin, fault, scheduler, field_, network, programs, checks)
        scheduler.call_in(fault.time, partial(_await_state, fault, scheduler, programs, begin))
    _repeat(scheduler, 0.1, network.watch_silence)
    _repeat(scheduler, 0.02, checks.look)
    ended = scheduler.run(lambda: programs.state is not None, LIMIT)
    outcome = Outcome(scenario, str(programs.state or ""), seconds=1e-9 * scheduler.now, log=programs.errors)
    checks.end(folder / "mission", ended)
    outcome.violations = checks.violations
    outcome.nees, outcome.ends = checks.nees, checks.ends
    outcome.attempts, outcome.entered = (_rows(folder / "mission", what) for what in ("planned", "entered"))
    for process in programs.processes.values():
        scheduler.kill(process)
    outcome.digest = _digest(folder)
    return outcome


def _await_state(fault: Fault, scheduler: Scheduler, programs: Programs, begin: Callable[[], None]) -> None:
    """Let a fault begin once the coordinator is in the state that it waits for."""
    if programs.state is not None:
        return
    if not fault.state:
        begin()
    elif programs.leads_in(fault.state):
        scheduler.call_in(fault.late, begin)
    else:
        scheduler.call_in(STATE_PERIOD, partial(_await_state, fault, scheduler, programs, begin))


def _begin(
    fault: Fault, scheduler: Scheduler, field_: Field, network: Network, programs: Programs, checks: Checks
) -> None:
    """Let a fault begin, and see to its end."""
    if programs.state is not None:
        return
    where, end = fault.where, lambda: None
    process, host = programs.processes.get(where), programs.hosts[where]
    if fault.kind in NETWORK:
        end = _network_fault(fault, network)
    elif fault.kind == "kill":
        if process is not None and process.alive:
            scheduler.kill(process)
            if where == COORDINATOR:
                checks.look_at_record(programs.folder / "mission")
        end = lambda: programs.start(where)  # noqa: E731
    elif fault.kind == "stop" and process is not None:
        scheduler.stop(process)
        end = lambda: scheduler.go_on(process)  # noqa: E731
    elif fault.kind == "hang" and where in programs.mains:
        main = programs.mains[where]
        main.hung = True
        end = lambda: scheduler.unhang(main)  # noqa: E731
    elif fault.kind in ("full", "slow"):
        host.disk_full, host.disk_delay = fault.kind == "full", fault.amount

        def end() -> None:
            host.disk_full, host.disk_delay = False, 0.0

    elif fault.kind == "jump":
        programs.jumps[where] += round(1e9 * fault.amount)
    elif fault.kind in ("unplug", "freeze"):
        which = field_.unplugged if fault.kind == "unplug" else field_.frozen
        which.add(where)
        end = lambda: which.discard(where)  # noqa: E731
    elif fault.kind == "push":
        x, y, yaw = (fault.amount * scheduler.random.uniform(-1, 1) for _ in range(3))
        field_.robots[where].body.push(x, y, 2 * yaw)
        checks.pushed = True
    scheduler.call_in(fault.duration, end)


def _network_fault(fault: Fault, network: Network) -> Callable[[], None]:
    conditions = network.conditions[fault.where]
    if fault.kind == "cut":
        network.cut(fault.where, True)
        return lambda: network.cut(fault.where, False)
    name = {"loss": "loss", "delay": "jitter", "duplication": "duplication"}[fault.kind]
    before = type(conditions)()
    setattr(conditions, name, fault.amount)
    return lambda: setattr(conditions, name, getattr(before, name))


def _repeat(scheduler: Scheduler, period: float, call: Callable[[], None]) -> None:
    def again() -> None:
        call()
        scheduler.call_in(period, again)

    scheduler.call_in(period, again)


def _digest(folder: Path) -> str:
    """Hash of all files of a folder."""
    sum_ = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not path.name.startswith("."):
            sum_.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return sum_.hexdigest()


def _rows(mission: Path, what: str) -> int:
    """Number of rows of a kind in the log of a mission."""
    path = mission / "mission.jsonl"
    return path.read_text(encoding="utf-8").count(f'"what": "{what}"') if path.exists() else 0


def as_json(outcome: Outcome) -> str:
    """Return an outcome as one line of JSON."""
    return json.dumps(msgspec.to_builtins(outcome))
