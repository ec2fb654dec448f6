"""The pose graph of a team: one pose a robot and move, stay-put constraints, and what was measured between them."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.landmarks import ALWAYS, MAP, OnMap, landmarks_of, map_of, of_seen
from coloc_graph.backend.validation import require_valid
from coloc_graph.errors import EstimationError, MeasurementError
from coloc_graph.measurements import Measurement, Node, Odometry, RelativePose, Sighting
from coloc_graph.run import Stance
from coloc_graph.team import Floor, Landmark, Robot, Slip, Team

Array = NDArray[np.float64]

#: GTSAM's keys number the robots of a team in one byte.
MOST_ROBOTS = 255


@dataclass(frozen=True)
class StayPut:
    """The paper's constraint: an anchor's pose at stance `after` is its pose at stance `before`.

    Without a `slip` it is enforced exactly: both stances share one variable, since every equality factor of
    GTSAM 4.3 fails somewhere. With one it is a between-factor on two variables, whose residual tells a bump.
    """

    robot: str
    before: int
    after: int
    slip: Slip | None = None

    @property
    def ends(self) -> tuple[Node, Node]:
        """The two nodes that are one place."""
        return (self.robot, self.before), (self.robot, self.after)

    @property
    def T_i_j(self) -> Array:
        """Pose (4, 4) of the second end in the first."""
        return np.eye(4)

    def __str__(self) -> str:
        return f"{self.robot} staying put from stance {self.before} to {self.after}"


#: What the graph holds between two nodes.
Link = Measurement | StayPut | OnMap


def pose_of(link: Link) -> gtsam.Pose3:
    """Pose of a link's second end in its first."""
    return gtsam.Pose3(link.T_i_j)


class PoseKeys:
    """Which variable each robot's pose at each stance is: stance after stance, by counting its moves.

    `landmarks`, and the map, never move: each is one variable, at every stance.
    """

    def __init__(self, robots: tuple[str, ...], slips: Mapping[str, Slip], landmarks: Iterable[str] = ()) -> None:
        if len(robots) > MOST_ROBOTS:
            raise EstimationError(f"a team of {len(robots)} robots is too large: a graph holds {MOST_ROBOTS} at most")
        self.slips = slips
        self._numbers = {robot: number for number, robot in enumerate(robots, start=1)}
        self._moves = dict.fromkeys(robots, 0)
        # robots are numbered from 1; what never moves has the number 0, and is told by its count
        self._still = {name: int(gtsam.mrsymbol(ord("x"), 0, n)) for n, name in enumerate((MAP, *landmarks))}
        self._keys: dict[Node, int] = {}

    def after(self, before: Stance | None, stance: Stance) -> dict[Node, int]:
        """The keys of all robots at the stance that comes after `before`: who is not its anchor has moved."""
        keys = {}
        for robot, number in self._numbers.items():
            moves = self._moves[robot]
            if before is not None and (robot in self.slips or not self.stays(robot, before, stance)):
                moves += 1
            keys[robot, stance.index] = int(gtsam.mrsymbol(ord("x"), number, moves))
        return keys

    def accept(self, keys: Mapping[Node, int]) -> None:
        """Take in a stance's keys, as `after` gave them."""
        for (robot, _), key in keys.items():
            self._moves[robot] = gtsam.mrsymbolIndex(key)
        self._keys.update(keys)

    def forget(self, before: Stance | None, stance: Stance) -> None:
        """Take the last stance back, which came after `before`."""
        for robot in self._numbers:
            del self._keys[robot, stance.index]
            self._moves[robot] = 0 if before is None else gtsam.mrsymbolIndex(self._keys[robot, before.index])

    @staticmethod
    def stays(robot: str, before: Stance, after: Stance) -> bool:
        """Whether a robot's pose of stance `before` is that of `after`: one that was driving has left it."""
        return robot in after.anchors and robot not in before.movers

    def stay_puts(self, before: Stance, after: Stance) -> Iterator[StayPut]:
        """The constraints between two stances, of all anchors."""
        for robot in after.anchors:
            if self.stays(robot, before, after):
                yield StayPut(robot, before.index, after.index, self.slips.get(robot))

    def key(self, node: Node) -> int:
        """GTSAM's key of a node; `KeyError` where there is no such robot or stance."""
        still = self._still.get(node[0])
        return self._keys[node] if still is None else still

    def __contains__(self, node: Node) -> bool:
        return node in self._keys or (node[0] in self._still and (node[1] == ALWAYS or self._is_stance(node[1])))

    def _is_stance(self, index: int) -> bool:
        return any((robot, index) in self._keys for robot in self._numbers)

    def is_still(self, name: str) -> bool:
        """Whether it is a landmark, or the map."""
        return name in self._still

    def still(self) -> dict[str, int]:
        """The keys of the landmarks and of the map."""
        return dict(self._still)


@dataclass(frozen=True, repr=False)
class PoseGraph:
    """What a team measured, as a graph.

    Nodes are the poses T_world_body of robots at stances: of its observers, of whoever a measurement names, and of
    anchors whose pose is a node already. Nodes that are one place share one variable (`key`). The world frame is
    where the reference robot stands at the first stance: its body, or, where there is a `floor`, the floor beneath
    it (the same on a level floor), x along its heading. `slips` are of the robots that stay put within a tolerance.
    `rigs` are the robots as the team describes them, with mounts and markers: what the joint estimate calibrates.
    `landmarks` that were sighted are one variable each, and `on_map` is what is known of where these stand.

    Raises `EstimationError` where there is nothing to solve, and `MeasurementError` where a measurement is not one.
    """

    reference: str
    robots: tuple[str, ...]
    stances: tuple[Stance, ...]
    measurements: tuple[Measurement, ...]
    floor: Floor | None = None
    slips: Mapping[str, Slip] = field(default_factory=dict)
    rigs: Mapping[str, Robot] = field(default_factory=dict)
    landmarks: Mapping[str, Landmark] = field(default_factory=dict)
    on_map: tuple[OnMap, ...] = ()

    @classmethod
    def of(cls, team: Team, stances: Iterable[Stance], measurements: Iterable[Measurement]) -> "PoseGraph":
        """The graph of a team."""
        rigs = {robot.name: robot for robot in team.robots}
        landmarks = landmarks_of(team)
        return cls(
            team.reference,
            team.names,
            tuple(stances),
            tuple(measurements),
            team.floor,
            slips_of(team),
            rigs,
            landmarks,
            map_of(landmarks),
        )

    def __post_init__(self) -> None:
        if not self.stances:
            raise EstimationError("there is no stance to estimate: record one in which two robots stand and watch")
        twice = [after.index for before, after in zip(self.stances, self.stances[1:], strict=False)
                 if after.index <= before.index]  # fmt: skip
        if twice:
            raise MeasurementError(f"stance {twice[0]} is there twice, or out of order; number each stance once")
        first = self.stances[0]
        require_reference(self.reference, first)
        for stance in self.stances:
            require_robots(stance, self.robots)
        for measured in self.measurements:
            require_ends(measured, self.places, self.by_index)
        require_valid(self.measurements, self.floor)
        instants_of(self.measurements, self.by_index)

    @cached_property
    def places(self) -> PoseKeys:
        """Which variable each node is."""
        places = PoseKeys(self.robots, self.slips, self.landmarks)
        for before, stance in zip((None, *self.stances), self.stances, strict=False):
            places.accept(places.after(before, stance))
        return places

    @cached_property
    def by_index(self) -> dict[int, Stance]:
        """The stances by their number."""
        return {stance.index: stance for stance in self.stances}

    @cached_property
    def nodes(self) -> tuple[Node, ...]:
        """All nodes, in the order of the stances; landmarks are none of them."""
        named: dict[int, dict[str, None]] = defaultdict(dict)
        for measured in self.measurements:
            for robot, index in measured.ends:
                if robot not in self.landmarks:
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
        """The sightings of each landmark that was seen."""
        found: dict[str, list[Sighting]] = defaultdict(list)
        for one in self.measurements:
            if isinstance(one, Sighting) and one.seen in self.landmarks:
                found[one.seen].append(one)
        return {name: tuple(found[name]) for name in self.landmarks if name in found}

    @property
    def relative_poses(self) -> tuple[RelativePose, ...]:
        """The measurements made of homographies."""
        return tuple(m for m in self.measurements if isinstance(m, RelativePose))

    @cached_property
    def times(self) -> dict[Node, float]:
        """When each node's pose was [UTC s]: at the start of the stance, or when a moving robot was sighted."""
        times = {(robot, index): self.by_index[index].start for robot, index in self.nodes}
        for measured in self.measurements:
            if isinstance(measured, Sighting) and measured.seen in self.by_index[measured.stance].movers:
                times[measured.seen, measured.stance] = measured.time
        return times

    @cached_property
    def stay_puts(self) -> tuple[StayPut, ...]:
        """The constraints, in the order of the stances."""
        nodes = set(self.nodes)
        return tuple(
            stay
            for before, after in zip(self.stances, self.stances[1:], strict=False)
            for stay in self.places.stay_puts(before, after)
            if nodes.issuperset(stay.ends)
        )

    @property
    def links(self) -> tuple[Link, ...]:
        """All that holds two variables together: measurements, stay-put constraints with a slip, and what the map says
        of landmarks that were seen."""
        slipping = (stay for stay in self.stay_puts if stay.slip is not None)
        return (*self.measurements, *slipping, *of_seen(self.on_map, self.sighted))

    def key(self, robot: str, stance: int) -> int:
        """GTSAM's key of a robot's pose at a stance."""
        return self.places.key((robot, stance))

    @property
    def reference_key(self) -> int:
        """The key of the pose that defines the world."""
        return self.key(self.reference, self.stances[0].index)

    def up_to(self, stances: int) -> "PoseGraph":
        """The graph of the first so many stances, one at least, with what was measured in them."""
        first = self.stances[: max(stances, 1)]
        within = {stance.index for stance in first}
        measured = tuple(m for m in self.measurements if all(index in within for _, index in m.ends))
        return replace(self, stances=first, measurements=measured)

    def without(self, rejected: Iterable[object]) -> "PoseGraph":
        """The same nodes with fewer measurements."""
        out = {id(one) for one in rejected}
        if not out:
            return self
        kept = tuple(m for m in self.measurements if id(m) not in out)
        graph = replace(self, measurements=kept, on_map=tuple(one for one in self.on_map if id(one) not in out))
        # a node stays one, and is disconnected, if all its measurements are rejected
        vars(graph).update(nodes=self.nodes, times=self.times)
        return graph

    def disconnected(self, known: Iterable[int]) -> tuple[Node, ...]:
        """The (robot, stance) whose pose is not among these keys, in the order of the stances."""
        keys = set(known)
        return tuple(node for node in self.nodes if self.places.key(node) not in keys)

    def __repr__(self) -> str:
        kinds = {"relative pose": RelativePose, "sighting": Sighting, "odometry": Odometry}
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
    """The robots of a team that stay put within a tolerance, with it."""
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


def require_ends(measured: Measurement, places: PoseKeys, stances: Mapping[int, Stance]) -> None:
    """Raise `MeasurementError` where a measurement relates what is not there, or a robot to itself."""
    for robot, index in measured.ends:
        if (robot, index) not in places:
            what = f"robot {robot}, which is not in the team" if index in stances else f"stance {index}, which is not"
            raise MeasurementError(f"the {measured} names {what} there: correct it, or add that first")
    (robot_i, before), (robot_j, after) = measured.ends
    if isinstance(measured, Odometry):
        if places.is_still(robot_i):
            raise MeasurementError(f"the {measured} names a landmark, which does not move")
        if before >= after:
            raise MeasurementError(f"the {measured} does not lead from a stance to a later one")
        return
    if robot_i == robot_j:
        raise MeasurementError(f"the {measured} relates a robot to itself")
    watching = (robot_i,) if isinstance(measured, Sighting) else (robot_i, robot_j)
    for robot in watching:
        if robot not in stances[before].observers:
            raise MeasurementError(f"the {measured} names {robot}, which does not observe there")


def instants_of(
    measurements: Iterable[Measurement], stances: Mapping[int, Stance], known: Mapping[Node, float] | None = None
) -> dict[Node, float]:
    """Times [UTC s] at which moving robots were sighted that are not `known`.

    A moving robot has one pose a stance: raises `MeasurementError` where it was sighted there at two instants.
    """
    known, found = known or {}, dict[Node, float]()
    for one in measurements:
        if isinstance(one, Sighting) and one.seen in stances[one.stance].movers:
            node = (one.seen, one.stance)
            _require_instant(one, known[node] if node in known else found.setdefault(node, one.time))
    return found


def _require_instant(sighting: Sighting, time: float) -> None:
    """Raise `MeasurementError` where a moving robot was sighted at another time than its pose of the stance is."""
    if abs(sighting.time - time) > 1e-3:
        raise MeasurementError(
            f"the {sighting} is of another instant than an earlier one ({sighting.time - time:+.3f} s), and the robot "
            "moves: give the sightings of one instant"
        )
