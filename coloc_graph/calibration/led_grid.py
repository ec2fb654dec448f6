"""Put the lights of a plane of LEDs in the order of their grid, in an image of any lens."""

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_OFF = 0.45  # of the spacing, between a light and its place on the grid


def ordered_grid(uv: Array, columns: int, rows: int) -> Array | None:
    """Order lights as a grid, row by row.

    The lights nearest to the corners of the smallest rectangle around all of them are the grid's corners; a homography
    of these gives each light its place. Of the orders that are not mirrored, the one whose rows run to the right is
    taken: a grid that is turned by half a turn looks the same.

    Parameters
    ----------
    uv
        Lights in the image, (n, 2) [px].
    columns, rows
        Numbers of LEDs in a row and in a column.

    Returns
    -------
    ndarray of float or None
        The same lights in order; None if they are no such grid.
    """
    if len(uv) != columns * rows:
        return None
    points = uv.astype(np.float32)
    hull = np.asarray(cv2.convexHull(points)).reshape(-1, 2)
    around = cv2.boxPoints(cv2.minAreaRect(points))
    corners = np.array([hull[np.argmin(np.linalg.norm(hull - one, axis=1))] for one in around])
    if len(np.unique(corners, axis=0)) < 4:
        return None
    if cv2.contourArea(corners, oriented=True) < 0:
        corners = corners[::-1]
    target = np.array([[0, 0], [columns - 1, 0], [columns - 1, rows - 1], [0, rows - 1]], np.float32)
    best: tuple[float, Array] | None = None
    for turn in range(4):
        H = cv2.getPerspectiveTransform(np.roll(corners, turn, axis=0), target)
        at = cv2.perspectiveTransform(points[:, None], H)[:, 0]
        place = np.rint(at).astype(int)
        if not np.array_equal(np.unique(place, axis=0), _places(columns, rows)) or np.abs(at - place).max() > MAX_OFF:
            continue
        order = np.lexsort((place[:, 0], place[:, 1]))
        ahead = uv[order][columns - 1] - uv[order][0]
        leftward = float(-ahead[0] / np.linalg.norm(ahead))
        if best is None or leftward < best[0]:
            best = leftward, uv[order]
    return None if best is None else best[1]


def _places(columns: int, rows: int) -> NDArray[np.int64]:
    return np.stack(np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij"), axis=-1).reshape(-1, 2)
