"""Rows of trajectory files of several formats, told apart by their header and number of columns.

Read are TUM (with a header, commas or times in nanoseconds, too), EuRoC's CSV and KITTI's poses after a time each.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.geometry.lie import quaternion

Array = NDArray[np.float64]

TUM_COLUMNS = 8  # time, x, y, z, qx, qy, qz, qw
KITTI_COLUMNS = 12  # a row-major (3, 4) pose, without a time
EUROC_COLUMNS = 17  # time, position, quaternion with w first, velocity, biases
MAX_SECONDS = 1e11  # s: larger times are not in seconds
MIN_NANOSECONDS = 1e17  # times of this decade in nanoseconds are larger, in microseconds smaller
MAX_SKEW = 1e-3  # largest element of R R' - I of a rotation that was rounded


def pose_rows(path: Path, lines: Sequence[str]) -> Iterator[tuple[int, list[float]]]:
    """Yield the number of each line with a pose, and its time [s], x, y, z [m], qx, qy, qz, qw.

    Raises
    ------
    InputError
        A line is no pose, or the format is ambiguous; it names the line and the format.
    """
    header: list[str] = []
    columns = 0
    for number, line in enumerate(lines, start=1):
        words = line.lstrip("#").replace(",", " ").split() if "," in line else line.split()
        if not words or line.startswith("#") or (not columns and not header and not _is_number(words[0])):
            if not columns and any("q" in word.lower() for word in words):
                header = [word.lower() for word in words if not word.startswith("[")]
            elif words and not line.startswith("#"):
                raise InputError(
                    f"{path}, line {number}: {TUM_COLUMNS} finite numbers are expected; write the file anew"
                )
            continue
        if not columns:
            columns = len(words)
            w_first = _is_w_first(path, number, header, columns, words[0], "," in line)
        try:
            values = [float(word) for word in words]
        except ValueError:
            values = []
        if len(values) != columns or not np.isfinite(values).all():
            raise InputError(f"{path}, line {number}: {columns} finite numbers are expected; write the file anew")
        time = _seconds(path, number, words[0], values[0])
        if columns == KITTI_COLUMNS + 1:
            yield number, [time, *_of_matrix(path, number, values[1:])]
        elif w_first:
            w, x, y, z = values[4:8]
            yield number, [time, *values[1:4], x, y, z, w]
        else:
            yield number, [time, *values[1:8]]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _is_w_first(path: Path, line: int, header: list[str], columns: int, time: str, commas: bool) -> bool:
    """Return whether quaternions begin with w; raise `InputError` where the format is not read or ambiguous."""
    if columns == KITTI_COLUMNS:
        raise InputError(
            f"{path}, line {line}: is KITTI's format ({KITTI_COLUMNS} numbers a line), which has no times: put the "
            "time [s] before each line"
        )
    if columns == KITTI_COLUMNS + 1:
        return False
    if columns not in (TUM_COLUMNS, EUROC_COLUMNS):
        raise InputError(f"{path}, line {line}: {TUM_COLUMNS} finite numbers are expected; write the file anew")
    if columns == EUROC_COLUMNS:
        return True
    rotations = [name for name in header if name.startswith("q")]
    if len(rotations) == 4:
        return "w" in rotations[0]
    if commas and float(time) >= MIN_NANOSECONDS:
        raise InputError(
            f"{path}, line {line}: may be EuRoC's CSV (qw first) or TUM with commas (qw last): give a header line, as "
            "timestamp,tx,ty,tz,qx,qy,qz,qw"
        )
    return False


def _seconds(path: Path, line: int, word: str, value: float) -> float:
    if abs(value) < MAX_SECONDS:
        return value
    if value >= MIN_NANOSECONDS:
        return int(word) / 1e9 if word.isdigit() else value / 1e9
    raise InputError(f"{path}, line {line}: the time {word} is neither in seconds nor in nanoseconds: write seconds")


def _of_matrix(path: Path, line: int, values: list[float]) -> list[float]:
    """Return x, y, z, qx, qy, qz, qw of a row-major (3, 4) pose."""
    T = np.reshape(values, (3, 4))
    R = T[:, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > MAX_SKEW or np.linalg.det(R) < 0:
        raise InputError(f"{path}, line {line}: the first three columns of the pose (3, 4) are not a rotation matrix")
    w, x, y, z = quaternion(R)
    return [*T[:, 3].tolist(), x, y, z, w]
