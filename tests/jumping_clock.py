"""A robot's program whose clock jumps 50 ms ahead at SIGUSR1: `python jumping_clock.py NAME TEAM.toml ...`."""

import signal
import sys
import time

from coloc_graph.cli.running import until_signal
from coloc_graph.online.robot import RobotProgram
from coloc_graph.team import read_team

AHEAD = [7_000_000_000]


def clock() -> int:
    return time.monotonic_ns() + AHEAD[0]


def jump(*_) -> None:
    AHEAD[0] += 50_000_000


def main() -> None:
    name, team, folder, connect, camera, wheels = sys.argv[1:]
    signal.signal(signal.SIGUSR1, jump)
    with (
        until_signal() as stop,
        RobotProgram(
            name, read_team(team), connect=connect, folder=folder, camera=camera, wheels=wheels, model=2, clock=clock
        ) as program,
    ):
        program.run(stop)


if __name__ == "__main__":
    main()
