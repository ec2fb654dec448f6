"""Causes that would explain measurements which contradict each other: a bumped anchor, or wrong measurements."""

from dataclasses import dataclass

from coloc_graph.backend.graph import Link, StayPut
from coloc_graph.measurements import Node, Odometry, Range, RelativePose, Sighting


@dataclass(frozen=True, eq=False)
class Cause:
    """Links of a graph that are wrong for one reason.

    Parameters
    ----------
    links : tuple of Link
        One stay-put constraint of a robot that was bumped, or wrong measurements.
    view : Node or None
        Observer and stance, where all that its camera measured there is wrong.
    """

    links: tuple[Link, ...]
    view: Node | None = None

    @property
    def is_bump(self) -> bool:
        """True if an anchor was bumped."""
        return isinstance(self.links[0], StayPut)

    def is_seen_in(self, stance: int) -> bool:
        """Return whether it is what cameras measured in a stance, and nothing else."""
        return all(isinstance(link, RelativePose | Sighting) and link.stance == stance for link in self.links)

    @property
    def robots(self) -> tuple[str, ...]:
        """Robots of which one, at least, is at fault."""
        if self.view is not None:
            return (self.view[0],)
        first = self.links[0]
        if isinstance(first, RelativePose):
            return first.robot_i, first.robot_j
        if isinstance(first, Sighting):
            return first.observer, first.seen
        if isinstance(first, Range):
            return first.robot, first.target
        return (first.robot,) if isinstance(first, StayPut | Odometry) else ()

    def __str__(self) -> str:
        first = self.links[0]
        if isinstance(first, StayPut):
            return f"robot {first.robot} was bumped between stances {first.before} and {first.after}"
        if self.view is not None:
            return f"all that {self.view[0]} observed in stance {self.view[1]} is wrong"
        if len(self.links) > 1 and isinstance(first, Odometry):
            return f"the odometry of {first.robot} is wrong"
        return f"the {first} is wrong"

    @property
    def check(self) -> str:
        """The remedy: what to check."""
        first = self.links[0]
        if isinstance(first, StayPut):
            return f"whether {first.robot} was pushed"
        if isinstance(first, Odometry):
            return f"the wheels and clock of {first.robot}"
        if self.view is not None:
            return f"whether the camera of {self.view[0]} was moved in stance {self.view[1]}"
        if isinstance(first, RelativePose):
            return f"the cameras of {first.robot_i} and {first.robot_j} in stance {first.stance}"
        if isinstance(first, Sighting):
            return f"the markers of {first.seen} in stance {first.stance}"
        if isinstance(first, Range):
            return f"what stood between {first.robot} and {first.target} in stance {first.stance}"
        return "the landmark's position"


def or_else(alternative: tuple[Cause, ...]) -> str:
    """Continue a sentence on a cause with those that explain as much; empty where there are none."""
    return f", or else {', or '.join(map(str, alternative))}" if alternative else ""


def to_check(*causes: Cause) -> str:
    """Join the remedies of some causes."""
    checks = list(dict.fromkeys(cause.check for cause in causes))
    return ", and ".join(checks[:2]) + "".join(f", and {one}" for one in checks[2:])
