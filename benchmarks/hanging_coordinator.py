"""A coordinator that hangs when it is sent a signal, and prints when: for `stop_times.py`.

    python benchmarks/hanging_coordinator.py TEAM.toml FOLDER ADDRESS SPEED

SIGUSR1: its main loop hangs. SIGUSR2: it hangs while it asks robot A. Each for `HANG` s.
"""

import argparse
import contextlib
import signal
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("team", "folder", "address"):
        parser.add_argument(name)
    parser.add_argument("speed", type=float, help="speed of the robots [m/s]")
    arguments = parser.parse_args()
    asks = threading.Event()
    send, step = CoordinatorLink._send, leap_frog.LeapFrog.step

    def hanging_send(link: CoordinatorLink, *rest: Any) -> None:
        if asks.is_set():
            asks.clear()
            hang()
        send(link, *rest)

    def asking_step(mission: leap_frog.LeapFrog) -> None:
        if asks.is_set():
            with contextlib.suppress(RobotError):  # the answer comes too late
                mission._commander.ask("A", EndCapture())
        step(mission)

    leap_frog.DRIVE_TIME = float("inf")
    CoordinatorLink._send = hanging_send
    leap_frog.LeapFrog.step = asking_step
    signal.signal(signal.SIGUSR1, lambda *_: hang())
    signal.signal(signal.SIGUSR2, lambda *_: asks.set())
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    team, options = read_team(arguments.team), MissionOptions(speed=arguments.speed, attempts=1000)
    with Coordinator(team, arguments.folder, options, listen=arguments.address) as coordinator:
        coordinator.run(stop)


if __name__ == "__main__":
    main()
