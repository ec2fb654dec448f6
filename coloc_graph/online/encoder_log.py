"""Encoder counts that a robot's program leaves for the next one, which continues its odometry; `EncoderLog`.

The encoders go on counting while no program runs, and tell how far the robot has driven meanwhile.
"""

import contextlib
import math
import os
from pathlib import Path

import msgspec

from coloc_graph.geometry.se2 import Planar
from coloc_graph.machine import machine
from coloc_graph.robot_io.create.odometry import WHEELS, arc, ticks_between

FURTHEST = 5.0  # a longer distance means that the robot was carried, or its counters were reset [m]
SHARE = 0.1  # sigma of a motion of which only the end is known, as a share of its length
MIN_SIGMA = 0.01  # its least value [m]
SIZE = 512  # size of the file, which is overwritten as one block [bytes]
MIN_YAW_SIGMA = 0.02  # its least value of the heading [rad]


class Counted(msgspec.Struct, frozen=True):
    """Encoder counts (left, right) and the pose in an odometry `frame` at which they were so."""

    frame: str
    ticks: tuple[int, int]
    pose: Planar


class EncoderLog:
    """The file of one robot."""

    def __init__(self, path: Path) -> None:
        self._path, self._file = path, -1

    def read(self) -> Counted | None:
        """Return the counts written last; None if there are none, or they are not valid."""
        try:
            counted = msgspec.json.decode(self._path.read_bytes(), type=Counted)
        except (OSError, msgspec.MsgspecError):
            return None
        return counted if all(map(math.isfinite, counted.pose)) else None

    def write(self, counted: Counted) -> None:
        """Write counts in one call, which a kill does not divide; a disk that refuses does not stop a robot."""
        with contextlib.suppress(OSError):
            machine.use_disk()
            if self._file < 0:
                self._file = machine.opened(os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o666))
            os.pwrite(self._file, msgspec.json.encode(counted).ljust(SIZE), 0)

    def close(self) -> None:
        """Close the file."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def way_since(counted: Counted, ticks: tuple[int, int]) -> tuple[Planar, tuple[float, float, float]] | None:
    """Return the motion of a Create 2 since, as one arc, and its sigmas [m], [m], [rad]; None if it is not possible."""
    wheels = WHEELS[2]
    left, right = (ticks_between(b, a) * wheels.metres for b, a in zip(counted.ticks, ticks, strict=True))
    if max(abs(left), abs(right)) > FURTHEST:
        return None
    rolled = abs(left) + abs(right)
    place = MIN_SIGMA + SHARE * rolled
    return arc(left, right, wheels.base), (place, place, MIN_YAW_SIGMA + SHARE * rolled / wheels.base)
