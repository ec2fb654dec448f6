"""What the coordinator is doing: the phases of a mission, and which follows which."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

log = logging.getLogger(__name__)


class Phase(StrEnum):
    """What goes on; the value is what is shown."""

    GATHERING = "gathering"  # waits until every robot answers, with a camera and wheels that work
    SYNCHRONISING = "synchronising"  # until every clock is known well enough
    PLACING = "placing"  # the next observer leaps to its place, the mover goes to where it begins
    LOOKING = "looking"  # all stand; is the mover in the observers' views?
    CAPTURING = "capturing"  # the mover drives about before the observers' cameras
    TURNING_BACK = "turning back"  # the same, and the mover is on its way back into their views
    COLLECTING = "collecting"  # all stand; waits for the last detections
    ESTIMATING = "estimating"  # the stance is measured and entered
    HOLDING = "holding"  # something is wrong: all stand until it is mended
    DONE = "done"
    FAILED = "failed"


#: Which phase may follow which.
FOLLOWS: dict[Phase, tuple[Phase, ...]] = {
    Phase.GATHERING: (Phase.SYNCHRONISING,),
    Phase.SYNCHRONISING: (Phase.PLACING, Phase.HOLDING),
    Phase.PLACING: (Phase.LOOKING, Phase.HOLDING),
    Phase.LOOKING: (Phase.CAPTURING, Phase.HOLDING),
    Phase.CAPTURING: (Phase.COLLECTING, Phase.TURNING_BACK, Phase.HOLDING),
    Phase.TURNING_BACK: (Phase.CAPTURING, Phase.COLLECTING, Phase.HOLDING),
    Phase.COLLECTING: (Phase.ESTIMATING, Phase.HOLDING),
    Phase.ESTIMATING: (Phase.PLACING, Phase.DONE, Phase.HOLDING),
    Phase.HOLDING: (Phase.SYNCHRONISING,),
    Phase.DONE: (),
    Phase.FAILED: (),
}


@dataclass(frozen=True)
class Change:
    """A phase that began, when [s, monotonic clock], in which stance, and why."""

    phase: Phase
    time: float
    stance: int
    why: str


class Phases:
    """The phase of a mission, and every change of it; `changed` hears of each."""

    def __init__(self, changed: Callable[[Change], None]) -> None:
        self._changed = changed
        self.now = Phase.GATHERING
        self.since = time.monotonic()

    def enter(self, phase: Phase, stance: int, why: str = "") -> None:
        """Begin a phase. `ValueError` where it cannot follow, but for the end, which any may come to."""
        if phase not in FOLLOWS[self.now] and (phase != Phase.FAILED or not FOLLOWS[self.now]):
            raise ValueError(f"{phase} cannot follow {self.now}")
        self.now, self.since = phase, time.monotonic()
        log.log(
            logging.WARNING if phase in (Phase.HOLDING, Phase.FAILED) else logging.INFO,
            "stance %d: %s%s", stance, phase, f": {why}" if why else "",
        )  # fmt: skip
        self._changed(Change(phase, self.since, stance, why))


def as_dot() -> str:
    """The phases as a Graphviz drawing."""
    lines = ["digraph mission {", "  rankdir=LR;", '  node [shape=box, style=rounded, fontname="sans-serif"];']
    lines += [f'  "{phase}" -> "{after}";' for phase, follows in FOLLOWS.items() for after in follows]
    going = [phase for phase in FOLLOWS if FOLLOWS[phase]]
    lines += [f'  "{phase}" -> "{Phase.FAILED}" [style=dotted];' for phase in going]
    return "\n".join([*lines, "}"])
