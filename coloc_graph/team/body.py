"""Parts of a robot: `Mount` and `Markers` on its body, `Slip` as an anchor, `Devices` of its program."""

import math

import msgspec
import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.lie import se3
from coloc_graph.geometry.mounting import camera_rotation
from coloc_graph.team.checks import require_finite, require_not_negative

Array = NDArray[np.float64]


class Mount(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Extrinsics of the camera, `T_body_camera`, with tolerances.

    Parameters
    ----------
    height : float
        Height of the optical centre above the floor [m].
    tilt_deg, roll_deg, yaw_deg : float
        Angles in the order yaw, tilt, roll about the body's z, y, x; a positive tilt looks down.
    x, y : float
        Position of the optical centre on the body [m].
    height_sigma, tilt_sigma_deg, roll_sigma_deg : float
        Tolerances; 0 is exact.
    yaw_sigma_deg, position_sigma : float
        Tolerances of the yaw, and of x and y [m]; 0 is exact. Only wheel odometry makes them observable.
    """

    height: float
    tilt_deg: float = 0.0
    roll_deg: float = 0.0
    yaw_deg: float = 0.0
    x: float = 0.0
    y: float = 0.0
    height_sigma: float = 0.0
    tilt_sigma_deg: float = 0.0
    roll_sigma_deg: float = 0.0
    yaw_sigma_deg: float = 0.0
    position_sigma: float = 0.0

    def __post_init__(self) -> None:
        require_finite(self)
        require_not_negative(self, ("height", "height_sigma", "tilt_sigma_deg", "roll_sigma_deg"))
        require_not_negative(self, ("yaw_sigma_deg", "position_sigma"))

    @property
    def R_body_camera(self) -> Array:
        """Rotation of the optical camera frame in the body, (3, 3)."""
        return camera_rotation(*np.deg2rad([self.yaw_deg, self.tilt_deg, self.roll_deg]))

    @property
    def T_body_camera(self) -> Array:
        """Pose of the optical camera frame in the body, (4, 4), metres."""
        return se3(self.R_body_camera, (self.x, self.y, self.height))

    def off_by(self, errors: Array) -> Array:
        """Return `T_body_camera` (m, 4, 4) with errors (m, 3) of height [m], tilt and roll [rad]."""
        yaw, tilt, roll = np.deg2rad([self.yaw_deg, self.tilt_deg, self.roll_deg])
        T = se3(camera_rotation(yaw, tilt + errors[:, 1], roll + errors[:, 2]), (self.x, self.y, self.height))
        T[:, 2, 3] += errors[:, 0]
        return T


class Markers(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Markers on a body, all at one height.

    Parameters
    ----------
    height : float
        Height above the floor [m].
    positions : tuple of (float, float)
        x, y on the body [m].
    hue_deg : float or None
        Colour (HSV, 0 to 360) by which they are detected; None: white, detected by brightness.
    span_sigma : float
        Tolerance of the distance between the markers [m].
    height_sigma : float
        Tolerance of the height [m].
    """

    height: float
    positions: tuple[tuple[float, float], ...]
    hue_deg: float | None = None
    span_sigma: float = 0.0
    height_sigma: float = 0.0

    def __post_init__(self) -> None:
        require_finite(self)
        require_not_negative(self, ("height", "span_sigma", "height_sigma"))
        if not self.positions:
            raise ValueError("`positions` is empty; give the x and y of at least one marker")
        if not all(math.isfinite(value) for position in self.positions for value in position):
            raise ValueError("`positions` holds a number that is not finite")
        if self.hue_deg is not None and not 0 <= self.hue_deg < 360:
            raise ValueError(f"`hue_deg` is {self.hue_deg}; give degrees from 0 to 360")

    @property
    def p_body(self) -> Array:
        """Marker positions in the body frame, (n, 3) [m]."""
        return np.array([(*position, self.height) for position in self.positions])

    @property
    def span(self) -> float | None:
        """Distance between the first two markers [m]; None where there is one marker."""
        if len(self.positions) < 2:
            return None
        return math.dist(self.positions[0], self.positions[1])


MIN_SLIP = 1e-3  # m: tighter stay-put constraints fail in some graphs of GTSAM


class Slip(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Slip of an anchor from one stance to the next.

    Parameters
    ----------
    sigma : float
        Standard deviation of its position [m].
    sigma_deg : float
        Standard deviation of its rotation [deg].
    """

    sigma: float
    sigma_deg: float

    def __post_init__(self) -> None:
        require_finite(self)
        if self.sigma < MIN_SLIP or self.sigma_deg <= 0:
            raise ValueError(
                f"a slip of {self.sigma} m and {self.sigma_deg} deg is too tight to be solved; give at least "
                f"{MIN_SLIP} m and an angle above 0, or leave `slip` out: then the robot stays put exactly"
            )


class Devices(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Devices that a robot's own program opens, and the robot's initial pose.

    Parameters
    ----------
    camera : str or None
        Source of images ("v4l2:/dev/video0").
    wheels : str or None
        Serial port of its iRobot Create.
    model : {1, 2} or None
        Model of the Create; None: detected.
    start : (float, float, float) or None
        Initial x, y [m] and yaw [deg] on a floor whose x axis is the team's direction; None: that of the formation.
    """

    camera: str | None = None
    wheels: str | None = None
    model: int | None = None
    start: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        if self.model not in (None, 1, 2):
            raise ValueError(f"there is no Create {self.model}; `model` is 1 or 2, or is left out")
        if self.start is not None and not all(map(math.isfinite, self.start)):
            raise ValueError("`start` holds a number that is not finite")
