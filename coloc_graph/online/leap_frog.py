"""The mission itself, state by state: who moves when, what is a stance, and when all must stand; `LeapFrog`."""

import contextlib
import math
from collections.abc import Callable, Iterable
from dataclasses import replace

from coloc_graph.errors import ColocError, RobotError, RunError
from coloc_graph.geometry.se2 import Planar
from coloc_graph.machine import machine
from coloc_graph.online.bumps import displaced, pushed
from coloc_graph.online.commands import Commander, Stopped
from coloc_graph.online.decision_worker import DecisionWorker
from coloc_graph.online.estimation_worker import EstimationWorker
from coloc_graph.online.journal import row_of, row_of_entered
from coloc_graph.online.leap_end import TurnToDrive, turn_to_drive
from coloc_graph.online.leap_planner import Situation, StancePlan, StancePlanner
from coloc_graph.online.mission import MissionOptions, roles
from coloc_graph.online.mission_log import MissionLog
from coloc_graph.online.mission_states import NEXT_STATES, WAITING, MissionState, StateChange, StateMachine
from coloc_graph.online.proximity import too_near
from coloc_graph.online.robot_registry import RobotRegistry
from coloc_graph.online.stance_attempt import OUT_OF_VIEW, StanceAttempt
from coloc_graph.online.visibility import InView
from coloc_graph.pipeline.incremental import EnteredStance
from coloc_graph.robot_io.link.messages import Body, Capture, EndCapture, Halt, Recover
from coloc_graph.run import Detections, Stance
from coloc_graph.team import Team

SETTLED = 0.25  # all robots have stood for this time before a stance begins [s]
MARGIN = 0.02  # a stance ends this long after its last image [s]
DRIVE_TIME = 40.0  # longest time of a drive [s]
GLANCE_TIME = 1.0  # the mover is sent to the middle of the views if it is not seen for this time where it begins [s]
LOOK_TIME = 4.0  # longest time to see the mover, and for it to set off [s]
COLLECT_TIME = 30.0  # longest time until the last images have come [s]
HOLD_TIME = 120.0  # longest time until what is wrong is put right [s]
CALM = 0.5  # robots are well for this time before the mission goes on [s]
RECOVER_PERIOD = 1.0  # robots that stopped for a reason are told to recover after this time [s]


class LeapFrog:
    """The states of a mission, one `step` at a time. It needs no network: robots are a registry and a commander.

    Parameters
    ----------
    team, options
        The team, and the mission's goals and limits.
    planner, decisions
        Planner of the stances, and its thread.
    registry, commander, worker, log
        States of the robots, commands to them, the estimator's thread, and the mission's log.
    synchronised
        Returns whether a robot's clock is known well enough.
    on_stance, on_plan
        Called with each stance that has entered the estimate, and with each plan.
    """

    def __init__(
        self,
        team: Team,
        options: MissionOptions,
        planner: StancePlanner,
        *,
        decisions: DecisionWorker,
        registry: RobotRegistry,
        commander: Commander,
        worker: EstimationWorker,
        log: MissionLog,
        synchronised: Callable[[str], bool],
        on_stance: Callable[[EnteredStance], None] | None = None,
        on_plan: Callable[[StancePlan], None] | None = None,
    ) -> None:
        self._team, self._options, self._planner = team, options, planner
        self._decisions = decisions
        self._registry, self._commander, self._worker, self._log = registry, commander, worker, log
        self._synchronised, self._on_stance, self._on_plan = synchronised, on_stance, on_plan
        self.mover, self.observers = roles(team, options.mover)
        self.stances: list[Stance] = []
        self.latencies: list[float] = []
        self.attempt: StanceAttempt | None = None
        self.states = StateMachine(self._note_state)
        self._plan: StancePlan | None = None
        self._leap: tuple[str, Planar] | None = None  # a leap that is still to be commanded
        self._turned = False  # the observer that leapt has been turned to the drive
        self._failures = 0  # attempts at the present stance that failed
        self._missing: tuple[str, ...] = ()  # observers that did not see the mover in the last attempt
        self._captures = machine.time_ns() // 1_000_000  # capture numbers are unique across coordinators
        self._recovered = -math.inf
        self._steps = {
            MissionState.GATHERING: self._gather,
            MissionState.SYNCHRONISING: self._synchronise,
            MissionState.PLANNING: self._await_plan,
            MissionState.PLACING: self._place,
            MissionState.LOOKING: self._look,
            MissionState.CAPTURING: self._capture,
            MissionState.TURNING_BACK: self._capture,
            MissionState.COLLECTING: self._collect,
            MissionState.ESTIMATING: self._estimate,
            MissionState.HOLDING: self._hold,
        }

    @property
    def ended(self) -> bool:
        """True once the mission is done or has failed."""
        return not NEXT_STATES[self.states.now]

    def step(self) -> None:
        """Do what the present state asks for now. What goes wrong voids the stance, and all robots hold.

        Raises
        ------
        Stopped
            If the mission is told to stop while it waits for a robot's answer.
        RunError
            If the disk refuses the record or the log.
        """
        try:
            trouble = self._trouble()
            if trouble is None:
                self._steps[self.states.now]()
            else:
                self._void(trouble)
        except (Stopped, RunError):  # a record or a log that cannot be written ends the mission
            raise
        except ColocError as error:
            self._void(str(error))

    def take_image(self, capture: int, seen: Detections) -> None:
        """Take in the detections of an image that an observer took for a capture."""
        if self.attempt is not None:
            self.attempt.take(capture, seen, self._registry[self.mover].tracker)

    def describe(self) -> str:
        """Describe the present state in one line for people."""
        text = f"stance {self._index}: {self.states.now}"
        if self.states.now in (MissionState.CAPTURING, MissionState.TURNING_BACK) and self.attempt is not None:
            text += "" if self.attempt.precision is None else f", {self.attempt.precision}"
        return text

    # states

    def _gather(self) -> None:
        if self._waits_for() is None:
            self._enter(MissionState.SYNCHRONISING)

    def _synchronise(self) -> None:
        late = [name for name in self._team.names if not self._synchronised(name)]
        if not late:
            self._begin_plan()
        elif self.states.lasted(HOLD_TIME):
            self._fail(f"the clocks of {', '.join(late)} are not known to {1e3 * self._options.clock_limit:g} ms")

    def _begin_plan(self) -> None:
        """Have the next stance planned."""
        anchors = self._anchors()
        moved = tuple(name for name in self.observers if self.stances and name not in anchors)
        self._decisions.decide(Situation(self._index, self._failures, self._registry.poses(), moved, self._missing))
        self._enter(MissionState.PLANNING)

    def _await_plan(self) -> None:
        """Send the robots off once the next stance is planned."""
        plan = self._decisions.decided()
        if plan is None:
            return
        if plan.leap is not None and self._anchors() == (plan.leap[0],):
            raise RobotError(f"{plan.leap[0]} is not sent off: no other observer stands where it stood before")
        self._plan, self._leap, self._turned = plan, plan.leap, False
        for robot in self._registry.robots.values():
            robot.arrived, robot.drive = True, None
        self._log.note("planned", **plan.as_row())
        if self._on_plan is not None:
            self._on_plan(plan)
        self._send_leaper()
        self._commander.send_off(self.mover, plan.placing, leaving=self._leap and self._leap[0])
        self._enter(MissionState.PLACING)

    def _send_leaper(self) -> None:
        """Send off the observer that is to leap, unless it is on its way, or the mover is in its way."""
        if self._leap is not None and self._plan is not None:
            leaper, (x, y, yaw) = self._leap
            arrived = self._registry[self.mover].arrived and self._registry[self.mover].drive is not None
            poses = self._registry.poses((leaper, self.mover))
            if not arrived and not self._plan.may_leap(poses[leaper], poses[self.mover]):
                return
            self._leap = None
            way, leaving = [*self._plan.detour, (x, y)], None if arrived else self.mover
            self._commander.send_off(leaper, way, yaw, backwards=False, leaving=leaving)

    def _place(self) -> None:
        self._commander.resume_drives()
        self._send_leaper()
        under_way = [name for name, robot in self._registry.robots.items() if not robot.arrived]
        if under_way:
            if self.states.lasted(DRIVE_TIME):
                raise RobotError(
                    f"{' and '.join(under_way)} did not arrive within {DRIVE_TIME:.0f} s: see what is in the way"
                )
        elif self._registry.stood(SETTLED):
            self._begin_attempt()

    def _begin_attempt(self) -> None:
        assert self._plan is not None
        now, watching = self._registry.utc(), self._plan.watching
        self._captures, self._missing = self._captures + 1, ()
        self.attempt = StanceAttempt(
            Stance(self._index, now, now, watching, (self.mover,), self._anchors()),
            InView(self._team, self.mover, self._registry.poses(self.observers), watching),
            self._captures,
            self._plan.patrol,
            self._registry[self.mover].tracker,
        )
        self._worker.forget()
        for name in watching:
            self._commander.ask(name, Capture(capture=self._captures))
        self._enter(MissionState.LOOKING)

    def _look(self) -> None:
        attempt = self._attempted()
        missing, mover = attempt.view.missing(), self._registry[self.mover]
        if not self._turned and (turn := turn_to_drive(self._team, attempt.view, self._plan, mover.tracker.pose())):
            self._turn(turn)
        elif not missing:
            self._commander.send_off(self.mover, attempt.whole_round() if attempt.to_middle else attempt.first_round())
            self._enter(MissionState.CAPTURING)
        elif not attempt.to_middle and self.states.lasted(GLANCE_TIME):
            # a leap that ended some degrees off shows less of the border, but the middle
            attempt.to_middle = True
            self._commander.drive(self.mover, attempt.way_back())
        elif mover.arrived and self._registry.stood(LOOK_TIME):
            self._missing = tuple(missing)
            self._note_bumped(displaced(self._registry, attempt.view, attempt.by_wheels(mover.tracker)))
            raise RobotError(
                f"{' and '.join(missing)} did not see {self.mover} where it should be: put the robots where they "
                "are said to stand, clear what is between them, and check that its lights are on"
            )

    def _turn(self, turn: TurnToDrive) -> None:
        """Turn the observer that leapt to the drive."""
        self._turned, self.attempt = True, None
        self._registry[turn.robot].tracker.displace(self._registry.utc(), turn.place)
        self._commander.drive(turn.robot, [turn.place[:2]], turn.yaw, backwards=False)
        self._enter(MissionState.PLACING, str(turn))

    def _capture(self) -> None:
        attempt = self._attempted()
        if not attempt.set_off:
            # a stance begins when its mover sets off: images of it standing would weigh too much
            status = self._registry[self.mover].status
            attempt.set_off = status is not None and status.still_since is None
            if not attempt.set_off and self.states.lasted(LOOK_TIME):
                raise RobotError(f"{self.mover} did not start moving within {LOOK_TIME:g} s: check what blocks it")
            attempt.begin(self._registry.record.rounded(self._registry.utc()))
        self._keep_in_view(attempt)
        if (found := self._worker.judged()) is not None:
            attempt.precision = found
            lasted = self._registry.utc() - attempt.stance.start
            if self._plan is not None and (reason := self._plan.ends(found, lasted, self._options)):
                self._end_capture(reason)
                return
        left = attempt.stance.start + self._options.longest - self._registry.utc()
        if not self._worker.judging and (stance := attempt.to_judge(left)) is not None:
            self._worker.judge(stance)
        self._commander.resume_drives()
        if self._registry[self.mover].arrived and self.states.now == MissionState.CAPTURING:
            self._commander.drive(self.mover, attempt.next_round())
        if left < 0:
            self._end_capture(f"{self._options.longest:g} s are over")

    def _keep_in_view(self, attempt: StanceAttempt) -> None:
        """Send the mover back where it has left an observer's view."""
        missing = attempt.view.missing()
        seconds = attempt.out_of_view(bool(missing))
        if not missing:
            if self.states.now == MissionState.TURNING_BACK:
                self._commander.drive(self.mover, attempt.whole_round())
                self._enter(MissionState.CAPTURING)
        elif seconds > OUT_OF_VIEW and self.states.now == MissionState.CAPTURING:
            self._commander.drive(self.mover, attempt.way_back())
            self._enter(MissionState.TURNING_BACK, f"{self.mover} left the view of {' and '.join(missing)}")
        elif seconds > DRIVE_TIME / 2 or (
            self.states.now == MissionState.TURNING_BACK
            and self._registry[self.mover].arrived
            and self._registry.stood(LOOK_TIME)
        ):
            self._missing = tuple(missing)
            raise RobotError(f"{self.mover} did not come back into the view of {' and '.join(missing)}")

    def _end_capture(self, reason: str) -> None:
        attempt = self._attempted()
        commands: dict[str, Body] = {self.mover: Halt(), **dict.fromkeys(attempt.stance.observers, EndCapture())}
        attempt.expect(self._commander.ask_each(commands))
        self._enter(MissionState.COLLECTING, reason)

    def _collect(self) -> None:
        attempt = self._attempted()
        if attempt.complete:
            self._enter(MissionState.ESTIMATING)
            end = self._registry.record.rounded(attempt.last_image + MARGIN)
            stance = replace(attempt.stance, end=end, anchors=self._anchors())
            retake = not self._failures  # what is wrong twice is no accident of the images
            self._log.note("entering", **row_of(stance, self._registry.record.counts, retake))
            self._worker.enter(stance, retake=retake)
        elif self.states.lasted(COLLECT_TIME):
            raise RobotError(f"not all images of stance {self._index} came within {COLLECT_TIME:.0f} s")

    def _estimate(self) -> None:
        one = self._worker.entered()
        if one is None:
            return
        if not isinstance(one, EnteredStance):
            self._note_bumped(pushed(self._registry, one))
            return
        self._registry.record.complete(one.stance)
        self.stances.append(one.stance)
        latency = self._registry.utc() - self._attempted().last_image
        self.latencies.append(latency)
        self._registry.follow(one)
        self._decisions.take(one, self._registry.poses())
        self._log.note("entered", **row_of_entered(one), latency=round(latency, 4))
        # what another attempt cannot cure: clocks and wheels that are wrong
        outliers = [f"the {other.measurement} was rejected: it is {other.reason}" for other in one.estimate.rejected]
        self._log.warn([*one.warnings, *outliers])
        if self._on_stance is not None:
            self._on_stance(one)
        self._failures, self.attempt = 0, None
        if self._at_goal():
            self._enter(MissionState.DONE, f"{len(self.stances)} stances")
        else:
            self._begin_plan()

    def _hold(self) -> None:
        waits = self._waits_for()
        if waits is None:
            self._enter(MissionState.SYNCHRONISING)
        elif self.states.lasted(HOLD_TIME):
            self._fail(f"nothing has changed for {HOLD_TIME:.0f} s: {waits}")

    # what goes wrong

    def _void(self, reason: str) -> None:
        """Stop all robots until what is wrong is put right; the stance is void, and is tried again."""
        self.attempt = None
        self._failures += 1
        if self._failures >= self._options.attempts:
            self._fail(f"{self._failures} attempts at stance {self._index} failed, the last one: {reason}")
            return
        self._enter(MissionState.HOLDING, reason)
        self._commander.halt_all()

    def _fail(self, reason: str) -> None:
        self._enter(MissionState.FAILED, reason)

    def _trouble(self) -> str | None:
        """Describe why the present state cannot go on; None if it can."""
        if self.states.now in WAITING:
            return None
        for name, robot in self._registry.robots.items():
            why = robot.trouble(drives=self._plan is not None and self._plan.drives(name, self.mover))
            if why is None and not self._synchronised(name):
                why = (
                    f"the clock of {name} jumped, or is no longer known to {1e3 * self._options.clock_limit:g} ms: "
                    "it is compared anew"
                )
            if why is not None:
                return why
        if self.attempt is not None:
            start = self.attempt.stance.start
            moved = [name for name in self.observers if self._registry[name].tracker.moved_since(start)]
            if moved:
                return f"{' and '.join(moved)} moved during stance {self.attempt.stance.index}"
        return too_near(self._registry, self._commander.free)

    def _waits_for(self) -> str | None:
        """Describe what keeps the robots from beginning; those that stopped for a reason are told to recover."""
        for name, robot in self._registry.robots.items():
            why = robot.trouble(drives=True)
            if why is not None:
                fault = robot.present and robot.status is not None and robot.status.fault
                if fault and machine.monotonic() - self._recovered > RECOVER_PERIOD:
                    self._recovered = machine.monotonic()
                    with contextlib.suppress(RobotError):
                        self._commander.ask(name, Recover())
                return why
            if not robot.tracker.known:
                return f"no odometry received from {name} yet"
        return None if self.states.lasted(CALM) else "a moment"

    def _note_bumped(self, found: Iterable[tuple[str, str]]) -> None:
        """Note robots that were pushed, if any, and raise `RobotError`: they are no anchors of the next attempt."""
        reasons = dict(found)
        for robot, text in reasons.items():
            self._log.note("bumped", robot=robot, text=text)
        if reasons:
            raise RobotError("; ".join(reasons.values()))

    # the stance

    def _attempted(self) -> StanceAttempt:
        assert self.attempt is not None
        return self.attempt

    @property
    def _index(self) -> int:
        """Number of the stance that is under way."""
        return self.stances[-1].index + 1 if self.stances else 0

    def _anchors(self) -> tuple[str, ...]:
        """Return the observers that had a pose in the stance before and have stood since, by their wheels."""
        posed = [name for one in self.stances[-1:] for name in one.observers + one.anchors]
        names = [name for name in self.observers if name in posed]
        return self._registry.stand_since(self.stances[-1].end, names) if names else ()

    def _at_goal(self) -> bool:
        if self._options.stances is not None and len(self.stances) >= self._options.stances:
            return True
        return self._planner.at_goal(self._registry.poses(self.observers))

    def _enter(self, state: MissionState, reason: str = "") -> None:
        self.states.enter(state, self._index, reason)

    def _note_state(self, change: StateChange) -> None:
        self._log.note("state", state=str(change.state), stance=change.stance, reason=change.reason)
