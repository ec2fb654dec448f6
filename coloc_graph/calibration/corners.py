"""Detect the corners of a board in images, with sub-pixel accuracy."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.calibration.board import Board, charuco_board
from coloc_graph.calibration.led_grid import ordered_grid
from coloc_graph.errors import InputError
from coloc_graph.image_file import image_paths as image_paths
from coloc_graph.image_file import range_of, read_image, to_8_bits, to_grey

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# a larger window would see the neighbour's edges: 11 px on squares of 13 px give 0.58 px RMS instead of 0.16 px
WINDOW = 0.45  # half side of the refinement window, as a share of the distance to the next corner
MAX_WINDOW = 12  # px, upper bound of that half side
SMOOTHING = 0.7  # px, sigma of the blur against JPEG blocks and sensor noise
MIN_CORNERS = 8  # of a ChArUco board, to determine its pose


@dataclass(frozen=True, eq=False)
class View:
    """Board in one image: corners on the board (n, 3) [m], and in the image (n, 2) [px]."""

    name: str
    points: Array
    uv: Array


@dataclass(frozen=True, eq=False)
class Views:
    """Boards in images of one size, and names of the images without one."""

    width: int
    height: int
    views: tuple[View, ...]
    missed: tuple[str, ...] = ()

    @property
    def images(self) -> int:
        """Number of images that were searched."""
        return len(self.views) + len(self.missed)


def find_boards(
    paths: Sequence[Path],
    board: Board,
    progress: Callable[[int, int], None] | None = None,
    lights: Callable[[Image], Array] | None = None,
) -> tuple[Views, Board]:
    """Find a board in images.

    Parameters
    ----------
    paths
        Image files.
    board
        The board.
    progress
        Called with (done, total).
    lights
        Detector of the centres (n, 2) [px] of all LEDs in a grey image, for a plane of LEDs.

    Returns
    -------
    tuple
        The views, and the board with `legacy` as the images show it.

    Raises
    ------
    InputError
        An image cannot be read, sizes differ, or no image shows the board.
    """
    values = range_of(paths, read_image(paths[0]))
    images = [(path, to_grey(to_8_bits(read_image(path), values))) for path in paths]
    height, width = images[0][1].shape
    for path, image in images:
        if image.shape != (height, width):
            raise InputError(
                f"{path} has {image.shape[1]}x{image.shape[0]} pixels and {paths[0]} {width}x{height}: "
                "give images of one camera, which all have one size"
            )
    for candidate in (board, replace(board, legacy=True)) if board.dictionary else (board,):
        views, missed = [], []
        for done, (path, image) in enumerate(images, start=1):
            view = find_board(image, candidate, str(path), lights)
            if view is None:
                missed.append(str(path))
            else:
                views.append(view)
            if progress is not None:
                progress(done, len(images))
        if views:
            return Views(width, height, tuple(views), tuple(missed)), candidate
    raise InputError(
        f"{board} is in none of {len(images)} images ({paths[0]}{', ...' if len(images) > 1 else ''}): "
        + _remedy([image for _, image in images[:3]], board)
    )


def find_board(
    image: Image, board: Board, name: str = "", lights: Callable[[Image], Array] | None = None
) -> View | None:
    """Find the board in one grey image; None if it is not seen."""
    if board.leds:
        assert lights is not None
        ordered = ordered_grid(lights(image), board.columns, board.rows)
        return None if ordered is None else View(name, board.points, ordered)
    if board.dictionary is None:
        size = board.grid
        found, seen = cv2.findChessboardCorners(
            image, size, flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        )
        if not found:
            found, seen = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if not found:
            return None
        uv, index = np.asarray(seen, np.float32).reshape(-1, 2), np.arange(size[0] * size[1], dtype=np.int64)
    else:
        # OpenCV's types have no "none found", which is what comes where none are
        seen, ids, *_ = cv2.aruco.CharucoDetector(charuco_board(board)).detectBoard(image)
        if ids is None or len(ids) < MIN_CORNERS:
            return None
        uv, index = np.asarray(seen, np.float32).reshape(-1, 2), np.asarray(ids, np.int64).ravel()
        if np.linalg.matrix_rank(board.points[index, :2] - board.points[index[0], :2], tol=1e-9) < 2:
            return None
    points = board.points[index]
    # the window must not reach the edges of markers, which would bias a ChArUco board's corners
    free = WINDOW if board.marker is None else min(WINDOW, 0.45 * (1 - board.marker / board.square))
    return View(name, points, _refined(image, points, uv, board.square, free))


def neighbours(points: Array, square: float) -> NDArray[np.int64]:
    """Pairs (m, 2) of corners (n, 3) that are one square apart."""
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    return np.argwhere(np.triu(np.abs(apart - square) < 0.01 * square))


def _refined(image: Image, points: Array, uv: NDArray[np.float32], square: float, free: float) -> Array:
    pairs = neighbours(points, square)
    spacing = float(np.linalg.norm(uv[pairs[:, 0]] - uv[pairs[:, 1]], axis=1).min()) if len(pairs) else 10.0
    half = int(np.clip(round(free * spacing), 2, MAX_WINDOW))
    until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    smooth = cv2.GaussianBlur(image, (0, 0), SMOOTHING)
    return np.asarray(cv2.cornerSubPix(smooth, uv[:, None].copy(), (half, half), (-1, -1), until), float).reshape(-1, 2)


def _remedy(images: Sequence[Image], board: Board) -> str:
    """Return a remedy for a board that is not found: another size that is seen, or general advice."""
    if board.leds:
        return "count the LEDs in a row and in a column, show all of them, and no other light"
    for other in _others(board):
        if any(find_board(image, other) is not None for image in images):
            counted = "inner corners, not squares" if board.dictionary is None else "squares, columns first"
            return f"{other} is seen, and --board counts {counted}: give --board {other.columns}x{other.rows}"
    if board.dictionary is not None:
        detector = cv2.aruco.ArucoDetector(charuco_board(board).getDictionary())
        found: list[Any] = [ids.ravel() for image in images if (ids := detector.detectMarkers(image)[1]) is not None]
        if found:
            return (
                f"markers of its dictionary are seen, up to id {max(map(max, found))}, but not in this layout; "
                "check --board (squares, columns first) and --charuco"
            )
        return "check --charuco, and show the board nearer, sharp, in even light, with its white margin"
    return "count the inner corners, and show the whole board, sharp, in even light, with its white margin"


def _others(board: Board) -> Iterator[Board]:
    if board.dictionary is not None:
        yield replace(board, columns=board.rows, rows=board.columns)
        return
    for columns, rows in ((-1, -1), (1, 1), (-1, 0), (0, -1), (1, 0), (0, 1)):
        if min(board.columns + columns, board.rows + rows) >= 3:
            yield replace(board, columns=board.columns + columns, rows=board.rows + rows)
