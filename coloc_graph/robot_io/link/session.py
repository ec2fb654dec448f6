"""A session of either end of the link: publishers, subscribers, commands and presence, by key; `LinkSession` on zenoh.

Robot NAME has the keys coloc/NAME/samples, wheels, events (kept and recovered), status, time, command/SESSION (a
query) and alive/SESSION (its liveliness token). The coordinator publishes coloc/NAME/question, hold and refusal, and
has coloc/coordinator/alive.
"""

import contextlib
import re
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import msgspec
import zenoh
import zenoh.ext

from coloc_graph.errors import RobotError
from coloc_graph.robot_io.link.messages import Event, Sample, Wheels
from coloc_graph.robot_io.link.zenoh_config import Tls, config_of

#: Kinds of messages that a robot keeps until they are received, by the last part of their key.
KEPT_KINDS: dict[str, type[msgspec.Struct]] = {"samples": Sample, "wheels": Wheels, "events": Event}
#: Messages of a kind that a robot keeps: 40 s of samples at 100 Hz, 200 s of odometry at 20 Hz.
CACHED = 4000
#: Options of publishers and queries whose messages overtake measurements.
URGENT: dict[str, Any] = {"priority": zenoh.Priority.INTERACTIVE_HIGH, "express": True}

#: Sends a message; never waits, and never raises.
Put = Callable[[bytes], None]
#: Takes a message and its key.
Take = Callable[[str, bytes], None]


class Question(Protocol):
    """A command that waits for its answer."""

    @property
    def payload(self) -> bytes:
        """The command."""

    def answer(self, reply: bytes | None) -> None:
        """Send a reply, None for none; once."""


class Session(Protocol):
    """A connection to the other end of the link, which comes and goes by itself. Callbacks come on its threads."""

    def publisher(self, key: str) -> Put:
        """Return a publisher whose messages overtake measurements."""

    def kept_publisher(self, key: str) -> Put:
        """Return a publisher whose newest `CACHED` messages are kept, for `kept`."""

    def subscribe(self, key: str, take: Take, *, at_once: bool = False) -> None:
        """Take messages; `at_once` is for quick work whose time matters."""

    def on_question(self, key: str, take: Callable[[Question], None]) -> None:
        """Take commands."""

    def ask(
        self, key: str, payload: bytes, timeout: float, take: Callable[[bytes], None], ended: Callable[[], None]
    ) -> None:
        """Send a command; `take` its replies, until it has `ended`, after `timeout` [s] at the latest."""

    def kept(self, key: str, which: str, timeout: float, take: Take) -> int | None:
        """Request kept messages, in the words of zenoh's cache; return their number, None if they did not all come."""

    def announce(self, key: str) -> None:
        """Be present under a key."""

    def watch(self, key: str, take: Callable[[str, bool], None]) -> None:
        """Take presence and absence under a key, with that of before."""

    def close(self) -> None:
        """Close the session."""


class OpenSession(Protocol):
    """Opens a session; see `config_of` for its arguments."""

    def __call__(
        self,
        *,
        listen: str | None = None,
        connect: str | None = None,
        tls: Tls | None = None,
        robots: Sequence[str] = (),
        exposed: bool = False,
    ) -> Session:
        """Raise `InputError` if the address is not valid, `RobotError` if it cannot be listened on."""


class LinkSession:
    """A `Session` on zenoh; see `config_of` for its arguments.

    Raises
    ------
    InputError
        If the address is not valid, or needs certificates.
    RobotError
        If the session cannot be opened at its address.
    """

    def __init__(
        self,
        *,
        listen: str | None = None,
        connect: str | None = None,
        tls: Tls | None = None,
        robots: Sequence[str] = (),
        exposed: bool = False,
    ) -> None:
        config = config_of(listen=listen, connect=connect, tls=tls, robots=robots, exposed=exposed)
        try:
            self.zenoh = zenoh.open(config)
        except zenoh.ZError as error:
            reason = re.sub(r" at /\S+", "", str(error))  # paths of zenoh's own source files
            address = listen or connect
            raise RobotError(f"cannot open the link at {address} ({reason}): give another address") from error
        self._declared: list[Any] = []

    def publisher(self, key: str) -> Put:
        """Return a publisher whose messages overtake measurements."""
        return self._putting(self.zenoh.declare_publisher(key, **URGENT))

    def kept_publisher(self, key: str) -> Put:
        """Return a publisher whose newest `CACHED` messages are kept."""
        return self._putting(
            zenoh.ext.declare_advanced_publisher(
                self.zenoh,
                key,
                congestion_control=zenoh.CongestionControl.DROP,
                cache=zenoh.ext.CacheConfig(max_samples=CACHED),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(),  # type: ignore[call-arg]
            )
        )

    def subscribe(self, key: str, take: Take, *, at_once: bool = False) -> None:
        """Take messages; `at_once` on the receiving thread itself."""

        def taken(sample: zenoh.Sample) -> None:
            take(str(sample.key_expr), sample.payload.to_bytes())

        callback = zenoh.handlers.Callback(taken, indirect=False) if at_once else taken
        self._declared.append(self.zenoh.declare_subscriber(key, callback))

    def on_question(self, key: str, take: Callable[[Question], None]) -> None:
        """Take commands."""
        self._declared.append(self.zenoh.declare_queryable(key, lambda query: take(_Query(query))))

    def ask(
        self, key: str, payload: bytes, timeout: float, take: Callable[[bytes], None], ended: Callable[[], None]
    ) -> None:
        """Send a command."""

        def taken(one: zenoh.Reply) -> None:
            if one.ok is not None:
                take(one.ok.payload.to_bytes())

        callback = zenoh.handlers.Callback(taken, ended, indirect=False)
        self.zenoh.get(key, callback, payload=payload, timeout=timeout, **URGENT)

    def kept(self, key: str, which: str, timeout: float, take: Take) -> int | None:
        """Request kept messages from zenoh's cache."""
        count = 0
        try:
            replies = self.zenoh.get(
                f"{key}/@adv/pub/**?{which}",
                timeout=timeout,
                accept_replies=zenoh.ReplyKeyExpr.ANY,
                consolidation=zenoh.ConsolidationMode.NONE,
            )
            for one in replies:
                if one.ok is None:
                    return None
                take(str(one.ok.key_expr), one.ok.payload.to_bytes())
                count += 1
        except zenoh.ZError:
            return None
        return count

    def announce(self, key: str) -> None:
        """Be present under a key."""
        self._declared.append(self.zenoh.liveliness().declare_token(key))

    def watch(self, key: str, take: Callable[[str, bool], None]) -> None:
        """Take presence and absence under a key, with that of before."""

        def taken(sample: zenoh.Sample) -> None:
            take(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        self._declared.append(self.zenoh.liveliness().declare_subscriber(key, taken, history=True))

    def close(self) -> None:
        """Close the session."""
        for declared in reversed(self._declared):
            with contextlib.suppress(Exception):
                declared.undeclare()
        with contextlib.suppress(Exception):
            self.zenoh.close()  # type: ignore[no-untyped-call]

    def _putting(self, publisher: Any) -> Put:
        self._declared.append(publisher)

        def put(data: bytes) -> None:
            with contextlib.suppress(zenoh.ZError):
                publisher.put(data)

        return put


class _Query:
    """A command, as zenoh has it."""

    def __init__(self, query: zenoh.Query) -> None:
        self._query: zenoh.Query | None = query
        self.payload = b"" if query.payload is None else query.payload.to_bytes()

    def answer(self, reply: bytes | None) -> None:
        query, self._query = self._query, None
        assert query is not None
        with contextlib.suppress(zenoh.ZError):  # who asked has gone
            if reply is not None:
                query.reply(query.key_expr, reply)
        query.drop()  # type: ignore[no-untyped-call]


def robot_of(key: str) -> str:
    """Name of the robot in a key; if it has wildcards, its first part."""
    parts = key.split("/")
    return parts[1] if len(parts) >= 3 and not {"*", "**"} & set(parts) else parts[0]


def session_of(key: str) -> str:
    """Last part of a key: the session in the key of a liveliness token."""
    return key.rpartition("/")[2]
