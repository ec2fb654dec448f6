"""Read everything that a map asks of a bag, except images, once and in order of time."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import BagError
from coloc_graph.exchange.ros_bag import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    ODOMETRY,
    OLD_TF,
    POSE,
    POSE_WITH_COVARIANCE,
    RANGE,
    TF,
    Bag,
    BagMessage,
)
from coloc_graph.exchange.ros_clocks import BagClocks, StampedTopic, bag_clocks
from coloc_graph.exchange.ros_map import RosMap
from coloc_graph.exchange.ros_order import Order, order_of
from coloc_graph.exchange.ros_poses import T_of, planar_covariance
from coloc_graph.exchange.ros_tf import Frames
from coloc_graph.geometry.lie import yaw

Array = NDArray[np.float64]

#: The types that a topic of a map may have, by what it is.
TYPES = {
    "image": (IMAGE, COMPRESSED_IMAGE),
    "camera_info": (CAMERA_INFO,),
    "odometry": (ODOMETRY,),
    "truth": (POSE, POSE_WITH_COVARIANCE, ODOMETRY),
    "range": (RANGE,),
}
TF_TOPICS = {"/tf": False, "/tf_static": True}
TELL_EVERY = 100  # messages between two reports of progress


class Moment(NamedTuple):
    """Sample of odometry.

    Attributes
    ----------
    pose, covariance
        x, y [m], yaw [rad] of the frame `frame`, and their covariance, (3, 3).
    T_odom_frame
        The same in space, (4, 4).
    tilt
        Deviation from upright [rad].
    """

    pose: tuple[float, float, float]
    covariance: Array
    tilt: float
    frame: str
    T_odom_frame: Array


class TruePose(NamedTuple):
    """True pose (4, 4), and its frame."""

    T_world_body: Array
    frame: str


@dataclass(frozen=True, eq=False)
class Recording:
    """Content of a bag that a map asks for: the order of each topic's messages and, except for images, their values.

    Attributes
    ----------
    by_bag
        Topics whose times are those of reception.
    frames
        Frames of tf, empty if no robot needs them.
    notes
        Sentences on oddities.
    """

    orders: dict[str, Order]
    values: dict[str, list[Any]]
    by_bag: frozenset[str]
    frames: Frames
    notes: tuple[str, ...]
    clocks: BagClocks

    def time(self, bag: Bag, message: BagMessage) -> int:
        """Time of a message [ns], corrected by the error of its robot's clock."""
        if message.topic in self.by_bag:
            return message.received
        clock = self.clocks.clocks.get(message.topic)
        return bag.stamp(message) - (clock.error(message.received) if clock is not None else 0)


def require_topics(bag: Bag, the_map: RosMap) -> None:
    """Raise `BagError` for a topic of the map that the bag lacks or has with another type; it lists candidates."""
    for robot in the_map.robots:
        for kind, name in robot.topics.items():
            wanted = TYPES[kind.partition(" ")[0]]
            fitting = [topic for topic in bag.topics.values() if {*topic.types} & {*wanted}]
            could_be = ", ".join(topic.name for topic in fitting) or "none"
            types, which = " or ".join(wanted), f"which the map has as `{kind}` of {robot.name}"
            if name not in bag.topics:
                raise BagError(f"{bag.path}: has no topic {name}, {which}; of {types} it has: {could_be}")
            topic = bag.topics[name]
            if len(topic.types) != 1 or topic.types[0] not in wanted:
                has = " and ".join(topic.types)
                raise BagError(f"{bag.path}: the messages of {name}, {which}, are {has}; of {types} it has: {could_be}")
            if not topic.count:
                raise BagError(f"{bag.path}: has no message of {name}, {which}; record it, or leave it out of the map")
        if robot.truth_tf is not None and not any(_is_tf(bag, name) for name in TF_TOPICS):
            raise BagError(
                f"{bag.path}: has no /tf and no /tf_static, which `truth_tf` of {robot.name} needs; record them"
            )


def _is_tf(bag: Bag, name: str) -> bool:
    return name in bag.topics and set(bag.topics[name].types) <= {TF, OLD_TF}


def read_recording(bag: Bag, the_map: RosMap, told: Callable[[int], None]) -> Recording:
    """Read everything that the map asks for except images, after `require_topics`.

    Raises `BagError`, naming topic and time, for a wrong message.
    """
    kinds = {topic: kind for robot in the_map.robots for kind, topic in robot.topics.items()}
    wanted = set(kinds)
    frames = Frames()
    for name, static in TF_TOPICS.items():  # static transforms also say where odometry's frame is on a body
        if _is_tf(bag, name) and (static or any(robot.truth_tf for robot in the_map.robots)):
            wanted.add(name)
    stamps: dict[str, list[int]] = {topic: [] for topic in kinds}
    received: dict[str, list[int]] = {topic: [] for topic in kinds}
    values: dict[str, list[Any]] = {topic: [] for topic in kinds}
    for number, message in enumerate(bag.messages(wanted), start=1):
        if number % TELL_EVERY == 0:
            told(number)
        if message.topic not in kinds:
            _take_tf(bag, message, frames, by_bag=the_map.time == "bag")
            continue
        stamps[message.topic].append(bag.stamp(message))
        received[message.topic].append(message.received)
        if kinds[message.topic] != "image":
            values[message.topic].append(_READ[kinds[message.topic].partition(" ")[0]](bag, message))
    for topic, every in received.items():
        if not every:
            raise BagError(
                f"{bag.path}: says that it has {bag.topics[topic].count} messages of {topic}, and none was found; "
                "record the bag again, or leave the topic out of the map"
            )
    by_bag = {topic for topic in kinds if the_map.time == "bag" or not any(stamps[topic])}
    times = {topic: received[topic] if topic in by_bag else stamps[topic] for topic in kinds}
    _require_stamped(bag, times)
    owner = {topic: robot.name for robot in the_map.robots for topic in robot.topics.values()}
    clocks = bag_clocks(
        {
            topic: StampedTopic(
                owner[topic], kind, np.array(stamps[topic], np.int64), np.array(received[topic], np.int64)
            )
            for topic, kind in kinds.items()
            if topic not in by_bag and kind in ("image", "odometry")
        }
    )
    for topic, clock in clocks.clocks.items():
        times[topic] = [ns - clock.error(at) for ns, at in zip(stamps[topic], received[topic], strict=True)]
    orders = {topic: order_of(times[topic]) for topic in kinds}
    notes = [*_of_order(bag, orders)]
    if the_map.time == "header":
        notes += _unstamped(bag, by_bag)
        notes += [f"{bag.path}: {sentence}" for sentence in clocks.sentences()]
    return Recording(
        orders=orders,
        values={topic: [every[k] for k in orders[topic].kept] for topic, every in values.items() if every},
        by_bag=frozenset(by_bag),
        frames=frames,
        notes=tuple(notes),
        clocks=clocks,
    )


def _require_stamped(bag: Bag, times: dict[str, list[int]]) -> None:
    for topic, every in times.items():
        missing = sum(one <= 0 for one in every)
        if missing:
            raise BagError(
                f"{bag.path}: {missing} of {len(every)} messages of {topic} have no time in their header, or one "
                'before 1970; say `time = "bag"` in the map to take when they were received'
            )


def _of_order(bag: Bag, orders: dict[str, Order]) -> Iterator[str]:
    for topic, order in orders.items():
        if order.late:
            yield f"{bag.path}: {order.late} messages of {topic} came after later ones, and were sorted by time"
        if order.repeated:
            yield (
                f"{bag.path}: {order.repeated} messages of {topic} have the time of another one of it, "
                "and were left out"
            )


def _unstamped(bag: Bag, by_bag: set[str]) -> Iterator[str]:
    if by_bag:
        yield (
            f"{bag.path}: no message of {', '.join(sorted(by_bag))} has a time in its header; "
            "their times of reception are used"
        )


def _odometry(bag: Bag, message: BagMessage) -> Moment:
    found = bag.decode(message)
    T = _pose(bag, message, found.pose.pose)
    (x, y, _), tilt = T[:3, 3].tolist(), float(np.arccos(np.clip(T[2, 2], -1, 1)))
    return Moment((x, y, float(yaw(T))), planar_covariance(found), tilt, found.child_frame_id.lstrip("/"), T)


def _truth(bag: Bag, message: BagMessage) -> TruePose:
    found = bag.decode(message)
    pose = found.pose if message.type == POSE else found.pose.pose
    return TruePose(_pose(bag, message, pose), found.header.frame_id)


def _pose(bag: Bag, message: BagMessage, pose: Any) -> Array:
    T = T_of(pose.position, pose.orientation)
    if T is None:
        raise bag.error(message, "is not a finite position and a unit quaternion; leave out what was not measured")
    return T


def _range(bag: Bag, message: BagMessage) -> float:
    """Range [m]; NaN outside the sensor's limits, where nothing was measured (REP 117)."""
    found = bag.decode(message)
    value = float(found.range)
    return value if found.min_range <= value <= found.max_range and 0 < value < np.inf else float("nan")


def _camera_info(bag: Bag, message: BagMessage) -> BagMessage:
    return message


def _take_tf(bag: Bag, message: BagMessage, frames: Frames, *, by_bag: bool) -> None:
    for one in bag.decode(message).transforms:
        T = T_of(one.transform.translation, one.transform.rotation)
        if T is None:
            raise bag.error(
                message, f"has no finite translation and unit quaternion of `{one.child_frame_id}`; record it again"
            )
        stamp = one.header.stamp
        ns = message.received if by_bag else int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
        parent, child = one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/")
        frames.add(parent, child, ns, T, static=TF_TOPICS[message.topic])


_READ: dict[str, Callable[[Bag, BagMessage], Any]] = {
    "camera_info": _camera_info,
    "odometry": _odometry,
    "truth": _truth,
    "range": _range,
}
