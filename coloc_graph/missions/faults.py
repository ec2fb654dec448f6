"""Faults of a simulated mission, drawn from its seed: each begins at a time and ends later; `draw_faults`."""

import random
from collections.abc import Sequence
from dataclasses import dataclass

from coloc_graph.online.mission_states import MissionState

COORDINATOR = "coordinator"
AFTERWARDS = (5.0, 30.0)  # time from a push to the kill that follows [s]
LATE = 0.7  # longest time of a state after which a fault that waits for it begins [s]

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
#: Kinds that are drawn more often than others: a resume, and stances that are taken again, have most to keep.
OFTEN = {"kill": 5, "push": 3}
#: States of the coordinator for one of which a fault waits, by how often; estimating is short.
STATES = {
    MissionState.PLANNING: 1,
    MissionState.PLACING: 1,
    MissionState.LOOKING: 1,
    MissionState.CAPTURING: 1,
    MissionState.ESTIMATING: 3,
}
NETWORK = ("cut", "loss", "delay", "duplication")
#: Faults that only robots have.
ROBOTS = (*NETWORK, "jump", "unplug", "freeze", "push")


@dataclass(frozen=True)
class Fault:
    """A fault of a kind that begins at `time` [s] on a robot or the coordinator, and is over after `duration` [s].

    With a `state` it begins when the coordinator is next in that state, `late` [s] after that is seen.
    """

    time: float
    kind: str
    where: str
    duration: float
    amount: float = 0.0
    state: str = ""
    late: float = 0.0

    def __str__(self) -> str:
        amount = f" {self.amount:.3g}" if self.amount else ""
        when = f", {self.late:.2f} s into {self.state}" if self.state else ""
        return f"{self.time:.2f} s{when}: {self.kind}{amount} of {self.where} for {self.duration:.2f} s"


def draw_faults(seed: int, robots: Sequence[str], count: int, until: float) -> tuple[Fault, ...]:
    """Draw faults of random kinds, places and times up to `until` [s].

    Half of them wait for a state. Half of the pushes are followed by a kill of the coordinator, which must not forget
    what the push did to its estimate.
    """
    draw = random.Random(seed)
    faults = []
    for _ in range(count):
        (kind,) = draw.choices(list(KINDS), [OFTEN.get(kind, 1) for kind in KINDS])
        where = draw.choice([*robots] if kind in ROBOTS else [*robots, *[COORDINATOR] * len(robots)])
        duration = draw.choice((0.1, 0.4, 1.0, 3.0, 8.0)) * draw.uniform(0.5, 1.5)
        time, amount, late = draw.uniform(0.0, until), draw.uniform(*KINDS[kind]), draw.uniform(0.0, LATE)
        (state,) = draw.choices(list(STATES), list(STATES.values())) if draw.random() < 0.5 else ("",)
        faults.append(Fault(time, kind, where, duration, amount, state, late if state else 0.0))
        if kind == "push" and draw.random() < 0.5:
            faults.append(Fault(time + draw.uniform(*AFTERWARDS), "kill", COORDINATOR, duration))
    return tuple(sorted(faults, key=lambda one: one.time))
