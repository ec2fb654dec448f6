"""Serial line to a Create, with a timeout for every operation; `CreateLine`."""

import contextlib
import errno
import select
import threading
from typing import Protocol

import serial

from coloc_graph.errors import RobotError
from coloc_graph.machine import machine
from coloc_graph.robot_io.create import protocol as oi
from coloc_graph.robot_io.create.odometry import WHEELS
from coloc_graph.robot_io.create.protocol import Packet
from coloc_graph.robot_io.create.state import DELTAS, STREAMED
from coloc_graph.robot_io.create.watchdog import Watchdog

ANSWER_TIMEOUT = 1.0  # s that a robot may take to answer at one baud rate
WRITE = 0.2  # s that a write may take
READ = 0.05  # s that a read waits for bytes
RETURN_PERIOD = 0.05  # s between two attempts to open a lost port
RELEASE_TIMEOUT = 0.5  # s to wait for a port that another driver held
#: Commands that leave a robot standing, silent and in passive mode.
LEAVE = oi.HALT + oi.pause_stream() + bytes([oi.START])


class Line(Protocol):
    """A line to a robot that streams; see `CreateLine`."""

    model: int
    layouts: list[tuple[Packet, ...]]
    lost: str | None

    def send(self, data: bytes) -> None:
        """Write these bytes."""

    def read(self) -> list[dict[int, int]]:
        """Return the frames that come within `READ`."""

    def permit(self, until: float | None) -> None:
        """Tell the watchdog until when the wheels may turn [s, monotonic]."""

    def beat(self) -> None:
        """Show the watchdog that the driver runs."""

    @property
    def watchdog_silence(self) -> float:
        """Time for which the watchdog has not answered [s]."""

    @property
    def frames(self) -> tuple[int, int]:
        """Counts of valid and of damaged frames."""

    def stop_when_back(self, ended: threading.Event) -> None:
        """Stop the robot as soon as its port comes back, unless `ended` is set before."""

    def close(self) -> None:
        """Close the line."""


class CreateLine:
    """An open serial line on which a robot streams.

    Parameters
    ----------
    port
        Serial port.
    model
        1 or 2, None to detect it by baud rate and checksum.

    Attributes
    ----------
    lost
        Reason for which the line cannot be used any more; None while it can.

    Raises
    ------
    RobotError
        If the port cannot be opened, no robot answers, or the watchdog cannot be started.
    """

    def __init__(self, port: str, model: int | None) -> None:
        self.port = port
        self.lost: str | None = None
        self._lock = machine.new_lock()
        self._watchdog: Watchdog | None = None
        models = [model] if model else [2, 1]
        try:
            self._serial = self._first_opened(models[0])
        except (OSError, ValueError) as error:
            raise RobotError(f"cannot open {port} ({error}): check that it is plugged in, free and yours") from error
        try:
            self.model = next((one for one in models if self._answers(one)), 0)
            if not self.model:
                bauds = " or ".join(str(WHEELS[one].baud) for one in models)
                raise RobotError(f"no Create answers on {port} at {bauds} baud: switch it on, check model and cable")
            self._watchdog = self._started_watchdog()
        except BaseException:
            self.close()
            raise

    def _started_watchdog(self) -> Watchdog:
        try:
            return Watchdog(self._serial.fileno(), oi.HALT, LEAVE)
        except OSError as error:
            raise RobotError(f"cannot start the watchdog process of {self.port} ({error}): free some memory") from error

    def _first_opened(self, model: int) -> serial.Serial:
        """Open the port, waiting until the watchdog of a driver that was killed has closed it."""
        until = machine.monotonic() + RELEASE_TIMEOUT
        while True:
            try:
                return self._opened(model)
            except OSError as error:
                if error.errno != errno.EAGAIN or machine.monotonic() > until:
                    raise
                machine.sleep(0.01)

    def _answers(self, model: int) -> bool:
        """Return whether valid frames come at this model's baud rate."""
        self.layouts = [STREAMED[1], (*STREAMED[1], *DELTAS)] if model == 1 else [STREAMED[2]]
        self.decoder = oi.StreamDecoder(*self.layouts)
        try:
            self._serial.baudrate = WHEELS[model].baud
            self._serial.reset_input_buffer()
        except OSError as error:
            raise RobotError(f"{self.port} cannot be set to {WHEELS[model].baud} baud ({error})") from error
        self.send(bytes([oi.START]) + oi.stream(self.layouts[0]))
        until = machine.monotonic() + ANSWER_TIMEOUT
        while machine.monotonic() < until and self.decoder.header_counts is None:
            self.read()
        return self.decoder.header_counts is not None

    def send(self, data: bytes) -> None:
        """Write these bytes. Raises `RobotError` if the line is lost or takes nothing."""
        if self.lost is None:
            held = self._lock.acquire(timeout=2 * WRITE)
            try:
                self._write(data)
                return
            except (OSError, TypeError, ValueError) as error:
                self.lost = self.lost or str(error)
            finally:
                if held:
                    self._lock.release()
        raise RobotError(f"the line on {self.port} is lost ({self.lost}): check the cable and open it again")

    def _write(self, data: bytes) -> None:
        # pyserial's own timeout fails if this process did not run meanwhile, though all was written
        until = machine.monotonic() + WRITE
        while data:
            _, ready, _ = select.select([], [self._serial.fileno()], [], max(until - machine.monotonic(), 0))
            if not ready:
                raise RobotError(f"{self.port} takes no bytes: check the cable and its flow control")
            data = data[self._serial.write(data) or 0 :]

    def read(self) -> list[dict[int, int]]:
        """Return the frames that come within `READ`. Raises `RobotError` if the line is lost."""
        try:
            return self.decoder.feed(self._serial.read(max(1, self._serial.in_waiting)))
        except (OSError, TypeError) as error:
            self.lost = self.lost or str(error)
            with contextlib.suppress(OSError, TypeError):  # the way out may be whole
                self._serial.write(oi.HALT)
            raise RobotError(
                f"the line on {self.port} is lost ({self.lost}): check the cable, open it again"
            ) from error

    def permit(self, until: float | None) -> None:
        """Tell the watchdog until when the wheels may turn [s, monotonic]; None when they stand."""
        self._require_watchdog(self._watchdog is None or self._watchdog.permit(until))

    def beat(self) -> None:
        """Show the watchdog that the driver runs. Raises `RobotError` if the watchdog has ended."""
        self._require_watchdog(self._watchdog is None or self._watchdog.beat())

    @property
    def frames(self) -> tuple[int, int]:
        """Counts of valid and of damaged frames."""
        return self.decoder.good, self.decoder.bad

    @property
    def watchdog_silence(self) -> float:
        """Time for which the watchdog has not answered [s]."""
        return self._watchdog.silence if self._watchdog is not None else 0.0

    def _require_watchdog(self, running: bool) -> None:
        if not running:
            if self.lost is None:
                with contextlib.suppress(RobotError):
                    self.send(oi.HALT)
                self.lost = self.lost or "its watchdog process has ended"
            raise RobotError(f"the line on {self.port} is lost ({self.lost}): open it again")

    def stop_when_back(self, ended: threading.Event) -> None:
        """Stop the robot as soon as its port comes back, unless `ended` is set before."""
        self.close()
        while not ended.wait(RETURN_PERIOD):
            with contextlib.suppress(OSError, ValueError), self._opened(self.model) as again:
                again.write(LEAVE)
                again.flush()
                return

    def _opened(self, model: int) -> serial.Serial:
        return serial.Serial(self.port, WHEELS[model].baud, timeout=READ, write_timeout=0, exclusive=True)

    def close(self) -> None:
        """Close the port."""
        self.lost = self.lost or "closed"
        watchdog, self._watchdog = self._watchdog, None
        if watchdog is not None:
            watchdog.end()
        with contextlib.suppress(OSError):
            self._serial.close()
