"""The watchdog: a small process beside the driver that stops the wheels in time when the driver does not.

Nothing in a process can act on its own SIGKILL or SIGSTOP. The watchdog shares the driver's open serial line, knows
the deadline of each motion, and sends the stop command itself when that passes. Only the standard library is imported:
this module also runs as a program, to start at once and stay small.
"""

import contextlib
import os
import select
import signal
import struct
import subprocess
import sys
import threading
import time
from collections import deque

SILENCE = 0.12  # s without a message, while no motion has a deadline, after which the wheels are stopped
BEAT_PERIOD = 0.02  # s between two messages of the driver
REPEAT_PERIOD = 0.03  # s between two stop commands
LAST_STOPS = 4  # stop commands after the driver has ended: the first may complete a command that was half sent
WRITE_TIMEOUT = 0.2  # s that the serial line may take to accept a command
REALTIME_PRIORITY = 50  # of SCHED_FIFO, where the user may have it
_MESSAGE = struct.Struct("<q")  # deadline of the motion [ns, CLOCK_MONOTONIC], or one of the next two
STANDING = 0
_END = -1


class Watchdog:
    """Driver's end of a watchdog process for an open serial line.

    Parameters
    ----------
    line
        File descriptor of the serial line.
    halt
        Bytes that stop the wheels.
    leave
        Bytes that stop the wheels and end the session with the robot, sent after the driver has ended.
    """

    def __init__(self, line: int, halt: bytes, leave: bytes) -> None:
        command = [sys.executable, "-I", "-S", __file__, str(line), halt.hex(), leave.hex()]
        # a session of its own: a Ctrl-C, or a kill of the process group, is not for it
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=(line,), start_new_session=True, bufsize=0
        )
        assert self._process.stdin is not None and self._process.stdout is not None
        self._pipe, self._answers = self._process.stdin.fileno(), self._process.stdout.fileno()
        self._lock = threading.RLock()  # a signal handler may stop the wheels amid a command
        self._deadline = STANDING
        self._sent = 0.0
        self._unanswered: deque[float] = deque()
        self._alive = os.read(self._answers, 1) != b""  # it has started
        for pipe in (self._pipe, self._answers):
            os.set_blocking(pipe, False)

    def permit(self, until: float | None) -> bool:
        """Set the time until which the wheels may turn [s, monotonic], None when they stand.

        Returns
        -------
        bool
            False if the watchdog has ended.
        """
        with self._lock:
            self._deadline = STANDING if until is None else round(1e9 * until)
            return self._beat()

    def beat(self) -> bool:
        """Show that the driver runs, at most every `BEAT_PERIOD`; return False if the watchdog has ended."""
        with self._lock:
            return self._listen() if time.monotonic() - self._sent < BEAT_PERIOD else self._beat()

    @property
    def silence(self) -> float:
        """Time since the earliest message that the watchdog has not answered [s]; 0 if it answered all."""
        with self._lock:
            self._listen()
            return time.monotonic() - self._unanswered[0] if self._unanswered else 0.0

    def end(self) -> None:
        """End the watchdog; it leaves the line as it is."""
        with self._lock:
            if self._pipe >= 0:
                self._send(_END)
                self._pipe = self._answers = -1
                for pipe in (self._process.stdin, self._process.stdout):
                    if pipe is not None:
                        with contextlib.suppress(OSError):
                            pipe.close()
        try:
            self._process.wait(1.0)
        except subprocess.TimeoutExpired:  # it was stopped (SIGSTOP)
            self._process.kill()
            self._process.wait(1.0)

    def _beat(self) -> bool:
        if self._pipe < 0:
            return True
        self._listen()
        self._sent = time.monotonic()
        if self._send(self._deadline):
            self._unanswered.append(self._sent)
        return self._alive

    def _listen(self) -> bool:
        """Take in the answers, one byte a message."""
        if self._answers >= 0:
            try:
                answers = len(os.read(self._answers, 4096))
                self._alive = self._alive and answers > 0
            except BlockingIOError:
                answers = 0
            for _ in range(min(answers, len(self._unanswered))):
                self._unanswered.popleft()
        return self._alive

    def _send(self, word: int) -> bool:
        try:
            os.write(self._pipe, _MESSAGE.pack(word))
        except BlockingIOError:  # it is stopped (SIGSTOP) and the pipe is full
            return False
        except OSError:
            self._alive = False
            return False
        return True


class StopTimer:
    """Time at which the wheels are to be stopped, by the driver's messages; times are CLOCK_MONOTONIC [s]."""

    def __init__(self, now: float) -> None:
        self._limit, self._stopped = now + SILENCE, 0.0

    def take(self, word: int, now: float) -> None:
        """Take in the newest message: the deadline of a motion [ns], or that the wheels stand."""
        self._limit = now + SILENCE if word == STANDING else word * 1e-9

    def due(self, now: float) -> bool:
        """Return whether a stop command is to be sent now; it is to be repeated until a message comes."""
        if not (self._limit <= now and self._stopped + REPEAT_PERIOD <= now):
            return False
        self._stopped = now
        return True

    def next(self, now: float) -> float:
        """Return when a stop command is due next."""
        return self._limit if self._limit > now else self._stopped + REPEAT_PERIOD


def _stand_by(line: int, halt: bytes, leave: bytes) -> None:
    """Run the watchdog until the driver has ended."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGPIPE):
        signal.signal(number, signal.SIG_IGN)  # a supervisor signals all processes of a service; this one ends last
    _raise_priority()
    os.set_blocking(1, False)
    os.write(1, b".")
    timer = StopTimer(time.monotonic())
    while True:
        now = time.monotonic()
        if timer.due(now):
            _write(line, halt)
        if not select.select([0], [], [], max(timer.next(now) - time.monotonic(), 0.0))[0]:
            continue
        words = [word for (word,) in _MESSAGE.iter_unpack(os.read(0, 128 * _MESSAGE.size))]
        if not words:  # the driver has ended without a word
            break
        if words[-1] == _END:
            return
        with contextlib.suppress(OSError):
            os.write(1, bytes(len(words)))
        timer.take(words[-1], time.monotonic())
    for _ in range(LAST_STOPS):
        _write(line, halt)
        time.sleep(REPEAT_PERIOD)
    _write(line, leave)


def _raise_priority() -> None:
    """Run before other processes where the user may, so that a loaded computer delays no stop."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(REALTIME_PRIORITY))
    except (AttributeError, OSError):
        for niceness in (-20, -10, -5):
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, 0, niceness)
                return


def _write(line: int, data: bytes) -> None:
    with contextlib.suppress(OSError):
        if select.select([], [line], [], WRITE_TIMEOUT)[1]:
            os.write(line, data)


if __name__ == "__main__":
    _stand_by(int(sys.argv[1]), bytes.fromhex(sys.argv[2]), bytes.fromhex(sys.argv[3]))
