"""The coordinator of a team in the field: who moves when, what is a stance, and what it says; `Coordinator`."""

import contextlib
import json
import logging
import math
import queue
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from coloc_graph.errors import ColocError, InputError, RobotError
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.measurements import Sighting
from coloc_graph.online.bumps import displaced, pushed
from coloc_graph.online.commands import Commander, Stopped
from coloc_graph.online.estimation_worker import Measuring
from coloc_graph.online.formation import STAGGER, Course, Formation, Planar
from coloc_graph.online.mission import Heard, MissionOptions, in_world
from coloc_graph.online.mission_folder import MissionFolder
from coloc_graph.online.mission_states import Change, Phase, Phases
from coloc_graph.online.robot_registry import Member, Roster
from coloc_graph.online.visibility import InView, Precision
from coloc_graph.pipeline.incremental import EnteredStance, StanceSolver
from coloc_graph.robot_io.link.coordinator_link import CoordinatorLink
from coloc_graph.robot_io.link.messages import Body, Capture, EndCapture, Event, Halt, Recover, Sample, Status, Wheels
from coloc_graph.robot_io.link.zenoh_config import Tls
from coloc_graph.run import Detections, Run, Stance
from coloc_graph.run.schemas import to_ns, to_seconds
from coloc_graph.team import Team

log = logging.getLogger(__name__)

#: How often is looked what is to be done, while all wait for the estimate too, and how often a stance's precision [s].
TICK = 0.03
SOON = 0.004
JUDGED = 0.7
#: Before a stance begins, all have stood for this long [s]; it ends so much after what was seen last in it.
SETTLED = 0.25
MARGIN = 0.02
#: How long things may take at most [s]: a drive, to find the mover, to get the last images, to be mended.
DRIVE_TIME = 40.0
LOOK_TIME = 4.0
COLLECT_TIME = 30.0
HOLD_TIME = 120.0
#: Each image moves where the mover is thought to be by this share towards where it is seen.
FOLLOWED = 0.1
#: The mover may be out of a view for so long before it turns back [s].
OUT_OF_VIEW = 0.6


class Coordinator:
    """Leads a team along its goals; a context manager, at whose end all stand.

    Writes into `folder`: run.mcap, the record, and mission.jsonl, what happened when. With `resume` it goes on where a
    coordinator left off there. `entered` hears of each stance, `heard` ten times a second of where all are.
    Raises `InputError` where the mission cannot begin.
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
        entered: Callable[[EnteredStance], None] | None = None,
        heard: Callable[[Heard], None] | None = None,
    ) -> None:
        self.team, self.folder = team, Path(folder)
        self.options = options or MissionOptions()
        self.mover = self.options.mover or team.names[-1]
        if team[self.mover].markers is None:
            raise InputError(f"{self.mover} is to move and has no markers: give it some, or name another with --mover")
        self.observers = tuple(name for name in team.names if name != self.mover)
        if len(self.observers) < 2 or team.reference not in self.observers:
            raise InputError(
                f"a mission needs two robots that watch {self.mover}, and the reference {team.reference} among them"
            )
        self._entered, self._heard = entered, heard
        starts, points = in_world(team, self.mover, self.options.goals)
        self.formation = Formation(Course(points), self.observers)
        self._inbox: queue.SimpleQueue[tuple[str, object]] = queue.SimpleQueue()
        self.solver = StanceSolver(team, self.options.solve)
        with contextlib.ExitStack() as undo:
            # the folder and the port are taken before anything of an earlier mission is touched
            held = undo.enter_context(MissionFolder(folder, resume=resume))
            link = CoordinatorLink(
                team,
                listen=listen,
                tls=tls,
                exposed=exposed,
                on_sample=lambda name, one: self._inbox.put((name, one)),
                on_wheels=lambda name, one: self._inbox.put((name, one)),
                on_event=lambda name, one: self._inbox.put((name, one)),
                on_status=lambda name, one: self._inbox.put((name, one)),
                on_presence=lambda name, there: self._inbox.put((name, there)),
            )
            self.link = undo.enter_context(link)
            record, self._before = held.open_record(team)
            self.record = undo.enter_context(record)
            epoch = time.time_ns() - time.monotonic_ns()
            if self._before is not None:
                epoch = max(epoch, to_ns(record.newest()) - time.monotonic_ns())  # time does not run backwards
            self._log = undo.enter_context(held.log_path.open("a", encoding="utf-8"))
            self.phases = Phases(self._note_phase)
            self.roster = Roster(record, starts, lambda name: link.clocks[name].to_coordinator, epoch)
            self._close = undo.pop_all()
        self._tries = self._rounds = 0
        self._capturing = time.time_ns() // 1_000_000  # no number twice, of whatever coordinator
        self._plan: tuple[int, str, Planar] | None = None  # the leap into a stance: its number, who, where to
        self._patrol = np.zeros((0, 2))
        self._awaited: Planar = (0.0, 0.0, 0.0)  # where the mover's wheels have it when a stance begins
        self._stance: Stance | None = None
        self._view: InView | None = None
        self._expected: dict[str, int] = {}
        self._out_since: float | None = None
        self._set_off = False  # whether the mover has, in the stance that goes on
        self._judged = self._told = 0.0
        self._precision: Precision | None = None
        self._measuring = Measuring(record, self.solver)
        self._ended_at = 0.0
        self._in: list[Stance] = []
        self._latencies: list[float] = []
        self._commander = Commander(
            link, self.roster, self.options.speed, lambda name: self._note("drives on", robot=name)
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._commander.halt_all()
        self._measuring.end()
        self._close.__exit__(kind, error, trace)

    @property
    def stances(self) -> int:
        """How many stances are in."""
        return len(self._in)

    @property
    def latencies(self) -> tuple[float, ...]:
        """Of each stance, from its last image to the estimate [s]."""
        return tuple(self._latencies)

    def run(self, stop: threading.Event) -> Phase:
        """Lead the team until it is done, has failed, or `stop` is set; the last phase comes back."""
        steps = {
            Phase.GATHERING: self._gather,
            Phase.SYNCHRONISING: self._synchronise,
            Phase.PLACING: self._place,
            Phase.LOOKING: self._look,
            Phase.CAPTURING: self._capture,
            Phase.TURNING_BACK: self._capture,
            Phase.COLLECTING: self._collect,
            Phase.ESTIMATING: self._estimate,
            Phase.HOLDING: self._hold,
        }
        self._commander.stop = stop
        if self._before is not None:
            self._go_on(self._before, stop)
        while self.phases.now in steps and not stop.is_set():
            self._listen()
            try:
                trouble = self._trouble()
                if trouble is None:
                    steps[self.phases.now]()
                else:
                    self._hold_on(trouble)
            except Stopped:
                break
            except ColocError as error:
                self._hold_on(str(error))
            self._tell()
        self._commander.halt_all()
        return self.phases.now

    # what comes in

    def _listen(self) -> None:
        """Take in all that came, or wait a little for something."""
        self._commander.renew()
        until = time.monotonic() + (SOON if self.phases.now in (Phase.COLLECTING, Phase.ESTIMATING) else TICK)
        while True:
            try:
                name, one = self._inbox.get(timeout=max(until - time.monotonic(), 0.001))
            except queue.Empty:
                return
            self._take(self.roster[name], one)
            self._commander.renew()
            if time.monotonic() > until + 10 * TICK:
                return

    def _take(self, member: Member, one: object) -> None:
        match one:
            case Sample():
                seen = self.roster.take_sample(member.name, one)
                if seen is not None and one.capture == self._capturing and self._stance is not None:
                    member.samples, member.newest = member.samples + 1, seen.time
                    if self._view is not None:
                        self._follow(self._view, seen)
            case Wheels():
                self.roster.take_wheels(member.name, one)
            case Status():
                if member.take_status(one):
                    self._note("session", robot=member.name, session=one.session)
                self.record.moves(member.name, self.roster.utc(time.monotonic_ns()), one.moving)
            case Event():
                self._note("event", robot=member.name, kind=one.kind, text=one.text)
                member.arrived |= member.way is not None and (one.kind, one.text) == ("arrived", str(member.way.number))
                member.stopped |= one.kind in ("stopped", "fault")
            case bool():
                member.present = one
                self._note("presence", robot=member.name, there=one)

    def _follow(self, view: InView, seen: Detections) -> None:
        """Where the mover is thought to be follows what is seen of it: its wheels lose their way within a minute."""
        whereabouts = self.roster[self.mover].whereabouts
        thought = whereabouts.place(seen.time)
        found = view.find(seen, thought)
        if found is not None:
            off = [FOLLOWED * (a - b) for a, b in zip(found, thought, strict=True)]
            thought = thought[0] + off[0], thought[1] + off[1], thought[2] + off[2]
            whereabouts.fix(seen.time, thought)
        view.take(seen, thought)

    # the phases

    def _gather(self) -> None:
        waits = self._waits_for()
        if waits is None:
            self._enter(Phase.SYNCHRONISING)

    def _synchronise(self) -> None:
        late = [name for name in self.team.names if not self.link.synchronised(name, self.options.clock_limit)]
        if not late:
            self._plan_stance()
            self._enter(Phase.PLACING)
        elif self._phase_lasted(HOLD_TIME):
            self._fail(f"the clocks of {', '.join(late)} are not known to {1e3 * self.options.clock_limit:g} ms")

    def _plan_stance(self) -> None:
        """Who leaps where, and the mover's way; robots set off."""
        k = self._next_index()
        places = self.roster.places()
        if self._plan is None or self._plan[0] != k:
            self._plan = (k, *self._next_leap(places)) if self.stances else None
        if self._plan is not None:
            _, leaper, to = self._plan
            places[leaper] = to
        standing = {name: places[name] for name in self.observers}
        self._view = InView(self.team, self.mover, standing)
        markers = self.team[self.mover].markers
        assert markers is not None
        left = bool((k + self._tries) % 2)
        self._patrol = self.formation.patrol(standing, list(self._view.views.values()), markers.p_body, left)
        for member in self.roster.members.values():
            member.arrived, member.way = True, None
        if self._plan is not None:
            self._commander.drive(leaper, [to[:2]], to[2], backwards=False)
        self._commander.drive(self.mover, self._patrol[:1])

    def _next_leap(self, places: dict[str, Planar]) -> tuple[str, Planar]:
        """Who leaps, and where to: one that has left its place already, under an earlier coordinator, goes on."""
        since = self._in[-1].end
        left = [name for name in self.observers if self.roster[name].whereabouts.moved_since(since)]
        if not left:
            return self.formation.next_leap(places)
        ways = self.formation.ways(places)
        front = max(way for name, way in ways.items() if name != left[0])
        return left[0], self.formation.place(left[0], front + STAGGER)

    def _place(self) -> None:
        self._commander.drive_on()
        if not all(member.arrived for member in self.roster.members.values()):
            if self._phase_lasted(DRIVE_TIME):
                raise RobotError(
                    f"{self._under_way()} did not arrive within {DRIVE_TIME:.0f} s: see what is in the way"
                )
            return
        if not self._stood(SETTLED):
            return
        k = self._next_index()
        now = self.roster.utc(time.monotonic_ns())
        standing = {name: self.roster[name].whereabouts.place() for name in self.observers}
        self._view = InView(self.team, self.mover, standing)
        self._stance = Stance(k, now, now, self.observers, (self.mover,), self._anchors())
        self._awaited = self.roster[self.mover].whereabouts.place()
        self._rounds, self._out_since, self._judged, self._precision = 0, None, time.monotonic(), None
        self._set_off = False
        self._measuring.forget()
        self._capturing += 1
        for name in self.observers:
            self.roster[name].samples = 0
            self._commander.ask(name, Capture(capture=self._capturing))
        self._enter(Phase.LOOKING)

    def _look(self) -> None:
        assert self._view is not None and self._stance is not None
        missing = self._view.missing()
        if not missing:
            self._commander.drive(self.mover, self._patrol[1:])
            self._enter(Phase.CAPTURING)
        elif self._phase_lasted(LOOK_TIME):
            self._note_bumped(displaced(self.roster, self._view, self._awaited))
            raise RobotError(
                f"{' and '.join(missing)} saw nothing of {self.mover} where it should be: put the robots where they "
                "are said to stand, clear what is between them, and check that its lights are on"
            )

    def _capture(self) -> None:
        assert self._view is not None and self._stance is not None
        now = time.monotonic()
        if not self._set_off:
            # a stance begins when its mover sets off: what it is seen to do before counts many times over
            status = self.roster[self.mover].status
            self._set_off = status is not None and status.still_since is None
            if not self._set_off and self._phase_lasted(LOOK_TIME):
                raise RobotError(f"{self.mover} did not set off: see what holds it")
            self._stance = replace(self._stance, start=self.record.rounded(self.roster.utc(time.monotonic_ns())))
        missing = self._view.missing()
        if not missing:
            self._out_since = None
            if self.phases.now == Phase.TURNING_BACK:
                self._commander.drive(self.mover, self._patrol)
                self._enter(Phase.CAPTURING)
        elif self._out_since is None:
            self._out_since = now
        elif now - self._out_since > OUT_OF_VIEW and self.phases.now == Phase.CAPTURING:
            self._commander.drive(self.mover, self._patrol[-1:])
            self._enter(Phase.TURNING_BACK, f"{self.mover} left the view of {' and '.join(missing)}")
        elif now - self._out_since > DRIVE_TIME / 2:
            raise RobotError(f"{self.mover} did not come back into the view of {' and '.join(missing)}")
        found = self._measuring.judged()
        if found is not None:
            self._precision = found
            if found.suffices(self.options):
                self._end_capture("it is enough")
                return
        left = self._stance.start + self.options.longest - self.roster.utc(time.monotonic_ns())
        if not self._measuring.judging and now - self._judged > JUDGED < left:  # what is measured last waits for none
            self._judged = now
            self._measuring.judge(replace(self._stance, end=self._last_image()))
        self._commander.drive_on()
        if self.roster[self.mover].arrived and self.phases.now == Phase.CAPTURING:
            self._rounds += 1
            order = self._patrol[::-1] if self._rounds % 2 else self._patrol
            self._commander.drive(self.mover, order)
        if left < 0:
            self._end_capture(f"{self.options.longest:g} s are over")

    def _end_capture(self, why: str) -> None:
        orders: dict[str, Body] = {self.mover: Halt(), **dict.fromkeys(self.observers, EndCapture())}
        said = self._commander.ask_each(orders)
        self._expected = {name: int(said[name] or 0) for name in self.observers}
        self._enter(Phase.COLLECTING, why)

    def _collect(self) -> None:
        if any(self.roster[name].samples < expected for name, expected in self._expected.items()):
            if self._phase_lasted(COLLECT_TIME):
                raise RobotError(f"not all images of stance {self._next_index()} came within {COLLECT_TIME:.0f} s")
            return
        self._measure()

    def _measure(self) -> None:
        """Have the stance measured and entered."""
        assert self._stance is not None
        self._enter(Phase.ESTIMATING)
        self._ended_at = self._last_image()
        end = self.record.rounded(self._ended_at + MARGIN)
        stance = replace(self._stance, end=end, anchors=self._anchors())
        self._measuring.enter(stance)

    def _estimate(self) -> None:
        one = self._measuring.entered()
        if one is None:
            return
        if not isinstance(one, EnteredStance):
            self._note_bumped(pushed(self.roster, one))
            return
        stance = one.stance
        self.record.complete(stance)
        self._in.append(stance)
        latency = self.roster.utc(time.monotonic_ns()) - self._ended_at
        self._latencies.append(latency)
        self._fix(one)
        self._note(
            "entered",
            stance=stance.index,
            anchors=stance.anchors,
            latency=round(latency, 4),
            points=min((len(p.correspondences) for p in one.pairs if p.correspondences is not None), default=0),
            poses={name: np.round(pose.matrix(), 12).tolist() for name, pose in one.estimate.poses.items()},
            refused=[str(refusal.measurement) for refusal in one.estimate.refused],
        )
        if self._entered is not None:
            self._entered(one)
        self._tries, self._stance, self._view = 0, None, None
        if self._arrived_at_goal():
            self._enter(Phase.DONE, f"{self.stances} stances")
        else:
            self._plan_stance()
            self._enter(Phase.PLACING)

    def _note_bumped(self, found: Iterable[tuple[str, str]]) -> None:
        """Of robots that were pushed; it voids a stance (`RobotError`), in the next of which they are no anchors."""
        said = dict(found)
        for robot, text in said.items():
            self._note("bumped", robot=robot, text=text)
        if said:
            raise RobotError("; ".join(said.values()))

    def _fix(self, one: EnteredStance) -> None:
        """Where the robots are follows the estimate."""
        seen = {m.seen: m.time for m in one.measurements if isinstance(m, Sighting)}
        for name, pose in one.estimate.poses.items():
            if name in one.stance.observers or name in seen:
                T = pose.matrix()
                place = float(T[0, 3]), float(T[1, 3]), math.atan2(T[1, 0], T[0, 0])
                self.roster[name].whereabouts.fix(seen.get(name, one.stance.start), place)

    def _hold(self) -> None:
        waits = self._waits_for()
        if waits is None:
            self._enter(Phase.SYNCHRONISING)
        elif self._phase_lasted(HOLD_TIME):
            self._fail(f"nothing has changed for {HOLD_TIME:.0f} s: {waits}")

    def _hold_on(self, why: str) -> None:
        """Stop everything until it is mended; the stance that was under way is void, and tried again."""
        self._stance = self._view = None
        self._tries += 1
        if self._tries >= self.options.attempts:
            self._fail(f"{self._tries} attempts of stance {self._next_index()} went wrong, the last one: {why}")
            return
        self._enter(Phase.HOLDING, why)
        self._commander.halt_all()

    def _fail(self, why: str) -> None:
        self._enter(Phase.FAILED, why)

    # what is asked

    def _trouble(self) -> str | None:
        """Why what is under way cannot go on."""
        if self.phases.now in (Phase.GATHERING, Phase.SYNCHRONISING, Phase.HOLDING, Phase.COLLECTING, Phase.ESTIMATING):
            return None  # all stand, and wait
        for name, member in self.roster.members.items():
            drives = name == self.mover or (self._plan is not None and self._plan[1] == name)
            why = member.trouble(drives=drives)
            if why is None and not self.link.synchronised(name, self.options.clock_limit):
                why = f"the clock of {name} jumped, or is not known to {1e3 * self.options.clock_limit:g} ms any more"
            if why is not None:
                return why
        if self._stance is not None:
            moved = [n for n in self.observers if self.roster[n].whereabouts.moved_since(self._stance.start)]
            if moved:
                return f"{' and '.join(moved)} moved during stance {self._stance.index}"
        return None

    def _waits_for(self) -> str | None:
        """What keeps all from beginning; robots that stopped for a reason are asked to go on, now and then."""
        for name, member in self.roster.members.items():
            why = member.trouble(drives=True)
            if why is not None:
                fault = member.status is not None and member.status.fault
                if fault and member.present and time.monotonic() - self._judged > 1.0:
                    self._judged = time.monotonic()
                    with contextlib.suppress(RobotError):
                        self._commander.ask(name, Recover())
                return why
            if not member.whereabouts.known:
                return f"the wheels of {name} have said nothing yet"
        return None if self._phase_lasted(0.5) else "a moment"

    def _anchors(self) -> tuple[str, ...]:
        """Who watched in the stance before and, by its wheels, has stood since."""
        if not self.stances:
            return ()
        before = self._in[-1]
        return tuple(
            name
            for name in self.observers
            if name in before.observers and not self.roster[name].whereabouts.moved_since(before.end)
        )

    def _stood(self, seconds: float) -> bool:
        """Whether all robots have stood for so long."""
        for member in self.roster.members.values():
            since = member.status.still_since if member.status is not None else None
            if since is None or time.monotonic_ns() - member.to_coordinator(since) < seconds * 1e9:
                return False
        return True

    def _last_image(self) -> float:
        return max(self.roster[name].newest for name in self.observers)

    def _next_index(self) -> int:
        return self._in[-1].index + 1 if self._in else 0

    def _arrived_at_goal(self) -> bool:
        if self.options.stances is not None and self.stances >= self.options.stances:
            return True
        reached = self.formation.progress({n: self.roster[n].whereabouts.place() for n in self.observers})
        return reached >= self.formation.course.length - STAGGER / 2

    def _under_way(self) -> str:
        return " and ".join(name for name, member in self.roster.members.items() if not member.arrived)

    def _phase_lasted(self, seconds: float) -> bool:
        return time.monotonic() - self.phases.since > seconds

    # what is noted

    def _enter(self, phase: Phase, why: str = "") -> None:
        self.phases.enter(phase, self._next_index(), why)

    def _note_phase(self, change: Change) -> None:
        self._note("phase", phase=str(change.phase), stance=change.stance, why=change.why)

    def _note(self, what: str, **more: object) -> None:
        row = {"time": to_seconds(time.monotonic_ns() + self.roster.epoch), "what": what, **more}
        self._log.write(json.dumps(row) + "\n")
        self._log.flush()

    def _tell(self) -> None:
        """Tell who listens where all are, ten times a second."""
        now = time.monotonic()
        if self._heard is None or now - self._told < 0.1:
            return
        self._told = now
        T = {name: floor_pose(*place) for name, place in self.roster.places().items()}
        note = f"stance {self._next_index()}: {self.phases.now}"
        if self.phases.now in (Phase.CAPTURING, Phase.TURNING_BACK) and self._precision is not None:
            found = self._precision
            note += f", {found.points} points"
            if not found.why:
                note += f", {1e3 * found.place:.1f} mm, {math.degrees(found.heading):.2f} deg"
        self._heard(Heard(self.roster.utc(time.monotonic_ns()), T, note))

    def _go_on(self, before: Run, stop: threading.Event) -> None:
        """Enter the stances of a run that ended, and find where the robots are."""
        self.roster.go_on()
        for stance in before.stances:
            if stop.is_set():
                return
            self._fix(self.solver.enter(before, stance))
            self._in.append(stance)
        self._note("resumed", stances=len(before.stances))
        log.info("goes on after %d stances", len(before.stances))
