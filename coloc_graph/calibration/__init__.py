"""Calibrate cameras (intrinsics) and mounts (height, tilt, roll) from images of a board, with uncertainties.

Uses OpenCV, SciPy and the team; no graph. The results are written into team.toml.
"""

from coloc_graph.calibration.board import Board, make_board
from coloc_graph.calibration.camera import CameraCalibration, calibrate_camera
from coloc_graph.calibration.corners import View, Views, find_boards, image_paths
from coloc_graph.calibration.mount import MountCalibration, calibrate_mount
from coloc_graph.calibration.team_file import write_camera, write_mount
from coloc_graph.calibration.verdict import verdict

__all__ = [
    "Board",
    "CameraCalibration",
    "MountCalibration",
    "View",
    "Views",
    "calibrate_camera",
    "calibrate_mount",
    "find_boards",
    "image_paths",
    "make_board",
    "verdict",
    "write_camera",
    "write_mount",
]
