"""The serial line to a Create: found, opened, written to and read from, each with a timeout; `CreateLine`."""

import contextlib
import errno
import select
import threading
import time

import serial

from coloc_graph.errors import RobotError
from coloc_graph.robot_io.create import protocol as oi
from coloc_graph.robot_io.create.odometry import WHEELS
from coloc_graph.robot_io.create.state import DELTAS, STREAMED
from coloc_graph.robot_io.create.watchdog import Stopper

#: How long a robot may take to answer at one baud, a write or a read to end, a lost port to come back, and one that
#: another driver held to be free [s].
ANSWER = 1.0
WRITE = 0.2
READ = 0.05
BACK = 10.0
FREED = 0.5
#: Leaves a robot still, silent and passive.
LEAVE = oi.HALT + oi.pause_stream() + bytes([oi.START])


class CreateLine:
    """An open line on which a robot streams; `RobotError` where none answers. `model` 1, 2 or None to find out.

    `lost` says why it can be used no more, None while it can.
    """

    def __init__(self, port: str, model: int | None) -> None:
        self.port = port
        self.lost: str | None = None
        self._lock = threading.RLock()
        self._stopper: Stopper | None = None
        models = [model] if model else [2, 1]
        try:
            self._serial = self._first_opened(models[0])
        except (OSError, ValueError) as error:
            raise RobotError(f"cannot open {port} ({error}): is it plugged in, free, and yours to use?") from error
        try:
            self.model = next((one for one in models if self._answers(one)), 0)
            if not self.model:
                bauds = " or ".join(str(WHEELS[one].baud) for one in models)
                raise RobotError(f"no Create answers on {port} at {bauds} baud: switch it on, check model and cable")
            self._stopper = self._stood_by()
        except BaseException:
            self.close()
            raise

    def _stood_by(self) -> Stopper:
        try:
            return Stopper(self._serial.fileno(), oi.HALT, LEAVE)
        except OSError as error:
            raise RobotError(
                f"the process that stops the wheels on {self.port} when this one is killed cannot be started ({error})"
            ) from error

    def _first_opened(self, model: int) -> serial.Serial:
        """The port, once the stopper of a driver that was killed has let go of it."""
        until = time.monotonic() + FREED
        while True:
            try:
                return self._opened(model)
            except OSError as error:
                if error.errno != errno.EAGAIN or time.monotonic() > until:
                    raise
                time.sleep(0.01)

    def _answers(self, model: int) -> bool:
        """Whether sound frames come at this model's baud."""
        self.layouts = [STREAMED[1], (*STREAMED[1], *DELTAS)] if model == 1 else [STREAMED[2]]
        self.decoder = oi.StreamDecoder(*self.layouts)
        try:
            self._serial.baudrate = WHEELS[model].baud
            self._serial.reset_input_buffer()
        except OSError as error:
            raise RobotError(f"{self.port} cannot be set to {WHEELS[model].baud} baud ({error})") from error
        self.send(bytes([oi.START]) + oi.stream(self.layouts[0]))
        until = time.monotonic() + ANSWER
        while time.monotonic() < until and self.decoder.header_counts is None:
            self.read()
        return self.decoder.header_counts is not None

    def send(self, data: bytes) -> None:
        """Write these bytes. `RobotError` where the line is lost or takes nothing."""
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
        # pyserial's own timeout calls it one where this process was not run for so long, though all was written
        until = time.monotonic() + WRITE
        while data:
            _, ready, _ = select.select([], [self._serial.fileno()], [], max(until - time.monotonic(), 0))
            if not ready:
                raise RobotError(f"{self.port} takes no bytes: check the cable and its flow control")
            data = data[self._serial.write(data) or 0 :]

    def read(self) -> list[dict[int, int]]:
        """The frames that have come, after `READ` at most. `RobotError` where the line is lost."""
        try:
            return self.decoder.feed(self._serial.read(max(1, self._serial.in_waiting)))
        except (OSError, TypeError) as error:
            self.lost = self.lost or str(error)
            with contextlib.suppress(OSError, TypeError):  # the way out may be whole
                self._serial.write(oi.HALT)
            raise RobotError(
                f"the line on {self.port} is lost ({self.lost}): check the cable, open it again"
            ) from error

    def beat(self) -> None:
        """Tell the stopper that this process lives. `RobotError` where that one ended: nobody would stop the robot."""
        if self._stopper is not None and self.lost is None and not self._stopper.beat():
            with contextlib.suppress(RobotError):
                self.send(oi.HALT)
            self.lost = self.lost or "the process that stops the wheels when this one is killed has ended"
            raise RobotError(f"the line on {self.port} is lost ({self.lost}): open it again")

    def stop_when_back(self, ended: threading.Event) -> bool:
        """For some seconds after the line was lost, stop the robot if its port comes back. Whether it did."""
        until = time.monotonic() + BACK
        self.close()
        while time.monotonic() < until and not ended.wait(0.05):
            with contextlib.suppress(OSError, ValueError), self._opened(self.model) as again:
                again.write(LEAVE)
                again.flush()
                return True
        return False

    def _opened(self, model: int) -> serial.Serial:
        return serial.Serial(self.port, WHEELS[model].baud, timeout=READ, write_timeout=0, exclusive=True)

    def close(self) -> None:
        """Let go of the port."""
        self.lost = self.lost or "closed"
        stopper, self._stopper = self._stopper, None
        if stopper is not None:
            stopper.end()
        with contextlib.suppress(OSError):
            self._serial.close()
