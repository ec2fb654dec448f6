"""Corners of a board in images, to a fraction of a pixel."""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.calibration.board import Board, charuco_board
from coloc_graph.errors import InputError
from coloc_graph.input_file import read_bytes
from coloc_graph.run.image_header import read_image_header, too_large

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

KINDS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")
#: A corner is sought in a window of this part of the way to its neighbour, at most so many pixels to each side: a
#: larger one sees the neighbour's edges (11 px on squares of 13 px: 0.58 px RMS instead of 0.16).
WINDOW = 0.45
LARGEST_WINDOW = 12
#: JPEG's blocks and the sensor's noise are smoothed by so many pixels first.
SMOOTHING = 0.7
#: Fewer corners of a ChArUco board than this say too little about its pose.
LEAST_CORNERS = 8


@dataclass(frozen=True, eq=False)
class View:
    """A board in one image: `points` (n, 3) on the board [m], seen at `uv` (n, 2) [px]."""

    name: str
    points: Array
    uv: Array


@dataclass(frozen=True, eq=False)
class Views:
    """The boards in images of one size, and the names of images in which there was none."""

    width: int
    height: int
    views: tuple[View, ...]
    missed: tuple[str, ...] = ()

    @property
    def images(self) -> int:
        """How many images were looked at."""
        return len(self.views) + len(self.missed)


def image_paths(given: Sequence[str | Path]) -> list[Path]:
    """Image files, and those in folders, by name with numbers as numbers; `InputError` where there are none."""
    paths: list[Path] = []
    for one in map(Path, given):
        if one.is_dir():
            inside = sorted((p for p in one.iterdir() if p.suffix.lower() in KINDS), key=_natural)
            if not inside:
                raise InputError(f"{one} holds no images ({' '.join(KINDS)}); give the folder of the images, or files")
            paths += inside
        elif not one.is_file():
            raise InputError(f"{one}: there is no such image; give image files, or a folder of them")
        else:
            paths.append(one)
    known: set[Path] = set()
    for path in paths:
        if path.resolve() in known:
            raise InputError(f"{path} is given twice, and would count twice; give each image once")
        known.add(path.resolve())
    return paths


def find_boards(
    paths: Sequence[Path], board: Board, progress: Callable[[int, int], None] | None = None
) -> tuple[Views, Board]:
    """The boards in images, and the board with what only its images tell (a ChArUco board's `legacy`).

    Raises `InputError` where an image cannot be read, where sizes differ, and where no image shows the board.
    """
    images = [(path, read_image(path)) for path in paths]
    height, width = images[0][1].shape
    for path, image in images:
        if image.shape != (height, width):
            raise InputError(
                f"{path} has {image.shape[1]}x{image.shape[0]} pixels and {paths[0]} {width}x{height}; "
                "one camera's images have one size: leave out those of others"
            )
    for candidate in (board, replace(board, legacy=True)) if board.dictionary else (board,):
        views, missed = [], []
        for done, (path, image) in enumerate(images, start=1):
            view = find_board(image, candidate, str(path))
            if view is None:
                missed.append(str(path))
            else:
                views.append(view)
            if progress is not None:
                progress(done, len(images))
        if views:
            return Views(width, height, tuple(views), tuple(missed)), candidate
    raise InputError(
        f"{board} is in none of {len(images)} images ({paths[0]}{', ...' if len(images) > 1 else ''}); "
        + _remedy([image for _, image in images[:3]], board)
    )


def find_board(image: Image, board: Board, name: str = "") -> View | None:
    """The board in one grey image, None where it is not seen."""
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
        if ids is None or len(ids) < LEAST_CORNERS:
            return None
        uv, index = np.asarray(seen, np.float32).reshape(-1, 2), np.asarray(ids, np.int64).ravel()
        if np.linalg.matrix_rank(board.points[index, :2] - board.points[index[0], :2], tol=1e-9) < 2:
            return None
    points = board.points[index]
    # the edges of markers, which begin at a margin from a ChArUco board's corners, would draw them just as well
    free = WINDOW if board.marker is None else min(WINDOW, 0.45 * (1 - board.marker / board.square))
    return View(name, points, _refined(image, points, uv, board.square, free))


def neighbours(points: Array, square: float) -> NDArray[np.int64]:
    """Pairs (m, 2) of corners (n, 3) that are one square apart."""
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    return np.argwhere(np.triu(np.abs(apart - square) < 0.01 * square))


def _refined(image: Image, points: Array, uv: NDArray[np.float32], square: float, free: float) -> Array:
    pairs = neighbours(points, square)
    spacing = float(np.linalg.norm(uv[pairs[:, 0]] - uv[pairs[:, 1]], axis=1).min()) if len(pairs) else 10.0
    half = int(np.clip(round(free * spacing), 2, LARGEST_WINDOW))
    until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    smooth = cv2.GaussianBlur(image, (0, 0), SMOOTHING)
    return np.asarray(cv2.cornerSubPix(smooth, uv[:, None].copy(), (half, half), (-1, -1), until), float).reshape(-1, 2)


def read_image(path: Path) -> Image:
    """The grey values of an image file; `InputError` where it is none."""
    # a camera's pixels are where its sensor has them, whatever a file says about how to hold it
    data = read_bytes(path, "leave it out, or give it anew")
    header = read_image_header(data)
    why = too_large(header, data) if header is not None else None
    if why is not None:
        raise InputError(f"{path}: {why}; leave it out, or make it smaller")
    try:
        flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except (cv2.error, MemoryError):
        image = None
    if image is None:
        raise InputError(f"{path}: cannot be read as an image; leave it out, or give it anew")
    return np.asarray(image, np.uint8)


def _remedy(images: Sequence[Image], board: Board) -> str:
    """What to try where a board is not found: another size that is seen, or the usual."""
    for other in _others(board):
        if any(find_board(image, other) is not None for image in images):
            counted = "inner corners, not squares" if board.dictionary is None else "squares, columns first"
            return f"{other} is: --board counts {counted}; give --board {other.columns}x{other.rows}"
    if board.dictionary is not None:
        detector = cv2.aruco.ArucoDetector(charuco_board(board).getDictionary())
        found: list[Any] = [ids.ravel() for image in images if (ids := detector.detectMarkers(image)[1]) is not None]
        if found:
            return (
                f"markers of its dictionary are seen, the largest id {max(map(max, found))}, in no such order; "
                "check --board (squares, columns first) and --charuco"
            )
        return "check --charuco, take the board nearer and sharper, in even light, with its white margin in view"
    return (
        "count the inner corners where four squares meet, and take the board whole, sharp and in even light, "
        "with its white margin in view"
    )


def _others(board: Board) -> Iterator[Board]:
    if board.dictionary is not None:
        yield replace(board, columns=board.rows, rows=board.columns)
        return
    for columns, rows in ((-1, -1), (1, 1), (-1, 0), (0, -1), (1, 0), (0, 1)):
        if min(board.columns + columns, board.rows + rows) >= 3:
            yield replace(board, columns=board.columns + columns, rows=board.rows + rows)


def _natural(path: Path) -> list[tuple[int, str]]:
    return [(int(word), "") if word.isdigit() else (-1, word) for word in re.split(r"(\d+)", path.name)]
