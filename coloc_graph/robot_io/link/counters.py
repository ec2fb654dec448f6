"""What came over a link and what was refused, counted, and logged now and then."""

import logging
import threading
import time
from collections import Counter
from dataclasses import dataclass, fields

from coloc_graph.robot_io.link.messages import OversizedError, WireError

log = logging.getLogger(__name__)

#: A refusal of one kind is logged so often at most [s].
LOGGED = 5.0


@dataclass(frozen=True)
class Counts:
    """Messages that were taken, and refused: malformed, oversized, late, replayed (a command or a sample that came
    again), or foreign (of no robot of the team). `missed` is what was lost for good."""

    taken: int
    malformed: int
    oversized: int
    late: int
    replayed: int
    foreign: int
    missed: int


class LinkCounter:
    """Counts what comes, and logs what is refused, now and then; for several threads."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._logged: dict[str, float] = {}
        self._lock = threading.Lock()

    def add(self, what: str, why: str = "", times: int = 1) -> None:
        """Count something of `Counts`; `why` it was refused is logged."""
        with self._lock:
            self._counts[what] += times
            number, now = self._counts[what], time.monotonic()
            if not why or now - self._logged.get(what, -LOGGED) < LOGGED:
                return
            self._logged[what] = now
        log.warning("%s (%s: %d so far)", why, what, number)

    def refuse(self, error: WireError, what: str) -> None:
        """Count, and log, that `what` came and was none."""
        self.add("oversized" if isinstance(error, OversizedError) else "malformed", f"{what} is refused: {error}")

    def counts(self) -> Counts:
        """The numbers so far."""
        with self._lock:
            return Counts(**{one.name: self._counts[one.name] for one in fields(Counts)})
