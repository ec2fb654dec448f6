"""A robot's end of the link to the coordinator, `RobotLink`, docs/link.md."""

import contextlib
import queue
from collections.abc import Callable
from types import TracebackType
from typing import Self

from coloc_graph.errors import InputError
from coloc_graph.machine import machine
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
from coloc_graph.robot_io.link.session import KEPT_KINDS, LinkSession, OpenSession, Question
from coloc_graph.robot_io.link.zenoh_config import Tls

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
    open_session
        Opens the session; another than zenoh's in a simulation.

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
        clock: Clock = machine.monotonic_ns,
        open_session: OpenSession = LinkSession,
    ) -> None:
        if not is_session(session):
            raise InputError(f"`{session}` is not a name of a session: use letters, digits, - and _")
        self.name, self.session, self._clock = name, session, clock
        self._counter = LinkCounter()
        self._commands = CommandFilter(name, session, handler, clock, self._counter)
        self._asked: queue.Queue[Question | None] = machine.new_queue(MAX_WAITING)
        self._connected = False
        self._refused: str | None = None
        self._session = open_session(connect=connect, tls=tls)
        try:
            self._publishers = {
                type_: self._session.kept_publisher(f"coloc/{name}/{kind}") for kind, type_ in KEPT_KINDS.items()
            }
            self._publishers[Status] = self._session.publisher(f"coloc/{name}/status")
            self._session.subscribe(f"coloc/{name}/hold", self._take_hold)
            self._session.on_question(f"coloc/{name}/command/{session}", self._take_command)
            self._session.subscribe(f"coloc/{name}/refusal", self._take_refusal)
            self._tell = self._session.publisher(f"coloc/{name}/time")
            self._session.subscribe(f"coloc/{name}/question", self._tell_time, at_once=True)
            self._session.watch("coloc/coordinator/alive", self._take_presence)
            self._session.announce(f"coloc/{name}/alive/{session}")
        except BaseException:
            self._session.close()
            raise
        self._worker = machine.new_thread(target=self._carry_out, name=f"commands to {name}")
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
        self._publishers[type(message)](encode(message))

    def _take_command(self, question: Question) -> None:
        with contextlib.suppress(queue.Full):
            self._asked.put_nowait(question)

    def _carry_out(self) -> None:
        """Thread that carries out commands, one after the other."""
        while (question := self._asked.get()) is not None:
            reply = self._commands.answer(question.payload)
            question.answer(None if reply is None else encode(reply))
            del question

    def _take_hold(self, _: str, data: bytes) -> None:
        self._commands.take_hold(data)

    def _take_refusal(self, _: str, data: bytes) -> None:
        try:
            refusal = decode(data, Refusal)
        except MessageError as error:
            self._counter.refuse(error, f"a refusal of {self.name}")
            return
        if refusal.session == self.session:
            self._refused = refusal.text

    def _take_presence(self, _: str, present: bool) -> None:
        self._connected = present

    def _tell_time(self, _: str, data: bytes) -> None:
        received = self._clock()
        try:
            asked = decode(data, ClockQuestion).asked
        except MessageError as error:
            self._counter.refuse(error, f"a request for the time of {self.name}")
            return
        self._tell(encode(ClockReply(session=self.session, asked=asked, received=received, sent=self._clock())))
