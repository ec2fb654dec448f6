"""Messages of one topic by their own time: sorted, those that are there twice dropped, and counted."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")

#: A message is held back until those before it have come, at most so many of a topic at once.
MOST_HELD = 200


@dataclass(frozen=True, eq=False)
class Order:
    """In which order the messages of a topic are, n of them as they came: `kept` (m,) are their numbers by time, the
    first of each instant; `ns` (m,) are the times [ns].

    `late` came after one of a later time, `repeated` are of an instant that was there already.
    """

    ns: NDArray[np.int64]
    kept: NDArray[np.intp]
    late: int
    repeated: int


def order_of(times: list[int]) -> Order:
    """The order of messages with these times [ns], as they came."""
    came = np.array(times, np.int64)
    ns, kept = np.unique(came, return_index=True)
    late = int((came[1:] < np.maximum.accumulate(came)[:-1]).sum()) if len(came) else 0
    return Order(ns, kept, late, len(came) - len(ns))


class InOrder(Generic[T]):
    """Gives messages by time while they come: one that came early is held back. `due` are their times, in order."""

    def __init__(self, due: NDArray[np.int64]) -> None:
        self._due, self._held = deque(due.tolist()), dict[int, T]()

    def take(self, ns: int, message: T) -> Iterator[tuple[int, T]]:
        """Yield the messages that are due with a message, none or several; one that is there already is dropped.

        `OverflowError` where more are held back than are held.
        """
        if self._due and ns >= self._due[0]:
            self._held.setdefault(ns, message)
        if len(self._held) > MOST_HELD:
            raise OverflowError
        while self._due and self._due[0] in self._held:
            due = self._due.popleft()
            yield due, self._held.pop(due)
