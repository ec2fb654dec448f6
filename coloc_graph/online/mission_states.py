"""States of a mission, and which may follow which."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from coloc_graph.machine import machine

log = logging.getLogger(__name__)


class MissionState(StrEnum):
    """State of a mission; the value is its name for people."""

    GATHERING = "gathering"  # wait until every robot answers, and its camera and wheels work
    SYNCHRONISING = "synchronising"  # wait until every clock is known
    PLANNING = "planning"  # all stand: the next stance is decided
    PLACING = "placing"  # the next observer leaps, the mover drives to its first waypoint
    LOOKING = "looking"  # all stand: is the mover in the observers' views?
    CAPTURING = "capturing"  # the mover drives before the observers' cameras
    TURNING_BACK = "turning back"  # the same, while the mover drives back into their views
    COLLECTING = "collecting"  # all stand: wait for the last detections
    ESTIMATING = "estimating"  # all stand: the stance is measured and enters the estimate
    HOLDING = "holding"  # something is wrong: all stand until it is put right
    DONE = "done"
    FAILED = "failed"


NEXT_STATES: dict[MissionState, tuple[MissionState, ...]] = {
    MissionState.GATHERING: (MissionState.SYNCHRONISING,),
    MissionState.SYNCHRONISING: (MissionState.PLANNING, MissionState.HOLDING),
    MissionState.PLANNING: (MissionState.PLACING, MissionState.HOLDING),
    MissionState.PLACING: (MissionState.LOOKING, MissionState.HOLDING),
    MissionState.LOOKING: (MissionState.CAPTURING, MissionState.PLACING, MissionState.HOLDING),
    MissionState.CAPTURING: (MissionState.COLLECTING, MissionState.TURNING_BACK, MissionState.HOLDING),
    MissionState.TURNING_BACK: (MissionState.CAPTURING, MissionState.COLLECTING, MissionState.HOLDING),
    MissionState.COLLECTING: (MissionState.ESTIMATING, MissionState.HOLDING),
    MissionState.ESTIMATING: (MissionState.PLANNING, MissionState.DONE, MissionState.HOLDING),
    MissionState.HOLDING: (MissionState.SYNCHRONISING,),
    MissionState.DONE: (),
    MissionState.FAILED: (),
}


#: States in which all robots stand and wait: nothing that happens to them there voids a stance.
WAITING = {
    MissionState.GATHERING,
    MissionState.SYNCHRONISING,
    MissionState.HOLDING,
    MissionState.PLANNING,
    MissionState.COLLECTING,
    MissionState.ESTIMATING,
}


@dataclass(frozen=True)
class StateChange:
    """A state that began at `time` [s, monotonic clock] in a stance, and the reason."""

    state: MissionState
    time: float
    stance: int
    reason: str


class StateMachine:
    """The state of a mission. `on_change` is called with every change of it."""

    def __init__(self, on_change: Callable[[StateChange], None]) -> None:
        self._on_change = on_change
        self.now = MissionState.GATHERING
        self.since = machine.monotonic()

    def enter(self, state: MissionState, stance: int, reason: str = "") -> None:
        """Begin a state.

        Raises
        ------
        ValueError
            If it cannot follow the present one. `FAILED` can follow any but the last ones.
        """
        if state not in NEXT_STATES[self.now] and (state != MissionState.FAILED or not NEXT_STATES[self.now]):
            raise ValueError(f"{state} cannot follow {self.now}")
        self.now, self.since = state, machine.monotonic()
        log.log(
            logging.WARNING if state in (MissionState.HOLDING, MissionState.FAILED) else logging.INFO,
            "stance %d: %s%s", stance, state, f": {reason}" if reason else "",
        )  # fmt: skip
        self._on_change(StateChange(state, self.since, stance, reason))

    def lasted(self, seconds: float) -> bool:
        """Return whether the present state has lasted for longer than `seconds` [s]."""
        return machine.monotonic() - self.since > seconds


def as_dot() -> str:
    """Draw the states as a Graphviz graph."""
    lines = ["digraph mission {", "  rankdir=LR;", '  node [shape=box, style=rounded, fontname="sans-serif"];']
    lines += [f'  "{state}" -> "{after}";' for state, follows in NEXT_STATES.items() for after in follows]
    going = [state for state in NEXT_STATES if NEXT_STATES[state]]
    lines += [f'  "{state}" -> "{MissionState.FAILED}" [style=dotted];' for state in going]
    return "\n".join([*lines, "}"])


def as_mermaid() -> str:
    """Draw the states as a Mermaid diagram."""

    def name(state: MissionState) -> str:
        return state.replace(" ", "_")

    lines = ["stateDiagram-v2", f"  [*] --> {name(MissionState.GATHERING)}"]
    lines += [f"  {name(state)} --> {name(after)}" for state, follows in NEXT_STATES.items() for after in follows]
    lines += [f"  {name(state)} --> {name(MissionState.FAILED)}" for state in NEXT_STATES if NEXT_STATES[state]]
    return "\n".join(lines)
