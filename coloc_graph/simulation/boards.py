"""Boards before a simulated camera: held in the air, or lying on a floor; as corners with noise, or as images."""

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.calibration.board import Board, charuco_board
from coloc_graph.calibration.corners import View, Views
from coloc_graph.geometry.lie import rotation_x, rotation_y, rotation_z, se3, so3_exp
from coloc_graph.team import Camera, Floor, Mount

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

#: Of a board's picture: pixels a square, white margin in squares. Rays a pixel of an image, along each axis.
PER_SQUARE = 40
MARGIN = 1
RAYS = 2
PAPER = 220.0
INK = 25.0
SURROUNDINGS = 110.0


def held_poses(
    rng: np.random.Generator, camera: Camera, board: Board, images: int, tilt_deg: float = 40.0, reach: float = 1.0
) -> Array:
    """Poses T_camera_board (n, 4, 4) of a board that is held about a camera, whole in the image.

    Its middle is anywhere in the middle `reach` of the image, its tilt to each side up to `tilt_deg`, its width between
    a third and three quarters of the image's.
    """
    poses: list[Array] = []
    middle = board.points.mean(axis=0)
    width = np.ptp(board.points[:, 0])
    while len(poses) < images:
        tilt, turn, roll = np.deg2rad(rng.uniform(-tilt_deg, tilt_deg, 2)), rng.uniform(-0.5, 0.5), rng.uniform()
        R = rotation_x(tilt[0]) @ rotation_y(tilt[1]) @ rotation_z(turn + np.pi * (roll < 0.2))
        z = camera.fx * width / (camera.width * rng.uniform(0.33, 0.75))
        off = reach * rng.uniform(-0.5, 0.5, 2)
        if camera.model == "fisheye":  # facing the camera from anywhere in its view
            (ray,) = camera.rays([off * (camera.width, camera.height) + (camera.cx, camera.cy)])
            if np.isnan(ray).any():
                continue
            R = _toward(ray) @ R
            T = se3(R, z * ray - R @ middle)
        else:
            off = off * (camera.width / camera.fx, camera.height / camera.fy)
            T = se3(R, [*(z * off), z] - R @ middle)
        _, inside = camera.project(_outline(board) @ R.T + T[:3, 3])
        if inside.all():
            poses.append(T)
    return np.array(poses)


def _toward(ray: Array) -> Array:
    """Rotation (3, 3) by the smallest angle that turns the optical axis to a unit ray (3,)."""
    axis = np.cross([0.0, 0.0, 1.0], ray)
    sine = float(np.linalg.norm(axis))
    return so3_exp(axis / max(sine, 1e-12) * np.arctan2(sine, ray[2]))


def floor_poses(
    rng: np.random.Generator,
    camera: Camera,
    mount: Mount,
    board: Board,
    images: int,
    floor: Floor | None = None,
    farthest: float = 1.2,
) -> Array:
    """Poses T_camera_board (n, 4, 4) of a board that lies 0.3 to `farthest` metres before a robot, whole in the image.

    With a `floor` it is uneven under each board, and under the robot.
    """
    uneven = np.zeros(3) if floor is None else np.array([floor.height_sigma, *[np.deg2rad(floor.tilt_sigma_deg)] * 2])
    T_camera_floor = np.linalg.inv(_uneven(rng, uneven) @ mount.T_body_camera)
    poses: list[Array] = []
    while len(poses) < images:
        # about where it lies, not about the robot
        R_floor_board = _uneven(rng, uneven)
        R_floor_board[:2, 3] = rng.uniform(0.3, farthest), rng.uniform(-0.3, 0.3)
        T = T_camera_floor @ R_floor_board @ se3(rotation_z(rng.uniform(-3, 3)), np.zeros(3))
        T[:3, 3] -= T[:3, :3] @ board.points.mean(axis=0)
        _, inside = camera.project(_outline(board) @ T[:3, :3].T + T[:3, 3])
        if inside.all():
            poses.append(T)
    return np.array(poses)


def seen_corners(
    rng: np.random.Generator, camera: Camera, board: Board, poses: Array, noise: float, bend: float = 0.0
) -> Views:
    """The corners of a board in poses T_camera_board (n, 4, 4), with noise [px].

    `bend` [m] is one sigma of how far its edges are off a plane, anew in each image: an error that its corners share.
    """
    p = board.points - board.points.mean(axis=0)
    x, y = p[:, 0] / np.abs(p[:, 0]).max(), p[:, 1] / np.abs(p[:, 1]).max()
    views = []
    for index, T in enumerate(poses):
        points = board.points.copy()
        points[:, 2] = rng.normal(scale=bend, size=3) @ [x * x, x * y, y * y] if bend else 0.0
        uv, _ = camera.project(points @ T[:3, :3].T + T[:3, 3])
        views.append(View(f"image{index}.png", board.points, uv + rng.normal(scale=noise, size=uv.shape)))
    return Views(camera.width, camera.height, tuple(views))


def render_boards(
    rng: np.random.Generator, camera: Camera, board: Board, poses: Array, blur: float = 0.7, noise: float = 2.0
) -> list[Image]:
    """Images of a board in poses T_camera_board (n, 4, 4), through the lens, blurred [px], with noise [grey levels]."""
    picture = board_picture(board)
    v, u = np.mgrid[0 : RAYS * camera.height, 0 : RAYS * camera.width]
    pixels = (np.stack([u, v], axis=-1).reshape(-1, 2) + 0.5) / RAYS - 0.5
    rays = camera.rays(pixels)
    images = []
    for T in poses:
        # the ray meets the board's plane at s ray = R p + t with p_z = 0
        directions = rays @ T[:3, :3]
        origin = -T[:3, :3].T @ T[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            s = -origin[2] / directions[:, 2]
            p = origin + s[:, None] * directions
        # a square's edges lie between pixels
        at = (p[:, :2] / board.square + MARGIN + 1) * PER_SQUARE - 0.5
        at = np.where((s > 0)[:, None] & np.isfinite(at), at, -1).clip(-1, max(picture.shape))
        at = at.astype(np.float32).reshape(RAYS * camera.height, RAYS * camera.width, 2)
        drawn = cv2.remap(
            picture, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=SURROUNDINGS
        )
        image = np.asarray(cv2.resize(drawn, (camera.width, camera.height), interpolation=cv2.INTER_AREA), float)
        image = cv2.GaussianBlur(image, (0, 0), blur) if blur else image
        images.append(np.clip(image + rng.normal(scale=noise, size=image.shape), 0, 255).round().astype(np.uint8))
    return images


def board_picture(board: Board) -> NDArray[np.float32]:
    """A board as it is printed, with its white margin; its first inner corner is MARGIN + 1 squares from the edge."""
    columns, rows = (one + 1 for one in board.grid)
    if board.dictionary is not None:
        printed = charuco_board(board).generateImage((columns * PER_SQUARE, rows * PER_SQUARE)) / 255.0
    else:
        v, u = np.mgrid[0:rows, 0:columns]
        printed = np.kron((u + v) % 2, np.ones((PER_SQUARE, PER_SQUARE)))
    printed = np.pad(printed, MARGIN * PER_SQUARE, constant_values=1.0)
    return np.asarray(INK + (PAPER - INK) * printed, np.float32)


def _outline(board: Board) -> Array:
    """The corners of the outermost squares (4, 3) [m]."""
    low, high = board.points.min(axis=0) - board.square, board.points.max(axis=0) + board.square
    return np.array([(x, y, 0.0) for x in (low[0], high[0]) for y in (low[1], high[1])])


def _uneven(rng: np.random.Generator, sigmas: Array) -> Array:
    z, tilt, roll = rng.normal(size=3) * sigmas
    return se3(rotation_y(tilt) @ rotation_x(roll), [0.0, 0.0, z])
