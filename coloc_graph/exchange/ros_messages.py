"""Poses of a team as ROS 2's DDS messages: tf, poses with covariances, paths, markers. Needs `cyclonedds`."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coloc_graph.exchange import ros_dds_types as ros
from coloc_graph.exchange.ros_poses import ros_covariance
from coloc_graph.geometry.lie import quaternion
from coloc_graph.run.schemas import to_ns
from coloc_graph.team import Team

Array = NDArray[np.float64]

WORLD = "world"
CHI2_95 = 5.991  # of two degrees of freedom: squared radius of a 95 % ellipse in units of sigma
BODY_SIZE = (0.34, 0.34, 0.08)  # m, of an iRobot Create
TEXT_HEIGHT = 0.12  # m
TEXT_ABOVE = 0.35  # m over the floor
FLAT = 0.002  # m, height of an ellipse on the floor
SPHERE = 2  # type of visualization_msgs/Marker
CYLINDER = 3  # the same
TEXT = 9  # the same, facing the viewer
COLORS = ((0.12, 0.47, 0.71), (1.0, 0.5, 0.05), (0.17, 0.63, 0.17), (0.84, 0.15, 0.16), (0.58, 0.4, 0.74))


def header(time: float, frame: str) -> ros.Header:
    """Header of a time [UTC s] and a frame."""
    seconds, rest = divmod(to_ns(time), 1_000_000_000)
    return ros.Header(ros.Time(seconds, rest), frame)


def transforms(time: float, poses: Iterable[tuple[str, str, Array]]) -> ros.TFMessage:
    """Transforms of (parent, child, T_parent_child (4, 4))."""
    return ros.TFMessage([
        ros.TransformStamped(
            header(time, parent), child, ros.Transform(ros.Vector3(*T[:3, 3].tolist()), _rotation(T))
        )
        for parent, child, T in poses
    ])  # fmt: skip


def mounts(time: float, team: Team) -> ros.TFMessage:
    """Static transforms from each robot's body to its camera."""
    return transforms(
        time,
        [
            (f"{robot.name}/base_link", f"{robot.name}/camera", robot.mount.T_body_camera)
            for robot in team.robots
            if robot.camera_if_any is not None
        ],
    )


def pose_with_covariance(time: float, T_world_body: Array, covariance: Array) -> ros.PoseWithCovarianceStamped:
    """Pose (4, 4) with a covariance (6, 6) in GTSAM's tangent, which becomes ROS's."""
    by_ros = ros_covariance(covariance[None], T_world_body[None, :3, :3])[0]
    known = ros.PoseWithCovariance(_pose(T_world_body), by_ros.ravel().tolist())
    return ros.PoseWithCovarianceStamped(header(time, WORLD), known)


def path(times: Sequence[float], T_world_body: Sequence[Array]) -> ros.Path:
    """Poses (4, 4) at times [UTC s], the newest last."""
    poses = [ros.PoseStamped(header(time, WORLD), _pose(T)) for time, T in zip(times, T_world_body, strict=True)]
    return ros.Path(header(times[-1], WORLD), poses)


def markers(time: float, poses: Mapping[str, tuple[Array, Array]], robots: Sequence[str]) -> ros.MarkerArray:
    """Each robot as a cylinder with its name, and its 95 % ellipse on the floor.

    Parameters
    ----------
    time : float
        Time [UTC s].
    poses : mapping of str to ((4, 4) float, (6, 6) float)
        Pose and covariance, in GTSAM's tangent, by robot.
    robots : sequence of str
        Robots of the team, by whose order colours and ids are given.
    """
    shapes = []
    for robot, (T, covariance) in poses.items():
        number = robots.index(robot)
        color = ros.ColorRGBA(*COLORS[number % len(COLORS)], 1.0)
        middle = T.copy()
        middle[2, 3] += BODY_SIZE[2] / 2
        shapes.append(_marker(time, "robots", number, CYLINDER, middle, BODY_SIZE, color))
        above = np.eye(4)
        above[:3, 3] = T[:3, 3] + (0, 0, TEXT_ABOVE)
        shapes.append(_marker(time, "names", number, TEXT, above, (0.0, 0.0, TEXT_HEIGHT), color, robot))
        by_ros = ros_covariance(covariance[None], T[None, :3, :3])[0]
        values, vectors = np.linalg.eigh(by_ros[:2, :2])
        axes = np.eye(4)
        axes[:2, :2] = vectors * [1, np.sign(np.linalg.det(vectors))]  # right-handed
        axes[:3, 3] = T[:3, 3]
        width = 2 * np.sqrt(CHI2_95 * np.maximum(values, 0))
        pale = ros.ColorRGBA(color.r_, color.g_, color.b_, 0.4)
        shapes.append(_marker(time, "ellipses", number, SPHERE, axes, (*width.tolist(), FLAT), pale))
    return ros.MarkerArray(shapes)


def _marker(
    time: float, kind: str, number: int, shape: int, T: Array, size: Sequence[float], color: Any, text: str = ""
) -> ros.Marker:
    at = header(time, WORLD)
    return ros.Marker(
        at, kind, number, shape, 0, _pose(T), ros.Vector3(*map(float, size)), color, ros.Duration(), False,
        [], [], "", ros.CompressedImage(at), [], text, "", ros.MeshFile(), False,
    )  # fmt: skip


def _pose(T: Array) -> ros.Pose:
    return ros.Pose(ros.Point(*T[:3, 3].tolist()), _rotation(T))


def _rotation(T: Array) -> ros.Quaternion:
    w, x, y, z = map(float, quaternion(T[:3, :3]))
    return ros.Quaternion(x, y, z, w)
