"""Calibration boards: chessboards and planes of LEDs, seen whole, and ChArUco boards, of which a part suffices."""

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Board:
    """Flat board with corners on a grid, counted as OpenCV does.

    Attributes
    ----------
    columns, rows
        Inner corners of a chessboard, squares of a ChArUco board, LEDs.
    square
        Side of a square, or distance between two LEDs [m].
    dictionary
        ArUco dictionary of a ChArUco board, such as "4X4_50"; None for a chessboard.
    marker
        Side of a marker of a ChArUco board [m].
    legacy
        True for the ChArUco pattern of OpenCV before 4.6.
    leds
        True for a plane of LEDs.
    """

    columns: int
    rows: int
    square: float
    dictionary: str | None = None
    marker: float | None = None
    legacy: bool = False
    leds: bool = False

    @property
    def grid(self) -> tuple[int, int]:
        """Numbers of inner corners in a row and in a column."""
        return (self.columns, self.rows) if self.dictionary is None else (self.columns - 1, self.rows - 1)

    @property
    def points(self) -> Array:
        """Inner corners on the board, row by row, z = 0, (n, 3) [m]."""
        columns, rows = self.grid
        y, x = np.mgrid[0:rows, 0:columns].reshape(2, -1)
        return np.stack([self.square * x, self.square * y, np.zeros(len(x))], axis=1)

    def __str__(self) -> str:
        size = f"{self.columns}x{self.rows}"
        if self.leds:
            return f"a plane of {size} LEDs"
        if self.dictionary is None:
            return f"a chessboard of {size} inner corners"
        return f"a ChArUco board of {size} squares with markers of DICT_{self.dictionary}"


def make_board(
    size: str, square: float, dictionary: str | None = None, marker: float | None = None, *, leds: bool = False
) -> Board:
    """Make a board from its size.

    Parameters
    ----------
    size
        COLUMNSxROWS, such as "9x6".
    square
        Side of a square [m].
    dictionary, marker
        ArUco dictionary and side of a marker [m] of a ChArUco board.
    leds
        True for a plane of LEDs.

    Raises
    ------
    InputError
        There is no such board.
    """
    found = re.fullmatch(r"(\d+)\s*[xX]\s*(\d+)", size.strip())
    if not found:
        raise InputError(f"--board {size} is not a size: give COLUMNSxROWS, such as 9x6")
    columns, rows = int(found[1]), int(found[2])
    if min(columns, rows) < 3 or max(columns, rows) > 100:
        raise InputError(f"--board {size}: a board has 3 to 100 corners or squares in a row and in a column")
    if not 1e-4 < square < 2.0:
        raise InputError(f"--square {square} is not the side of a square in metres: 24.23 mm is 0.02423")
    if dictionary is None:
        if marker is not None:
            raise InputError("--marker applies to a ChArUco board: give its dictionary with --charuco, or omit it")
        return Board(columns, rows, square, leds=leds)
    if leds:
        raise InputError("--leds is a plane of LEDs, and --charuco another board: give one of them")
    if marker is None or not 0 < marker < square:
        raise InputError(
            f"a ChArUco board needs --marker, the side of a marker in metres, shorter than that of a square ({square})"
        )
    dictionary = dictionary.upper().removeprefix("DICT_")
    _dictionary(dictionary)
    return Board(columns, rows, square, dictionary, marker)


def charuco_board(board: Board) -> Any:
    """Return OpenCV's object for a ChArUco board."""
    import cv2

    assert board.dictionary is not None and board.marker is not None
    made = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.square, board.marker, _dictionary(board.dictionary)
    )
    made.setLegacyPattern(board.legacy)
    return made


def _dictionary(name: str) -> Any:
    import cv2

    known = sorted(one.removeprefix("DICT_") for one in dir(cv2.aruco) if one.startswith("DICT_"))
    if name not in known:
        raise InputError(f"--charuco {name} is not a dictionary of OpenCV, which has {', '.join(known)}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
