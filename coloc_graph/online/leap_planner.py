"""The next stance's plan: the observer that leaps, its target, and the mover's waypoints; `LeapPlanner`."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.se2 import Planar
from coloc_graph.online.formation import STAGGER, Formation
from coloc_graph.online.robot_registry import RobotRegistry
from coloc_graph.online.visibility import InView
from coloc_graph.pipeline.incremental import EnteredStance
from coloc_graph.run import Stance
from coloc_graph.team import Team


@dataclass(frozen=True, eq=False)
class StancePlan:
    """Plan of stance `index`.

    Attributes
    ----------
    leap
        Observer that leaps and its target in the world (x [m], y [m], yaw [rad]); None where nobody leaps.
    patrol
        Waypoints (n, 2) [m] of the mover, in the world, spread over what all observers see.
    duration
        Time of the mover's drive after which the stance ends [s]; None to end it once it is precise enough.
    mover_first
        True if the observer leaps only once the mover is where its drive begins: their ways come near each other.
    """

    index: int
    leap: tuple[str, Planar] | None
    patrol: NDArray[np.float64]
    duration: float | None = None
    mover_first: bool = False


class StancePlanner(Protocol):
    """Planner of a mission's stances."""

    def plan(self, index: int, before: Stance | None, attempt: int) -> StancePlan:
        """Plan stance `index` after the one `before` it; `attempt` counts the attempts at it that failed."""

    def drives(self, robot: str) -> bool:
        """Return whether a robot drives in the present plan."""

    def take(self, entered: EnteredStance) -> None:
        """Take in a stance that has entered the estimate."""

    def at_goal(self, poses: Mapping[str, Planar]) -> bool:
        """Return whether the observers have come to the goal."""


class LeapPlanner:
    """Plans stances from the robots' present poses; `mover` is not one of the formation's observers."""

    def __init__(self, team: Team, mover: str, formation: Formation, registry: RobotRegistry) -> None:
        markers = team[mover].markers
        assert markers is not None
        self._team, self._mover, self._p_markers = team, mover, markers.p_body
        self._formation, self._registry = formation, registry
        self._plan: StancePlan | None = None

    def plan(self, index: int, before: Stance | None, attempt: int) -> StancePlan:
        """Plan a stance after the one `before` it. Another attempt at it keeps the leap, and mirrors the patrol.

        Raises
        ------
        InputError
            If the observers see too little of the floor together.
        """
        poses = self._registry.poses()
        leap = None if before is None else self._next_leap(before, poses)
        if self._plan is not None and self._plan.index == index:
            leap = self._plan.leap
        if leap is not None:
            poses[leap[0]] = leap[1]
        standing = {name: poses[name] for name in self._formation.observers}
        views = list(InView(self._team, self._mover, standing).views.values())
        patrol = self._formation.patrol(standing, views, self._p_markers, bool((index + attempt) % 2))
        self._plan = StancePlan(index, leap, patrol)
        return self._plan

    def drives(self, robot: str) -> bool:
        """Return whether a robot drives in the present plan."""
        leap = self._plan.leap if self._plan is not None else None
        return robot == self._mover or (leap is not None and leap[0] == robot)

    def take(self, entered: EnteredStance) -> None:
        """Take in a stance that has entered the estimate: the formation stays as it is."""

    def at_goal(self, poses: Mapping[str, Planar]) -> bool:
        """Return whether the middle of the observers has come within half a stagger of the goal."""
        return self._formation.progress(poses) >= self._formation.course.length - STAGGER / 2

    def _next_leap(self, before: Stance, poses: dict[str, Planar]) -> tuple[str, Planar]:
        """Choose the observer that leaps, and its target.

        One that has set off already, under an earlier coordinator, is the one.
        """
        formation = self._formation
        under_way = [name for name in formation.observers if self._registry[name].tracker.moved_since(before.end)]
        if not under_way:
            return formation.next_leap(poses)
        ways = formation.ways(poses)
        front = max(way for name, way in ways.items() if name != under_way[0])
        return under_way[0], formation.place(under_way[0], front + STAGGER)
