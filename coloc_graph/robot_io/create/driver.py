"""Driver for the iRobot Create 1 and 2 whose motion ends by itself; `Create`.

The robot has no command timeout: it keeps the last speed for ever. The driver, and a watchdog process beside it, stop
the wheels instead (docs/wheels.md).
"""

import contextlib
import logging
import math
from collections.abc import Callable, Collection
from typing import Self

from coloc_graph.errors import InputError, RobotError
from coloc_graph.machine import machine
from coloc_graph.robot_io.create import protocol as oi
from coloc_graph.robot_io.create.exit_hooks import guard, release
from coloc_graph.robot_io.create.feed import SensorFeed
from coloc_graph.robot_io.create.line import LEAVE, CreateLine, Line
from coloc_graph.robot_io.create.odometry import WHEELS
from coloc_graph.robot_io.create.protocol import Mode, Packet
from coloc_graph.robot_io.create.state import HAZARDS, CreateState
from coloc_graph.robot_io.deadlines import reaction_time
from coloc_graph.run.messages import OdometrySample

LEASE = 0.2  # s for which a drive command holds by default
MAX_LEASE = 0.5  # s, bound of the lease that may be asked for
STALE = 0.3  # s without a frame after which a moving robot has a fault and a standing one does not set off
FRESH = 0.1  # s that a command waits for a frame before that, since this process may not have run
HUNG = 1.0  # s without an answer of the watchdog after which there is a fault
WATCH_PERIOD = 0.02  # s between two checks of what must end; a motion's deadline is kept to the moment
REPEAT_PERIOD = 0.05  # s until a stop command that the robot has not taken is sent again
DELTA_PERIOD = 0.5  # s between two requests for distance and angle from a Create 1

log = logging.getLogger(__name__)


class Create:
    """The wheels of one robot on a serial port; a context manager, at whose end the wheels stand.

    After a fault methods raise `RobotError` until `recover`.

    Parameters
    ----------
    port
        Serial port.
    model
        1 or 2, None to detect it.
    robot
        Name of the robot in odometry samples.
    max_speed, max_turn
        Bounds of every command [m/s], [rad/s].
    stop_on
        Hazards to stop on: "bump", "cliff", "wheel_drop", "charger".
    full
        Ask for full mode, in which the robot itself does not stop at a cliff, a dropped wheel or the charger.
    odometry_period
        Time between two odometry samples while the robot moves [s].
    epoch
        Offset of the samples' times from the monotonic clock [s]; None for UTC when the line is opened.
    open_line
        Opens the line on a port; another than a serial one in a simulation.
    exit_hooks
        Stop the wheels when the process is told to end.

    Raises
    ------
    InputError
        If an argument is out of range.

    Notes
    -----
    Source: iRobot Create Open Interface; iRobot Create 2 Open Interface specification.
    """

    def __init__(
        self,
        port: str,
        model: int | None = None,
        *,
        robot: str = "",
        max_speed: float = 0.5,
        max_turn: float = 2.0,
        stop_on: Collection[str] = ("wheel_drop", "cliff"),
        full: bool = False,
        odometry_period: float = 0.05,
        epoch: float | None = None,
        open_line: Callable[[str, int | None], Line] = CreateLine,
        exit_hooks: bool = True,
    ) -> None:
        if model not in (None, *WHEELS):
            raise InputError(f"there is no Create {model}: the model is 1, 2, or None to detect it")
        if isinstance(stop_on, str) or set(stop_on) - set(HAZARDS):
            raise InputError(f"stop_on is a list of {', '.join(HAZARDS)}, not {stop_on}")
        if not (max_speed > 0 and max_turn > 0):
            raise InputError(f"limits are above 0, not {max_speed} m/s and {max_turn} rad/s")
        self.port, self.max_speed, self.max_turn, self._epoch = port, max_speed, max_turn, epoch
        self._asked_model, self._stop_on = model, frozenset(stop_on)
        self._mode, self._robot, self._period = Mode.FULL if full else Mode.SAFE, robot, odometry_period
        self._open_line, self._exit_hooks = open_line, exit_hooks
        self._line: Line | None = None
        self._feed = SensorFeed(2, robot, odometry_period, epoch)

    def open(self) -> Self:
        """Open the line, start the stream and enter the mode.

        A robot that does not enter its mode, because it charges or a wheel hangs, can be read, not driven.

        Raises
        ------
        RobotError
            If the robot does not answer within a second at its baud rate.
        """
        if self._line is not None:
            raise RobotError(f"the Create on {self.port} is open already: close it first")
        line = self._open_line(self.port, self._asked_model)
        self.model = line.model
        self._ended = machine.new_event()
        self._fault: str | None = None
        self._armed = self._ask = False
        self._halted_at, self._halts, self._blames = 0.0, object(), object()  # new ones with each stop, each fault
        self._deadline: float | None = None
        self._commanded, self._hazards = (0, 0), set[str]()
        self._feed = SensorFeed(line.model, self._robot, self._period, self._epoch)
        self._last_ask = machine.monotonic()
        self._threads = [
            machine.new_thread(target=self._alive, args=(work, line), name=f"{name} of {self.port}")
            for name, work in (("reader", self._read), ("deadlines", self._watch))
        ]
        self._line = line
        try:
            if self._exit_hooks:
                guard(self)
            for thread in self._threads:
                thread.start()
            line.send(self._enter_mode + oi.HALT)
            if not self._wait(lambda: self._armed, 1.0):
                self._halt(f"it did not enter {self._mode.name.lower()} mode{self._feed.because}")
        except BaseException:
            self.close()
            raise
        return self

    def __enter__(self) -> Self:
        return self.open() if self._line is None else self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the wheels, leave the robot in passive mode, and close the port. Never raises."""
        line = self._line
        if line is None:
            return
        self._halt(None)
        self._wait(lambda: not self._feed.told_to_move, 0.3)
        self._ended.set()
        with contextlib.suppress(RobotError):
            line.send(LEAVE)
        for thread in self._threads:
            if thread.is_alive() and thread is not machine.current_thread():
                thread.join(timeout=1.0)
        line.close()
        self._line = None
        release(self)

    def drive(self, v: float, w: float, lease: float = LEASE, granted: float | None = None) -> tuple[float, float]:
        """Drive for a moment; call it again before that ends.

        The motion ends after `lease`, and so early that the wheels stand within `STAND_WITHIN` of the last sign of
        life of what it depends on: this call, `granted`, sensor data, and the watchdog. The faster, the earlier.

        Parameters
        ----------
        v, w
            Speed ahead [m/s] and turn rate to the left [rad/s]. Beyond the limits both are reduced alike, so that the
            curve stays the same.
        lease
            Duration of the motion [s].
        granted
            Time of a permission that the motion depends on [s, monotonic].

        Returns
        -------
        tuple of float
            (v, w) as sent, in whole mm/s of each wheel; (0, 0) if too long ago was seen what the motion depends on.

        Raises
        ------
        InputError
            If the arguments are not a motion.
        RobotError
            If the robot must not drive.
        """
        if not (math.isfinite(v) and math.isfinite(w)):
            raise InputError(f"drive({v}, {w}) is not a motion: give finite m/s and rad/s")
        if not 0 < lease <= MAX_LEASE:
            raise InputError(f"a lease must be above 0 and at most {MAX_LEASE} s, not {lease} s: renew it instead")
        halts, line = self._halts if self._line else None, self._may_drive()
        half = WHEELS[self.model].base / 2
        wheel = (abs(v) + abs(w) * half) * 1e3 / oi.MAX_WHEEL_SPEED
        slower = max(1.0, abs(v) / self.max_speed, abs(w) / self.max_turn, wheel)
        left, right = (round((v + side * w * half) / slower * 1e3) for side in (-1, 1))
        now = machine.monotonic()
        seen = min(self._feed.last, now - line.watchdog_silence, now if granted is None else granted)
        deadline = min(now + lease, seen + reaction_time(max(abs(left), abs(right)) * 1e-3))
        if deadline <= now:
            self._halt(None)
            return 0.0, 0.0
        self._ask |= (left, right) != self._commanded
        self._commanded, self._deadline = (left, right), deadline
        try:
            line.permit(deadline)
            line.send(oi.drive_direct(right, left))
        except RobotError as error:
            self._halt(str(error))
            raise
        if self._halts is not halts:  # stopped while this was under way: the stop has the last word
            self._halt(None)
            self._may_drive()
        return (left + right) / 2e3, (right - left) * 1e-3 / (2 * half)

    def stop(self) -> None:
        """Stop the wheels now. Raises `RobotError` if the command cannot be sent."""
        self._halt(None)
        if self._line is None or self._line.lost:
            self._may_drive()

    def emergency_stop(self, reason: str) -> None:
        """Stop the wheels now and do not drive again before `recover`; never raises."""
        if self._line is not None:
            self._halt(reason)

    def recover(self, timeout: float = 1.0) -> None:
        """Permit driving again after a fault.

        A hazard that is still there (a cliff to back away from) does not stop the robot again, a new one does.

        Parameters
        ----------
        timeout
            Time that the robot has to enter its mode [s].

        Raises
        ------
        RobotError
            If it does not enter its mode in time, or the line is lost.
        """
        line = self._line
        if line is None or line.lost:
            line = self._may_drive()
        self._halt(None)
        blames, state = self._blames, self._feed.state
        asleep = self._feed.age > STALE or state is None or state.mode == Mode.OFF
        self._armed = False
        line.send((bytes([oi.START]) if asleep else b"") + self._enter_mode + oi.HALT + oi.stream(line.layouts[0]))
        since = machine.monotonic() + 2 * oi.STREAM_PERIOD
        if not self._wait(lambda: self._armed and self._feed.last > since, timeout):
            why = f"it did not go back to {self._mode.name.lower()} mode{self._feed.because}"
            self._halt(why)
            raise RobotError(f"the Create on {self.port} cannot continue, {why}: correct that and try again")
        self._fault = None
        if self._blames is not blames:
            self._fault = "it was stopped again while it recovered"
            self._may_drive()

    @property
    def state(self) -> CreateState:
        """The newest sensor data."""
        if self._line is None or self._feed.state is None:
            raise RobotError(f"the Create on {self.port} has sent no sensor data yet: open it first")
        return self._feed.state

    @property
    def odometry(self) -> OdometrySample:
        """The newest odometry sample; `take_odometry` returns all of them."""
        if self._line is None or self._feed.sample is None:
            raise RobotError(f"the Create on {self.port} has no odometry yet: open it, and wait for the first sample")
        return self._feed.sample

    def take_odometry(self) -> list[OdometrySample]:
        """Return all samples since the last call (the newest 20 000), each with its increment's covariance."""
        return self._feed.take_samples()

    @property
    def moving(self) -> bool:
        """True while a drive command holds, or the robot reports that it has one."""
        return self._line is not None and (self._deadline is not None or self._feed.told_to_move)

    @property
    def fault(self) -> str | None:
        """Reason for which the robot does not drive; None if it does."""
        return self._fault if self._line else "it is not open"

    @property
    def lost(self) -> bool:
        """True if the line is lost or not open: open it again."""
        return self._line is None or self._line.lost is not None

    @property
    def awaits_port(self) -> bool:
        """True while the port of a lost line is awaited, to stop the robot as soon as it is back; do not close then."""
        return self._line is not None and self._line.lost is not None and self._threads[0].is_alive()

    @property
    def frames(self) -> tuple[int, int]:
        """Counts of valid and of damaged frames since the line was opened."""
        return self._line.frames if self._line else (0, 0)

    @property
    def _enter_mode(self) -> bytes:
        return bytes([oi.FULL if self._mode == Mode.FULL else oi.SAFE])

    def _may_drive(self) -> Line:
        """Return the line. Raises `RobotError` if the robot must not drive."""
        if self._line is None:
            raise RobotError(f"the Create on {self.port} is not open: open it, best as a context manager")
        why, remedy = self._fault, "put it right and call recover()"
        if self._line.lost:
            why, remedy = f"its line is lost ({self._line.lost})", "check the cable, close it and open it again"
        elif why is None and not self._wait(lambda: self._feed.age <= STALE, FRESH):
            why = f"no sensor data came for {STALE} s"
            self._halt(why)
        if why is not None:
            raise RobotError(f"the Create on {self.port} does not drive, {why}: {remedy}")
        return self._line

    def _halt(self, fault: str | None) -> None:
        """Stop the wheels and keep the reason; never raises."""
        self._halts, self._blames = object(), object() if fault else self._blames
        new, self._fault = bool(fault and not self._fault), self._fault or fault
        self._deadline, self._commanded, self._halted_at = None, (0, 0), machine.monotonic()
        if self._line is not None:
            with contextlib.suppress(RobotError):
                self._line.send(oi.HALT)
            with contextlib.suppress(RobotError):
                self._line.permit(None)
        if new:
            log.warning("Create on %s stops: %s", self.port, fault)

    def _wait(self, met: Callable[[], bool], timeout: float) -> bool:
        return self._feed.wait(met, lambda: self._line is None or self._line.lost is not None, timeout)

    def _alive(self, work: Callable[[Line], None], line: Line) -> None:
        """Run a thread's work; when it fails, stop the wheels and report it."""
        try:
            work(line)
        except BaseException as error:
            if not self._ended.is_set():
                self._halt(str(error) if isinstance(error, RobotError) else f"its driver failed ({error!r})")
                if line.lost and work == self._read:
                    line.stop_when_back(self._ended)

    def _read(self, line: Line) -> None:
        """Reader thread: take in frames, and stop for what they report."""
        while not self._ended.is_set():
            for values in line.read():
                if line.model == 1 and Packet.DISTANCE in values:
                    line.send(oi.stream(line.layouts[0]))
                state = self._feed.take(values)
                if state is not None:
                    self._judge(state)
                self._feed.notify()
            if line.model == 1 and (self._ask or machine.monotonic() - self._last_ask > DELTA_PERIOD):
                self._ask, self._last_ask = False, machine.monotonic()
                line.send(oi.stream(line.layouts[1]))

    def _judge(self, state: CreateState) -> None:
        """Stop if the robot left its mode or met a hazard to stop on."""
        hazards = state.hazards()
        new = [said for name, said in hazards.items() if name in self._stop_on and name not in self._hazards]
        left_mode = self._armed and state.mode != self._mode and not self._ended.is_set()
        self._armed, self._hazards = state.mode == self._mode, set(hazards)
        if left_mode:
            self._halt(f"it left {self._mode.name.lower()} mode for {state.mode.name.lower()}{self._feed.because}")
        elif new:
            self._halt(f"it met {' and '.join(new)}")

    def _watch(self, line: Line) -> None:
        """Deadline thread: end each motion in time, and repeat a stop that the robot has not taken."""
        wait = WATCH_PERIOD
        while not self._ended.wait(wait):
            line.beat()
            now, deadline = machine.monotonic(), self._deadline
            wait = WATCH_PERIOD if deadline is None else min(max(deadline - now, 0.0), WATCH_PERIOD)
            if deadline is not None and now >= deadline:
                self._halt(None)
            elif deadline is not None and self._feed.age > STALE:
                self._halt(f"no sensor data came for {STALE} s")
            elif self._fault is None and line.watchdog_silence > HUNG:
                self._halt(f"its watchdog process has not answered for {HUNG:g} s")
            elif deadline is not None or line.lost:
                continue
            elif self._feed.told_to_move and now - self._halted_at > REPEAT_PERIOD:
                self._halt(None)
