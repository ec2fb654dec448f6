"""Errors of wheel odometry against the truth."""

import numpy as np

from coloc_graph.frontend import WheelTrack
from coloc_graph.geometry.lie import floor_pose, se3_inverse


def planar(T):
    return np.array([np.arctan2(T[1, 0], T[0, 0]), T[0, 3], T[1, 3]])


def nees(samples, true_start, true_end):
    """NEES of the motion between the first and the last sample, and its error; true poses (x, y, yaw) at its ends."""
    way = WheelTrack("A", samples).between(0, 1, samples[0].time, samples[-1].time)
    T_start, T_end = (floor_pose(*true) for true in (true_start, true_end))
    off = planar(se3_inverse(way.T_before_after) @ se3_inverse(T_start) @ T_end)
    return off @ np.linalg.solve(way.covariance, off), off
