"""Handle signals and logging of programs that run until they are stopped."""

import logging
import select
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from coloc_graph.cli.nonblocking_log import NonBlockingHandler

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
READER_WAIT = 2.0  # s, for which stdout and stderr may block after a signal


@contextmanager
def until_signal() -> Iterator[threading.Event]:
    """Yield an event that SIGINT, SIGTERM or SIGHUP sets, and log to stderr meanwhile without ever blocking on it.

    SIGHUP stays ignored if it was ignored before, as under nohup. SIGINT, which shells ignore for programs in the
    background, does not.
    """
    stop = threading.Event()
    numbers = [n for n in SIGNALS if n != signal.SIGHUP or signal.getsignal(n) != signal.SIG_IGN]
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in numbers}
    root, handler = logging.getLogger(), NonBlockingHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s", "%H:%M:%S"))
    level = root.level
    root.addHandler(handler)
    root.setLevel(logging.INFO)
    logging.captureWarnings(True)
    try:
        yield stop
    finally:
        logging.captureWarnings(False)
        root.removeHandler(handler)
        root.setLevel(level)
        handler.close()
        for number, earlier in before.items():
            signal.signal(number, earlier)


def output_is_read() -> bool:
    """Return whether stdout and stderr take a few lines within `READER_WAIT` without waiting for their reader."""
    for stream in (sys.stdout, sys.stderr):
        try:
            if not select.select([], [stream.fileno()], [], READER_WAIT)[1]:
                return False
        except (OSError, ValueError):  # no file behind it
            continue
    return True
