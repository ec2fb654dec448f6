"""The next stance's plan: the observer that leaps, its target, and the mover's waypoints; `LeapPlanner`."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.se2 import Planar, segment_distance
from coloc_graph.online.formation import STAGGER, Formation
from coloc_graph.online.mission import MissionOptions
from coloc_graph.online.visibility import InView, Precision
from coloc_graph.pipeline.incremental import EnteredStance
from coloc_graph.team import Team


@dataclass(frozen=True, eq=False)
class StancePromise:
    """Promise of a planned stance.

    Attributes
    ----------
    standing
        Poses of the observers in the world (x [m], y [m], yaw [rad]), by name, leaps done.
    covariances
        Covariance (3, 3) of x [m], y [m] in the world and of yaw [rad] of each after the stance.
    points
        Expected number of correspondences.
    end_sigma
        Expected sigma of the last positions, and of the last headings at an arm of 4 m, together [m].
    reason
        What decided, in one line for people.
    """

    standing: Mapping[str, Planar]
    covariances: Mapping[str, NDArray[np.float64]]
    points: float
    end_sigma: float
    reason: str


@dataclass(frozen=True, eq=False)
class StancePlan:
    """Plan of stance `index`.

    Attributes
    ----------
    leap
        Observer that leaps and its target in the world (x [m], y [m], yaw [rad]); None where nobody leaps.
    watching
        Observers that are to see the whole drive, in the team's order: the stance is theirs. Others only stand.
    patrol
        Waypoints (n, 2) [m] of the mover, in the world, spread over what they see.
    duration
        Time of the mover's drive after which the stance ends [s]; None to end it once it is precise enough.
    passing
        The observer is sent off once its way is this far from what the mover still has to drive to its first waypoint
        [m]; None to send it at once.
    promise
        What the stance is expected to bring; None where nothing is predicted.
    approach, detour
        Waypoints (n, 2) [m] of the mover before the first one of `patrol`, and of the observer before its target.
    """

    index: int
    leap: tuple[str, Planar] | None
    watching: tuple[str, ...]
    patrol: NDArray[np.float64]
    duration: float | None = None
    passing: float | None = None
    promise: StancePromise | None = None
    approach: tuple[tuple[float, float], ...] = ()
    detour: tuple[tuple[float, float], ...] = ()

    @property
    def placing(self) -> NDArray[np.float64]:
        """Waypoints (n, 2) [m] of the mover until it is where its drive begins."""
        return np.array([*self.approach, self.patrol[0]])

    def as_row(self) -> dict[str, object]:
        """Return the plan as a row of the mission's log."""
        row: dict[str, object] = {
            "stance": self.index,
            "leap": self.leap,
            "watching": self.watching,
            "patrol": np.round(self.patrol, 3).tolist(),
            "duration": self.duration,
        }
        if self.promise is not None:
            row["promise"] = {
                "standing": {name: np.round(pose, 6).tolist() for name, pose in self.promise.standing.items()},
                "covariances": {name: C.tolist() for name, C in self.promise.covariances.items()},
                "points": round(self.promise.points),
                "end_sigma": self.promise.end_sigma,
                "reason": self.promise.reason,
            }
        return row

    def may_leap(self, leaper: Planar, mover: Planar) -> bool:
        """Return whether the observer, where it stands, may set off while the mover is on its way to its drive."""
        if self.leap is None or self.passing is None:
            return True
        way = itertools.pairwise([mover[:2], *self.placing.tolist()])
        leap = itertools.pairwise([leaper[:2], *self.detour, self.leap[1][:2]])
        return all(segment_distance(*one, *other) > self.passing for one, other in itertools.product(leap, way))

    def ends(self, found: Precision, seconds: float, options: MissionOptions) -> str:
        """Return why a stance, as it was judged, may end after `seconds` [s]; empty if it may not."""
        if self.duration is None:
            return "the stance is precise enough" if found.suffices(options) else ""
        return "the stance is as long as planned" if not found.why and seconds >= self.duration else ""

    def drives(self, robot: str, mover: str) -> bool:
        """Return whether a robot drives in this plan, whose mover is `mover`."""
        return robot == mover or (self.leap is not None and self.leap[0] == robot)


@dataclass(frozen=True)
class Situation:
    """Situation in which a stance is planned.

    Attributes
    ----------
    index, attempt
        Number of the stance, and number of attempts at it that failed.
    poses
        Poses of all robots in the world (x [m], y [m], yaw [rad]), by name.
    moved
        Observers that have moved since the stance before: they are no anchors.
    missing
        Observers that did not see the mover in the attempt before.
    """

    index: int
    attempt: int
    poses: Mapping[str, Planar]
    moved: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()


class StancePlanner(Protocol):
    """Planner of a mission's stances."""

    def plan(self, situation: Situation) -> StancePlan:
        """Plan the next stance."""

    def take(self, entered: EnteredStance, poses: Mapping[str, Planar]) -> None:
        """Take in a stance that has entered the estimate, and where all robots then stood."""

    def at_goal(self, poses: Mapping[str, Planar]) -> bool:
        """Return whether the observers have come to the goal."""


class LeapPlanner:
    """Plans stances in the paper's formation; `mover` is not one of the formation's observers."""

    def __init__(self, team: Team, mover: str, formation: Formation) -> None:
        markers = team[mover].markers
        assert markers is not None
        self._team, self._mover, self._p_markers = team, mover, markers.p_body
        self._formation = formation
        self._plan: StancePlan | None = None

    def plan(self, situation: Situation) -> StancePlan:
        """Plan the next stance. Another attempt at it keeps the leap, and mirrors the patrol.

        Raises
        ------
        InputError
            If the observers see too little of the floor together.
        """
        index, poses = situation.index, dict(situation.poses)
        leap = None if index == 0 else self._next_leap(situation)
        if self._plan is not None and self._plan.index == index and leap is not None:
            leap = self._plan.leap
        if leap is not None:
            poses[leap[0]] = leap[1]
        standing = {name: poses[name] for name in self._formation.observers}
        views = list(InView(self._team, self._mover, standing).views.values())
        patrol = self._formation.patrol(standing, views, self._p_markers, bool((index + situation.attempt) % 2))
        self._plan = StancePlan(index, leap, self._formation.observers, patrol)
        return self._plan

    def take(self, entered: EnteredStance, poses: Mapping[str, Planar]) -> None:
        """Take in a stance that has entered the estimate: the formation stays as it is."""

    def at_goal(self, poses: Mapping[str, Planar]) -> bool:
        """Return whether the middle of the observers has come within half a stagger of the goal."""
        return self._formation.progress(poses) >= self._formation.course.length - STAGGER / 2

    def _next_leap(self, situation: Situation) -> tuple[str, Planar] | None:
        """Choose the observer that leaps, and its target; None if no anchor would be left.

        One that has set off already, under an earlier coordinator, is the one.
        """
        formation = self._formation
        if not situation.moved:
            return formation.next_leap(situation.poses)
        if len(situation.moved) == len(formation.observers):
            return None
        leaper = situation.moved[0]
        ways = formation.ways(situation.poses)
        front = max(way for name, way in ways.items() if name != leaper)
        return leaper, formation.place(leaper, front + STAGGER)
