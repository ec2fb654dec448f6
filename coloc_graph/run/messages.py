"""Records of a run: one frozen dataclass per message.

Times are UTC seconds (float64) by the clock of the robot that wrote the message. Pixels: (0, 0) is the centre of the
top-left pixel.
"""

from dataclasses import dataclass, field
from enum import IntFlag
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Flag(IntFlag):
    """Reasons for which a detection may be bad."""

    NONE = 0
    SATURATED = 1  # the blob's core is at the sensor's limit
    CLIPPED = 2  # the blob touches the border of the image
    MERGED = 4  # the blob is too large or too long for one marker
    BLURRED = 8  # the blob is elongated by motion


@dataclass(frozen=True, eq=False)
class Detections:
    """Marker centres in one image; n may be 0.

    Parameters
    ----------
    robot : str
        Robot whose camera took the image.
    time : float
        Time of the image [UTC s].
    uv : (n, 2) float
        Centres [px].
    covariance : (n, 2, 2) float
        Their covariances [px^2].
    markers : tuple of str
        Name of each marker ("C/0": robot C's first one); "" where it is not known.
    flags : (n,) uint8
        Sums of `Flag`s.
    peak : (n,) float
        Brightness above the background [grey levels].
    area : (n,) float
        Area of each blob [px].
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
    """One image of a robot's camera.

    Parameters
    ----------
    robot : str
        The robot.
    time : float
        Time [UTC s].
    pixels : (height, width) or (height, width, 3) uint8
        Grey, or BGR.
    """

    robot: str
    time: float
    pixels: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class EncodedImage:
    """An image as a camera's file, written as it is, and read back as an `Image`.

    Parameters
    ----------
    robot : str
        The robot.
    time : float
        Time [UTC s].
    format : {"jpeg", "png"}
        Format of the file.
    data : bytes
        Content of the file.
    """

    robot: str
    time: float
    format: Literal["jpeg", "png"]
    data: bytes


@dataclass(frozen=True, eq=False)
class OdometrySample:
    """Sample of wheel odometry.

    Parameters
    ----------
    robot : str
        The robot.
    time : float
        Time [UTC s].
    pose : (3,) float
        x [m], y [m], yaw [rad] in the robot's own odometry frame.
    covariance : (3, 3) float
        Covariance of the increment since the previous sample, in the previous sample's body.
    """

    robot: str
    time: float
    pose: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class Ranges:
    """Ranges, and bearings if its sensor has them, measured by one robot at one time.

    Parameters
    ----------
    robot : str
        The observer.
    time : float
        Time [UTC s].
    targets : tuple of str
        Robots and landmarks of the team.
    range : (n,) float
        Ranges [m].
    bearing : (n,) float or None
        Bearings [rad], positive to the left; None of a sensor that measures none (UWB).
    """

    robot: str
    time: float
    targets: tuple[str, ...]
    range: Array
    bearing: Array | None = None


@dataclass(frozen=True)
class Motion:
    """Begin or end of a movement of a robot.

    Parameters
    ----------
    robot : str
        The robot.
    time : float
        Time [UTC s].
    moving : bool
        True where it begins to move, False where it stands again.
    """

    robot: str
    time: float
    moving: bool


@dataclass(frozen=True)
class Stance:
    """Interval in which observers stand still and watch movers.

    Parameters
    ----------
    index : int
        Number of the stance, from 0.
    start, end : float
        Interval [UTC s].
    observers : tuple of str
        Robots that stand and watch.
    movers : tuple of str
        Robots that move.
    anchors : tuple of str
        Robots that have stayed put since the previous stance; () at the first.
    """

    index: int
    start: float
    end: float
    observers: tuple[str, ...]
    movers: tuple[str, ...] = ()
    anchors: tuple[str, ...] = ()


@dataclass(frozen=True)
class Planes:
    """Stated marker planes of one stance, used instead of those by the mounts.

    Parameters
    ----------
    stance : int
        Index of the stance.
    time : float
        Time of the message [UTC s].
    planes : dict of str to (nx, ny, nz, d)
        By observer: N . X = d in its camera frame, d > 0 [m].
    sigmas : dict of str to (float, float)
        Standard deviations of the normal [rad] and of d [m], where the plane is not exact.
    """

    stance: int
    time: float
    planes: dict[str, tuple[float, float, float, float]] = field(default_factory=dict)
    sigmas: dict[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class RobotClock:
    """Error of a robot's clock as it was found when the run was made; the run's stamps are corrected by it.

    Parameters
    ----------
    robot : str
        The robot.
    offset : float
        Offset against the other robots' clocks; positive if ahead [s].
    drift : float
        Change of the offset in time [s/s].
    steps : tuple of (float, float)
        Steps within the recording: time [UTC s] and change [s].
    jitter : float
        Standard deviation of the stamps [s].
    known : str
        Measurements by which all of it is known.
    """

    robot: str
    offset: float
    drift: float
    steps: tuple[tuple[float, float], ...]
    jitter: float
    known: str


@dataclass(frozen=True)
class Clocks:
    """Clocks of a run's robots, at most one message a run.

    Parameters
    ----------
    time : float
        Any time [UTC s].
    clocks : tuple of RobotClock
        Clock of each robot of which something is known.
    """

    time: float
    clocks: tuple[RobotClock, ...]
