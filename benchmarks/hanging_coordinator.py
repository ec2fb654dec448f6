"""A coordinator that hangs when it is sent a signal, and prints when: for `stop_times.py`.

    python benchmarks/hanging_coordinator.py TEAM.toml FOLDER ADDRESS SPEED

SIGUSR1: its main loop hangs. SIGUSR2: it hangs while it asks robot A. Each for `HANG` s.
"""

import contextlib
import signal
import sys
import threading
import time
from typing import Any

from coloc_graph.errors import RobotError
from coloc_graph.online import leap_frog
from coloc_graph.online.coordinator import Coordinator
from coloc_graph.online.mission import MissionOptions
from coloc_graph.robot_io.link.coordinator_link import CoordinatorLink
from coloc_graph.robot_io.link.messages import EndCapture
from coloc_graph.team import read_team

HANG = 1.2  # duration of a hang [s]


def hang() -> None:
    """Hang, and print the time at which that began [s, monotonic clock]."""
    print(time.monotonic(), flush=True)
    time.sleep(HANG)


def main() -> None:
    """Lead the team until SIGTERM; drives may take any time."""
    team, folder, address, speed = sys.argv[1:]
    asks = threading.Event()
    send, step = CoordinatorLink._send, leap_frog.LeapFrog.step

    def hanging_send(link: CoordinatorLink, *arguments: Any) -> None:
        if asks.is_set():
            asks.clear()
            hang()
        send(link, *arguments)

    def asking_step(mission: leap_frog.LeapFrog) -> None:
        if asks.is_set():
            with contextlib.suppress(RobotError):  # the answer comes too late
                mission._commander.ask("A", EndCapture())
        step(mission)

    leap_frog.DRIVE_TIME = float("inf")
    CoordinatorLink._send = hanging_send  # type: ignore[method-assign]
    leap_frog.LeapFrog.step = asking_step  # type: ignore[method-assign]
    signal.signal(signal.SIGUSR1, lambda *_: hang())
    signal.signal(signal.SIGUSR2, lambda *_: asks.set())
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    with Coordinator(
        read_team(team), folder, MissionOptions(speed=float(speed), attempts=1000), listen=address
    ) as coordinator:
        coordinator.run(stop)


if __name__ == "__main__":
    main()
