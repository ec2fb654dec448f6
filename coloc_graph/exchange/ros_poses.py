"""Convert poses of ROS messages, covariances of odometry increments, and ROS covariances.

ROS orders a covariance x, y, z, then rotations about the fixed axes of the pose's frame; here rotation comes first,
then translation, both in the body frame (docs/conventions.md).
"""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coloc_graph.errors import BagError
from coloc_graph.exchange.ros_map import OdometrySigmas
from coloc_graph.geometry.lie import se3
from coloc_graph.geometry.se2 import wrap

Array = NDArray[np.float64]

PLANAR = [0, 1, 5]  # x, y and the rotation about z of ROS's six
ROUNDING = 1e-6  # relative decrease of a covariance that is rounding
UNIT = 1e-3  # tolerance of a quaternion's length
STATE_SIGMAS = "state `odometry_sigmas` in the map: its errors after a metre, and after a turn"  # remedy


def T_of(position: Any, orientation: Any) -> Array | None:
    """Pose (4, 4) of a geometry_msgs position and quaternion, or translation and rotation; None if it is invalid."""
    x, y, z, w = q = (orientation.x, orientation.y, orientation.z, orientation.w)
    p = (position.x, position.y, position.z)
    norm = math.hypot(*q)
    if not (all(map(math.isfinite, p)) and abs(norm - 1) <= UNIT):
        return None
    x, y, z, w = (one / norm for one in q)
    R = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return se3(R, p)


def planar_covariance(message: Any) -> Array:
    """Covariance (3, 3) of x, y, yaw in the odometry frame of a nav_msgs/Odometry."""
    return np.asarray(message.pose.covariance, float).reshape(6, 6)[np.ix_(PLANAR, PLANAR)]


def stated_increments(poses: ArrayLike, sigmas: OdometrySigmas) -> Array:
    """Covariances (n, 3, 3) of the increments to poses (n, 3) of x, y [m], yaw [rad] from stated standard deviations.

    Each is of x, y, yaw in the body frame at the sample before and grows with distance and rotation; the first is zero.
    """
    steps = np.diff(np.asarray(poses, float), axis=0, prepend=np.asarray(poses, float)[:1])
    way, turn = np.hypot(steps[:, 0], steps[:, 1]), np.abs(wrap(steps[:, 2]))
    variances = np.stack(
        [sigmas.along**2 * way, sigmas.across**2 * way, sigmas.turned**2 * turn + sigmas.veer**2 * way], axis=1
    )
    return np.asarray(variances[:, :, None] * np.eye(3))


def grown_increments(poses: ArrayLike, covariances: ArrayLike, where: str) -> Array:
    """Covariances (n, 3, 3) of increments from the growth of the covariances (n, 3, 3) of poses (n, 3).

    To first order, C_k = J C_(k-1) J' + R Q R' with R the heading at sample k - 1; Q is returned. Raises `BagError` if
    they do not grow that way: many drivers fill in the same numbers every time.
    """
    p, C = np.asarray(poses, float), np.asarray(covariances, float)
    if not np.isfinite(C).all():
        raise BagError(f"{where} has covariances that are not finite; {STATE_SIGMAS}")
    moved = (np.diff(p, axis=0) != 0).any(axis=1)
    if not moved.any():
        return np.zeros((len(p), 3, 3))
    J = np.tile(np.eye(3), (len(p) - 1, 1, 1))
    J[:, 0, 2], J[:, 1, 2] = -np.diff(p[:, 1]), np.diff(p[:, 0])
    R = np.tile(np.eye(3), (len(p) - 1, 1, 1))
    c, s = np.cos(p[:-1, 2]), np.sin(p[:-1, 2])
    R[:, 0, 0], R[:, 0, 1], R[:, 1, 0], R[:, 1, 1] = c, -s, s, c
    Q = R.mT @ (C[1:] - J @ C[:-1] @ J.mT) @ R
    Q = (Q + Q.mT) / 2
    values, vectors = np.linalg.eigh(Q)
    size = np.abs(C[1:]).max(axis=(1, 2))
    if (values[:, 0] < -ROUNDING * size).any() or (values[moved, 2] <= ROUNDING * size[moved]).all():
        raise BagError(f"{where} has covariances that do not grow with distance and are meaningless; {STATE_SIGMAS}")
    Q = vectors @ (np.maximum(values, 0)[:, :, None] * vectors.mT)
    return np.concatenate([np.zeros((1, 3, 3)), (Q + Q.mT) / 2])


def ros_covariance(covariance: ArrayLike, R_world_body: ArrayLike) -> Array:
    """Convert GTSAM covariances (..., 6, 6) of poses with rotation (..., 3, 3) to ROS's in the world frame.

    An error xi = (w, v) in the body frame, T_true = T exp(xi), rotates the pose about the world's axes by R w and moves
    it by R v, to first order.
    """
    C, R = np.asarray(covariance, float), np.asarray(R_world_body, float)
    to_ros = np.zeros_like(C)
    to_ros[..., :3, 3:] = to_ros[..., 3:, :3] = R
    return np.asarray(to_ros @ C @ to_ros.mT)
