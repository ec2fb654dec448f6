"""Counts of the messages of a link that were taken and refused, logged at intervals."""

import logging
from collections import Counter
from dataclasses import dataclass, fields

from coloc_graph.machine import machine
from coloc_graph.robot_io.link.messages import MessageError, OversizedError

log = logging.getLogger(__name__)

LOG_PERIOD = 5.0  # s, at least, between two log lines on one kind of refusal


@dataclass(frozen=True)
class Counts:
    """Counts of messages.

    Attributes
    ----------
    taken
        Accepted.
    malformed, oversized
        Refused since they are not valid, or too large.
    late
        Commands refused after their deadline.
    replayed
        Commands and measurements that came again.
    foreign
        From a robot that is not in the team.
    unknown
        From a session whose clock is not known yet, or that ended long ago. The first are requested again later.
    missed
        Measurements that are lost.
    duplicate
        Refusals sent to a second program that runs under a robot's name.
    """

    taken: int
    malformed: int
    oversized: int
    late: int
    replayed: int
    foreign: int
    unknown: int
    missed: int
    duplicate: int


class LinkCounter:
    """Counts what comes and logs what is refused, at most every `LOG_PERIOD`; for several threads."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._logged: dict[str, float] = {}
        self._lock = machine.new_lock()

    def add(self, what: str, why: str = "", times: int = 1) -> None:
        """Count messages under a field of `Counts`, and log `why`, if given."""
        with self._lock:
            self._counts[what] += times
            if not why:
                return
            number, now = self._counts[what], machine.monotonic()
            if now - self._logged.get(what, -LOG_PERIOD) < LOG_PERIOD:
                return
            self._logged[what] = now
        log.warning("%s (%s: %d until now)", why, what, number)

    def refuse(self, error: MessageError, what: str) -> None:
        """Count and log a message, described by `what`, that is not valid."""
        self.add("oversized" if isinstance(error, OversizedError) else "malformed", f"refused {what}: {error}")

    def counts(self) -> Counts:
        """Return the present counts."""
        with self._lock:
            return Counts(**{one.name: self._counts[one.name] for one in fields(Counts)})
