"""Faults of a simulated mission, drawn from its seed: each begins at a time and ends later; `draw_faults`."""

import random
from collections.abc import Sequence
from dataclasses import dataclass

COORDINATOR = "coordinator"

#: Kinds of faults by name, and the least and largest amount of each, where it has one.
KINDS: dict[str, tuple[float, float]] = {
    "cut": (0.0, 0.0),  # nothing passes between a robot and the coordinator
    "loss": (0.02, 0.5),  # share of messages that are lost
    "delay": (0.02, 0.6),  # further mean delay of messages [s], which changes their order
    "duplication": (0.1, 0.6),  # share of messages that come twice
    "kill": (0.0, 0.0),  # a process is killed, and started again at the end
    "stop": (0.0, 0.0),  # a process is stopped (SIGSTOP), and goes on at the end
    "hang": (0.0, 0.0),  # only the main loop of a process stops, and goes on at the end
    "full": (0.0, 0.0),  # the disk of a host is full
    "slow": (0.005, 0.3),  # each write to the disk of a host takes this time [s]
    "jump": (-0.5, 0.5),  # a robot's clock jumps by this time [s]
    "unplug": (0.0, 0.0),  # the line to a robot's wheels is unplugged
    "freeze": (0.0, 0.0),  # a robot's camera delivers nothing
    "push": (0.03, 0.12),  # a robot is displaced by this distance [m]
}
NETWORK = ("cut", "loss", "delay", "duplication")
#: Faults that only robots have.
ROBOTS = (*NETWORK, "jump", "unplug", "freeze", "push")


@dataclass(frozen=True)
class Fault:
    """A fault of a kind that begins at `time` [s] on a robot or the coordinator, and is over after `duration` [s]."""

    time: float
    kind: str
    where: str
    duration: float
    amount: float = 0.0

    def __str__(self) -> str:
        amount = f" {self.amount:.3g}" if self.amount else ""
        return f"{self.time:.2f} s: {self.kind}{amount} of {self.where} for {self.duration:.2f} s"


def draw_faults(seed: int, robots: Sequence[str], count: int, until: float) -> tuple[Fault, ...]:
    """Draw faults of random kinds, places and times up to `until` [s]."""
    draw = random.Random(seed)
    faults = []
    for _ in range(count):
        kind = draw.choice(list(KINDS))
        where = draw.choice([*robots] if kind in ROBOTS else [*robots, COORDINATOR, COORDINATOR])
        duration = draw.choice((0.1, 0.4, 1.0, 3.0, 8.0)) * draw.uniform(0.5, 1.5)
        faults.append(Fault(draw.uniform(0.0, until), kind, where, duration, draw.uniform(*KINDS[kind])))
    return tuple(sorted(faults, key=lambda one: one.time))
