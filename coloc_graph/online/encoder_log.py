"""What a robot's program writes down of its wheels, so that the next one goes on counting.

A program that is killed stops nobody: a Create drives on until somebody opens its line. Its encoders count by
themselves, and tell how far.
"""

import contextlib
import math
from pathlib import Path

import msgspec

from coloc_graph.geometry.se2 import Planar
from coloc_graph.robot_io.create.odometry import WHEELS, arc, ticks_between
from coloc_graph.run.atomic_file import write_whole

#: Nobody counted for less than such a way [m]: more is a robot that was carried, or began to count anew.
FURTHEST = 5.0
#: Where the robot is after a way that only its ends were counted of: a share of the way, and no less [m], [rad].
SHARE = 0.1
LEAST = 0.01
LEAST_TURN = 0.02


class Counted(msgspec.Struct, frozen=True):
    """Encoder counts (left, right) and the pose in an odometry `frame` at which they were so."""

    frame: str
    ticks: tuple[int, int]
    pose: Planar


class Ledger:
    """The file of one robot."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def read(self) -> Counted | None:
        """What was written last; None where there is nothing, or nothing whole."""
        try:
            counted = msgspec.json.decode(self._path.read_bytes(), type=Counted)
        except (OSError, msgspec.MsgspecError):
            return None
        return counted if all(map(math.isfinite, counted.pose)) else None

    def write(self, counted: Counted) -> None:
        """Write it, whole or not at all; a disk that refuses does not stop a robot."""
        with contextlib.suppress(OSError):
            write_whole(self._path, msgspec.json.encode(counted))


def way_since(counted: Counted, ticks: tuple[int, int]) -> tuple[Planar, tuple[float, float, float]] | None:
    """The way of a Create 2 since, as one arc, and sigmas of its end [m], [m], [rad]; None for one that cannot be."""
    wheels = WHEELS[2]
    left, right = (ticks_between(b, a) * wheels.metres for b, a in zip(counted.ticks, ticks, strict=True))
    if max(abs(left), abs(right)) > FURTHEST:
        return None
    rolled = abs(left) + abs(right)
    place = LEAST + SHARE * rolled
    return arc(left, right, wheels.base), (place, place, LEAST_TURN + SHARE * rolled / wheels.base)
