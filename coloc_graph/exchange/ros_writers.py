"""DDS writers of a team's ROS 2 topics, with the quality of service that ROS 2 expects. Needs `cyclonedds`."""

import ipaddress
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from cyclonedds.core import DDSException, Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.exchange import ros_dds_types as ros
from coloc_graph.exchange import ros_messages as messages
from coloc_graph.team import Team

Array = NDArray[np.float64]

DEPTH = 100  # messages of /tf that are kept for a reliable reader
MAX_PARTICIPANTS = 120  # on this machine, as ROS 2 allows when it discovers on the loopback only


def configuration(address: str) -> str:
    """Return Cyclone's configuration for one interface; on the loopback readers are looked for without multicast."""
    loopback = ipaddress.ip_address(address).is_loopback
    discovery = (
        "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
        f"<MaxAutoParticipantIndex>{MAX_PARTICIPANTS}</MaxAutoParticipantIndex>"
        f'<Peers><Peer address="{address}"/></Peers></Discovery>'
    )
    return (
        f'<CycloneDDS><Domain><General><Interfaces><NetworkInterface address="{address}"/></Interfaces>'
        f"<AllowMulticast>{'false' if loopback else 'default'}</AllowMulticast></General>"
        f"{discovery if loopback else ''}</Domain></CycloneDDS>"
    )


def ros_name(robot: str) -> str:
    """Return a robot's name as part of a topic: ROS 2 takes letters, digits and underscores, no digit first."""
    name = re.sub(r"\W", "_", robot, flags=re.ASCII)
    return f"robot_{name}" if name[0].isdigit() else name


class RosWriters:
    """Writers of /tf, /tf_static, /<robot>/pose, /<robot>/path and /markers."""

    def __init__(self, robots: Sequence[str], address: str, domain: int, blocking: int) -> None:
        try:
            config = configuration(address)
        except ValueError:
            raise InputError(f"--ros2: `{address}` is no address of an interface; give one, as 127.0.0.1") from None
        reliable = Policy.Reliability.Reliable(duration(milliseconds=blocking))
        plain = Policy.DataRepresentation(use_cdrv0_representation=True)  # ROS 2's encoding
        stream = Qos(reliable, plain, Policy.History.KeepLast(DEPTH))
        latched = Qos(reliable, plain, Policy.History.KeepLast(1), Policy.Durability.TransientLocal)
        self._robots = tuple(robots)
        try:
            self._domain = Domain(domain, config)
            self._participant = DomainParticipant(domain)
            self._tf = self._writer("tf", ros.TFMessage, stream)
            self._tf_static = self._writer("tf_static", ros.TFMessage, latched)
            self._poses = {
                robot: self._writer(f"{ros_name(robot)}/pose", ros.PoseWithCovarianceStamped, stream)
                for robot in robots
            }
            self._paths = {robot: self._writer(f"{ros_name(robot)}/path", ros.Path, latched) for robot in robots}
            self._markers = self._writer("markers", ros.MarkerArray, latched)
        except DDSException as error:
            reason = " ".join(str(error).split())
            raise InputError(
                f"--ros2: DDS cannot use the interface {address} in domain {domain} ({reason}); give the address of "
                "one of this machine's interfaces"
            ) from error

    def _writer(self, name: str, kind: Any, qos: Qos) -> Any:
        return DataWriter(self._participant, Topic(self._participant, f"rt/{name}", kind, qos=qos), qos=qos)

    def mounts(self, time: float, team: Team) -> None:
        """Send /tf_static."""
        self._tf_static.write(messages.mounts(time, team))

    def tf(self, time: float, poses: Mapping[str, Array]) -> None:
        """Send /tf: each robot's body in the world."""
        frames = [(messages.WORLD, f"{robot}/base_link", T) for robot, T in poses.items()]
        self._tf.write(messages.transforms(time, frames))

    def pose(self, robot: str, time: float, T_world_body: Array, covariance: Array) -> None:
        """Send /<robot>/pose."""
        self._poses[robot].write(messages.pose_with_covariance(time, T_world_body, covariance))

    def path(self, robot: str, poses: Sequence[tuple[float, Array]]) -> None:
        """Send /<robot>/path."""
        self._paths[robot].write(messages.path([time for time, _ in poses], [T for _, T in poses]))

    def markers(self, time: float, poses: Mapping[str, tuple[Array, Array]]) -> None:
        """Send /markers."""
        self._markers.write(messages.markers(time, poses, self._robots))

    @property
    def readers(self) -> int:
        """Number of readers of all topics that were found."""
        writers = (self._tf, self._tf_static, self._markers, *self._poses.values(), *self._paths.values())
        return sum(len(one.get_matched_subscriptions()) for one in writers)

    def close(self) -> None:
        """Leave the network."""
        for entity in (self._participant, self._domain):
            entity.__del__()
