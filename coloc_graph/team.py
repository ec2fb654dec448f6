"""Who the robots are: `Camera`, `Mount`, `Markers`, `Slip`, `Devices`, `Robot`,
`Floor`, `Team`, and the file team.toml.

Fields carry the unit a person writes (`tilt_deg`); metres where a name says nothing. Tolerances (`*_sigma*`)
are one standard deviation: what a simulated truth is drawn from and what the estimators take as a prior.
"""

import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from coloc_graph.errors import TeamError
from coloc_graph.lie import rotation_x, rotation_y, rotation_z

Array = NDArray[np.float64]

#: Camera axes in a body whose camera looks along body x: z forward, x right, y down.
R_BODY_OPTICAL: Array = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def _finite(owner: msgspec.Struct) -> None:
    for name, value in msgspec.structs.asdict(owner).items():
        if isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f"`{name}` is {value}; give a finite number")


def _not_negative(owner: msgspec.Struct, names: Iterable[str]) -> None:
    for name in names:
        if getattr(owner, name) < 0:
            raise ValueError(f"`{name}` is {getattr(owner, name)}; give a number that is not negative")


class Camera(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Pinhole camera with OpenCV's distortion; pixels, (0, 0) is the centre of the top-left pixel.

    `distortion` is OpenCV's (k1, k2, p1, p2[, k3[, k4, k5, k6]]), empty for none. `noise_px` is the standard
    deviation of a detected marker centre per axis where a detection does not bring its own. `shot_gain` is the
    variance [grey levels^2] that one grey level of light adds to a pixel; it decides how sure a centre is.
    `bias_px` is the standard deviation per axis of an error that all centres of one marker share during a stance,
    and that no number of them averages away: what calibration leaves of the lens, a background that pulls.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    fps: float = 100.0
    noise_px: float = 0.3
    shot_gain: float = 0.1
    bias_px: float = 0.0

    def __post_init__(self) -> None:
        _finite(self)
        for name in ("width", "height", "fx", "fy", "fps", "noise_px"):
            if getattr(self, name) <= 0:
                raise ValueError(f"`{name}` is {getattr(self, name)}; give a number above 0")
        _not_negative(self, ("shot_gain", "bias_px"))
        if len(self.distortion) not in (0, 4, 5, 8):
            raise ValueError(
                f"`distortion` has {len(self.distortion)} numbers; give none, or OpenCV's 4, 5 or 8 coefficients"
            )
        if not all(map(math.isfinite, self.distortion)):
            raise ValueError("`distortion` holds a number that is not finite")

    @property
    def K(self) -> Array:
        """Intrinsic matrix, (3, 3), pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points_camera: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Pixels (..., 2) of points in the camera frame (..., 3) [m], and which of them the image contains.

        Points behind the camera come back as NaN. Source: OpenCV, "Camera Calibration and 3D Reconstruction".
        """
        points = np.asarray(points_camera, float)
        ahead = points[..., 2] > 1e-9
        x, y = np.moveaxis(points[..., :2] / np.where(ahead, points[..., 2], np.nan)[..., None], -1, 0)
        ahead &= self._unfolded(x, y)
        x, y = self._distort(x, y)
        uv = np.stack([self.fx * x + self.cx, self.fy * y + self.cy], axis=-1)
        with np.errstate(invalid="ignore"):
            inside = (uv >= -0.5).all(-1) & (uv[..., 0] < self.width - 0.5) & (uv[..., 1] < self.height - 0.5)
        return uv, inside & ahead

    def _unfolded(self, x: Array, y: Array) -> NDArray[np.bool_]:
        """Where the distorted radius still grows: beyond, a lens model folds far points back into the image."""
        k1, k2, _, _, k3, k4, k5, k6 = (*self.distortion, *([0.0] * (8 - len(self.distortion))))
        r2 = x * x + y * y
        with np.errstate(invalid="ignore"):
            above, below = (1 + r2 * (a + r2 * (b + r2 * c)) for a, b, c in ((k1, k2, k3), (k4, k5, k6)))
            above_grows, below_grows = (
                2 * r2 * (a + r2 * (2 * b + r2 * 3 * c)) for a, b, c in ((k1, k2, k3), (k4, k5, k6))
            )
            # the sign of d(r above / below)/dr
            return np.asarray((above + above_grows) * below - above * below_grows > 0)

    def _lens(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Radial factor and tangential shift of the lens at undistorted normalised coordinates."""
        k1, k2, p1, p2, k3, k4, k5, k6 = (*self.distortion, *([0.0] * (8 - len(self.distortion))))
        r2 = x * x + y * y
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        return (
            radial,
            2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )

    def _distort(self, x: Array, y: Array) -> tuple[Array, Array]:
        if not self.distortion:
            return x, y
        radial, dx, dy = self._lens(x, y)
        return x * radial + dx, y * radial + dy

    def normalise(self, uv: ArrayLike) -> Array:
        """Undistorted normalised coordinates (n, 2) of pixels (n, 2): the ray is (x, y, 1).

        NaN where the lens model cannot be inverted (pixels far outside the image).
        """
        seen = (np.asarray(uv, float).reshape(-1, 2) - (self.cx, self.cy)) / (self.fx, self.fy)
        if not self.distortion:
            return np.asarray(seen)
        x, y = seen.T
        # OpenCV's fixed point, but to rounding: its five steps leave 1e-3 px at the corners of a wide lens
        with np.errstate(all="ignore"):
            for _ in range(100):
                radial, dx, dy = self._lens(x, y)
                x_before, y_before = x, y
                x, y = (seen[:, 0] - dx) / radial, (seen[:, 1] - dy) / radial
                moved = np.maximum(np.abs(x - x_before), np.abs(y - y_before))
                if not (moved > 1e-13).any():
                    break
        return np.where((moved < 1e-9)[:, None], np.stack([x, y], axis=1), np.nan)

    def per_pixel(self, x: ArrayLike) -> Array:
        """How far one pixel to the right, and one down, go at normalised coordinates x (n, 2): (n, 2, 2)."""
        at = np.asarray(x, float)
        seen_by_x = np.broadcast_to(np.eye(2), (len(at), 2, 2))
        if self.distortion:
            step = 1e-6
            sides = [
                np.stack(self._distort(*(at + off).T), -1) - np.stack(self._distort(*(at - off).T), -1)
                for off in ((step, 0.0), (0.0, step))
            ]
            seen_by_x = np.stack(sides, axis=-1) / (2 * step)
        (a, b), (c, d) = np.moveaxis(seen_by_x, 0, -1)
        with np.errstate(all="ignore"):
            inverse = np.array([[d / self.fx, -b / self.fy], [-c / self.fx, a / self.fy]]) / (a * d - b * c)
        return np.moveaxis(inverse, -1, 0)


class Mount(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How the camera sits on the body: `T_body_camera`, with tolerances.

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
        _finite(self)
        _not_negative(self, ("height", "height_sigma", "tilt_sigma_deg", "roll_sigma_deg"))

    @property
    def R_body_camera(self) -> Array:
        """Rotation of the optical camera frame in the body, (3, 3)."""
        yaw, tilt, roll = np.deg2rad([self.yaw_deg, self.tilt_deg, self.roll_deg])
        return rotation_z(yaw) @ rotation_y(tilt) @ rotation_x(roll) @ R_BODY_OPTICAL

    @property
    def T_body_camera(self) -> Array:
        """Pose of the optical camera frame in the body, (4, 4), metres."""
        T = np.eye(4)
        T[:3, :3] = self.R_body_camera
        T[:3, 3] = self.x, self.y, self.height
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
        _finite(self)
        _not_negative(self, ("height", "span_sigma", "height_sigma"))
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
    """How far a robot that should stay put may slip from one stance to the next: `sigma` [m] and `sigma_deg`."""

    sigma: float
    sigma_deg: float

    def __post_init__(self) -> None:
        _finite(self)
        if self.sigma < LEAST_SLIP or self.sigma_deg <= 0:
            raise ValueError(
                f"a slip of {self.sigma} m and {self.sigma_deg} deg is too tight to be solved; give at least "
                f"{LEAST_SLIP} m and an angle above 0, or leave `slip` out: then the robot stays put exactly"
            )


class Devices(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What a robot's own program opens, and where the robot is put down.

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


class Robot(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A body with a camera, its mount, and markers (none on a robot that is never watched).

    As an anchor it stays put exactly, or, with a `slip`, within that. `devices` are for its own program.
    """

    name: str
    camera: Camera
    mount: Mount
    markers: Markers | None = None
    slip: Slip | None = None
    devices: Devices | None = None

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]*", self.name):
            raise ValueError(
                f"the name `{self.name}` is not usable in a topic; "
                "use letters, digits, - and _, beginning with a letter"
            )


class Floor(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The floor the team stands on: how far from level and flat it is (standard deviations)."""

    tilt_sigma_deg: float = 0.0
    height_sigma: float = 0.0

    def __post_init__(self) -> None:
        _finite(self)
        _not_negative(self, ("tilt_sigma_deg", "height_sigma"))


class Team(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The robots, the floor (None where they do not stand on a common one), and the reference robot.

    The world frame is the body of `reference` at stance 0. `clock_sigma` [s] is how well the clocks of any two
    robots agree, one standard deviation; where it is 0 they agree, and no offset is estimated.
    """

    reference: str
    robots: tuple[Robot, ...]
    floor: Floor | None = None
    clock_sigma: float = 0.0

    def __post_init__(self) -> None:
        _finite(self)
        _not_negative(self, ("clock_sigma",))
        names = [robot.name for robot in self.robots]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"two robots are called `{twice[0]}`; give each a name of its own")
        if len(names) < 2:
            raise ValueError("a team has at least two robots; add another under [[robots]]")
        if self.reference not in names:
            raise ValueError(f"`reference` is `{self.reference}`, which is not one of the robots {', '.join(names)}")

    @property
    def names(self) -> tuple[str, ...]:
        """The robots' names, in the team's order."""
        return tuple(robot.name for robot in self.robots)

    def __getitem__(self, name: str) -> Robot:
        for robot in self.robots:
            if robot.name == name:
                return robot
        raise TeamError(f"robot `{name}` is not in the team ({', '.join(self.names)}); add it under [[robots]]")

    def marker_height(self, movers: Iterable[str] = ()) -> float | None:
        """Height of the marker plane of these robots (of all where none is named) [m]; None if they differ."""
        wanted = tuple(movers) or self.names
        heights = {robot.markers.height for robot in self.robots if robot.markers and robot.name in wanted}
        return heights.pop() if len(heights) == 1 else None


def read_team(path: str | Path) -> Team:
    """The team described by a TOML file; `TeamError` names the file and the path in it."""
    path = Path(path)
    try:
        return msgspec.toml.decode(path.read_bytes(), type=Team)
    except OSError as error:
        raise TeamError(f"{path}: cannot be read ({error.strerror}); give the path of a team.toml") from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise TeamError(f"{path}: {error}; see docs/team.md for the fields") from error


def write_team(team: Team, path: str | Path) -> None:
    """Write a team as TOML; what `read_team` reads back equal."""
    import tomli_w

    Path(path).write_text(tomli_w.dumps(without_none(msgspec.to_builtins(team))), encoding="utf-8")


def without_none(value: Any) -> Any:
    """TOML has no null: a field that is None is left out, and reads back as its default."""
    if isinstance(value, dict):
        return {key: without_none(inner) for key, inner in value.items() if inner is not None}
    if isinstance(value, list | tuple):
        return [without_none(inner) for inner in value]
    return value
