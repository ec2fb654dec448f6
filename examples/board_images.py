"""Render images of a chessboard, held in front of a camera and laid on the floor: something to calibrate with."""

from pathlib import Path

import cv2
import numpy as np

from coloc_graph.calibration import make_board
from coloc_graph.simulation.boards import floor_poses, held_poses, render_boards
from coloc_graph.team import Camera, Mount

camera = Camera(width=320, height=240, fx=301.0, fy=303.0, cx=158.5, cy=121.5, distortion=(-0.12, 0.05, 0.0, 0.0))
mount = Mount(height=0.41, tilt_deg=24.0, roll_deg=-0.8)
board, rng = make_board("7x5", 0.03), np.random.default_rng(4)
sets = {
    "board": held_poses(rng, camera, board, 12),
    "floor": floor_poses(rng, camera, mount, board, 3, farthest=0.7),
}
for name, poses in sets.items():
    Path(name).mkdir(exist_ok=True)
    images = list(render_boards(rng, camera, board, poses))
    for index, image in enumerate(images):
        cv2.imwrite(f"{name}/{index}.png", image)
    print(f"{name}/: {len(images)} images")
cv2.imwrite("board_images.png", cv2.hconcat([cv2.imread(f"{name}/0.png") for name in sets]))
