"""Robots that were pushed while they stood, which their wheels do not know: found by what the cameras see."""

import math
from collections.abc import Iterable, Iterator

from coloc_graph.backend import Bump
from coloc_graph.online.formation import Planar
from coloc_graph.online.pose_tracker import compose
from coloc_graph.online.robot_registry import Roster
from coloc_graph.online.visibility import InView


def pushed(roster: Roster, bumps: Iterable[Bump]) -> Iterator[tuple[str, str]]:
    """Put anchors that the estimate found pushed where they are; each robot, and what happened to it, comes back."""
    for bump in bumps:
        T, robot = bump.T_before_after, bump.stay_put.robot
        by = T.x(), T.y(), T.rotation().yaw()
        roster.carried(robot, compose(roster[robot].whereabouts.place(), by))
        yield robot, bump.what


def displaced(roster: Roster, view: InView, mover: Planar) -> Iterator[tuple[str, str]]:
    """The same of observers that have the mover, which stands there by its wheels, plainly elsewhere than another."""
    for robot, place in view.displaced(mover).items():
        before = roster[robot].whereabouts.place()
        roster.carried(robot, place)
        far, turned = math.dist(place[:2], before[:2]), abs(math.remainder(place[2] - before[2], 2 * math.pi))
        yield (
            robot,
            (
                f"robot {robot} does not stand where it should: it was bumped, or its wheels slipped, by about "
                f"{100 * far:.0f} cm and {math.degrees(turned):.0f} deg"
            ),
        )
