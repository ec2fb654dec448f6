"""Publish a team's poses to ROS 2 while they are estimated, over DDS and without ROS: `RosPublisher`.

Topics are named as ROS 2 names them on the wire (`rt/tf`). All encoding and sending is done by a thread of its own,
from a queue that drops the oldest when it is full: who publishes never waits.
"""

import logging
import os
import queue
import threading
from collections.abc import Callable, Mapping
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.team import Team

Array = NDArray[np.float64]

log = logging.getLogger(__name__)

CAPACITY = 200  # messages that wait to be sent
BLOCKING = 10  # ms, for which a write may wait for a slow reader
LAST_WAIT = 2.0  # s, for messages that wait when the publisher is closed
DOMAIN = "ROS_DOMAIN_ID"
MAX_DOMAIN = 232
NOT_INSTALLED = "--ros2 needs Eclipse Cyclone DDS: pip install 'coloc-graph[ros2]'"


def domain_of_environment() -> int:
    """Return the DDS domain of ROS_DOMAIN_ID, 0 by default; `InputError` where it is none."""
    text = os.environ.get(DOMAIN, "") or "0"
    if not text.isdecimal() or int(text) > MAX_DOMAIN:
        raise InputError(f"{DOMAIN} is `{text}`; set it to a number from 0 to {MAX_DOMAIN}")
    return int(text)


class RosPublisher:
    """Publisher of a team's tf, poses, paths and markers.

    Parameters
    ----------
    team : Team
        The team; its mounts are sent as /tf_static.
    address : str
        Address of the network interface to use. On 127.0.0.1, only readers on this machine find it.
    domain : int, optional
        DDS domain; by default that of ROS_DOMAIN_ID, or 0.

    Raises
    ------
    InputError
        cyclonedds is not installed, or the interface cannot be used.
    """

    def __init__(self, team: Team, address: str = "127.0.0.1", domain: int | None = None) -> None:
        domain = domain_of_environment() if domain is None else domain
        try:
            from coloc_graph.exchange.ros_writers import RosWriters
        except ImportError as error:
            raise InputError(NOT_INSTALLED) from error
        self._team = team
        self._writers = RosWriters(team.names, address, domain, BLOCKING)
        self._waiting: queue.Queue[Callable[[], None] | None] = queue.Queue(CAPACITY)
        self._dropped, self._failed, self._mounts = 0, "", False
        self._poses: dict[str, dict[int, tuple[float, Array]]] = {name: {} for name in team.names}
        self._known: dict[str, tuple[Array, Array]] = {}
        self._sender = threading.Thread(target=self._send, name="ros2", daemon=True)
        self._sender.start()

    @property
    def readers(self) -> int:
        """Number of readers of all topics that were found."""
        return self._writers.readers

    def publish_poses(self, time: float, T_world_body: Mapping[str, Array]) -> None:
        """Send poses (4, 4) of any robots at a time [UTC s] as /tf."""
        poses = {robot: np.array(T) for robot, T in T_world_body.items()}
        self._put(lambda: self._send_poses(time, poses))

    def publish_stance(self, stance: int, poses: Mapping[str, tuple[float, Array, Array]]) -> None:
        """Send the estimate of a stance: poses with covariances, paths, and markers.

        Parameters
        ----------
        stance : int
            Its number; a stance that was sent before is replaced in the paths.
        poses : mapping of str to (float, (4, 4) float, (6, 6) float)
            Time [UTC s], pose and covariance (GTSAM's tangent) by robot.
        """
        self._put(lambda: self._send_stance(stance, dict(poses)))

    def _put(self, what: Callable[[], None]) -> None:
        while True:
            try:
                self._waiting.put_nowait(what)
                return
            except queue.Full:
                try:
                    self._waiting.get_nowait()
                    self._dropped += 1
                except queue.Empty:
                    continue

    def _send(self) -> None:
        while (what := self._waiting.get()) is not None:
            try:
                what()
            except Exception as error:
                # of the network or of the library: a mission goes on without its display
                if self._failed != (reason := f"{type(error).__name__}: {error}"):
                    self._failed = reason
                    log.warning("ROS 2 is not served: %s", reason)

    def _send_poses(self, time: float, poses: Mapping[str, Array]) -> None:
        self._send_mounts(time)
        self._writers.tf(time, poses)

    def _send_mounts(self, time: float) -> None:
        if not self._mounts:
            self._writers.mounts(time, self._team)
            self._mounts = True

    def _send_stance(self, stance: int, poses: dict[str, tuple[float, Array, Array]]) -> None:
        for robot, (time, T, covariance) in poses.items():
            self._send_mounts(time)
            self._poses[robot][stance] = time, T
            self._known[robot] = T, covariance
            self._writers.pose(robot, time, T, covariance)
            self._writers.path(robot, [self._poses[robot][one] for one in sorted(self._poses[robot])])
        if poses:
            self._writers.markers(max(time for time, _, _ in poses.values()), self._known)

    def close(self) -> None:
        """Send what waits, unless that takes longer than `LAST_WAIT`, and leave the network."""
        if self._sender.is_alive():
            try:
                self._waiting.put(None, timeout=LAST_WAIT)
                self._sender.join(LAST_WAIT)
            except queue.Full:
                pass
            if self._dropped:
                log.warning("%d messages for ROS 2 were dropped: the network did not take them in time", self._dropped)
            self._writers.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()
