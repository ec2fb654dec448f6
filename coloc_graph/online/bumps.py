"""Robots that were pushed while they stood, which their wheels cannot tell: found from the cameras."""

import math
from collections.abc import Iterable, Iterator

from coloc_graph.backend import Bump
from coloc_graph.backend.cause import or_else
from coloc_graph.geometry.se2 import Planar, compose, wrap
from coloc_graph.online.robot_registry import RobotRegistry
from coloc_graph.online.visibility import InView


def pushed(registry: RobotRegistry, bumps: Iterable[Bump]) -> Iterator[tuple[str, str]]:
    """Correct the poses of anchors that the estimate found displaced; yield each robot and a sentence about it."""
    for bump in bumps:
        T, robot = bump.T_before_after, bump.stay_put.robot
        by = T.x(), T.y(), T.rotation().yaw()
        registry.displace(robot, compose(registry[robot].tracker.pose(), by))
        yield robot, f"{bump.description}{or_else(bump.alternative)}"


def displaced(registry: RobotRegistry, view: InView, mover: Planar) -> Iterator[tuple[str, str]]:
    """Correct the poses of observers that see the standing mover elsewhere than another does; yield as `pushed`."""
    for robot, place in view.displaced(mover).items():
        before = registry[robot].tracker.pose()
        registry.displace(robot, place)
        far, turned = math.dist(place[:2], before[:2]), abs(wrap(place[2] - before[2]))
        yield (
            robot,
            (
                f"robot {robot} does not stand where it should: it was bumped, or its wheels slipped, by about "
                f"{100 * far:.0f} cm and {math.degrees(turned):.0f} deg"
            ),
        )
