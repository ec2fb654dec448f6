"""Messages of one robot as the coordinator takes them in: which session counts, and what is handed on; `RobotInbox`."""

from collections import OrderedDict
from collections.abc import Callable, Iterable
from typing import Any

from coloc_graph.machine import machine
from coloc_graph.robot_io.link.counters import LinkCounter
from coloc_graph.robot_io.link.messages import decode
from coloc_graph.robot_io.link.reordering import REQUEST_SIZE, ReorderBuffer
from coloc_graph.robot_io.link.session import CACHED, KEPT_KINDS

#: Sessions of one robot that are noticed at the same time; further ones are ignored.
MAX_PRESENT = 16
#: Ended sessions of one robot whose message numbers are remembered, so that late messages are not handed on twice.
MAX_ENDED = 1000


class RobotInbox:
    """State of one robot's sessions and of its numbered messages; for one thread at a time.

    A session is one run of the robot's program. The first that is present is in charge until it leaves; another that
    is present meanwhile is a duplicate program of the same name. Memory is bounded, and nothing that another robot
    sends reaches this object.

    Parameters
    ----------
    robot
        Name of the robot.
    deliver
        Called with each message, once and in order within a kind and session.
    counter
        Counts messages that are taken, lost, repeated, or of an unknown session.

    Attributes
    ----------
    in_charge
        Session that is in charge, present or not; None before the first.
    session
        Session whose messages are taken: the one in charge, once its clock is known; before that the previous one.
    last_taken
        Time of the newest message of each kind of this session [s, monotonic].
    """

    def __init__(self, robot: str, deliver: Callable[[Any], None], counter: LinkCounter) -> None:
        self._robot, self._deliver, self._counter = robot, deliver, counter
        self._present: dict[str, int] = {}
        self._buffers: dict[type, ReorderBuffer] = {}
        self._ended: OrderedDict[str, dict[type, int]] = OrderedDict()
        self.in_charge: str | None = None
        self.session: str | None = None
        self.last_taken: dict[type, float] = {}

    @property
    def present(self) -> bool:
        """True if the session in charge is connected."""
        return self.in_charge in self._present

    def connect(self, session: str, now: int) -> None:
        """Note that a session is present from `now` [ns, coordinator's clock] on."""
        if session in self._present or len(self._present) >= MAX_PRESENT:
            return
        if not self.present:
            self.in_charge = session
        self._present[session] = now

    def disconnect(self, session: str) -> None:
        """Note that a session has left; of those present the earliest takes its place."""
        self._present.pop(session, None)
        if not self.present and self._present:
            self.in_charge = next(iter(self._present))

    def duplicates(self, asked: int) -> list[str]:
        """Sessions that were present beside the one in charge when that was `asked` for the time, and answered [ns]."""
        return [one for one, since in self._present.items() if one != self.in_charge and since < asked]

    def begin(self) -> None:
        """Take messages of the session in charge from now on; what was held of the session before it is handed on."""
        if self.in_charge == self.session or self.in_charge is None:
            return
        for kind, buffer in self._buffers.items():
            self._hand_on(kind, buffer, buffer.end)
        if self.session is not None:
            self._ended[self.session] = {kind: one.next_number for kind, one in self._buffers.items()}
        while len(self._ended) > MAX_ENDED:
            self._ended.popitem(last=False)
        self.session, self.last_taken = self.in_charge, {}
        before = self._ended.pop(self.session, {})
        # the sender may already have dropped the oldest when a request for them comes: one request more of a window
        window = CACHED + REQUEST_SIZE
        self._buffers = {kind: ReorderBuffer(window, before.get(kind, 0)) for kind in KEPT_KINDS.values()}

    def take(self, message: Any, data: bytes, *, requested: bool = False) -> None:
        """Take in a message that was decoded from `data`; one that was `requested` may have come before.

        A message of a session whose clock is not known yet is counted as unknown and not taken: it is requested again
        as soon as the clock is known. One of a session that ended is handed on if its turn has not passed.
        """
        kind, session, number = type(message), message.session, message.number
        if session == self.session:
            self.last_taken[kind] = machine.monotonic()
            buffer = self._buffers[kind]
            if not (requested and buffer.knows(number)):
                self._hand_on(kind, buffer, lambda: buffer.take(number, data), message, data)
        elif session in self._ended:
            buffer = ReorderBuffer(1, self._ended[session].get(kind, 0))
            self._hand_on(kind, buffer, lambda: buffer.take(number, data), message, data)
            self._ended[session][kind] = buffer.next_number
        else:
            self._counter.add("unknown")

    def missing(self) -> list[tuple[type, int, int]]:
        """Gaps to request from the current session: kind of message, first and last number."""
        gaps = ((kind, buffer.missing()) for kind, buffer in self._buffers.items())
        return [(kind, *gap) for kind, gap in gaps if gap is not None]

    def answered(self, session: str, kind: type, first: int, last: int) -> None:
        """Note that a session answered a request for `first` to `last`."""
        if session == self.session:
            buffer = self._buffers[kind]
            self._hand_on(kind, buffer, lambda: buffer.requested(first, last))

    def _hand_on(
        self,
        kind: type,
        buffer: ReorderBuffer,
        action: Callable[[], Iterable[bytes]],
        message: Any = None,
        data: bytes | None = None,
    ) -> None:
        """Deliver what an action on a buffer lets through, and count the rest."""
        lost, repeated = buffer.lost, buffer.repeated
        for one in action():
            self._counter.add("taken")
            self._deliver(message if one is data else decode(one, kind))
        if buffer.repeated > repeated:
            self._counter.add("replayed", times=buffer.repeated - repeated)
        if (count := buffer.lost - lost) > 0:
            self._counter.add("missed", f"{count} {kind.__name__} messages of {self._robot} are lost", count)
