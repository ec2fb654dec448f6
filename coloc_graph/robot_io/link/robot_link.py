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

from coloc_graph.robot_io.link.command_filter import Commands
from coloc_graph.robot_io.link.counters import Counts, LinkCounter
from coloc_graph.robot_io.link.messages import (
    Body,
    ClockQuestion,
    ClockReply,
    Event,
    Sample,
    Status,
    Wheels,
    WireError,
    decode,
    encode,
)
from coloc_graph.robot_io.link.session import CACHED, FIRST, KEPT_KINDS, LinkSession, at_once, payload_of
from coloc_graph.robot_io.link.zenoh_config import Tls, config_of

Clock = Callable[[], int]

#: So many commands wait at a robot at most; more are dropped, and asked again.
WAITING = 64


class RobotLink:
    """A robot's end; a context manager. `handler` carries out a command and gives what to answer, or raises.

    `session` tells this program's run from the one before. What is put while the coordinator does not hear it arrives
    when it does, the newest `CACHED` of a kind. Raises `InputError` for an address that does not do.
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
        self.name, self.session, self._clock = name, session, clock
        self._counter = LinkCounter()
        self._commands = Commands(name, session, handler, clock, self._counter)
        self._asked: queue.Queue[zenoh.Query | None] = queue.Queue(WAITING)
        self._connected = False
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
            self._publishers[Status] = keep(session_.declare_publisher(f"coloc/{name}/status", **FIRST))
            keep(session_.declare_subscriber(f"coloc/{name}/hold", self._take_hold))
            keep(session_.declare_queryable(f"coloc/{name}/command", self._take_command))
            self._time = keep(session_.declare_publisher(f"coloc/{name}/time", **FIRST))
            keep(session_.declare_subscriber(f"coloc/{name}/question", at_once(self._tell_time)))
            liveliness = session_.liveliness()
            keep(liveliness.declare_subscriber("coloc/coordinator/alive", self._take_presence, history=True))
            keep(liveliness.declare_token(f"coloc/{name}/alive"))
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
        with contextlib.suppress(queue.Full):
            self._asked.put(None, timeout=1.0)
        self._worker.join(2.0)
        self._session.close()

    @property
    def counts(self) -> Counts:
        """What came and what was refused."""
        return self._counter.counts()

    @property
    def connected(self) -> bool:
        """Whether the coordinator is there; one that is lost is noticed within the link's lease."""
        return self._connected

    @property
    def last_heard(self) -> int:
        """When the coordinator last let the robot move: when that was sent [ns, CLOCK_MONOTONIC]; 0 before."""
        return self._commands.last_heard

    def put(self, message: Sample | Wheels | Event | Status) -> None:
        """Send something; never waits."""
        with contextlib.suppress(zenoh.ZError):
            self._publishers[type(message)].put(encode(message))

    def _take_command(self, query: zenoh.Query) -> None:
        with contextlib.suppress(queue.Full):
            self._asked.put_nowait(query)

    def _obey(self) -> None:
        """The thread that carries out commands, one after the other."""
        while (query := self._asked.get()) is not None:
            reply = self._commands.answer(payload_of(query))
            with contextlib.suppress(zenoh.ZError):  # who asked has gone
                if reply is not None:
                    query.reply(query.key_expr, encode(reply))
            query.drop()  # type: ignore[no-untyped-call]
            del query

    def _take_hold(self, sample: zenoh.Sample) -> None:
        self._commands.take_hold(sample.payload.to_bytes())

    def _take_presence(self, sample: zenoh.Sample) -> None:
        self._connected = sample.kind == zenoh.SampleKind.PUT

    def _tell_time(self, sample: zenoh.Sample) -> None:
        received = self._clock()
        try:
            asked = decode(sample.payload.to_bytes(), ClockQuestion).asked
            reply = ClockReply(session=self.session, asked=asked, received=received, sent=self._clock())
            self._time.put(encode(reply))
        except WireError as error:
            self._counter.refuse(error, f"a question for the time of {self.name}")
        except zenoh.ZError:
            pass  # who asked has gone
