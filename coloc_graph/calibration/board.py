"""The board: a chessboard, or a ChArUco board of which a part is enough."""

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Board:
    """A flat board with corners on a grid, as OpenCV counts it; lengths in metres.

    A chessboard is counted in inner corners, a ChArUco board (with a `dictionary`, "4X4_50") in squares, and its
    `marker` is the side of a marker. `legacy` is the pattern of OpenCV before 4.6.
    """

    columns: int
    rows: int
    square: float
    dictionary: str | None = None
    marker: float | None = None
    legacy: bool = False

    @property
    def grid(self) -> tuple[int, int]:
        """Inner corners in a row, and rows of them."""
        return (self.columns, self.rows) if self.dictionary is None else (self.columns - 1, self.rows - 1)

    @property
    def points(self) -> Array:
        """The corners on the board (n, 3), row by row, z = 0 [m]."""
        columns, rows = self.grid
        y, x = np.mgrid[0:rows, 0:columns].reshape(2, -1)
        return np.stack([self.square * x, self.square * y, np.zeros(len(x))], axis=1)

    def __str__(self) -> str:
        size = f"{self.columns}x{self.rows}"
        if self.dictionary is None:
            return f"a chessboard of {size} inner corners"
        return f"a ChArUco board of {size} squares with markers of DICT_{self.dictionary}"


def make_board(size: str, square: float, dictionary: str | None = None, marker: float | None = None) -> Board:
    """The board of a size COLUMNSxROWS, with lengths in metres; `InputError` says what such a board cannot be."""
    found = re.fullmatch(r"(\d+)\s*[xX]\s*(\d+)", size.strip())
    if not found:
        raise InputError(f"--board {size} is not a size; give COLUMNSxROWS, such as 9x6")
    columns, rows = int(found[1]), int(found[2])
    if min(columns, rows) < 3 or max(columns, rows) > 100:
        raise InputError(f"--board {size}: a board has 3 to 100 in a row and in a column; give what is on the board")
    if not 1e-4 < square < 2.0:
        raise InputError(f"--square {square} is not the side of a square in metres; 24.23 mm is 0.02423")
    if dictionary is None:
        if marker is not None:
            raise InputError("--marker is for a ChArUco board; give its dictionary with --charuco, or leave it out")
        return Board(columns, rows, square)
    if marker is None or not 0 < marker < square:
        raise InputError(
            f"a ChArUco board needs --marker, the side of a marker in metres, less than that of a square ({square})"
        )
    dictionary = dictionary.upper().removeprefix("DICT_")
    _dictionary(dictionary)
    return Board(columns, rows, square, dictionary, marker)


def charuco_board(board: Board) -> Any:
    """OpenCV's own of a ChArUco board."""
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
        raise InputError(f"--charuco {name} is no dictionary of OpenCV; it has {', '.join(known)}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
