"""Commands to the robots, and their permission to move; `Commander`."""

import contextlib
from collections.abc import Callable, Iterable, Mapping, Sequence

from coloc_graph.errors import ColocError, RobotError
from coloc_graph.machine import machine
from coloc_graph.online.proximity import require_clear_way
from coloc_graph.online.robot_registry import RobotRegistry
from coloc_graph.planning.route import Free
from coloc_graph.robot_io.deadlines import PERMISSION_PERIOD
from coloc_graph.robot_io.link.coordinator_link import CoordinatorLink
from coloc_graph.robot_io.link.messages import Body, Drive, EndCapture, Halt

ANSWER = 1.0  # time that a robot has to answer a command [s]
STOP_ANSWER = 0.3  # the same when all robots are stopped [s]


class Stopped(ColocError):
    """The mission was told to stop while it waited for an answer."""


class Commander:
    """Commands to the robots of a registry; they move only while `renew` is called again and again.

    It runs on the thread of the mission's main loop alone: when that hangs, permissions end. Waiting for an answer
    renews them.

    Parameters
    ----------
    link, registry
        The link to the robots, and their states.
    speed
        Speed of drives [m/s].
    on_drive_resumed
        Called with the name of each robot that is sent on after it stopped on its way.
    free
        Returns which places are free of walls; None without a map.
    """

    def __init__(
        self,
        link: CoordinatorLink,
        registry: RobotRegistry,
        speed: float,
        on_drive_resumed: Callable[[str], None],
        free: Free | None = None,
    ) -> None:
        self.free = free
        self._link, self._registry, self._speed, self._on_drive_resumed = link, registry, speed, on_drive_resumed
        self._drives = machine.time_ns() // 1_000_000  # drive numbers are unique across coordinators
        self._renewed = -PERMISSION_PERIOD
        self.stop = machine.new_event()

    def renew(self) -> None:
        """Renew the robots' permission to move, unless that was done within `PERMISSION_PERIOD`."""
        now = machine.monotonic()
        if now - self._renewed >= PERMISSION_PERIOD:
            self._renewed = now
            self._link.hold()

    def ask(self, name: str, body: Body) -> str:
        """Have a robot carry out a command, and return its answer.

        Raises
        ------
        RobotError
            If it does not answer in time, or refuses.
        Stopped
            If the mission is told to stop meanwhile.
        """
        return self.ask_each({name: body})[name]

    def ask_each(self, bodies: Mapping[str, Body]) -> dict[str, str]:
        """Have several robots carry out a command each at the same time, and return their answers; see `ask`."""
        answers = {}
        for name, reply in self._link.ask_each(bodies, ANSWER, self._while_waiting).items():
            if reply is None:
                what = type(bodies[name]).__name__
                raise RobotError(
                    f"robot {name} has not answered `{what}` within {ANSWER:g} s: check its program and network"
                )
            if not reply.ok:
                raise RobotError(f"{name} refuses: {reply.text}")
            answers[name] = reply.text
        return answers

    def drive(
        self, name: str, waypoints: Iterable[Sequence[float]], yaw: float | None = None, *, backwards: bool = True
    ) -> None:
        """Send a robot through waypoints (x, y) [m] in the world, and then turn it to `yaw` [rad]."""
        robot = self._registry[name]
        own = [robot.tracker.in_odometry((float(x), float(y), 0.0))[:2] for x, y in waypoints]
        last = None if yaw is None else robot.tracker.in_odometry((0.0, 0.0, yaw))[2]
        self._drives += 1
        robot.drive = Drive(number=self._drives, places=own, yaw=last, speed=self._speed, backwards=backwards)
        robot.arrived = robot.interrupted = False
        self.ask(name, robot.drive)

    def send_off(
        self,
        name: str,
        waypoints: Iterable[Sequence[float]],
        yaw: float | None = None,
        *,
        backwards: bool = True,
        leaving: str | None = None,
    ) -> None:
        """Send a robot off as `drive` does, where its way is clear of those that stand but the one that is `leaving`.

        Raises
        ------
        RobotError
            If it is not, or the robot does not answer.
        """
        way = [(float(x), float(y)) for x, y in waypoints]
        robots = self._registry.robots.items()
        others = [other for other, robot in robots if robot.arrived and other not in (name, leaving)]
        require_clear_way(self._registry, name, way, others, self.free)
        self.drive(name, way, yaw, backwards=backwards)

    def resume_drives(self) -> None:
        """Send on the robots that stopped on their way because no permission came in time."""
        for name, robot in self._registry.robots.items():
            if robot.interrupted and not robot.arrived and robot.drive is not None:
                robot.interrupted = False
                self._on_drive_resumed(name)
                self.ask(name, robot.drive)

    def halt_all(self) -> None:
        """Stop all robots that are present, and their cameras' captures; never raises for those that do not answer."""
        present = [name for name, robot in self._registry.robots.items() if robot.present]
        for body in (Halt(), EndCapture()):
            with contextlib.suppress(RobotError):
                self._link.ask_each(dict.fromkeys(present, body), STOP_ANSWER)

    def _while_waiting(self) -> None:
        if self.stop.is_set():
            raise Stopped("the mission was told to stop")
        self.renew()
