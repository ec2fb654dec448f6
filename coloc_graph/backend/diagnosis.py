"""Check before solving: parts of a graph that nothing ties to the reference, and measurements that would."""

from collections import defaultdict
from dataclasses import dataclass

from coloc_graph.backend.chain import spanning_tree
from coloc_graph.backend.graph import PoseGraph
from coloc_graph.backend.planar import unlocated
from coloc_graph.backend.ranging import KeyframeGraph
from coloc_graph.measurements import Node, Range


@dataclass(frozen=True)
class DisconnectedComponent:
    """Nodes that are connected to each other but not to the reference, in the order of the stances.

    Parameters
    ----------
    nodes : tuple of Node
        The robots and stances.
    remedy : str
        What would connect them.
    robot : str or None
        Of keyframes, the robot.
    """

    nodes: tuple[Node, ...]
    remedy: str
    robot: str | None = None

    def __str__(self) -> str:
        if self.robot is not None:
            return f"robot {self.robot} has no pose: {self.remedy}"
        robots = ", ".join(dict.fromkeys(robot for robot, _ in self.nodes))
        first, last = self.nodes[0][1], self.nodes[-1][1]
        when = f"stance {first}" if first == last else f"stances {first} to {last}"
        return f"{robots} at {when}: not tied to the reference; {self.remedy}"


def diagnose(graph: PoseGraph | KeyframeGraph) -> tuple[DisconnectedComponent, ...]:
    """Find the disconnected parts of a graph, each with a remedy; () where all is connected to the reference.

    Of keyframes a part is a robot that its measurements leave without a pose, as where ranges fit two mirrored ones.
    """
    if isinstance(graph, KeyframeGraph):
        missing = unlocated(graph.team, graph.keyframes)
        return tuple(DisconnectedComponent(tuple(graph.nodes_of(one)), why, one) for one, why in missing.items())
    tied = {graph.reference_key, *(step.to for step in spanning_tree(graph, graph.links))}
    neighbours: dict[int, list[int]] = defaultdict(list)
    for link in graph.links:
        if isinstance(link, Range):  # it leaves a circle, and a mirrored one
            continue
        i, j = map(graph.pose_keys.key, link.ends)
        neighbours[i].append(j)
        neighbours[j].append(i)
    part: dict[int, int] = {}
    parts: dict[int, list[Node]] = defaultdict(list)
    for node in graph.nodes:
        key = graph.pose_keys.key(node)
        if key in tied:
            continue
        if key not in part:
            _mark(key, len(parts), neighbours, part)
        parts[part[key]].append(node)
    return tuple(DisconnectedComponent(tuple(nodes), _remedy(graph, nodes, tied)) for nodes in parts.values())


def _mark(start: int, number: int, neighbours: dict[int, list[int]], part: dict[int, int]) -> None:
    waiting = [start]
    while waiting:
        key = waiting.pop()
        if key not in part:
            part[key] = number
            waiting += neighbours[key]


def _remedy(graph: PoseGraph, nodes: list[Node], tied: set[int]) -> str:
    """Advise a measurement shared with a connected robot, else an anchor or odometry into the stance."""
    for robot, stance in nodes:
        known = [r for r, s in graph.nodes if s == stance and graph.pose_keys.key((r, s)) in tied]
        if known:
            others = " or ".join(known)
            return f"a relative pose or a sighting between {robot} and {others} at stance {stance} would tie it"
    robot, stance = nodes[0]
    before = [s for r, s in graph.nodes if r == robot and s < stance and graph.pose_keys.key((r, s)) in tied]
    if before:
        return f"odometry of {robot} from stance {before[-1]} to {stance}, or an anchor that stays, would tie it"
    return f"an anchor that stays put into stance {stance} would tie it"
