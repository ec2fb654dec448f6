"""The zenoh session of either end of the link, and its keys; `LinkSession`.

Robot NAME has the keys coloc/NAME/samples, wheels, events (kept and recovered), status, time, command/SESSION (a
query) and alive/SESSION (its liveliness token). The coordinator publishes coloc/NAME/question, hold and refusal, and
has coloc/coordinator/alive.
"""

import contextlib
import re
from collections.abc import Callable
from typing import Any

import msgspec
import zenoh

from coloc_graph.errors import RobotError
from coloc_graph.robot_io.link.messages import Event, Sample, Wheels

#: Kinds of messages that a robot keeps until they are received, by the last part of their key.
KEPT_KINDS: dict[str, type[msgspec.Struct]] = {"samples": Sample, "wheels": Wheels, "events": Event}
#: Messages of a kind that a robot keeps: 40 s of samples at 100 Hz, 200 s of odometry at 20 Hz.
CACHED = 4000
#: Options of publishers and queries whose messages overtake measurements.
URGENT: dict[str, Any] = {"priority": zenoh.Priority.INTERACTIVE_HIGH, "express": True}


class LinkSession:
    """A zenoh session and its declarations, closed together.

    Raises
    ------
    RobotError
        If the session cannot be opened at its address.
    """

    def __init__(self, address: str, config: zenoh.Config) -> None:
        try:
            self.zenoh = zenoh.open(config)
        except zenoh.ZError as error:
            reason = re.sub(r" at /\S+", "", str(error))  # paths of zenoh's own source files
            raise RobotError(f"cannot open the link at {address} ({reason}): give another address") from error
        self._declared: list[Any] = []

    def keep(self, declared: Any) -> Any:
        """Undeclare something when the session is closed."""
        self._declared.append(declared)
        return declared

    def close(self) -> None:
        """Close the session."""
        for declared in reversed(self._declared):
            with contextlib.suppress(Exception):
                declared.undeclare()
        with contextlib.suppress(Exception):
            self.zenoh.close()  # type: ignore[no-untyped-call]


def on_receiving_thread(call: Callable[[zenoh.Sample], None]) -> "zenoh.handlers.Callback[zenoh.Sample]":
    """Callback on the receiving thread itself, for quick work whose time matters."""
    return zenoh.handlers.Callback(call, indirect=False)


def robot_of(sample: zenoh.Sample) -> str:
    """Name of the robot in a key; if it has wildcards, its first part."""
    parts = str(sample.key_expr).split("/")
    return parts[1] if len(parts) >= 3 and not {"*", "**"} & set(parts) else parts[0]


def session_of(sample: zenoh.Sample) -> str:
    """Last part of a key: the session in the key of a liveliness token."""
    return str(sample.key_expr).rpartition("/")[2]


def payload_of(query: zenoh.Query) -> bytes:
    """Payload of a query, empty if it has none."""
    return b"" if query.payload is None else query.payload.to_bytes()
