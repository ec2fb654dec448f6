"""Messages to systemd, which starts a robot's program as a service: `ServiceManager`."""

import contextlib
import os
import socket
import time
from types import TracebackType
from typing import Self

WATCHDOG_SHARE = 0.25  # of systemd's watchdog time, between two signs of life


class ServiceManager:
    """Notifications to the service manager of this process; does nothing where there is none.

    A context manager: at its end the service is reported as stopping.

    Notes
    -----
    Source: sd_notify(3). A datagram goes to the socket in ``NOTIFY_SOCKET``; ``WATCHDOG_USEC`` is the time [us] after
    which systemd ends a service that sent no sign of life, if ``WATCHDOG_PID`` is this process.
    """

    def __init__(self) -> None:
        self._address = _address(os.environ.get("NOTIFY_SOCKET", ""))
        self._period = _watchdog_seconds() * WATCHDOG_SHARE
        self._due = 0.0
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._send("STOPPING=1")
        self._socket.close()

    def ready(self) -> None:
        """Report that the service has started."""
        self._send("READY=1")

    def alive(self) -> None:
        """Report a sign of life, as often as the watchdog needs it; call it in each step of the main loop."""
        now = time.monotonic()
        if self._period and now >= self._due:
            self._due = now + self._period
            self._send("WATCHDOG=1")

    def _send(self, message: str) -> None:
        if self._address is None:
            return
        with contextlib.suppress(OSError):  # a service manager that went away must not stop a robot's program
            self._socket.sendto(message.encode(), self._address)


def _address(name: str) -> str | None:
    """Address of the socket; a leading @ stands for the abstract namespace."""
    if name.startswith("@"):
        return "\0" + name[1:]
    return name if name.startswith("/") else None


def _watchdog_seconds() -> float:
    """Time after which the service manager takes this process for dead [s]; 0 where it does not watch."""
    watched = os.environ.get("WATCHDOG_PID", str(os.getpid()))
    text = os.environ.get("WATCHDOG_USEC", "")
    return int(text) * 1e-6 if watched == str(os.getpid()) and text.isdecimal() else 0.0
