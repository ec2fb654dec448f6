"""Sort the messages of one topic by time, and drop and count duplicates."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")

MAX_HELD = 200  # messages of a topic that are held back until earlier ones arrive


@dataclass(frozen=True, eq=False)
class Order:
    """Order of n messages of a topic: indices `kept` (m,) by time, the first of each time, and times `ns` (m,) [ns].

    `late` is the number of messages that came after one of a later time, `repeated` that of messages with a repeated
    time.
    """

    ns: NDArray[np.int64]
    kept: NDArray[np.intp]
    late: int
    repeated: int


def order_of(times: list[int]) -> Order:
    """Order of messages with these times [ns]."""
    came = np.array(times, np.int64)
    ns, kept = np.unique(came, return_index=True)
    late = int((came[1:] < np.maximum.accumulate(came)[:-1]).sum()) if len(came) else 0
    return Order(ns, kept, late, len(came) - len(ns))


class InOrder(Generic[T]):
    """Reorder messages by time while they arrive; early ones are held back. `due` are their times, in order."""

    def __init__(self, due: NDArray[np.int64]) -> None:
        self._due, self._held = deque(due.tolist()), dict[int, T]()

    def take(self, ns: int, message: T) -> Iterator[tuple[int, T]]:
        """Yield the messages that are due with a message, none or several; duplicates are dropped.

        `OverflowError` if too many are held back.
        """
        if self._due and ns >= self._due[0]:
            self._held.setdefault(ns, message)
        if len(self._held) > MAX_HELD:
            raise OverflowError
        while self._due and self._due[0] in self._held:
            due = self._due.popleft()
            yield due, self._held.pop(due)
