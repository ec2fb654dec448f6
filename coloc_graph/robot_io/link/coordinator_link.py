"""The coordinator's end of the link to its robots, on zenoh; `CoordinatorLink`, docs/link.md.

What robots measure arrives whole and in order, also after a cut; commands are carried out once, in time, or refused.
"""

import contextlib
import queue
import threading
import time
import uuid
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from types import TracebackType
from typing import Any, Self, TypeVar

import msgspec
import zenoh

from coloc_graph.errors import RobotError
from coloc_graph.robot_io.link.clock import ClockFilter
from coloc_graph.robot_io.link.counters import Counts, LinkCounter
from coloc_graph.robot_io.link.messages import (
    FARTHEST,
    Body,
    ClockQuestion,
    ClockReply,
    Command,
    Event,
    Halt,
    Hold,
    Reply,
    Sample,
    Status,
    Wheels,
    WireError,
    decode,
    encode,
)
from coloc_graph.robot_io.link.reordering import InOrder
from coloc_graph.robot_io.link.session import CACHED, FIRST, KEPT_KINDS, LinkSession, at_once, robot_of
from coloc_graph.robot_io.link.zenoh_config import Tls, config_of
from coloc_graph.team import Team

M = TypeVar("M", bound=msgspec.Struct)
Clock = Callable[[], int]

#: How often clocks are compared [s].
COMPARED = 0.1
#: How often what is missing is asked for, and, of a kind of which nothing comes, whether there is something newer [s].
RECOVERED = 0.2
NEWER = 1.0
AGAIN = 0.25  # a command is sent again after this time, until its deadline [s]
NO_SESSION = 0.02  # the same where the robot's session is not known, or nobody answers its key [s]
WAITING = 0.02  # while answers are awaited, the caller's `waiting` is called at least this often [s]


class CoordinatorLink:
    """The coordinator's end; a context manager. Callbacks come on the link's threads, one at a time, and must be quick.

    What a robot measured is asked for when something is known of its clock: `clocks` has it, by name. A robot's
    messages come in order, none twice, `counts.missed` are lost for good. `exposed` lets others than this machine
    connect without certificates. Raises `InputError` for an address that does not do, `RobotError` where it cannot
    listen.
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
        clock: Clock = time.monotonic_ns,
    ) -> None:
        self.team, self._clock = team, clock
        self.clocks = {name: ClockFilter() for name in team.names}
        self._calls: dict[type, Callable[[str, Any], None]] = {
            Sample: on_sample, Wheels: on_wheels, Event: on_event, Status: on_status,
        }  # fmt: skip
        self._on_presence = on_presence
        self._counter = LinkCounter()
        self._lock = threading.RLock()
        self._present = dict.fromkeys(team.names, False)
        self._sessions: dict[str, str] = {}
        self._orders: OrderedDict[tuple[str, type, str], InOrder] = OrderedDict()
        self._heard: dict[str, tuple[str, list[Any]]] = {}
        self._came: dict[tuple[str, type], float] = {}
        self._ended = threading.Event()
        self._session = LinkSession(listen, config_of(listen=listen, tls=tls, robots=team.names, exposed=exposed))
        session, keep = self._session.zenoh, self._session.keep
        try:
            keep(session.declare_subscriber("coloc/*/status", self._taker(Status)))
            keep(session.declare_subscriber("coloc/*/time", at_once(self._take_time)))
            self._questions = {
                name: keep(session.declare_publisher(f"coloc/{name}/question", **FIRST)) for name in team.names
            }
            self._holds = {name: keep(session.declare_publisher(f"coloc/{name}/hold", **FIRST)) for name in team.names}
            keep(session.liveliness().declare_subscriber("coloc/*/alive", self._take_presence, history=True))
            keep(session.liveliness().declare_token("coloc/coordinator/alive"))
        except BaseException:
            self._session.close()
            raise
        self._threads = [
            threading.Thread(target=work, name=name, daemon=True)
            for work, name in ((self._compare_clocks, "clocks"), (self._recover, "recovery"))
        ]
        for thread in self._threads:
            thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End it."""
        self._ended.set()
        for thread in self._threads:
            thread.join(2.0)
        for _, subscribers in self._heard.values():
            for one in subscribers:
                with contextlib.suppress(zenoh.ZError):
                    one.undeclare()
        self._session.close()

    @property
    def counts(self) -> Counts:
        """What came and what was refused."""
        return self._counter.counts()

    def synchronised(self, robot: str, limit: float = 1e-3) -> bool:
        """Whether a robot's clock is known to `limit` [s] now."""
        return self.clocks[robot].synchronised(self._clock(), limit)

    def hold(self) -> None:
        """Let robots that move go on moving for a moment, those of them whose clocks are known."""
        now = self._clock()
        for robot, session in list(self._sessions.items()):
            if self._present[robot] and self.clocks[robot].known:
                with contextlib.suppress(zenoh.ZError):
                    self._holds[robot].put(encode(Hold(session=session, sent=self.clocks[robot].to_robot(now))))

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

        Each command is sent again until it is answered, and is carried out once. The robot refuses it afterwards,
        except `Halt` where nothing is known of its clock.

        Parameters
        ----------
        bodies
            The command of each robot, by name.
        timeout
            Time to answer [s].
        waiting
            Called on this thread at least every `WAITING` s until all have answered. What it raises ends the wait.

        Returns
        -------
        dict
            The reply of each robot, None for one that did not answer in time.
        """
        until, came = time.monotonic() + timeout, queue.SimpleQueue[tuple[str, Reply | None]]()
        commands: dict[str, Command] = {}
        again = dict.fromkeys(bodies, 0.0)
        replies: dict[str, Reply | None] = dict.fromkeys(bodies)
        while (left := until - (now := time.monotonic())) > 0 and None in replies.values():
            for robot, body in bodies.items():
                if replies[robot] is None and now >= again[robot]:
                    command = commands.get(robot) or self._command(robot, body, left)
                    again[robot] = now + NO_SESSION
                    if command is not None:
                        commands[robot] = command
                        wait = max(min(left, max(AGAIN, timeout / 3)), 0.01)
                        again[robot] = now + wait
                        self._send(robot, command, wait, came)
            waiting()
            with contextlib.suppress(queue.Empty):
                robot, reply = came.get(timeout=max(min(left, WAITING), 0.001))
                if reply is None:  # this query is over, and nobody answered it
                    again[robot] = min(again[robot], time.monotonic() + NO_SESSION)
                elif reply.id == commands[robot].id:
                    replies[robot] = reply
        return replies

    def _command(self, robot: str, body: Body, left: float) -> Command | None:
        """The command for the robot's session that runs now; None while that, or its clock, is not known."""
        session, clock = self._sessions.get(robot), self.clocks[robot]
        if session is None or not (clock.known or isinstance(body, Halt)):
            return None
        deadline = clock.to_robot(self._clock() + round(1e9 * left)) if clock.known else FARTHEST - 1
        return Command(id=uuid.uuid4().hex, session=session, deadline=deadline, body=body)

    def _send(
        self, robot: str, command: Command, timeout: float, came: "queue.SimpleQueue[tuple[str, Reply | None]]"
    ) -> None:
        """Send a command as a query; the robot's replies, and None at the query's end, are put into `came`."""

        def take(one: zenoh.Reply) -> None:
            if one.ok is None:
                return
            try:
                came.put((robot, decode(one.ok.payload.to_bytes(), Reply)))
            except WireError as error:
                self._counter.refuse(error, f"an answer of {robot}")

        self._session.zenoh.get(
            f"coloc/{robot}/command",
            zenoh.handlers.Callback(take, lambda: came.put((robot, None)), indirect=False),
            payload=encode(command),
            timeout=timeout,
            **FIRST,
        )

    def _taker(self, type_: type[M], asked: bool = False) -> Callable[[zenoh.Sample], None]:
        """What takes messages of one kind from zenoh, and never raises into its threads.

        Those that were `asked` for may have come already: that is no replay.
        """

        def take(sample: zenoh.Sample) -> None:
            robot = robot_of(sample)
            if robot not in self.clocks:
                self._counter.add("foreign", f"a message of `{robot[:40]}`, which is no robot of the team, is refused")
                return
            try:
                message = decode(sample.payload.to_bytes(), type_)
            except WireError as error:
                self._counter.refuse(error, f"a {type_.__name__} of {robot}")
                return
            with self._lock:
                self._hand_over(robot, message, asked)

        return take

    def _hand_over(self, robot: str, message: Any, asked: bool) -> None:
        if isinstance(message, Status):
            self._counter.add("taken")
            self._calls[Status](robot, message)
            return
        self._came[robot, type(message)] = time.monotonic()
        key = robot, type(message), message.session
        order = self._orders.get(key)
        if order is None:
            order = self._orders[key] = InOrder(CACHED)
            while len(self._orders) > 12 * len(self.team.names):
                self._orders.popitem(last=False)
        if not (asked and order.knows(message.number)):
            self._call(key, order, order.take(message.number, message))

    def _call(self, key: tuple[str, type, str], order: InOrder, messages: Iterator[Any]) -> None:
        """Hand over messages whose turn it is, and count what is not among them."""
        robot, type_, _ = key
        lost, again = order.lost, order.again
        for message in messages:
            self._counter.add("taken")
            self._calls[type_](robot, message)
        if order.again > again:
            self._counter.add("replayed", times=order.again - again)
        if order.lost > lost:
            count = order.lost - lost
            self._counter.add("missed", f"{count} {type_.__name__} of {robot} are lost for good", count)

    def _recover(self) -> None:
        """The thread that asks robots for what is missing of what they measured, until it comes or is no more."""
        while not self._ended.wait(0.0 if self._recovered() else RECOVERED):
            # of what is rare the newest tells what is missing before it; of the rest the next one that comes does
            for robot, (session, _) in list(self._heard.items()):
                for type_ in KEPT_KINDS.values():
                    due = self._came.get((robot, type_), 0.0) + NEWER <= time.monotonic()
                    if due and self._present[robot] and self._sessions.get(robot) == session:
                        self._ask_again(robot, type_, "_max=1")
                        self._came[robot, type_] = time.monotonic()

    def _recovered(self) -> bool:
        """Ask once for what is missing of each kind of each robot; whether anything came, and there is more."""
        with self._lock:
            orders = list(self._orders.items())
        more = False
        for key, order in orders:
            robot, type_, session = key
            with self._lock:
                missing = order.missing()
                if missing is not None and self._sessions.get(robot, session) != session:
                    self._call(key, order, order.end())  # who kept what is missing has ended
                    continue
            if missing is None or not self._present[robot] or robot not in self._sessions:
                continue
            answered = self._ask_again(robot, type_, f"_sn={missing[0]}..{missing[1]}")
            with self._lock:
                if answered and self._present[robot]:
                    self._call(key, order, order.asked(*missing))
                left = order.missing()
                more |= left is not None and left[0] != missing[0]
        return more

    def _ask_again(self, robot: str, type_: type[M], which: str) -> bool:
        """Have some of what a robot keeps come again; whether it answered."""
        kind = next(kind for kind, one in KEPT_KINDS.items() if one is type_)
        take = self._taker(type_, asked=True)
        try:
            replies = self._session.zenoh.get(
                f"coloc/{robot}/{kind}/@adv/pub/**?{which}",
                timeout=5.0,
                accept_replies=zenoh.ReplyKeyExpr.ANY,
                consolidation=zenoh.ConsolidationMode.NONE,
            )
            for one in replies:
                if one.ok is None:
                    return False
                take(one.ok)
        except zenoh.ZError:
            return False
        return True

    def _take_presence(self, sample: zenoh.Sample) -> None:
        robot = robot_of(sample)
        if robot in self._present:
            there = sample.kind == zenoh.SampleKind.PUT
            with self._lock:
                self._present[robot] = there
                self._on_presence(robot, there)

    def _compare_clocks(self) -> None:
        """The thread that asks robots for the time, and for what they measured."""
        while not self._ended.wait(COMPARED):
            for robot in [robot for robot, there in self._present.items() if there]:
                with contextlib.suppress(zenoh.ZError):
                    self._questions[robot].put(encode(ClockQuestion(asked=self._clock())))
                    self._listen_to(robot)

    def _listen_to(self, robot: str) -> None:
        """Have what a session of a robot measured come, from its first on, once it has told its time.

        What is missing is asked for by `_recover`, some at a time, and not by zenoh, which has a robot send all of it
        at once: more than a bad network carries before zenoh takes the connection for dead.
        """
        session = self._sessions.get(robot)
        before, subscribers = self._heard.get(robot, (None, []))
        if session is None or session == before:
            return
        for one in subscribers:
            one.undeclare()
        self._heard[robot] = (
            session,
            [
                self._session.zenoh.declare_subscriber(f"coloc/{robot}/{kind}", self._taker(type_))
                for kind, type_ in KEPT_KINDS.items()
            ],
        )

    def _take_time(self, sample: zenoh.Sample) -> None:
        heard, robot = self._clock(), robot_of(sample)
        if robot not in self.clocks:
            self._counter.add("foreign", f"the time of `{robot[:40]}`, which is no robot of the team, is refused")
            return
        try:
            reply = decode(sample.payload.to_bytes(), ClockReply)
            self.clocks[robot].add(reply.asked, reply.received, reply.sent, heard)
        except WireError as error:
            self._counter.refuse(error, f"the time of {robot}")
        except ValueError as error:
            self._counter.add("malformed", f"the time of {robot} is refused: {error}")
        else:
            self._sessions[robot] = reply.session
