"""A small process beside the one that drives, which stops the wheels when that one is killed, paused or hangs.

It shares the open line and hears a beat; nothing in the process that drives can act on its own SIGKILL. Only the
standard library is imported: it runs as a file, to be there at once and to stay small.
"""

import contextlib
import os
import select
import signal
import subprocess
import sys
import threading
import time

#: Without a beat for this long [s] it stops the wheels, again and again; how often a beat is sent [s].
SILENT = 0.35
BEAT = 0.1
#: Between two stops [s], and how many are sent once nobody can beat any more.
AGAIN = 0.03
LAST = 4
_BEAT = b"."
_END = b"q"


class Stopper:
    """Stands by an open line `fd`: sends `halt` when beats stay away, `halt` and `leave` when the process has ended."""

    def __init__(self, fd: int, halt: bytes, leave: bytes) -> None:
        command = [sys.executable, "-I", "-S", __file__, str(fd), halt.hex(), leave.hex()]
        # a session of its own: a Ctrl-C, or a kill of the process group, is not for it
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=(fd,), start_new_session=True
        )
        assert self._process.stdin is not None and self._process.stdout is not None
        self._pipe, self._beaten, self._lock = self._process.stdin.fileno(), 0.0, threading.Lock()
        os.set_blocking(self._pipe, False)
        self._process.stdout.read(1)  # it is there

    def beat(self) -> bool:
        """All is well here. Whether it still listens."""
        now = time.monotonic()
        with self._lock:
            if self._pipe < 0 or now - self._beaten < BEAT:
                return True
            self._beaten = now
            return self._say(_BEAT)

    def end(self) -> None:
        """Let it go: it leaves the line as it is."""
        with self._lock:
            self._say(_END)
            self._pipe = -1
            for pipe in (self._process.stdin, self._process.stdout):
                if pipe is not None:
                    with contextlib.suppress(OSError):
                        pipe.close()
        try:
            self._process.wait(1.0)
        except subprocess.TimeoutExpired:  # paused from outside
            self._process.kill()
            self._process.wait(1.0)

    def _say(self, word: bytes) -> bool:
        try:
            os.write(self._pipe, word)
        except BlockingIOError:  # paused from outside: the pipe is full
            return self._process.poll() is None
        except (OSError, ValueError):
            return False
        return True


def _stand_by(line: int, halt: bytes, leave: bytes) -> None:
    """The other process: until it is let go, or the one that drives has ended."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGPIPE):
        signal.signal(number, signal.SIG_IGN)  # a supervisor signals all of a service's processes; this one ends last
    os.write(1, _BEAT)
    wait = SILENT
    while True:
        heard = select.select([0], [], [], wait)[0]
        words = os.read(0, 1024) if heard else None
        if words is not None and words.endswith(_END):
            return
        if words == b"":
            break
        wait = SILENT if heard else AGAIN
        if not heard:
            _write(line, halt)
    for _ in range(LAST):  # one alone may end a command that was half sent
        _write(line, halt)
        time.sleep(AGAIN)
    _write(line, leave)


def _write(line: int, data: bytes) -> None:
    with contextlib.suppress(OSError):
        if select.select([], [line], [], 0.2)[1]:
            os.write(line, data)


if __name__ == "__main__":
    _stand_by(int(sys.argv[1]), bytes.fromhex(sys.argv[2]), bytes.fromhex(sys.argv[3]))
