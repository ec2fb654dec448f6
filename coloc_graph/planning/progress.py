"""Leaps that bring a team on, and those that only change places; `leading_on`, `require_progress`."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

from coloc_graph.geometry.se2 import Planar
from coloc_graph.planning.beam import Node
from coloc_graph.planning.belief import Belief
from coloc_graph.planning.course import Course
from coloc_graph.planning.ways_out import stuck

STRAGGLE = 2.2  # an observer further behind the foremost one than this leaps next [m]
STALLED = 6  # stances without progress after which a mission is given up
ARRIVED = 0.1  # less than this along the course is no progress, and the goal is reached within it [m]

#: The next stances of a team after leaps of one observer, `leaper`.
LeapsOf = Callable[..., list[Node]]
#: Returns whether observers that stand so are at the goal.
Arrived = Callable[[Mapping[str, Planar]], bool]


def leading_on(
    plans: Iterator[list[Node]], belief: Belief, course: Course, arrived: Arrived, leaps_of: LeapsOf
) -> Iterator[list[Node]]:
    """Yield of each of `plans` the nodes by whose leaps the team comes on: the hindmost leaps then or next.

    Else one in front turns to and fro, or goes on alone to where the hindmost cannot follow.
    """
    leads: dict[tuple[str, Planar], bool] = {}
    for nodes in plans:
        good = []
        for node in nodes:
            first = node.choices[0][:2]
            if first not in leads:
                leads[first] = _leads_on(belief, node, course, arrived, leaps_of)
            if leads[first]:
                good.append(node)
        if good:
            yield good


def require_progress(
    before: Sequence[Mapping[str, Planar]], left: Sequence[float], length: float
) -> tuple[Planar, ...]:
    """Require that of the stances before, each with where the observers stood, one of the last brought them on.

    Parameters
    ----------
    before, left
        The stances, and the way that was left after each [m].
    length
        Length of the course [m].

    Returns
    -------
    tuple
        Poses in which observers stood in the last stances, two or more, if these did not bring the team on. They are to
        be avoided: what looked as if it led on from there did not.

    Raises
    ------
    InputError
        If robots only change their places: none can pass another.
    """
    if len(left) > STALLED and min(left[-STALLED:]) > min(left[:-STALLED]) - ARRIVED:
        raise stuck(length - left[-1])
    best = next((n for n in range(len(left) - 1, 0, -1) if left[n] < min(left[:n]) - ARRIVED), 0)
    idle = before[best + 1 :]
    return tuple(pose for standing in idle for pose in standing.values()) if len(idle) > 1 else ()


def _leads_on(belief: Belief, node: Node, course: Course, arrived: Arrived, leaps_of: LeapsOf) -> bool:
    """Return whether the hindmost observer comes on by the leaps of a node, or can leap after its first one.

    Of more than two, any that comes on counts, up to where the hindmost is left behind.
    """
    first, poses = node.choices[0][0], {name: belief.poses[name] for name in node.standing}
    for n, (leaper, target, _) in enumerate(node.choices):
        ways = {name: course.way_of(pose) for name, pose in poses.items()}
        is_last = ways[leaper] == min(ways.values())
        together = len(ways) > 2 and max(ways.values()) - min(ways.values()) < STRAGGLE
        gains = course.way_of(target) - ways[leaper] > ARRIVED
        if gains and (is_last or together) and (n == 0 or leaper != first):  # else it puts off its leap for ever
            return True
        poses[leaper] = target
    after = replace(belief, poses={**belief.poses, first: node.choices[0][1]}, leapt={})
    standing = {name: after.poses[name] for name in node.standing}
    if arrived(standing):
        return True
    last = min(standing, key=lambda name: course.way_of(standing[name]))
    way = course.way_of(standing[last])
    # not only to another side of a corner
    found = () if last == first else leaps_of(Node(after, standing, node.seconds, 0.0), leaper=last)
    return any(course.way_of(one.standing[last]) - way > ARRIVED for one in found)
