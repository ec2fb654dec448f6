"""`coloc` with a robot's clock that jumps by 0.3 s at each SIGUSR1."""

import signal
import time

from coloc_graph.cli import main
from coloc_graph.online.robot import RobotProgram

JUMP = 300_000_000
ahead = 0


def jump(*_):
    global ahead
    ahead += JUMP


signal.signal(signal.SIGUSR1, jump)
RobotProgram.__init__.__kwdefaults__["clock"] = lambda: time.monotonic_ns() + ahead
main()
