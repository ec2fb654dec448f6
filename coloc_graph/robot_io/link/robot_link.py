"""A robot's end of the link to the coordinator, on zenoh; `RobotLink`, docs/link.md."""

import contextlib
import queue
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

import zenoh
import zenoh.ext

from coloc_graph.errors import InputError
from coloc_graph.robot_io.link.command_filter import CommandFilter
from coloc_graph.robot_io.link.counters import Counts, LinkCounter
from coloc_graph.robot_io.link.messages import (
    Body,
    ClockQuestion,
    ClockReply,
    Event,
    MessageError,
    Refusal,
    Sample,
    Status,
    Wheels,
    decode,
    encode,
    is_session,
)
from coloc_graph.robot_io.link.session import CACHED, KEPT_KINDS, URGENT, LinkSession, on_receiving_thread, payload_of
from coloc_graph.robot_io.link.zenoh_config import Tls, config_of

Clock = Callable[[], int]

MAX_WAITING = 64  # commands that wait to be carried out; further ones are dropped and come again


class RobotLink:
    """A robot's end of the link; a context manager.

    Messages that the coordinator does not receive are kept, the newest `CACHED` of a kind, and sent when it is back.

    Parameters
    ----------
    name
        Name of the robot.
    connect
        Address of the coordinator, tcp/HOST:PORT or tls/HOST:PORT.
    handler
        Carries out a command and returns the answer, or raises.
    session
        Name of this run of the robot's program, another one each time: letters, digits, - and _.
    tls
        Certificates of this end.
    clock
        The robot's monotonic clock [ns].

    Raises
    ------
    InputError
        If the address or the session is not valid.
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
        if not is_session(session):
            raise InputError(f"`{session}` is not a name of a session: use letters, digits, - and _")
        self.name, self.session, self._clock = name, session, clock
        self._counter = LinkCounter()
        self._commands = CommandFilter(name, session, handler, clock, self._counter)
        self._asked: queue.Queue[zenoh.Query | None] = queue.Queue(MAX_WAITING)
        self._connected = False
        self._refused: str | None = None
        self._session = LinkSession(connect, config_of(connect=connect, tls=tls))
        session_, keep = self._session.zenoh, self._session.keep
        try:
            self._publishers = {
                type_: keep(
                    zenoh.ext.declare_advanced_publisher(
                        session_,
                        f"coloc/{name}/{kind}",
                        congestion_control=zenoh.CongestionControl.DROP,
                        cache=zenoh.ext.CacheConfig(max_samples=CACHED),
                        sample_miss_detection=zenoh.ext.MissDetectionConfig(),  # type: ignore[call-arg]
                    )
                )
                for kind, type_ in KEPT_KINDS.items()
            }
            self._publishers[Status] = keep(session_.declare_publisher(f"coloc/{name}/status", **URGENT))
            keep(session_.declare_subscriber(f"coloc/{name}/hold", self._take_hold))
            keep(session_.declare_queryable(f"coloc/{name}/command/{session}", self._take_command))
            keep(session_.declare_subscriber(f"coloc/{name}/refusal", self._take_refusal))
            self._time = keep(session_.declare_publisher(f"coloc/{name}/time", **URGENT))
            keep(session_.declare_subscriber(f"coloc/{name}/question", on_receiving_thread(self._tell_time)))
            liveliness = session_.liveliness()
            keep(liveliness.declare_subscriber("coloc/coordinator/alive", self._take_presence, history=True))
            keep(liveliness.declare_token(f"coloc/{name}/alive/{session}"))
        except BaseException:
            self._session.close()
            raise
        self._worker = threading.Thread(target=self._carry_out, name=f"commands to {name}", daemon=True)
        self._worker.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the link."""
        with contextlib.suppress(queue.Full):
            self._asked.put(None, timeout=1.0)
        self._worker.join(2.0)
        self._session.close()

    @property
    def counts(self) -> Counts:
        """Counts of received and refused messages."""
        return self._counter.counts()

    @property
    def connected(self) -> bool:
        """True while the coordinator is connected; its loss is noticed within the link's lease."""
        return self._connected

    @property
    def last_heard(self) -> int:
        """Time at which the newest permission to move was sent [ns, CLOCK_MONOTONIC]; 0 before the first."""
        return self._commands.last_heard

    @property
    def refused(self) -> str | None:
        """Reason for which the coordinator refuses this program; None if it does not."""
        return self._refused

    def put(self, message: Sample | Wheels | Event | Status) -> None:
        """Send a message; never waits."""
        with contextlib.suppress(zenoh.ZError):
            self._publishers[type(message)].put(encode(message))

    def _take_command(self, query: zenoh.Query) -> None:
        with contextlib.suppress(queue.Full):
            self._asked.put_nowait(query)

    def _carry_out(self) -> None:
        """Thread that carries out commands, one after the other."""
        while (query := self._asked.get()) is not None:
            reply = self._commands.answer(payload_of(query))
            with contextlib.suppress(zenoh.ZError):  # who asked has gone
                if reply is not None:
                    query.reply(query.key_expr, encode(reply))
            query.drop()  # type: ignore[no-untyped-call]
            del query

    def _take_hold(self, sample: zenoh.Sample) -> None:
        self._commands.take_hold(sample.payload.to_bytes())

    def _take_refusal(self, sample: zenoh.Sample) -> None:
        try:
            refusal = decode(sample.payload.to_bytes(), Refusal)
        except MessageError as error:
            self._counter.refuse(error, f"a refusal of {self.name}")
            return
        if refusal.session == self.session:
            self._refused = refusal.text

    def _take_presence(self, sample: zenoh.Sample) -> None:
        self._connected = sample.kind == zenoh.SampleKind.PUT

    def _tell_time(self, sample: zenoh.Sample) -> None:
        received = self._clock()
        try:
            asked = decode(sample.payload.to_bytes(), ClockQuestion).asked
            reply = ClockReply(session=self.session, asked=asked, received=received, sent=self._clock())
            self._time.put(encode(reply))
        except MessageError as error:
            self._counter.refuse(error, f"a request for the time of {self.name}")
        except zenoh.ZError:
            pass  # who asked has gone
