"""The coordinator's end of the link to its robots; `CoordinatorLink`, docs/link.md.

What robots measure arrives complete and in order, also after a cut; commands are carried out once and in time, or
refused.
"""

import contextlib
import queue
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, Self, TypeVar

import msgspec

from coloc_graph.errors import RobotError
from coloc_graph.machine import machine
from coloc_graph.robot_io.link.clock import ClockFilter
from coloc_graph.robot_io.link.counters import Counts, LinkCounter
from coloc_graph.robot_io.link.messages import (
    MAX_STAMP,
    Body,
    ClockQuestion,
    ClockReply,
    Command,
    Event,
    Halt,
    Hold,
    MessageError,
    Refusal,
    Reply,
    Sample,
    Status,
    Wheels,
    decode,
    encode,
    is_session,
)
from coloc_graph.robot_io.link.recovery import Recovery
from coloc_graph.robot_io.link.robot_inbox import RobotInbox
from coloc_graph.robot_io.link.session import KEPT_KINDS, LinkSession, OpenSession, Take, robot_of, session_of
from coloc_graph.robot_io.link.zenoh_config import Tls
from coloc_graph.team import Team

M = TypeVar("M", bound=msgspec.Struct)
Clock = Callable[[], int]

CLOCK_PERIOD = 0.1  # s between two comparisons of a robot's clock with ours
COMMAND_PERIOD = 0.25  # s, at least, until a command that is not answered is sent again
SESSION_PERIOD = 0.02  # s, the same while the robot's session is not known, or nobody answers its key
WAITING_PERIOD = 0.02  # s, at most, between two calls of `waiting` while answers are awaited


class CoordinatorLink:
    """The coordinator's end of the link; a context manager.

    Callbacks come on the link's threads, one at a time, and must be quick. Messages of a robot are requested once its
    clock is known. They come in order and none twice; `counts.missed` are lost. A robot's program that runs beside
    another of the same name is refused.

    Parameters
    ----------
    team
        Robots that may connect.
    listen
        Address to listen on, tcp/HOST:PORT or tls/HOST:PORT.
    on_sample, on_wheels, on_event, on_status
        Called with a robot's name and a message.
    on_presence
        Called with a robot's name and True when it connects, False when it is gone.
    tls
        Certificates of this end.
    exposed
        Accept connections from other machines without certificates.
    clock
        This machine's monotonic clock [ns].
    open_session
        Opens the session; another than zenoh's in a simulation.

    Attributes
    ----------
    clocks
        `ClockFilter` of each robot, by name.

    Raises
    ------
    InputError
        If the address is not valid, or needs certificates.
    RobotError
        If the address cannot be listened on.
    """

    def __init__(
        self,
        team: Team,
        *,
        listen: str = "tcp/127.0.0.1:7447",
        on_sample: Callable[[str, Sample], None],
        on_wheels: Callable[[str, Wheels], None],
        on_event: Callable[[str, Event], None],
        on_status: Callable[[str, Status], None],
        on_presence: Callable[[str, bool], None],
        tls: Tls | None = None,
        exposed: bool = False,
        clock: Clock = machine.monotonic_ns,
        open_session: OpenSession = LinkSession,
    ) -> None:
        self.team, self._clock = team, clock
        self.clocks = {name: ClockFilter() for name in team.names}
        self._calls: dict[type, Callable[[str, Any], None]] = {
            Sample: on_sample, Wheels: on_wheels, Event: on_event, Status: on_status,
        }  # fmt: skip
        self._on_presence = on_presence
        self._counter = LinkCounter()
        self._lock = machine.new_lock()
        self._inboxes = {name: self._inbox(name) for name in team.names}
        self._ended = machine.new_event()
        self._session = open_session(listen=listen, tls=tls, robots=team.names, exposed=exposed)
        session = self._session
        try:
            self._publishers = {
                (name, kind): session.publisher(f"coloc/{name}/{kind}")
                for name in team.names
                for kind in ("question", "hold", "refusal")
            }
            session.subscribe("coloc/*/status", self._receiver(Status))
            session.subscribe("coloc/*/time", self._take_time, at_once=True)
            for name in team.names:
                for kind, type_ in KEPT_KINDS.items():
                    session.subscribe(f"coloc/{name}/{kind}", self._receiver(type_))
            session.watch("coloc/*/alive/*", self._take_presence)
            session.announce("coloc/coordinator/alive")
        except BaseException:
            session.close()
            raise
        self._clock_thread = machine.new_thread(target=self._compare_clocks, name="clocks")
        self._clock_thread.start()
        receivers = {type_: self._receiver(type_, requested=True) for type_ in KEPT_KINDS.values()}
        self._recoveries = {
            name: Recovery(name, inbox, self._lock, session, receivers) for name, inbox in self._inboxes.items()
        }

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the link."""
        self._ended.set()
        until = machine.monotonic() + 2.0
        self._clock_thread.join(2.0)
        for recovery in self._recoveries.values():
            recovery.end(max(until - machine.monotonic(), 0.0))
        self._session.close()

    @property
    def counts(self) -> Counts:
        """Counts of received and refused messages."""
        return self._counter.counts()

    def synchronised(self, robot: str, limit: float = 1e-3) -> bool:
        """Return whether a robot's clock is known to `limit` [s, one sigma] now."""
        return self.clocks[robot].synchronised(self._clock(), limit)

    def hold(self) -> None:
        """Permit moving robots whose clocks are known to go on moving for a moment."""
        now = self._clock()
        for robot, inbox in self._inboxes.items():
            session = inbox.session
            if session is not None and session == inbox.in_charge and inbox.present and self.clocks[robot].known:
                message = Hold(session=session, sent=self.clocks[robot].to_robot(now))
                self._publishers[robot, "hold"](encode(message))

    def ask(self, robot: str, body: Body, timeout: float, waiting: Callable[[], None] = lambda: None) -> Reply:
        """Have one robot carry out a command; `ask_each` for one robot. Raises `RobotError` if it does not answer."""
        reply = self.ask_each({robot: body}, timeout, waiting)[robot]
        if reply is None:
            what = type(body).__name__
            raise RobotError(
                f"robot {robot} has not answered `{what}` within {timeout:g} s: check its program and network"
            )
        return reply

    def ask_each(
        self, bodies: Mapping[str, Body], timeout: float, waiting: Callable[[], None] = lambda: None
    ) -> dict[str, Reply | None]:
        """Have several robots carry out a command each, at the same time.

        Each command is sent again until it is answered, and is carried out once. After `timeout` the robot refuses it,
        except `Halt` while its clock is not known.

        Parameters
        ----------
        bodies
            The command of each robot, by name.
        timeout
            Time to answer [s].
        waiting
            Called on this thread at least every `WAITING_PERIOD` until all have answered; its exceptions end the wait.

        Returns
        -------
        dict
            The reply of each robot, None for one that did not answer in time.
        """
        until = machine.monotonic() + timeout
        came: queue.Queue[tuple[str, Reply | None]] = machine.new_queue()
        commands: dict[str, Command] = {}
        again = dict.fromkeys(bodies, 0.0)
        replies: dict[str, Reply | None] = dict.fromkeys(bodies)
        while (left := until - (now := machine.monotonic())) > 0 and None in replies.values():
            for robot, body in bodies.items():
                if replies[robot] is None and now >= again[robot]:
                    command = commands.get(robot) or self._command(robot, body, left)
                    again[robot] = now + SESSION_PERIOD
                    if command is None:
                        continue
                    commands[robot] = command
                    if command.session != self._inboxes[robot].session:
                        replies[robot] = Reply(id=command.id, ok=False, text="its program was restarted meanwhile")
                        continue
                    wait = max(min(left, max(COMMAND_PERIOD, timeout / 3)), 0.01)
                    again[robot] = now + wait
                    self._send(robot, command, wait, came)
            waiting()
            with contextlib.suppress(queue.Empty):
                robot, reply = came.get(timeout=max(min(left, WAITING_PERIOD), 0.001))
                if reply is None:  # this query is over, and nobody answered it
                    again[robot] = min(again[robot], machine.monotonic() + SESSION_PERIOD)
                elif reply.id == commands[robot].id:
                    replies[robot] = reply
        return replies

    def _command(self, robot: str, body: Body, left: float) -> Command | None:
        """Command for the robot's current session; None while that, or its clock, is not known."""
        session, clock = self._inboxes[robot].session, self.clocks[robot]
        if session is None or not (clock.known or isinstance(body, Halt)):
            return None
        deadline = clock.to_robot(self._clock() + round(1e9 * left)) if clock.known else MAX_STAMP - 1
        return Command(id=machine.unique(), session=session, deadline=deadline, body=body)

    def _send(
        self, robot: str, command: Command, timeout: float, came: "queue.Queue[tuple[str, Reply | None]]"
    ) -> None:
        """Send a command as a query; the robot's replies, and None at the query's end, are put into `came`."""

        def take(data: bytes) -> None:
            try:
                came.put((robot, decode(data, Reply)))
            except MessageError as error:
                self._counter.refuse(error, f"an answer of {robot}")

        key = f"coloc/{robot}/command/{command.session}"
        self._session.ask(key, encode(command), timeout, take, lambda: came.put((robot, None)))

    def _inbox(self, robot: str) -> RobotInbox:
        return RobotInbox(robot, lambda message: self._calls[type(message)](robot, message), self._counter)

    def _receiver(self, type_: type[M], requested: bool = False) -> Take:
        """Callback that takes in messages of one kind and never raises into the session's threads."""

        def take(key: str, data: bytes) -> None:
            robot = robot_of(key)
            if robot not in self._inboxes:
                self._counter.add("foreign", f"refused a message of `{robot[:40]}`, which is not a robot of the team")
                return
            try:
                message = decode(data, type_)
            except MessageError as error:
                self._counter.refuse(error, f"a {type_.__name__} of {robot}")
                return
            with self._lock:
                inbox = self._inboxes[robot]
                if not isinstance(message, Status):
                    inbox.take(message, data, requested=requested)
                elif message.session == inbox.in_charge:
                    self._counter.add("taken")
                    self._calls[Status](robot, message)
                else:
                    self._counter.add("unknown")

        return take

    def _take_presence(self, key: str, present: bool) -> None:
        robot, session = robot_of(key), session_of(key)
        if robot not in self._inboxes or not is_session(session):
            return
        inbox = self._inboxes[robot]
        with self._lock:
            before = inbox.in_charge, inbox.present
            if present:
                inbox.connect(session, self._clock())
            else:
                inbox.disconnect(session)
            if (inbox.in_charge, inbox.present) == before:
                return
            if before[1]:
                self._on_presence(robot, False)
            if inbox.present:
                self._on_presence(robot, True)

    def _compare_clocks(self) -> None:
        """Thread that asks robots for the time."""
        while not self._ended.wait(CLOCK_PERIOD):
            for robot in [robot for robot, inbox in self._inboxes.items() if inbox.present]:
                self._publishers[robot, "question"](encode(ClockQuestion(asked=self._clock())))

    def _take_time(self, key: str, data: bytes) -> None:
        received, robot = self._clock(), robot_of(key)
        if robot not in self._inboxes:
            self._counter.add("foreign", f"refused the time of `{robot[:40]}`, which is not a robot of the team")
            return
        try:
            reply = decode(data, ClockReply)
            inbox = self._inboxes[robot]
            if reply.session != inbox.in_charge:
                self._counter.add("unknown")
                return
            self.clocks[robot].add(reply.asked, reply.received, reply.sent, received)
        except MessageError as error:
            self._counter.refuse(error, f"the time of {robot}")
        except ValueError as error:
            self._counter.add("malformed", f"refused the time of {robot}: {error}")
        else:
            with self._lock:
                if reply.session == inbox.in_charge:
                    inbox.begin()
                duplicates = inbox.duplicates(reply.asked)
            self._refuse(robot, duplicates)

    def _refuse(self, robot: str, sessions: list[str]) -> None:
        """Tell programs that run beside the one in charge of a robot to end."""
        text = f"another program runs as robot {robot} already: end it first, or give this one its own name"
        for session in sessions:
            self._counter.add("duplicate", f"refused a second program that runs as robot {robot}: end one of them")
            self._publishers[robot, "refusal"](encode(Refusal(session=session, text=text)))
