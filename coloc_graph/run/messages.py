"""Records of a run: one frozen dataclass a message.

Times are UTC seconds (float64) by the clock of the robot that wrote the message. Pixels: (0, 0) is the centre
of the top-left pixel.
"""

from dataclasses import dataclass, field
from enum import IntFlag
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Flag(IntFlag):
    """Reasons to doubt a detection."""

    NONE = 0
    SATURATED = 1  # the blob's core is at the sensor's limit
    CLIPPED = 2  # the blob touches the border of the image
    MERGED = 4  # the blob is too large or too long to be one marker
    BLURRED = 8  # the blob is drawn out by motion


@dataclass(frozen=True, eq=False)
class Detections:
    """The marker centres in one image: `uv` (n, 2) [px], `covariance` (n, 2, 2) [px^2], n may be 0.

    `markers` names each one where its identity is known ("C/0": robot C's first marker), or is "".
    `flags` (n,) are `Flag`s, `peak` (n,) grey levels above the background, `area` (n,) [px].
    """

    robot: str
    time: float
    uv: Array
    covariance: Array
    markers: tuple[str, ...]
    flags: NDArray[np.uint8]
    peak: Array
    area: Array


@dataclass(frozen=True, eq=False)
class Image:
    """One image of a robot's camera: `pixels` (height, width) grey or (height, width, 3) BGR, uint8."""

    robot: str
    time: float
    pixels: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class EncodedImage:
    """An image as another camera's file, `data` a whole `format` (jpeg or png), to be written as it is.

    It is read back as an `Image`.
    """

    robot: str
    time: float
    format: Literal["jpeg", "png"]
    data: bytes


@dataclass(frozen=True, eq=False)
class OdometrySample:
    """Sample of wheel odometry: `pose` (x [m], y [m], yaw [rad]) in the robot's own odometry frame.

    `covariance` (3, 3) is that of the increment since the previous sample, in the previous sample's body.
    """

    robot: str
    time: float
    pose: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class Ranges:
    """Ranges (n,) [m] and bearings (n,) [rad, left of ahead is positive] of `targets`, measured by one robot.

    Targets are robots and landmarks of the team.
    """

    robot: str
    time: float
    targets: tuple[str, ...]
    range: Array
    bearing: Array


@dataclass(frozen=True)
class Motion:
    """A robot begins or ends a movement."""

    robot: str
    time: float
    moving: bool


@dataclass(frozen=True)
class Stance:
    """A stretch of time in which `observers` stand still and watch `movers`.

    `anchors` have stayed put since the previous stance (none at the first).
    """

    index: int
    start: float
    end: float
    observers: tuple[str, ...]
    movers: tuple[str, ...] = ()
    anchors: tuple[str, ...] = ()


@dataclass(frozen=True)
class Planes:
    """The marker plane of one stance as stated, where it is not the mounts': per robot unit normal and distance.

    `planes` maps an observer to (nx, ny, nz, d): N . X = d in that robot's camera frame, d > 0 [m]. `sigmas` maps it to
    the standard deviations of the normal [rad] and of d [m], where the plane is not exact.
    """

    stance: int
    time: float
    planes: dict[str, tuple[float, float, float, float]] = field(default_factory=dict)
    sigmas: dict[str, tuple[float, float]] = field(default_factory=dict)
