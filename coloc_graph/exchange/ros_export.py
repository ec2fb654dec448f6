"""Write a result as a ROS 2 bag for RViz and Foxglove: one MCAP file with tf and each robot's poses with covariances.

Profile `ros2`, messages in CDR, schemas as ros2msg, like `ros2 bag` records.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import BagError, InputError
from coloc_graph.exchange.ros_bag import NOT_INSTALLED, POSE, POSE_WITH_COVARIANCE, TF
from coloc_graph.exchange.ros_poses import ros_covariance
from coloc_graph.geometry.lie import quaternion
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.run.schemas import to_ns
from coloc_graph.team import Team

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

Array = NDArray[np.float64]

PATH = "nav_msgs/msg/Path"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
WORLD = "world"
TF_STATIC = "/tf_static"
#: The metadata that ROS 2 Humble and all later ones read.
VERSION: Literal[8] = 8
#: No limit, as ROS 2 writes it: the nanoseconds of 63 bits.
FOREVER = divmod(2**63 - 1, 1_000_000_000)


def write_ros2(
    trajectories: Mapping[str, Trajectory], team: Team, path: str | Path, truth: Mapping[str, Array] | None = None
) -> int:
    """Write the poses T_world_body of a team as a ROS 2 bag.

    Parameters
    ----------
    trajectories
        Trajectory of each robot.
    team
        The team.
    path
        Bag to write (.mcap); it appears complete or not at all, and the same input gives the same bytes.
    truth
        True poses (n, 4, 4) by robot, at the times of its trajectory, NaN where there is none.

    Returns
    -------
    int
        Number of poses.

    Raises
    ------
    InputError
        There is no pose.
    BagError
        rosbags is not installed.

    Notes
    -----
    /tf_static has <robot>/camera (optical axes) in <robot>/base_link; /tf has <robot>/base_link in `world` at each
    pose; /<robot>/pose is a PoseWithCovarianceStamped with the covariance of x, y, z and of rotations about the world's
    axes; /<robot>/path is a nav_msgs/Path of all poses at the time of the first. Truth is truth/<robot>/base_link in
    /tf, and the PoseStamped /<robot>/truth.
    """
    path = Path(path)
    trajectories = {robot: one for robot, one in trajectories.items() if len(one)}
    if not trajectories:
        raise InputError("the result holds no pose, so that there is nothing to export; solve the run again")
    new = _Messages()
    messages = [new.mounts(trajectories, team)]
    for robot, trajectory in trajectories.items():
        messages += new.of_robot(robot, trajectory)
        if truth is not None and robot in truth:
            messages += new.of_truth(robot, trajectory, truth[robot])
    with TemporaryDirectory(prefix=f".{path.name}-", dir=path.parent) as folder:
        _write(Path(folder) / "bag", new.store, sorted(messages, key=lambda one: one.ns))
        (Path(folder) / "bag" / "bag.mcap").replace(path)
    return sum(map(len, trajectories.values()))


class _Message(NamedTuple):
    """Message for a topic at a time [ns]."""

    topic: str
    ns: int
    type: str
    content: Any


class _Messages:
    """Factory of ROS messages."""

    def __init__(self) -> None:
        try:
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise BagError(NOT_INSTALLED) from error
        self.store = get_typestore(Stores.LATEST)

    def mounts(self, trajectories: Mapping[str, Trajectory], team: Team) -> _Message:
        """Static transforms from each robot to its camera."""
        ns = min(to_ns(float(one.times[0])) for one in trajectories.values())
        mounts = [
            self._transform(ns, f"{robot}/base_link", f"{robot}/camera", team[robot].mount.T_body_camera)
            for robot in trajectories
            if team[robot].camera_if_any is not None
        ]
        return _Message(TF_STATIC, ns, TF, self._new(TF, transforms=mounts))

    def of_robot(self, robot: str, trajectory: Trajectory) -> Iterator[_Message]:
        """Path of a robot, its poses with covariances, and its tf."""
        times, poses = [to_ns(time) for time in trajectory.times.tolist()], trajectory.T_world_body
        stamped = [self._stamped(ns, T) for ns, T in zip(times, poses, strict=True)]
        path = self._new(PATH, header=self._header(times[0], WORLD), poses=stamped)
        yield _Message(f"/{robot}/path", times[0], PATH, path)
        covariances = np.zeros((len(times), 6, 6))  # by ROS's custom: not known
        if trajectory.covariances is not None:
            covariances = ros_covariance(trajectory.covariances, poses[:, :3, :3])
        for ns, T, one, covariance in zip(times, poses, stamped, covariances, strict=True):
            transform = self._transform(ns, WORLD, f"{robot}/base_link", T)
            yield _Message("/tf", ns, TF, self._new(TF, transforms=[transform]))
            known = self._new("geometry_msgs/msg/PoseWithCovariance", pose=one.pose, covariance=covariance.ravel())
            content = self._new(POSE_WITH_COVARIANCE, header=one.header, pose=known)
            yield _Message(f"/{robot}/pose", ns, POSE_WITH_COVARIANCE, content)

    def of_truth(self, robot: str, trajectory: Trajectory, true: Array) -> Iterator[_Message]:
        """True poses of a robot, and their tf."""
        for time, T in zip(trajectory.times.tolist(), true, strict=True):
            if np.isfinite(T).all():
                ns = to_ns(time)
                transform = self._transform(ns, WORLD, f"truth/{robot}/base_link", T)
                yield _Message("/tf", ns, TF, self._new(TF, transforms=[transform]))
                yield _Message(f"/{robot}/truth", ns, POSE, self._stamped(ns, T))

    def _new(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def _header(self, ns: int, frame: str) -> Any:
        seconds, rest = divmod(ns, 1_000_000_000)
        stamp = self._new("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)
        return self._new("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def _stamped(self, ns: int, T_world_body: Array) -> Any:
        x, y, z = T_world_body[:3, 3].tolist()
        position = self._new("geometry_msgs/msg/Point", x=x, y=y, z=z)
        pose = self._new("geometry_msgs/msg/Pose", position=position, orientation=self._rotation(T_world_body))
        return self._new(POSE, header=self._header(ns, WORLD), pose=pose)

    def _transform(self, ns: int, parent: str, child: str, T_parent_child: Array) -> Any:
        x, y, z = T_parent_child[:3, 3].tolist()
        translation = self._new("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
        transform = self._new(
            "geometry_msgs/msg/Transform", translation=translation, rotation=self._rotation(T_parent_child)
        )
        return self._new(TRANSFORM, header=self._header(ns, parent), child_frame_id=child, transform=transform)

    def _rotation(self, T: Array) -> Any:
        w, x, y, z = quaternion(T[:3, :3])
        return self._new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def _write(folder: Path, store: "Typestore", messages: Sequence[_Message]) -> None:
    """Write messages as a ROS 2 bag in a folder."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    writer = Writer(folder, version=VERSION, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    connections: dict[str, Any] = {}
    with writer:
        for one in messages:
            if one.topic not in connections:
                # who subscribes late wants mounts and paths all the same, and tf asks for them so
                kept = [_latched()] if one.type == PATH or one.topic == TF_STATIC else []
                connections[one.topic] = writer.add_connection(
                    one.topic, one.type, typestore=store, offered_qos_profiles=kept
                )
            writer.write(connections[one.topic], one.ns, store.serialize_cdr(one.content, one.type))


def _latched() -> Any:
    """ROS 2 quality of service of latched topics."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    forever = QosTime(*FOREVER)
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=1,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL,
        deadline=forever,
        lifespan=forever,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=forever,
        avoid_ros_namespace_conventions=False,
    )
