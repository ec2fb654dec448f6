"""Poses on the floor in space: trajectories and covariances."""

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.lie import floor_pose, rotation_z
from coloc_graph.geometry.trajectory import Trajectory

Array = NDArray[np.float64]

PLACE = np.array([3, 4, 2])  # tangent components of x, y, heading in those of a pose in space
FLAT = 1e-6  # standard deviation of roll, pitch [rad] and height [m] of a pose on the floor


def in_body(poses: Array, covariances: Array) -> Array:
    """Return covariances (n, 3, 3) of poses (n, 3) in their body frames, from those in the world's axes."""
    R = rotation_z(poses[:, 2]).mT
    return np.asarray(R @ covariances @ R.mT)


def joint_in_space(T_world_body: Array, joint: Array) -> Array:
    """Return the joint covariance (6 n, 6 n) of poses (n, 4, 4) in their bodies' tangents.

    `joint` (3 n, 3 n) is that of x, y and heading in the world's axes.
    """
    n = len(T_world_body)
    R = np.zeros((n, 6, n, 3))
    for k, to_body in enumerate(T_world_body[:, :3, :3].mT):
        R[k, PLACE, k] = to_body
    flat = np.tile(np.isin(np.arange(6), PLACE, invert=True), n)
    J = R.reshape(6 * n, 3 * n)
    return np.asarray(J @ joint @ J.T + np.diag(flat * FLAT**2))


def trajectory(
    robot: str, times: Array, poses: Array, covariances: Array, direction_sigma_deg: float = 0.0
) -> Trajectory:
    """Return a trajectory of poses (n, 3) x, y, heading, with covariances (n, 3, 3) in the body frame.

    Its headings are those in which the wheels drive, from which the body's differ by `direction_sigma_deg`.
    """
    C = np.zeros((len(poses), 6, 6))
    C[:, [0, 1, 5], [0, 1, 5]] = FLAT**2
    C[:, PLACE[:, None], PLACE] = covariances
    C[:, 2, 2] += np.deg2rad(direction_sigma_deg) ** 2
    return Trajectory(robot=robot, times=times, T_world_body=floor_pose(*poses.T), covariances=C)
