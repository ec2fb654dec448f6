"""Commands as a robot takes them: each once, in time, and only for this session of its program; `CommandFilter`."""

import logging
from collections import OrderedDict
from collections.abc import Callable

from coloc_graph.errors import ColocError
from coloc_graph.machine import machine
from coloc_graph.robot_io.link.counters import LinkCounter
from coloc_graph.robot_io.link.messages import Body, Command, Hold, MessageError, Reply, decode

log = logging.getLogger(__name__)

MAX_REMEMBERED = 1000  # commands whose replies are kept; the deadlines of earlier ones have passed


class CommandFilter:
    """Carries out commands; for one thread.

    Parameters
    ----------
    name
        Name of the robot.
    session
        Session whose commands are carried out.
    handler
        Carries out a command and returns the answer, or raises.
    clock
        The robot's monotonic clock [ns].
    counter
        Counts commands that are taken and refused.

    Attributes
    ----------
    last_heard
        Time at which the newest permission to move was sent [ns, CLOCK_MONOTONIC]; 0 before the first.
    """

    def __init__(
        self, name: str, session: str, handler: Callable[[Body], str], clock: Callable[[], int], counter: LinkCounter
    ) -> None:
        self._name, self._session, self._handler, self._clock, self._counter = name, session, handler, clock, counter
        self._done: OrderedDict[str, Reply] = OrderedDict()
        self.last_heard = 0

    def answer(self, data: bytes) -> Reply | None:
        """Carry out an encoded command unless it must be refused; return the reply, None if it is not valid."""
        try:
            command = decode(data, Command)
        except MessageError as error:
            self._counter.refuse(error, f"a command to {self._name}")
            return None
        what = type(command.body).__name__
        before = self._done.get(command.id)
        if before is not None:
            self._counter.add("replayed")
            return before
        if command.session != self._session:
            self._counter.add("replayed", f"{self._name} refuses `{what}`, which is for another session")
            return Reply(id=command.id, ok=False, text="it is for another session of the robot's program")
        if (late := self._clock() - command.deadline) > 0:
            self._counter.add("late", f"{self._name} refuses `{what}`, which came {late / 1e6:.0f} ms too late")
            return Reply(id=command.id, ok=False, text=f"it came {late / 1e6:.0f} ms too late")
        self._counter.add("taken")
        try:
            reply = Reply(id=command.id, ok=True, text=self._handler(command.body))
        except ColocError as error:
            reply = Reply(id=command.id, ok=False, text=str(error)[:1000])
        except Exception as error:  # the coordinator must learn of the program's own faults too
            log.exception("%s could not carry out `%s`", self._name, what)
            reply = Reply(id=command.id, ok=False, text=f"it failed: {error!r}"[:1000])
        self._done[command.id] = reply
        while len(self._done) > MAX_REMEMBERED:
            self._done.popitem(last=False)
        return reply

    def take_hold(self, data: bytes) -> None:
        """Take in an encoded permission to move, which counts from when it was sent."""
        try:
            hold = decode(data, Hold)
        except MessageError as error:
            self._counter.refuse(error, f"a permission to {self._name}")
            return
        if hold.session != self._session:
            self._counter.add("replayed")
            return
        age = max(self._clock() - hold.sent, 0)
        self.last_heard = max(self.last_heard, machine.monotonic_ns() - age)
