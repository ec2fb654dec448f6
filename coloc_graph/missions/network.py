"""A simulated network between sessions, as `link.session.Session` has them: delay, loss, order, cuts; `Network`.

It is worse than the TCP connection on which zenoh runs: messages of a connection can be lost, come twice or out of
order at any time.
"""

import re
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from queue import Empty

from coloc_graph.missions.scheduler import Process, Scheduler
from coloc_graph.missions.system import Queue
from coloc_graph.robot_io.link.session import CACHED, Put, Question, Take

LEASE = 2.0  # silence after which a connection is lost, as zenoh is set to [s]
REDIAL = (0.2, 1.0)  # time until a lost connection is made again [s]
BANDWIDTH = 2e-4  # time between two messages of an answer to a request [s]


@dataclass
class Conditions:
    """State of the network between one robot and the coordinator.

    Attributes
    ----------
    delay
        Mean delay of a message [s].
    jitter
        Mean of what it takes longer by chance [s], which changes the order of messages.
    loss, duplication
        Shares of messages that are lost, and that come twice.
    cut
        True while nothing passes.
    """

    delay: float = 1e-3
    jitter: float = 3e-4
    loss: float = 0.0
    duplication: float = 0.0
    cut: bool = False


class Network:
    """Connections of robots with the coordinator, by the name of the robot."""

    def __init__(self, scheduler: Scheduler, robots: Sequence[str]) -> None:
        self.scheduler = scheduler
        self.conditions = {name: Conditions() for name in robots}
        self.coordinator: SimulatedSession | None = None
        self.robots: list[SimulatedSession] = []

    def open(self, process: Process, robot: str | None) -> "Callable[..., SimulatedSession]":
        """Return what opens the session of a process: of a robot, or of the coordinator."""

        def opened(**_: object) -> SimulatedSession:
            session = SimulatedSession(self, process, robot)
            if robot is None:
                self.coordinator = session
            else:
                self.robots.append(session)
            process.at_end.append(session.vanish)
            self._dial_all()
            return session

        return opened

    def cut(self, robot: str, cut: bool) -> None:
        """Cut the connection of a robot, or mend it."""
        self.conditions[robot].cut = cut
        if not cut:
            self._dial_all()

    def watch_silence(self) -> None:
        """Lose connections on which nothing has come for `LEASE`; call this now and then."""
        for session in list(self.robots):
            if not session.connected:
                continue
            other = self.coordinator
            silent = self.conditions[session.robot or ""].cut or session.process.stopped
            silent |= other is None or other.process.stopped
            now = self.scheduler.now
            session.silent_since = (session.silent_since or now) if silent else None
            if session.silent_since is not None and now - session.silent_since > LEASE * 1e9:
                session.disconnect()
        self._dial_all()

    def forget(self, session: "SimulatedSession") -> None:
        """A session has ended."""
        if session.robot is None:
            if self.coordinator is session:
                self.coordinator = None
            for one in self.robots:
                one.disconnect()
        elif session in self.robots:
            session.disconnect()
            self.robots.remove(session)

    def _dial_all(self) -> None:
        for session in self.robots:
            if not session.connected and not session.dialling:
                session.dialling = True
                self.scheduler.call_in(self.scheduler.random.uniform(*REDIAL), session.connect)


class SimulatedSession:
    """One end of the link."""

    def __init__(self, network: Network, process: Process, robot: str | None) -> None:
        self.network, self.process, self.robot = network, process, robot
        self.connected = self.dialling = self.closed = False
        self.silent_since: int | None = None
        self.connection = 0  # number of the present connection: what is under way on an earlier one is lost
        self.tokens: list[str] = []
        self._subscribers: list[tuple[re.Pattern[str], Take, bool]] = []
        self._takers: dict[str, list[tuple[Take, Queue]]] = {}  # by key, of those that were looked up
        self._watchers: list[tuple[re.Pattern[str], Callable[[str, bool], None]]] = []
        self._questions: dict[str, Callable[[Question], None]] = {}
        self._kept: dict[str, deque[tuple[int, bytes]]] = {}
        scheduler = network.scheduler
        self._inbox, self._urgent = Queue(scheduler, 0), Queue(scheduler, 0)
        for queue, name in ((self._inbox, "callbacks"), (self._urgent, "receiving")):
            scheduler.spawn(partial(self._receive, queue), process, f"{name} of {process.name}")

    # what programs use

    def publisher(self, key: str) -> Put:
        """Return a publisher."""

        def put(data: bytes) -> None:
            for peer in self._peers():
                if peer.takers(key):
                    self._link(peer).send(partial(peer.take, key, data))

        return put

    def kept_publisher(self, key: str) -> Put:
        """Return a publisher whose messages are kept."""
        kept = self._kept[key] = deque(maxlen=CACHED)
        put, count = self.publisher(key), iter(range(1 << 62))

        def keep_and_put(data: bytes) -> None:
            kept.append((next(count), data))
            put(data)

        return keep_and_put

    def subscribe(self, key: str, take: Take, *, at_once: bool = False) -> None:
        """Take messages."""
        self._subscribers.append((_pattern(key), take, at_once))
        self._takers.clear()

    def on_question(self, key: str, take: Callable[[Question], None]) -> None:
        """Take commands."""
        self._questions[key] = take

    def ask(
        self, key: str, payload: bytes, timeout: float, take: Callable[[bytes], None], ended: Callable[[], None]
    ) -> None:
        """Send a command."""
        state = {"open": True}

        def end() -> None:
            if state.pop("open", False):
                self._urgent.put(ended)

        def replied(reply: bytes | None) -> None:
            if state and reply is not None:
                self._urgent.put(lambda: take(reply))
            end()

        self.network.scheduler.call_in(timeout, end)
        peers = [peer for peer in self._peers() if key in peer._questions]
        for peer in peers:
            self._put_question(peer, key, payload, replied)
        if not peers:
            end()

    def _put_question(
        self, peer: "SimulatedSession", key: str, payload: bytes, replied: Callable[[bytes | None], None]
    ) -> None:
        link = self._link(peer)
        link.send(lambda: peer.take_question(key, payload, lambda reply: link.send(lambda: replied(reply))))

    def kept(self, key: str, which: str, timeout: float, take: Take) -> int | None:
        """Request kept messages."""
        scheduler = self.network.scheduler
        came, count, end = Queue(scheduler, 0), 0, scheduler.now + round(1e9 * timeout)
        peers = [peer for peer in self._peers() if key in peer._kept]
        for peer in peers:
            link = self._link(peer)
            link.send(partial(peer.send_kept, key, which, link, came), certain=True)
            while scheduler.now < end and link.holds:
                try:
                    data = came.get(0.1)
                except Empty:  # nothing for a while: is the connection still there?
                    continue
                if data is None:
                    break
                take(key, data)
                count += 1
        return count

    def announce(self, key: str) -> None:
        """Be present."""
        self.tokens.append(key)
        for peer in self._peers():
            peer.notice(key, True)

    def watch(self, key: str, take: Callable[[str, bool], None]) -> None:
        """Take presence."""
        self._watchers.append((_pattern(key), take))
        for peer in self._peers():
            for token in peer.tokens:
                self.notice(token, True)

    def close(self) -> None:
        """Close the session."""
        self.vanish()

    # what the network does

    def connect(self) -> None:
        """Dial: connect with the coordinator if it is there."""
        self.dialling = False
        other, conditions = self.network.coordinator, self.network.conditions[self.robot or ""]
        if self.connected or self.closed or other is None or conditions.cut or not self.process.alive:
            return
        if self.process.stopped or other.process.stopped:
            return
        self.connected, self.silent_since = True, None
        self.connection += 1
        for one, there in ((self, other), (other, self)):
            for token in one.tokens:
                there.notice(token, True)

    def disconnect(self) -> None:
        """Lose the connection: both ends notice."""
        if not self.connected:
            return
        self.connected = False
        self.connection += 1
        other = self.network.coordinator
        if other is not None:
            for token in self.tokens:
                other.notice(token, False)
            for token in other.tokens:
                self.notice(token, False)

    def vanish(self) -> None:
        """End, with the process or before it."""
        if not self.closed:
            self.closed = True
            if self.robot is None:
                for one in self.network.robots:
                    if one.connected:
                        for token in self.tokens:
                            one.notice(token, False)
            self.network.forget(self)

    def notice(self, token: str, there: bool) -> None:
        """Take note of the presence of somebody else."""
        for pattern, take in self._watchers:
            if pattern.fullmatch(token):
                self._inbox.put(partial(take, token, there))

    def take(self, key: str, data: bytes) -> None:
        """Take a message in."""
        for take, queue in self.takers(key):
            queue.put(partial(take, key, data))

    def takers(self, key: str) -> list[tuple[Take, Queue]]:
        """Return the subscribers to a key, and the queues of their threads: a publisher sends to nobody else."""
        found = self._takers.get(key)
        if found is None:
            found = self._takers[key] = [
                (take, self._urgent if at_once else self._inbox)
                for pattern, take, at_once in self._subscribers
                if pattern.fullmatch(key)
            ]
        return found

    def take_question(self, key: str, payload: bytes, reply: Callable[[bytes | None], None]) -> None:
        """Take a command in."""
        if key in self._questions:
            question = _Asked(payload, reply)
            self._inbox.put(lambda: self._questions[key](question))

    def send_kept(self, key: str, which: str, link: "_Link", came: Queue) -> None:
        """Answer a request for kept messages, one after the other, until the connection is lost."""
        first, _, last = which.removeprefix("_sn=").partition("..")
        kept = list(self._kept.get(key, ()))
        found = kept[-1:] if which == "_max=1" else [one for one in kept if int(first) <= one[0] <= int(last)]
        for n, (_, data) in enumerate(found):
            link.send(partial(came.put, data), certain=True, later=n * BANDWIDTH)
        link.send(lambda: came.put(None), certain=True, later=(len(found) + 50) * BANDWIDTH + 0.02)

    def _peers(self) -> "list[SimulatedSession]":
        if self.robot is None:
            return [one for one in self.network.robots if one.connected and self.network.coordinator is self]
        other = self.network.coordinator
        return [other] if other is not None and self.connected else []

    def _link(self, peer: "SimulatedSession") -> "_Link":
        return _Link(self.network, self if self.robot is not None else peer)

    def _receive(self, queue: Queue) -> None:
        while True:
            queue.get()()


class _Link:
    """The present connection of a robot; what is under way when it is lost does not arrive."""

    def __init__(self, network: Network, session: SimulatedSession) -> None:
        self._network, self._session, self._connection = network, session, session.connection

    @property
    def holds(self) -> bool:
        """True while the connection is the same one."""
        return self._session.connected and self._session.connection == self._connection

    def send(self, arrive: Callable[[], None], *, certain: bool = False, later: float = 0.0) -> None:
        """Let something arrive at the other end; `certain` unless the connection is lost."""
        conditions, scheduler = self._network.conditions[self._session.robot or ""], self._network.scheduler
        random = scheduler.random.random
        if not certain and conditions.loss and random() < conditions.loss:
            return
        again = not certain and conditions.duplication and random() < conditions.duplication
        for _ in range(2 if again else 1):
            delay = later + conditions.delay + scheduler.exponential(conditions.jitter)
            scheduler.call_in(delay, partial(self._arrive, arrive))

    def _arrive(self, arrive: Callable[[], None]) -> None:
        if not self.holds:
            return
        if self._network.conditions[self._session.robot or ""].cut:  # it waits to be sent again, as TCP does
            self._network.scheduler.call_in(0.2, lambda: self._arrive(arrive))
        else:
            arrive()


class _Asked:
    """A command that came."""

    def __init__(self, payload: bytes, reply: Callable[[bytes | None], None]) -> None:
        self.payload, self._reply = payload, reply

    def answer(self, reply: bytes | None) -> None:
        """Send the reply."""
        self._reply(reply)


def _pattern(key: str) -> re.Pattern[str]:
    """Regular expression of a key in which `*` is any part."""
    return re.compile("/".join("[^/]+" if part == "*" else re.escape(part) for part in key.split("/")))
