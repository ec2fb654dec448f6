"""A zenoh session as both ends of the link use it, and what passes under which key.

Robot NAME has coloc/NAME/samples, wheels, events (kept, and recovered), status, time, command (a query), alive (its
liveliness token); the coordinator tells it coloc/NAME/question and hold, and has coloc/coordinator/alive.
"""

import contextlib
from collections.abc import Callable
from typing import Any

import msgspec
import zenoh

from coloc_graph.errors import RobotError
from coloc_graph.robot_io.link.messages import Event, Sample, Wheels

#: What a robot sends and must not be lost, by the last part of its key.
KEPT_KINDS: dict[str, type[msgspec.Struct]] = {"samples": Sample, "wheels": Wheels, "events": Event}
#: What a robot keeps for one who does not hear it, messages of a kind: 40 s of samples at 100 a second, 200 s of
#: odometry at 20 a second.
CACHED = 4000
#: Commands and the time overtake what was measured.
FIRST: dict[str, Any] = {"priority": zenoh.Priority.INTERACTIVE_HIGH, "express": True}


class LinkSession:
    """A zenoh session and what is declared on it; ends as a whole. `RobotError` where it cannot be opened."""

    def __init__(self, address: str, config: zenoh.Config) -> None:
        try:
            self.zenoh = zenoh.open(config)
        except zenoh.ZError as error:
            raise RobotError(f"the link at {address} cannot be opened ({error}): give another address") from error
        self._declared: list[Any] = []

    def keep(self, declared: Any) -> Any:
        """Have something end with the session."""
        self._declared.append(declared)
        return declared

    def close(self) -> None:
        """End it."""
        for declared in reversed(self._declared):
            with contextlib.suppress(Exception):
                declared.undeclare()
        with contextlib.suppress(Exception):
            self.zenoh.close()  # type: ignore[no-untyped-call]


def at_once(call: Callable[[zenoh.Sample], None]) -> "zenoh.handlers.Callback[zenoh.Sample]":
    """A callback on the thread that receives, for what is timed and does little; others have threads of their own."""
    return zenoh.handlers.Callback(call, indirect=False)


def robot_of(sample: zenoh.Sample) -> str:
    """Whose key it is; of a key with wildcards, which reaches us too, something that is no robot's name."""
    parts = str(sample.key_expr).split("/")
    return parts[1] if len(parts) == 3 else parts[0]


def payload_of(query: zenoh.Query) -> bytes:
    """What came with a query."""
    return b"" if query.payload is None else query.payload.to_bytes()
