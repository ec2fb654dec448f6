"""Log without ever blocking on the reader of stderr: `NonBlockingHandler`."""

import contextlib
import logging
import os
import queue
import threading

CAPACITY = 2000  # messages waiting to be written
LAST_WAIT = 0.5  # s, to write remaining messages when the program ends


class NonBlockingHandler(logging.Handler):
    """Write log messages to a file descriptor from a thread of its own.

    `emit` never waits: when nobody reads and `CAPACITY` messages wait, new ones are dropped, and their number is logged
    as soon as somebody reads again.
    """

    def __init__(self, descriptor: int = 2) -> None:
        super().__init__()
        self._descriptor = descriptor
        self._waiting: queue.Queue[bytes | None] = queue.Queue(CAPACITY)
        self._dropped, self._counting = 0, threading.Lock()
        # a daemon that uses no Python file object: a write that never returns does not hold up the interpreter's end
        self._writer = threading.Thread(target=self._write, name="log", daemon=True)
        self._writer.start()

    def emit(self, record: logging.LogRecord) -> None:
        """Queue one message."""
        try:
            self._waiting.put_nowait(f"{self.format(record)}\n".encode(errors="replace"))
        except queue.Full:
            with self._counting:
                self._dropped += 1

    def close(self) -> None:
        """Write the remaining messages, unless that takes longer than `LAST_WAIT`."""
        with contextlib.suppress(queue.Full):
            self._waiting.put_nowait(None)
            self._writer.join(LAST_WAIT)
        super().close()

    def _write(self) -> None:
        while (line := self._waiting.get()) is not None:
            if self._dropped and not self._waiting.qsize():
                with self._counting:
                    dropped, self._dropped = self._dropped, 0
                line += f"{dropped} log messages were dropped: nobody read them\n".encode()
            while line:
                try:
                    line = line[os.write(self._descriptor, line) :]
                except OSError:  # closed, or its reader has gone
                    break
