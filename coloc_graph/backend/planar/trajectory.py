"""Trajectories in space of poses on the floor."""

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.lie import floor_pose
from coloc_graph.geometry.trajectory import Trajectory

Array = NDArray[np.float64]

PLACE = np.array([3, 4, 2])  # tangent components of x, y, heading in those of a pose in space
FLAT = 1e-6  # standard deviation of roll, pitch [rad] and height [m] of a pose on the floor


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
