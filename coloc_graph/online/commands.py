"""What the coordinator tells robots to do, and its permission to move; `Orders`."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

from coloc_graph.errors import RobotError
from coloc_graph.online.robot_registry import Roster
from coloc_graph.robot_io.link.coordinator_link import CoordinatorLink
from coloc_graph.robot_io.link.messages import Body, Drive, EndCapture, Halt

#: The permission to move is renewed so often while the coordinator is at work, which may take so long [s].
RENEWED = 0.05
AT_WORK = 0.4
#: How long a robot has to answer [s], and one that is only told to stop.
ANSWER = 1.0
STOP_ANSWER = 0.3


class Orders:
    """Orders to the robots of a roster, at a `speed` [m/s]; they move only while `at_work` is called again and again.

    `note` is told of each robot that goes on after it stopped. Methods raise `RobotError` where a robot does not answer
    in time, or refuses.
    """

    def __init__(self, link: CoordinatorLink, roster: Roster, speed: float, note: Callable[[str], None]) -> None:
        self._link, self._roster, self._speed, self._note = link, roster, speed, note
        self._ways = time.time_ns() // 1_000_000  # no number twice, of whatever coordinator
        self._until = 0.0
        self._ended = threading.Event()
        self._holder = threading.Thread(target=self._renew, name="permission to move", daemon=True)
        self._holder.start()

    def end(self) -> None:
        """Renew no permission any more, and stop all robots."""
        self._ended.set()
        self._holder.join(1.0)
        self.halt_all()

    def at_work(self, seconds: float = AT_WORK) -> None:
        """The coordinator is alive, and will say so again within some time [s]."""
        self._until = time.monotonic() + seconds

    def ask(self, name: str, body: Body) -> str:
        """Ask a robot, which must answer and agree; what it says comes back."""
        self.at_work(ANSWER + AT_WORK)
        reply = self._link.ask(name, body, ANSWER)
        self.at_work()
        if not reply.ok:
            raise RobotError(f"{name} refuses: {reply.text}")
        return reply.text

    def ask_each(self, orders: Mapping[str, Body]) -> dict[str, str]:
        """Ask several robots at once, and what each says."""
        with ThreadPoolExecutor(len(orders), thread_name_prefix="orders") as threads:
            return dict(zip(orders, threads.map(self.ask, orders.keys(), orders.values()), strict=True))

    def drive(
        self, name: str, places: Iterable[Sequence[float]], yaw: float | None = None, *, backwards: bool = True
    ) -> None:
        """Send a robot through places (x, y) [m] in the world, and then turn it to `yaw` [rad]."""
        member = self._roster[name]
        own = [member.whereabouts.in_odometry((float(x), float(y), 0.0))[:2] for x, y in places]
        last = None if yaw is None else member.whereabouts.in_odometry((0.0, 0.0, yaw))[2]
        self._ways += 1
        member.way = Drive(number=self._ways, places=own, yaw=last, speed=self._speed, backwards=backwards)
        member.arrived = member.stopped = False
        self.ask(name, member.way)

    def drive_on(self) -> None:
        """Robots that stopped on their way, for want of a word in time, go on."""
        for name, member in self._roster.members.items():
            if member.stopped and not member.arrived and member.way is not None:
                member.stopped = False
                self._note(name)
                self.ask(name, member.way)

    def halt_all(self) -> None:
        """Stop all robots, as far as they hear it; those that do not stop by themselves."""
        for name, member in self._roster.members.items():
            if member.present:
                for body in (Halt(), EndCapture()):
                    with contextlib.suppress(RobotError):
                        self._link.ask(name, body, STOP_ANSWER)

    def _renew(self) -> None:
        """The thread that lets robots move as long as the coordinator is at work."""
        while not self._ended.wait(RENEWED):
            if time.monotonic() < self._until:
                self._link.hold()
