"""Messages that are numbered, handed over in order and once, while those that are missing are asked for."""

from collections.abc import Iterator
from typing import Any

#: So many are asked for at once [messages]: each answer is progress, on a bad network too, and does not fill zenoh's
#: queue, which would stop the robot's whole link.
AT_ONCE = 100
#: After so many answers without what is missing there is none of it any more.
TRIES = 3


class InOrder:
    """Messages of one kind of one session of a robot, whose numbers begin at 0; of one thread at a time.

    What comes ahead of its turn is held, `most` of it at most, until what is missing has come or is lost for good.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._next = 0
        self._held: dict[int, Any] = {}
        self._tried = 0
        #: Messages that were lost for good, and that came again.
        self.lost = self.again = 0

    def take(self, number: int, message: Any) -> Iterator[Any]:
        """Take one in; those whose turn it is come out."""
        if self.knows(number):
            self.again += 1
            return
        self._held[number] = message
        if len(self._held) > self._most:
            self._give_up(min(self._held))
        yield from self._turn()

    def knows(self, number: int) -> bool:
        """Whether it came already, or was given up."""
        return number < self._next or number in self._held

    def missing(self) -> tuple[int, int] | None:
        """The numbers to ask for, first and last."""
        if not self._held:
            return None
        return self._next, min(min(self._held) - 1, self._next + AT_ONCE - 1)

    def asked(self, first: int, last: int) -> Iterator[Any]:
        """What was missing, `first` to `last`, was asked for, and what there was of it came; what can, comes out."""
        if self._next != first:
            self._tried = 0
            return
        self._tried += 1
        if self._tried >= TRIES and self._held:
            self._give_up(min(last + 1, min(self._held)))
            yield from self._turn()

    def end(self) -> Iterator[Any]:
        """What is missing will not come any more; all that is held comes out."""
        while self._held:
            self._give_up(min(self._held))
            yield from self._turn()

    def _turn(self) -> Iterator[Any]:
        while self._next in self._held:
            self._tried = 0
            self._next += 1
            yield self._held.pop(self._next - 1)

    def _give_up(self, until: int) -> None:
        self.lost += until - self._next
        self._next, self._tried = until, 0
