"""Reordering of numbered messages: each is handed on once and in order, and the gaps are known; `ReorderBuffer`."""

#: Messages requested in one query. Each reply is progress on a bad network too, and 100 do not fill zenoh's queue,
#: which would stop the robot's whole link.
REQUEST_SIZE = 100
#: Requests for a gap that were answered without it, after which it is counted as lost.
MAX_REQUESTS = 3
#: Bytes of messages held behind a gap; beyond it the gap is counted as lost.
MAX_HELD_BYTES = 32 * 1024 * 1024


class ReorderBuffer:
    """Encoded messages of one kind from one session, numbered from 0; for one thread at a time.

    Parameters
    ----------
    window
        Number of newest messages that the sender keeps. A gap further behind the newest cannot be filled any more and
        is counted as lost.
    next_number
        Number of the first message to hand on.

    Attributes
    ----------
    next_number
        Number of the message that is handed on next.
    lost
        Count of the messages that were given up.
    repeated
        Count of the messages that came although they had been handed on, held or given up before.
    """

    def __init__(self, window: int, next_number: int = 0) -> None:
        self._window = window
        self._held: dict[int, bytes] = {}
        self._held_bytes = 0
        self._requests = 0
        self.next_number = next_number
        self.lost = self.repeated = 0

    def take(self, number: int, message: bytes) -> list[bytes]:
        """Accept a message and return those that can be handed on now, in order."""
        if self.knows(number):
            self.repeated += 1
            return []
        self._held[number] = message
        self._held_bytes += len(message)
        ready = self._skip_to(number + 1 - self._window)
        while self._held_bytes > MAX_HELD_BYTES:
            ready += self._skip_to(min(self._held))
        return ready

    def knows(self, number: int) -> bool:
        """Return whether a message was handed on, is held, or was given up."""
        return number < self.next_number or number in self._held

    def missing(self) -> tuple[int, int] | None:
        """First and last number to request next; None if there is no gap."""
        if not self._held:
            return None
        return self.next_number, min(min(self._held), self.next_number + REQUEST_SIZE) - 1

    def requested(self, first: int, last: int) -> list[bytes]:
        """Note that the sender answered a request for `first` to `last`, and return what can be handed on now.

        What it sent was taken before. After `MAX_REQUESTS` answers without number `first` the rest of the gap is lost.
        """
        if self.next_number != first or not self._held:
            return []
        self._requests += 1
        return self._skip_to(min(last + 1, min(self._held))) if self._requests >= MAX_REQUESTS else []

    def end(self) -> list[bytes]:
        """Give up all gaps, since the sender has ended, and return all that is held, in order."""
        return self._skip_to(max(self._held, default=-1) + 1)

    def _skip_to(self, number: int) -> list[bytes]:
        """Give up what is missing below `number`; return what can be handed on, from below and beyond it."""
        ready = []
        for held in sorted(one for one in self._held if one < number) if number > self.next_number else []:
            ready += self._advance_to(max(held, self.next_number))
        return ready + self._advance_to(max(number, self.next_number))

    def _advance_to(self, number: int) -> list[bytes]:
        """Give up what is missing below `number`, below which nothing is held; return the messages from it on."""
        if number > self.next_number:
            self.lost += number - self.next_number
            self.next_number, self._requests = number, 0
        ready = []
        while (message := self._held.pop(self.next_number, None)) is not None:
            ready.append(message)
            self._held_bytes -= len(message)
            self.next_number += 1
            self._requests = 0
        return ready
