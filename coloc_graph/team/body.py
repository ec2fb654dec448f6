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

    `height` is that of the optical centre above the floor, `x` and `y` its place on the body [m]. `tilt_deg`
    looks down where it is positive; the order is yaw, tilt, roll about the body's z, y, x.
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

    def __post_init__(self) -> None:
        require_finite(self)
        require_not_negative(self, ("height", "height_sigma", "tilt_sigma_deg", "roll_sigma_deg"))

    @property
    def R_body_camera(self) -> Array:
        """Rotation of the optical camera frame in the body, (3, 3)."""
        return camera_rotation(*np.deg2rad([self.yaw_deg, self.tilt_deg, self.roll_deg]))

    @property
    def T_body_camera(self) -> Array:
        """Pose of the optical camera frame in the body, (4, 4), metres."""
        return se3(self.R_body_camera, (self.x, self.y, self.height))

    def off_by(self, errors: Array) -> Array:
        """`T_body_camera` (m, 4, 4) with errors (m, 3) of height [m], tilt and roll [rad]."""
        yaw, tilt, roll = np.deg2rad([self.yaw_deg, self.tilt_deg, self.roll_deg])
        T = se3(camera_rotation(yaw, tilt + errors[:, 1], roll + errors[:, 2]), (self.x, self.y, self.height))
        T[:, 2, 3] += errors[:, 0]
        return T


class Markers(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The markers on a body, all at one height: `positions` are (x, y) on the body [m].

    White LEDs are found by brightness; a marker with `hue_deg` (0 to 360, HSV) by its colour. `span_sigma` is
    how well the distance between the markers is known.
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


#: A looser stay-put constraint than this does what it says in GTSAM; a tighter one fails here or there [m].
LEAST_SLIP = 1e-3


class Slip(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Slip of an anchor from one stance to the next, one standard deviation: `sigma` [m] and `sigma_deg`."""

    sigma: float
    sigma_deg: float

    def __post_init__(self) -> None:
        require_finite(self)
        if self.sigma < LEAST_SLIP or self.sigma_deg <= 0:
            raise ValueError(
                f"a slip of {self.sigma} m and {self.sigma_deg} deg is too tight to be solved; give at least "
                f"{LEAST_SLIP} m and an angle above 0, or leave `slip` out: then the robot stays put exactly"
            )


class Devices(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Devices that a robot's own program opens, and the pose at which the robot begins.

    `camera` is a source of images ("v4l2:/dev/video0"), `wheels` the serial port of its Create, of `model` 1 or 2
    (found out where it is not said). `start` is x, y [m] and yaw [deg] at the beginning, on a floor whose x axis is
    the way ahead; without one, where the formation has it.
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
