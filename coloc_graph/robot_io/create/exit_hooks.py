"""Exit hooks that stop devices when their process ends: at exit, and on SIGTERM, SIGINT and SIGHUP.

The user's own signal handlers are kept: the hook stops the devices, then calls the earlier handler, or lets the signal
have its default effect. A signal that is ignored (`nohup`, a background job of a script) stays ignored. Nothing in a
process can act on SIGKILL or SIGSTOP: see `watchdog.py`. Nothing acts when the computer itself fails.
"""

import atexit
import logging
import os
import signal
import threading
import weakref
from collections.abc import Callable
from types import FrameType
from typing import Any, Protocol

log = logging.getLogger(__name__)

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


class Stoppable(Protocol):
    """A device that moves and can be stopped."""

    def emergency_stop(self, reason: str) -> None:
        """Stop at once and refuse to go on. Never raises, never waits long; may be called in a signal handler."""

    def close(self) -> None:
        """Stop and close the device."""


_guarded: "weakref.WeakSet[Stoppable]" = weakref.WeakSet()
_before: dict[int, Callable[[int, FrameType | None], Any] | int] = {}
_process = 0


def guard(device: Stoppable) -> bool:
    """Stop this device when the process ends.

    Returns
    -------
    bool
        False if signals cannot be caught, as outside the main thread.
    """
    global _process
    if _process != os.getpid():  # the first here; a forked child has no business with its parent's robots
        _process = os.getpid()
        _guarded.clear()
        atexit.register(_at_exit, _process)
    _guarded.add(device)
    if threading.current_thread() is not threading.main_thread():
        if not _before:
            log.warning("opened outside the main thread: signals will not stop the wheels, the lease and the exit will")
        return bool(_before)
    for number in SIGNALS:
        handler = signal.getsignal(number)
        if handler is not _on_signal and handler not in (None, signal.SIG_IGN):
            _before[number] = handler
            signal.signal(number, _on_signal)
    return True


def release(device: Stoppable) -> None:
    """Stop guarding a device. After the last one the earlier signal handlers are restored, unless replaced since."""
    _guarded.discard(device)
    if _guarded or threading.current_thread() is not threading.main_thread():
        return
    for number, handler in list(_before.items()):
        if signal.getsignal(number) is _on_signal:
            signal.signal(number, handler)
            del _before[number]


def _on_signal(number: int, frame: FrameType | None) -> None:
    if os.getpid() == _process:
        for device in list(_guarded):
            device.emergency_stop(f"the process was sent {signal.Signals(number).name}")
    before = _before.get(number, signal.SIG_DFL)
    if callable(before):
        before(number, frame)
    else:
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)


def _at_exit(process: int) -> None:
    if os.getpid() == process:
        for device in list(_guarded):
            device.emergency_stop("the process ends")
        for device in list(_guarded):
            device.close()
