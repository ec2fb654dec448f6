"""Convert the robots of a ROS bag: camera, odometry, true poses, movements; and warnings."""

import itertools
import re
from collections.abc import Mapping

import msgspec
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import BagError
from coloc_graph.exchange.ros_bag import Bag
from coloc_graph.exchange.ros_images import camera_of, differences
from coloc_graph.exchange.ros_map import RobotTopics, RosMap
from coloc_graph.exchange.ros_poses import grown_increments, stated_increments
from coloc_graph.exchange.ros_read import Recording
from coloc_graph.exchange.stances import Movements, movements
from coloc_graph.geometry.lie import yaw
from coloc_graph.run import OdometrySample, Ranges
from coloc_graph.run.odometry_breaks import find_breaks, join_breaks
from coloc_graph.run.schemas import to_seconds
from coloc_graph.team import Team

Array = NDArray[np.float64]

STAMPED = 12  # bytes at the start of a message that hold its time
LEVEL = 5.0  # deg, largest tilt of odometry on a floor
BREAKS_NAMED = 3  # jumps of one topic that are described one by one
BODY_FRAME = re.compile(r"(^|[/_])(base(_link|_footprint)?|body|chassis|footprint)$")  # frames of the body itself
UNKNOWN = 1.0  # s, images further before or after all odometry are warned of


def with_cameras(bag: Bag, the_map: RosMap, recording: Recording, team: Team) -> tuple[Team, list[str]]:
    """Return the team with the cameras in the bag, and warnings if they differ from stated ones."""
    cameras, warnings = {}, []
    for robot in the_map.robots:
        if robot.camera_info is None:
            continue
        stated = team[robot.name].camera
        messages = recording.values[robot.camera_info]
        found = camera_of(bag, messages[0], stated, rectified=robot.rectified)
        for message in {one.data[STAMPED:]: one for one in messages}.values():
            if differences(camera_of(bag, message, stated, rectified=robot.rectified), found):
                raise bag.error(message, "is of another camera than the first one; import one calibration at a time")
        cameras[robot.name] = found
        if other := differences(found, stated):
            warnings.append(
                f"{bag.path}: {robot.name}'s camera is that of {robot.camera_info}, and the team states another: "
                + ", ".join(other)
            )
    robots = tuple(
        msgspec.structs.replace(one, camera_if_any=cameras.get(one.name, one.camera_if_any)) for one in team.robots
    )
    return msgspec.structs.replace(team, robots=robots), warnings


def seconds(ns: NDArray[np.int64]) -> Array:
    """Convert nanoseconds to UTC seconds, (n,)."""
    return np.array([to_seconds(one) for one in ns.tolist()])


def odometry_of(bag: Bag, robot: RobotTopics, recording: Recording) -> tuple[list[OdometrySample], list[str]]:
    """Odometry of a robot's body, and sentences on corrections.

    Covariances of increments are those stated in the map, or follow from the growth of those of the poses. A jump that
    no wheel can make is removed: poses continue from before it, and the increment across it has a very large
    covariance. Raises `BagError` if neither map nor messages give the errors of odometry.
    """
    assert robot.odometry is not None
    values = recording.values[robot.odometry]
    poses, said = _of_body(bag, robot, recording)
    times = seconds(recording.orders[robot.odometry].ns)
    breaks = find_breaks(times, poses)
    said += [
        f"{bag.path}: {robot.odometry} (`odometry` of {robot.name}) {one}; the jump is not taken for a movement, and "
        "the poses go on from before it"
        for one in breaks[:BREAKS_NAMED]
    ]
    if len(breaks) > BREAKS_NAMED:
        said.append(f"{bag.path}: {robot.odometry} jumped {len(breaks) - BREAKS_NAMED} more times")
    where = f"{bag.path}: {robot.odometry} (`odometry` of {robot.name})"
    parts = []
    for begin, end in itertools.pairwise([0, *(one.index for one in breaks), len(poses)]):
        if robot.odometry_sigmas is not None:
            parts.append(stated_increments(poses[begin:end], robot.odometry_sigmas))
        else:
            parts.append(grown_increments(poses[begin:end], [one.covariance for one in values[begin:end]], where))
    increments = np.concatenate(parts)
    for one in breaks:
        increments[one.index] = np.diag(np.square(one.sigmas))
    samples = zip(times.tolist(), join_breaks(poses, breaks), increments, strict=True)
    return [OdometrySample(robot.name, *one) for one in samples], said


def _of_body(bag: Bag, robot: RobotTopics, recording: Recording) -> tuple[Array, list[str]]:
    """Poses (n, 3) x, y, yaw of the body by odometry, which may be of another frame, and sentences on that."""
    assert robot.odometry is not None
    values = recording.values[robot.odometry]
    frame = values[0].frame
    poses = np.array([one.pose for one in values])
    if not frame or BODY_FRAME.search(frame):
        return poses, []
    prefix = frame.rpartition("/")[0]
    bodies = [name for name in recording.frames.names if BODY_FRAME.search(name)]
    bodies.sort(key=lambda name: name.rpartition("/")[0] != prefix)
    for body in bodies:
        T_frame_body = recording.frames.fixed(frame, body)
        if T_frame_body is not None:
            T = np.array([one.T_odom_frame for one in values]) @ T_frame_body
            x, y = T_frame_body[:2, 3].tolist()
            return np.column_stack([T[:, :2, 3], yaw(T)]), [
                f"{bag.path}: {robot.odometry} is of the frame `{frame}`; it was moved to `{body}` by the static tf "
                f"between them ({x:+.3f}, {y:+.3f} m)"
            ]
    return poses, [
        f"{bag.path}: {robot.odometry} (`odometry` of {robot.name}) is of the frame `{frame}`, which may not be the "
        "body's, and is taken for it; record /tf_static, which says where it is on the body, or odometry of base_link"
    ]


def ranges_of(bag: Bag, robot: RobotTopics, recording: Recording) -> tuple[list[Ranges], list[str]]:
    """Ranges that a robot measured, and sentences on readings outside the limits of the sensor, which are none."""
    records, said = [], []
    for target, topic in robot.ranges.items():
        times, values = seconds(recording.orders[topic].ns), np.array(recording.values[topic])
        there = np.isfinite(values)
        found = zip(times[there].tolist(), values[there], strict=True)
        records += [Ranges(robot.name, time, (target,), np.array([value])) for time, value in found]
        if not there.all():
            said.append(
                f"{bag.path}: {int((~there).sum())} of {len(there)} ranges of {topic} are outside min_range and "
                "max_range, and were left out"
            )
    return records, said


def truth_of(bag: Bag, robot: RobotTopics, recording: Recording) -> list[tuple[float, Array]]:
    """True poses of a robot's body, with their times [UTC s]."""
    if robot.truth is not None:
        times = seconds(recording.orders[robot.truth].ns).tolist()
        return [(time, one.T_world_body) for time, one in zip(times, recording.values[robot.truth], strict=True)]
    if robot.truth_tf is None:
        return []
    world, body = (frame.lstrip("/") for frame in robot.truth_tf)
    for frame in (world, body):
        if frame not in recording.frames:
            raise BagError(
                f"{bag.path}: tf has no frame `{frame}`, which `truth_tf` of {robot.name} names; it has: "
                + ", ".join(recording.frames.names)
            )
    found = recording.frames.poses(world, body)
    if found is None or not len(found[0]):
        what = "never moves" if found else "is not known"
        raise BagError(
            f"{bag.path}: by tf the pose of `{body}` in `{world}`, `truth_tf` of {robot.name}, {what}; give two frames "
            "with the robot's movement between them, or leave it out"
        )
    return list(zip(seconds(found[0]).tolist(), found[1], strict=True))


def movements_of(
    the_map: RosMap, recording: Recording, odometry: Mapping[str, list[OdometrySample]]
) -> list[Movements]:
    """Movements of each robot, by its odometry or as the map states."""
    begin, end = _extent(recording)
    found = []
    for robot in the_map.robots:
        if robot.motion == "odometry":
            samples = odometry[robot.name]
            times, poses = [one.time for one in samples], [one.pose for one in samples]
            found.append(movements(robot.name, times, poses, the_map.motion))
        else:
            found.append(Movements(robot.name, begin, end, ((begin, end),) if robot.motion == "moves" else ()))
    return found


def _extent(recording: Recording) -> tuple[float, float]:
    every = [order.ns for order in recording.orders.values()]
    return to_seconds(int(min(ns[0] for ns in every))), to_seconds(int(max(ns[-1] for ns in every)))


def of_motion(bag: Bag, the_map: RosMap, recording: Recording, moves: list[Movements]) -> list[str]:
    """Warnings on the movements of robots."""
    said = []
    for robot, one in zip(the_map.robots, moves, strict=True):
        if one.crept:
            first = one.crept[0]
            said.append(
                f"{bag.path}: {robot.name} changed its position {len(one.crept)} times slower than the thresholds of "
                f"[motion] (first from {first[0]:.3f} to {first[1]:.3f} s): it counts as moving then"
            )
        if robot.odometry is not None:
            tilt = float(np.rad2deg(max(moment.tilt for moment in recording.values[robot.odometry])))
            if tilt > LEVEL:
                said.append(
                    f"{bag.path}: {robot.odometry} is tilted by up to {tilt:.0f} deg, and only x, y and yaw are taken: "
                    "is it of the body, x forward, z up?"
                )
        if robot.image is not None and robot.motion == "odometry":
            ns = recording.orders[robot.image].ns
            out = max(one.start - to_seconds(int(ns[0])), to_seconds(int(ns[-1])) - one.end)
            if out > UNKNOWN:
                said.append(
                    f"{bag.path}: images of {robot.name} are up to {out:.1f} s before or after its odometry: no stance "
                    "is made of them, since its motion is unknown then"
                )
    return said


def of_team(bag: Bag, the_map: RosMap, team: Team, recording: Recording) -> list[str]:
    """Warnings on robots that are not imported, and on truths in different frames."""
    said = []
    absent = [name for name in team.names if name not in {robot.name for robot in the_map.robots}]
    if absent:
        said.append(
            f"{bag.path}: nothing is imported for {', '.join(absent)} of the team, since the map has no such robot"
        )
    worlds = {robot.name: recording.values[robot.truth][0].frame for robot in the_map.robots if robot.truth}
    worlds |= {robot.name: robot.truth_tf[0].lstrip("/") for robot in the_map.robots if robot.truth_tf}
    if len(set(worlds.values())) > 1:
        frames = ", ".join(f"{name} in `{frame}`" for name, frame in worlds.items())
        said.append(f"{bag.path}: the true poses are not all in one frame ({frames}): they cannot be compared")
    return said
