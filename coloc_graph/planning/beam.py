"""Plans that are followed at the same time while stances are looked ahead, and the choice: `Node`, `Decision`."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.se2 import Planar, wrap
from coloc_graph.planning.belief import Belief
from coloc_graph.planning.course import Course
from coloc_graph.planning.leaps import BEND
from coloc_graph.planning.plan import PlannedStance
from coloc_graph.planning.prediction import Promise

BEAM = 4  # plans that are followed from one stance to the next
MANY_BEAM = 3  # the same of more than two observers
CORNER_BEAM = 30  # the same before a corner
CORNER = 3.0  # a corner is near from this distance along the course on [m]
DIFFERENT = 0.15  # poses are compared one by one from this distance on, in which a radian counts as 0.5 m [m]


@dataclass(frozen=True, eq=False)
class Decision:
    """A planned stance with its promise, and where the team is to stand in the stances after it.

    Attributes
    ----------
    stance, promise
        The next stance, and what it promises.
    ahead
        Leaper, its target and the duration of each stance looked ahead, the next one first.
    expected
        Expected sigma of the observers' last poses at the end of the mission [m], as `Rollout.end_variance` has it; NaN
        where it is not computed.
    reason
        What decided, in one line for people.
    """

    stance: PlannedStance
    promise: Promise
    ahead: tuple[tuple[str, Planar, float], ...]
    expected: float = math.nan
    reason: str = ""


@dataclass(frozen=True, eq=False)
class Node:
    """A team after some planned stances: what it is believed to be, and how it came there.

    `by_gait` is true if the first of its leaps is that of the gait, `aside` if by it a robot makes way for another.
    """

    belief: Belief
    standing: Mapping[str, Planar]
    seconds: float
    score: float
    choices: tuple[tuple[str, Planar, float], ...] = ()
    by_gait: bool = False
    aside: bool = False

    def after(
        self,
        leaper: str,
        target: Planar,
        seconds: float,
        left: float,
        score: float,
        covariance: NDArray[np.float64] | None,
        *,
        by_gait: bool,
    ) -> "Node":
        """Return the team after a leap and a stance of `seconds`, with `left` [s] and, if it is known, a covariance."""
        belief = self.belief
        leapt = math.dist(belief.poses[leaper][:2], target[:2])
        belief = replace(
            belief,
            poses={**belief.poses, leaper: target},
            covariance=belief.covariance if covariance is None else covariance,
            leapt={**belief.leapt, leaper: leapt},
        )
        standing, choices = {**self.standing, leaper: target}, (*self.choices, (leaper, target, seconds))
        return Node(belief, standing, left, score, choices, by_gait, self.aside)


def beam_width(course: Course, standing: Sequence[Planar]) -> int:
    """Number of plans that are followed from one stance to the next: more before a corner, where most end."""
    ways = [course.way_of(pose) for pose in standing]
    headings = [course.at(way)[2] for way in np.arange(min(ways), max(ways) + CORNER, 0.5)]
    if np.abs(wrap(np.diff(headings))).max(initial=0.0) > BEND:
        return CORNER_BEAM
    return BEAM if len(standing) == 2 else MANY_BEAM


def different(nodes: Sequence[Node], beam: int) -> list[Node]:
    """Choose the `beam` best nodes whose robots stand in different poses, and the best one of the gait."""
    chosen: list[Node] = []
    for node in nodes:
        x, y, yaw = node.choices[-1][1]
        others = [other.choices[-1][1] for other in chosen]
        apart = all(math.hypot(x - a, y - b) + 0.5 * abs(yaw - c) > DIFFERENT for a, b, c in others)
        if (len(chosen) < beam and apart) or (node.by_gait and not any(one.by_gait for one in chosen)):
            chosen.append(node)
        if len(chosen) >= beam and any(one.by_gait for one in chosen):
            break
    return chosen


def first_leaps(nodes: Sequence[Node]) -> list[Node]:
    """Of nodes, the best first, those of different first leaps."""
    kept: dict[tuple[str, Planar], Node] = {}
    for node in nodes:
        kept.setdefault(node.choices[0][:2], node)
    return list(kept.values())
