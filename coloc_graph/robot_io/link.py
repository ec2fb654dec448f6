"""The link between robots and the coordinator, on zenoh: `RobotLink` dials, `CoordinatorLink` listens; docs/link.md.

What robots measure arrives whole and in order, also after a cut; commands are carried out once, in time, or refused.
"""

import contextlib
import logging
import queue
import threading
import time
import uuid
from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self, TypeVar

import msgspec
import zenoh
import zenoh.ext

from coloc_graph.errors import ColocError, RobotError
from coloc_graph.robot_io.clock import ClockFilter
from coloc_graph.robot_io.link_config import Tls, config_of
from coloc_graph.robot_io.wire import (
    Body,
    ClockReply,
    Command,
    Event,
    Reply,
    Sample,
    Status,
    Wheels,
    WireError,
    decode,
    encode,
)
from coloc_graph.team import Team

__all__ = ["CoordinatorLink", "Counts", "RobotLink", "Tls"]

log = logging.getLogger(__name__)
M = TypeVar("M", bound=msgspec.Struct)
Clock = Callable[[], int]

#: What a robot keeps for one who does not hear it, messages of a kind: samples of minutes, odometry of more.
CACHED = 4000
#: How often clocks are compared [s], and how often what was lost is noticed [s].
COMPARED, NOTICED = 0.1, 0.2
#: A command is asked again so often until its deadline [s].
AGAIN = 0.25
#: A refusal of one kind is logged so often at most [s].
LOGGED = 5.0
#: So many commands are remembered, which must not be carried out again; their deadlines end sooner.
REMEMBERED = 1000
#: What a robot sends, by the last part of its key.
KINDS: dict[str, type[msgspec.Struct]] = {"samples": Sample, "wheels": Wheels, "events": Event}


@dataclass(frozen=True)
class Counts:
    """What came: taken, and refused for being malformed (oversized too), late, replayed, or a robot's that is none of
    the team; `missed` is what was lost for good."""

    taken: int
    malformed: int
    late: int
    replayed: int
    foreign: int
    missed: int


class _Counter:
    """Counts what comes, and logs what is refused, now and then; for several threads."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._logged: dict[str, float] = {}
        self._lock = threading.Lock()

    def add(self, what: str, why: str = "", times: int = 1) -> None:
        with self._lock:
            self._counts[what] += times
            now = time.monotonic()
            if why and now - self._logged.get(what, -LOGGED) >= LOGGED:
                self._logged[what] = now
                log.warning("%s (%d %s so far)", why, self._counts[what], what)

    def counts(self) -> Counts:
        with self._lock:
            return Counts(**{name: self._counts[name] for name in Counts.__dataclass_fields__})


class _Session:
    """A zenoh session and what is declared on it; ends as a whole."""

    def __init__(self, **where: Any) -> None:
        try:
            self.zenoh = zenoh.open(config_of(**where))
        except zenoh.ZError as error:
            address = where.get("listen") or where.get("connect")
            raise RobotError(f"the link at {address} cannot be opened ({error}): give another address") from error
        self._declared: list[Any] = []

    def keep(self, declared: Any) -> Any:
        self._declared.append(declared)
        return declared

    def close(self) -> None:
        for declared in reversed(self._declared):
            with contextlib.suppress(Exception):
                declared.undeclare()
        with contextlib.suppress(Exception):
            self.zenoh.close()  # type: ignore[no-untyped-call]


class CoordinatorLink:
    """The coordinator's end; a context manager. Callbacks come on the link's threads, and must be quick.

    `clocks` are those of the robots, by name. Raises `RobotError` where it cannot listen.
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
        self._counter = _Counter()
        self._present: dict[str, bool] = dict.fromkeys(team.names, False)
        self._sessions: dict[str, str] = {}
        self._next: OrderedDict[tuple[str, str, str], int] = OrderedDict()
        self._on_status, self._on_presence = on_status, on_presence
        self._ended = threading.Event()
        self._session = _Session(listen=listen, tls=tls, robots=team.names, exposed=exposed)
        session, keep = self._session.zenoh, self._session.keep
        calls: dict[str, Callable[[str, Any], None]] = {
            "samples": on_sample, "wheels": on_wheels, "events": on_event,
        }  # fmt: skip
        try:
            for kind, type_ in KINDS.items():
                keep(
                    zenoh.ext.declare_advanced_subscriber(
                        session,
                        f"coloc/*/{kind}",
                        self._taker(kind, type_, calls[kind]),
                        history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
                        recovery=zenoh.ext.RecoveryConfig(heartbeat=True),  # type: ignore[call-arg]
                    )
                )
            keep(session.declare_subscriber("coloc/*/status", self._take_status))
            self._hold = keep(session.declare_publisher("coloc/coordinator/hold", express=True))
            keep(session.liveliness().declare_subscriber("coloc/*/alive", self._take_presence, history=True))
            keep(session.liveliness().declare_token("coloc/coordinator/alive"))
        except BaseException:
            self._session.close()
            raise
        self._comparer = threading.Thread(target=self._compare_clocks, name="clocks", daemon=True)
        self._comparer.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End it."""
        self._ended.set()
        self._comparer.join(2.0)
        self._session.close()

    @property
    def counts(self) -> Counts:
        """What came and what was refused."""
        return self._counter.counts()

    def synchronised(self, robot: str, limit: float) -> bool:
        """Whether a robot's clock is known to `limit` [s] now."""
        return self.clocks[robot].synchronised(self._clock(), limit)

    def hold(self) -> None:
        """Let robots that move go on moving for a moment."""
        with contextlib.suppress(zenoh.ZError):
            self._hold.put(b"")

    def ask(self, robot: str, body: Body, timeout: float) -> Reply:
        """Have a robot carry out a command, and its answer; `RobotError` where none comes in time [s].

        The command is asked again until then, and carried out once. The robot refuses it afterwards.
        """
        until = time.monotonic() + timeout
        deadline = self.clocks[robot].to_robot(self._clock() + round(1e9 * timeout))
        command = Command(id=uuid.uuid4().hex, session=self._sessions.get(robot, ""), deadline=deadline, body=body)
        data = encode(command)
        while (left := until - time.monotonic()) > 0:
            replies = self._session.zenoh.get(
                f"coloc/{robot}/command", payload=data, timeout=max(min(left, max(AGAIN, timeout / 3)), 0.01)
            )
            for one in replies:
                if one.ok is None:
                    continue
                try:
                    reply = decode(one.ok.payload.to_bytes(), Reply)
                except WireError as error:
                    self._counter.add("malformed", f"{robot}: {error}")
                    continue
                if reply.id == command.id:
                    return reply
            time.sleep(0.02)
        what = type(body).__name__
        raise RobotError(f"robot {robot} has not answered `{what}` within {timeout:g} s: check its program and network")

    def _taker(self, kind: str, type_: type[M], call: Callable[[str, Any], None]) -> Callable[[zenoh.Sample], None]:
        def take(sample: zenoh.Sample) -> None:
            message: Any = self._decoded(sample, type_)
            if message is None:
                return
            robot, one = message
            key = robot, kind, one.session
            expected = self._next.get(key)
            if expected is not None and one.number < expected:
                self._counter.add("replayed")
                return
            if expected is not None and one.number > expected:
                gap = one.number - expected
                self._counter.add("missed", f"{gap} {kind} of {robot} are lost for good", gap)
            self._next[key] = one.number + 1
            self._next.move_to_end(key)
            while len(self._next) > 12 * len(self.team.names):
                self._next.popitem(last=False)
            self._counter.add("taken")
            call(robot, one)

        return take

    def _take_status(self, sample: zenoh.Sample) -> None:
        message = self._decoded(sample, Status)
        if message is not None:
            self._sessions[message[0]] = message[1].session
            self._counter.add("taken")
            self._on_status(*message)

    def _decoded(self, sample: zenoh.Sample, type_: type[M]) -> tuple[str, M] | None:
        robot = str(sample.key_expr).split("/")[1]
        if robot not in self.clocks:
            self._counter.add("foreign", f"a message of `{robot[:40]}`, which is no robot of the team, is refused")
            return None
        try:
            return robot, decode(sample.payload.to_bytes(), type_)
        except WireError as error:
            self._counter.add("malformed", f"{robot}: {error}")
            return None

    def _take_presence(self, sample: zenoh.Sample) -> None:
        robot = str(sample.key_expr).split("/")[1]
        if robot in self._present:
            there = sample.kind == zenoh.SampleKind.PUT
            self._present[robot] = there
            self._on_presence(robot, there)

    def _compare_clocks(self) -> None:
        while not self._ended.wait(COMPARED):
            for robot, there in self._present.items():
                if there:
                    asked = self._clock()
                    with contextlib.suppress(zenoh.ZError):
                        self._session.zenoh.get(
                            f"coloc/{robot}/clock",
                            self._clock_taker(robot, asked),
                            payload=encode_int(asked),
                            timeout=1.0,
                        )

    def _clock_taker(self, robot: str, asked: int) -> Callable[[zenoh.Reply], None]:
        def take(one: zenoh.Reply) -> None:
            heard = self._clock()
            if one.ok is None:
                return
            try:
                reply = decode(one.ok.payload.to_bytes(), ClockReply)
                if reply.asked == asked:
                    self.clocks[robot].add(asked, reply.received, reply.sent, heard)
            except (WireError, ValueError) as error:
                self._counter.add("malformed", f"the clock of {robot}: {error}")

        return take


class RobotLink:
    """A robot's end; a context manager. `handler` carries out a command and gives what to answer, or raises.

    `session` tells this program's run from the one before. What is put while the coordinator does not hear arrives
    when it does, the newest `CACHED` of a kind.
    """

    def __init__(
        self,
        name: str,
        *,
        connect: str,
        handler: Callable[[Body], str],
        session: str,
        tls: Tls | None = None,
        clock: Clock = time.monotonic_ns,
    ) -> None:
        self.name, self.session, self._handler, self._clock = name, session, handler, clock
        self._counter = _Counter()
        self._done: OrderedDict[str, Reply] = OrderedDict()
        self._asked: queue.SimpleQueue[zenoh.Query | None] = queue.SimpleQueue()
        #: When the coordinator last let it move [ns, CLOCK_MONOTONIC].
        self.last_heard = 0
        self._session = _Session(connect=connect, tls=tls, name=name)
        session_, keep = self._session.zenoh, self._session.keep
        try:
            self._publishers = {
                type_: keep(
                    zenoh.ext.declare_advanced_publisher(
                        session_,
                        f"coloc/{name}/{kind}",
                        congestion_control=zenoh.CongestionControl.DROP,
                        cache=zenoh.ext.CacheConfig(max_samples=CACHED),
                        sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=NOTICED),  # type: ignore[call-arg]
                        publisher_detection=True,
                    )
                )
                for kind, type_ in KINDS.items()
            }
            self._publishers[Status] = keep(session_.declare_publisher(f"coloc/{name}/status"))
            keep(session_.declare_subscriber("coloc/coordinator/hold", self._take_hold))
            keep(session_.declare_queryable(f"coloc/{name}/command", self._asked.put))
            keep(session_.declare_queryable(f"coloc/{name}/clock", self._tell_time))
            keep(session_.liveliness().declare_token(f"coloc/{name}/alive"))
        except BaseException:
            self._session.close()
            raise
        self._worker = threading.Thread(target=self._obey, name=f"commands to {name}", daemon=True)
        self._worker.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End it."""
        self._asked.put(None)
        self._worker.join(2.0)
        self._session.close()

    @property
    def counts(self) -> Counts:
        """What came and what was refused."""
        return self._counter.counts()

    def put(self, message: Sample | Wheels | Event | Status) -> None:
        """Send something; never waits."""
        with contextlib.suppress(zenoh.ZError):
            self._publishers[type(message)].put(encode(message))

    def answer(self, data: bytes) -> Reply | None:
        """The reply to a command in bytes that came from outside, which is carried out unless it must not be."""
        try:
            command = decode(data, Command)
        except WireError as error:
            self._counter.add("malformed", f"a command is refused: {error}")
            return None
        before = self._done.get(command.id)
        if before is not None:
            self._counter.add("replayed")
            return before
        if command.session not in ("", self.session):
            self._counter.add("replayed", f"a command for an earlier session of {self.name} is refused")
            return Reply(id=command.id, ok=False, text="it is for an earlier session")
        if self._clock() > command.deadline:
            self._counter.add("late", f"a command came too late, {type(command.body).__name__}")
            return Reply(id=command.id, ok=False, text="it came too late")
        self._counter.add("taken")
        try:
            reply = Reply(id=command.id, ok=True, text=self._handler(command.body))
        except ColocError as error:
            reply = Reply(id=command.id, ok=False, text=str(error)[:1000])
        except Exception as error:  # the program's own fault must be heard of where it was asked
            log.exception("a command failed")
            reply = Reply(id=command.id, ok=False, text=f"it failed ({error!r})"[:1000])
        self._done[command.id] = reply
        while len(self._done) > REMEMBERED:
            self._done.popitem(last=False)
        return reply

    def _obey(self) -> None:
        """The thread that carries out commands, one after the other."""
        while (query := self._asked.get()) is not None:
            payload = query.payload
            reply = self.answer(payload.to_bytes() if payload is not None else b"")
            with contextlib.suppress(Exception):
                if reply is not None:
                    query.reply(query.key_expr, encode(reply))
                query.drop()  # type: ignore[no-untyped-call]
            del query

    def _take_hold(self, _: zenoh.Sample) -> None:
        self.last_heard = time.monotonic_ns()

    def _tell_time(self, query: zenoh.Query) -> None:
        received = self._clock()
        try:
            payload = query.payload
            asked = msgspec.msgpack.decode(payload.to_bytes() if payload is not None else b"", type=int)
            reply = ClockReply(asked=asked, received=received, sent=self._clock())
            query.reply(query.key_expr, encode(reply))
        except (msgspec.MsgspecError, OverflowError, ValueError) as error:
            self._counter.add("malformed", f"a question for the time is none: {error}")
        except zenoh.ZError:
            pass  # who asked has gone


def encode_int(number: int) -> bytes:
    """A whole number as bytes."""
    return msgspec.msgpack.encode(number)
