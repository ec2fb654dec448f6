"""Commands as a robot takes them: each once, in time, for this session of its program, or not at all."""

import logging
import time
from collections import OrderedDict
from collections.abc import Callable

from coloc_graph.errors import ColocError
from coloc_graph.robot_io.link.counters import LinkCounter
from coloc_graph.robot_io.link.messages import Body, Command, Hold, Reply, WireError, decode

log = logging.getLogger(__name__)

#: So many commands are remembered that must not be carried out again; the deadlines of earlier ones are over.
REMEMBERED = 1000


class Commands:
    """Carries out commands by `handler`, which gives what to answer, or raises; of one thread."""

    def __init__(
        self, name: str, session: str, handler: Callable[[Body], str], clock: Callable[[], int], counter: LinkCounter
    ) -> None:
        self._name, self._session, self._handler, self._clock, self._counter = name, session, handler, clock, counter
        self._done: OrderedDict[str, Reply] = OrderedDict()
        #: When the coordinator last let it move [ns, CLOCK_MONOTONIC]; 0 where it never did.
        self.last_heard = 0

    def answer(self, data: bytes) -> Reply | None:
        """The reply to what came as a command, which is carried out unless it must not be; None where it is none."""
        try:
            command = decode(data, Command)
        except WireError as error:
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
        except Exception as error:  # the program's own fault must be heard of where it was asked
            log.exception("%s could not carry out `%s`", self._name, what)
            reply = Reply(id=command.id, ok=False, text=f"it failed: {error!r}"[:1000])
        self._done[command.id] = reply
        while len(self._done) > REMEMBERED:
            self._done.popitem(last=False)
        return reply

    def take_hold(self, data: bytes) -> None:
        """Take in a permission to move, which counts from when it was sent: one that was held up is an old one."""
        try:
            hold = decode(data, Hold)
        except WireError as error:
            self._counter.refuse(error, f"a permission to {self._name}")
            return
        if hold.session != self._session:
            self._counter.add("replayed")
            return
        age = max(self._clock() - hold.sent, 0)
        self.last_heard = max(self.last_heard, time.monotonic_ns() - age)
