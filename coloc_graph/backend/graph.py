"""Pose graph of a team: one pose per robot and move, stay-put constraints, and measurements between them."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Set
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.landmarks import ALWAYS, MAP, OnMap, landmarks_of, map_positions, positions_of
from coloc_graph.backend.validation import require_valid
from coloc_graph.errors import EstimationError, MeasurementError
from coloc_graph.measurements import (
    Measurement,
    Node,
    Odometry,
    PoseMeasurement,
    Range,
    RelativePose,
    Sighting,
)
from coloc_graph.run import Stance
from coloc_graph.team import Floor, Landmark, Robot, Slip, Team

Array = NDArray[np.float64]

MAX_ROBOTS = 255  # robots of a team: GTSAM's keys number them in one byte


@dataclass(frozen=True)
class StayPut:
    """The paper's constraint: an anchor's pose at stance `after` is its pose at stance `before`.

    Parameters
    ----------
    robot : str
        The anchor.
    before, after : int
        Indices of the two stances.
    slip : Slip or None
        None: the constraint is exact, and both stances share one variable (every equality factor of GTSAM 4.3 fails
        in some graph). Otherwise a between-factor on two variables, whose residual reveals a bump.
    """

    robot: str
    before: int
    after: int
    slip: Slip | None = None

    @property
    def ends(self) -> tuple[Node, Node]:
        """The two nodes of the same pose."""
        return (self.robot, self.before), (self.robot, self.after)

    @property
    def T_i_j(self) -> Array:
        """Pose (4, 4) of the second end in the first."""
        return np.eye(4)

    def __str__(self) -> str:
        return f"{self.robot} staying put from stance {self.before} to {self.after}"


#: A relation between two nodes of the graph that gives the pose of one in the other.
PoseLink = PoseMeasurement | StayPut | OnMap

#: A relation between two nodes of the graph.
Link = PoseLink | Range


def pose_of(link: PoseLink) -> gtsam.Pose3:
    """Pose of a link's second end in its first."""
    return gtsam.Pose3(link.T_i_j)


def point_of(link: Range, T_world_robot: gtsam.Pose3) -> gtsam.Pose3:
    """Return the initial pose of a landmark that is a point."""
    assert link.place is not None
    return gtsam.Pose3(gtsam.Rot3(), T_world_robot.transformFrom(np.array([*link.place, 0.0])) * [1.0, 1.0, 0.0])


class PoseKeys:
    """GTSAM keys of each robot's pose at each stance: the robot's number and its count of moves.

    Each of the `landmarks`, and the map, is one variable for all stances.
    """

    def __init__(self, robots: tuple[str, ...], slips: Mapping[str, Slip], landmarks: Iterable[str] = ()) -> None:
        if len(robots) > MAX_ROBOTS:
            raise EstimationError(f"a team of {len(robots)} robots is too large: a graph holds {MAX_ROBOTS} at most")
        self.slips = slips
        self._numbers = {robot: number for number, robot in enumerate(robots, start=1)}
        self._moves = dict.fromkeys(robots, 0)
        # robots are numbered from 1; static things have the number 0 and differ by their count
        self._static = {name: int(gtsam.mrsymbol(ord("x"), 0, n)) for n, name in enumerate((MAP, *landmarks))}
        self._keys: dict[Node, int] = {}

    def after(self, before: Stance | None, stance: Stance) -> dict[Node, int]:
        """Return the keys of all robots at the stance after `before`: robots that are not its anchors have moved."""
        keys = {}
        for robot, number in self._numbers.items():
            moves = self._moves[robot]
            if before is not None and (robot in self.slips or not self.stays(robot, before, stance)):
                moves += 1
            keys[robot, stance.index] = int(gtsam.mrsymbol(ord("x"), number, moves))
        return keys

    def accept(self, keys: Mapping[Node, int]) -> None:
        """Record a stance's keys, as returned by `after`."""
        for (robot, _), key in keys.items():
            self._moves[robot] = gtsam.mrsymbolIndex(key)
        self._keys.update(keys)

    def forget(self, before: Stance | None, stance: Stance) -> None:
        """Remove the last stance, which came after `before`."""
        for robot in self._numbers:
            del self._keys[robot, stance.index]
            self._moves[robot] = 0 if before is None else gtsam.mrsymbolIndex(self._keys[robot, before.index])

    def kept(self, nodes: Set[Node] | None = None) -> "PoseKeys":
        """Return a copy with the keys of some nodes alone, or of all; later stances go on from all moves."""
        keys = copy(self)
        keys._moves = dict(self._moves)
        keys._keys = {node: key for node, key in self._keys.items() if nodes is None or node in nodes}
        return keys

    def find(self, node: Node) -> int | None:
        """Return GTSAM's key of a robot at a stance; None where it has none."""
        return self._keys.get(node)

    @staticmethod
    def stays(robot: str, before: Stance, after: Stance) -> bool:
        """Return whether a robot has the same pose at both stances: an anchor that did not move in `before`."""
        return robot in after.anchors and robot not in before.movers

    def stay_puts(self, before: Stance, after: Stance) -> Iterator[StayPut]:
        """Yield the constraints between two stances, of all anchors."""
        for robot in after.anchors:
            if self.stays(robot, before, after):
                yield StayPut(robot, before.index, after.index, self.slips.get(robot))

    def key(self, node: Node) -> int:
        """Return GTSAM's key of a node; `KeyError` where there is no such robot or stance."""
        still = self._static.get(node[0])
        return self._keys[node] if still is None else still

    def __contains__(self, node: Node) -> bool:
        return node in self._keys or (node[0] in self._static and (node[1] == ALWAYS or self._is_stance(node[1])))

    def _is_stance(self, index: int) -> bool:
        return any((robot, index) in self._keys for robot in self._numbers)

    def is_static(self, name: str) -> bool:
        """Return whether a name is that of a landmark, or of the map."""
        return name in self._static

    def static(self) -> dict[str, int]:
        """Return the keys of the landmarks and of the map, by name."""
        return dict(self._static)


@dataclass(frozen=True, repr=False)
class PoseGraph:
    """Measurements of a team as a graph.

    Parameters
    ----------
    reference : str
        Robot whose pose at the first stance is the world frame: its body, or, where there is a `floor`, the floor
        beneath it, x along its heading.
    robots : tuple of str
        Names of all robots.
    stances : tuple of Stance
        In the order of time.
    measurements : tuple of Measurement
        Relative poses, sightings, odometry and ranges between nodes (robot, stance). Ranges make no nodes.
    floor : Floor or None
        Floor that the robots stand on.
    slips : mapping of str to Slip
        Robots that stay put within a tolerance.
    robot_models : mapping of str to Robot
        Mounts and markers as stated, which a joint estimate calibrates.
    landmarks : mapping of str to Landmark
        Landmarks of the team; those sighted are one variable each.
    on_map : tuple of OnMap
        Stated positions of landmarks.

    Raises
    ------
    EstimationError
        There is nothing to solve.
    MeasurementError
        A measurement is invalid.

    Notes
    -----
    Nodes are the poses T_world_body of observers, of the robots that a measurement names, and of anchors whose pose is
    a node already. Nodes that share a pose share one variable (`key`).
    """

    reference: str
    robots: tuple[str, ...]
    stances: tuple[Stance, ...]
    measurements: tuple[Measurement, ...]
    floor: Floor | None = None
    slips: Mapping[str, Slip] = field(default_factory=dict)
    robot_models: Mapping[str, Robot] = field(default_factory=dict)
    landmarks: Mapping[str, Landmark] = field(default_factory=dict)
    on_map: tuple[OnMap, ...] = ()

    @classmethod
    def of(cls, team: Team, stances: Iterable[Stance], measurements: Iterable[Measurement]) -> "PoseGraph":
        """Return the graph of a team."""
        robot_models = {robot.name: robot for robot in team.robots}
        landmarks = landmarks_of(team)
        return cls(
            team.reference,
            team.names,
            tuple(stances),
            tuple(measurements),
            team.floor,
            slips_of(team),
            robot_models,
            landmarks,
            map_positions(landmarks),
        )

    def __post_init__(self) -> None:
        if not self.stances:
            raise EstimationError("there is no stance to estimate: record one in which two robots stand and watch")
        twice = [after.index for before, after in zip(self.stances, self.stances[1:], strict=False)
                 if after.index <= before.index]  # fmt: skip
        if twice:
            raise MeasurementError(
                f"stance {twice[0]} is repeated or out of order: number the stances in the order of time, each once"
            )
        first = self.stances[0]
        require_reference(self.reference, first)
        for stance in self.stances:
            require_robots(stance, self.robots)
        for measured in self.measurements:
            require_ends(measured, self.pose_keys, self.by_index)
        require_valid(self.measurements, self.floor)
        instants_of(self.measurements, self.by_index)

    @cached_property
    def pose_keys(self) -> PoseKeys:
        """GTSAM keys of the nodes."""
        keys = PoseKeys(self.robots, self.slips, self.landmarks)
        for before, stance in zip((None, *self.stances), self.stances, strict=False):
            keys.accept(keys.after(before, stance))
        return keys

    @cached_property
    def by_index(self) -> dict[int, Stance]:
        """Stances by index."""
        return {stance.index: stance for stance in self.stances}

    @cached_property
    def nodes(self) -> tuple[Node, ...]:
        """All nodes, in the order of the stances, without landmarks."""
        named: dict[int, dict[str, None]] = defaultdict(dict)
        for measured in self.measurements:
            for robot, index in measured.ends:
                if robot not in self.landmarks and not isinstance(measured, Range):
                    named[index][robot] = None
        nodes: list[Node] = []
        there: set[str] = set()
        for before, stance in zip((None, *self.stances), self.stances, strict=False):
            held = [r for r in stance.anchors if before and r in there and PoseKeys.stays(r, before, stance)]
            at = dict.fromkeys([*stance.observers, *named[stance.index], *held])
            there = set(at)
            nodes += [(robot, stance.index) for robot in at]
        return tuple(nodes)

    @cached_property
    def sighted(self) -> dict[str, tuple[Sighting, ...]]:
        """Sightings of each landmark that was seen."""
        found: dict[str, list[Sighting]] = defaultdict(list)
        for one in self.measurements:
            if isinstance(one, Sighting) and one.seen in self.landmarks:
                found[one.seen].append(one)
        return {name: tuple(found[name]) for name in self.landmarks if name in found}

    @property
    def relative_poses(self) -> tuple[RelativePose, ...]:
        """Measurements made of homographies."""
        return tuple(m for m in self.measurements if isinstance(m, RelativePose))

    @cached_property
    def times(self) -> dict[Node, float]:
        """Time of each node's pose [UTC s]: the start of the stance, or the sighting of a moving robot."""
        times = {(robot, index): self.by_index[index].start for robot, index in self.nodes}
        for measured in self.measurements:
            if isinstance(measured, Sighting) and measured.seen in self.by_index[measured.stance].movers:
                times[measured.seen, measured.stance] = measured.time
        return times

    @cached_property
    def stay_puts(self) -> tuple[StayPut, ...]:
        """Stay-put constraints, in the order of the stances."""
        nodes = set(self.nodes)
        return tuple(
            stay
            for before, after in zip(self.stances, self.stances[1:], strict=False)
            for stay in self.pose_keys.stay_puts(before, after)
            if nodes.issuperset(stay.ends)
        )

    @property
    def links(self) -> tuple[Link, ...]:
        """Relations between variables: measurements, stay-puts with a slip, map positions of sighted landmarks."""
        slipping = (stay for stay in self.stay_puts if stay.slip is not None)
        return (*self.measurements, *slipping, *positions_of(self.on_map, self.sighted))

    @cached_property
    def ends(self) -> dict[int, tuple[int, int]]:
        """Keys of the ends of each link, by its identity."""
        key = self.pose_keys.key
        return {id(link): (key(link.ends[0]), key(link.ends[1])) for link in self.links}

    def key(self, robot: str, stance: int) -> int:
        """Return GTSAM's key of a robot's pose at a stance."""
        return self.pose_keys.key((robot, stance))

    @property
    def reference_key(self) -> int:
        """The key of the pose that defines the world."""
        return self.key(self.reference, self.stances[0].index)

    def up_to(self, stances: int) -> "PoseGraph":
        """Return the graph of the first `stances` stances (at least one), with the measurements in them."""
        first = self.stances[: max(stances, 1)]
        within = {stance.index for stance in first}
        measured = tuple(m for m in self.measurements if all(index in within for _, index in m.ends))
        return replace(self, stances=first, measurements=measured)

    def without(self, rejected: Iterable[object]) -> "PoseGraph":
        """Return the graph of the same nodes without the `rejected` measurements and map positions."""
        out = {id(one) for one in rejected}
        if not out:
            return self
        kept = tuple(m for m in self.measurements if id(m) not in out)
        # of what was valid before, with the same nodes, their times, and the same stay-put constraints
        _ = self.nodes, self.times, self.ends
        graph = copy(self)
        for derived in ("sighted", "ranged_points"):
            vars(graph).pop(derived, None)
        on_map = tuple(one for one in self.on_map if id(one) not in out)
        # a node stays one, and is disconnected, if all its measurements are rejected
        vars(graph).update(measurements=kept, on_map=on_map)
        return graph

    @cached_property
    def ranged_points(self) -> dict[str, tuple[Range, ...]]:
        """Ranges of each landmark that has a position by them alone, and no heading."""
        found: dict[str, list[Range]] = defaultdict(list)
        for one in self.measurements:
            if isinstance(one, Range) and one.place is not None and one.target not in self.sighted:
                found[one.target].append(one)
        return {name: tuple(every) for name, every in found.items()}

    def disconnected(self, known: Iterable[int]) -> tuple[Node, ...]:
        """Return the nodes whose pose is not among the `known` keys, in the order of the stances."""
        keys = set(known)
        return tuple(node for node in self.nodes if self.pose_keys.key(node) not in keys)

    def __repr__(self) -> str:
        kinds = {"relative pose": RelativePose, "sighting": Sighting, "odometry": Odometry, "range": Range}
        counts = [f"{sum(isinstance(m, of) for m in self.measurements)} {name}" for name, of in kinds.items()]
        slipping = sum(stay.slip is not None for stay in self.stay_puts)
        exact = len(self.stay_puts) - slipping
        shown = ", ".join(f"{s.robot}@{s.before}={s.robot}@{s.after}" for s in self.stay_puts[:4])
        more = ", ..." if len(self.stay_puts) > 4 else ""
        if self.sighted:
            counts.append(f"{len(self.sighted)} landmarks")
        return (
            f"PoseGraph({len(self.robots)} robots, {len(self.stances)} stances, {', '.join(counts)}, "
            f"{exact} stay-put exact and {slipping} with a slip{': ' if shown else ''}{shown}{more})"
        )


def slips_of(team: Team) -> dict[str, Slip]:
    """Return the robots of a team that stay put within a tolerance, with that tolerance."""
    return {robot.name: robot.slip for robot in team.robots if robot.slip is not None}


def require_reference(reference: str, first: Stance) -> None:
    """Raise `EstimationError` where the reference robot does not stand at the first stance."""
    if reference not in first.observers:
        raise EstimationError(
            f"the reference robot {reference} does not observe at stance {first.index}, where the world "
            f"frame is set: name one of {', '.join(first.observers)} as the reference in the team"
        )


def require_robots(stance: Stance, robots: tuple[str, ...]) -> None:
    """Raise `MeasurementError` where a stance names a robot that is not in the team."""
    for robot in (*stance.observers, *stance.movers, *stance.anchors):
        if robot not in robots:
            raise MeasurementError(
                f"stance {stance.index} names robot {robot}, which is not in the team ({', '.join(robots)})"
            )


def require_anchor(stance: Stance, taken: Iterable[Measurement]) -> None:
    """Raise `MeasurementError` where neither an anchor nor odometry ties a stance to those before."""
    if not stance.anchors and not any(isinstance(one, Odometry) and one.after == stance.index for one in taken):
        raise MeasurementError(
            f"stance {stance.index} has no anchor and no odometry into it, so that nothing ties it to the stances "
            "before: name the robot that stayed put"
        )


def require_ends(measured: Measurement, keys: PoseKeys, stances: Mapping[int, Stance]) -> None:
    """Raise `MeasurementError` where a measurement names an unknown robot or stance, or relates a robot to itself."""
    for robot, index in measured.ends:
        if (robot, index) not in keys:
            what = f"robot {robot}, which is not in the team" if index in stances else f"stance {index}, which is none"
            raise MeasurementError(f"the {measured} names {what}: correct it, or add that first")
    (robot_i, before), (robot_j, after) = measured.ends
    if isinstance(measured, Odometry):
        if keys.is_static(robot_i):
            raise MeasurementError(f"the {measured} names a landmark, which does not move: name a robot")
        if before >= after:
            raise MeasurementError(f"the {measured} does not lead from a stance to a later one: correct its stances")
        return
    if robot_i == robot_j:
        raise MeasurementError(f"the {measured} relates a robot to itself: name two robots")
    if isinstance(measured, Range):
        if keys.is_static(robot_i):
            raise MeasurementError(f"the {measured} is by a landmark: name the robot that measured")
        return
    observers = (robot_i,) if isinstance(measured, Sighting) else (robot_i, robot_j)
    for robot in observers:
        if robot not in stances[before].observers:
            raise MeasurementError(f"the {measured} names {robot}, which is no observer of stance {before}")


def instants_of(
    measurements: Iterable[Measurement], stances: Mapping[int, Stance], known: Mapping[Node, float] | None = None
) -> dict[Node, float]:
    """Return the times [UTC s] at which moving robots were sighted that are not `known`.

    A moving robot has one pose per stance: raises `MeasurementError` where it was sighted there at two times.
    """
    known, found = known or {}, dict[Node, float]()
    for one in measurements:
        if isinstance(one, Sighting) and one.seen in stances[one.stance].movers:
            node = (one.seen, one.stance)
            _require_instant(one, known[node] if node in known else found.setdefault(node, one.time))
    return found


def _require_instant(sighting: Sighting, time: float) -> None:
    """Raise `MeasurementError` where a moving robot was sighted at another time than that of its pose."""
    if abs(sighting.time - time) > 1e-3:
        raise MeasurementError(
            f"the {sighting} is {sighting.time - time:+.3f} s from an earlier one of this stance, and the robot moves: "
            "give sightings of one instant"
        )
