"""Plans that are followed at the same time while stances are looked ahead: `Node`, `different`."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from coloc_graph.geometry.se2 import Planar
from coloc_graph.planning.belief import Belief

DIFFERENT = 0.15  # poses are compared one by one from this distance on, in which a radian counts as 0.5 m [m]


@dataclass(frozen=True, eq=False)
class Node:
    """A team after some planned stances: what it is believed to be, and how it came there.

    `by_gait` is true if the first of its leaps is that of the gait.
    """

    belief: Belief
    standing: Mapping[str, Planar]
    seconds: float
    score: float
    choices: tuple[tuple[str, Planar, float], ...] = ()
    by_gait: bool = False


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
