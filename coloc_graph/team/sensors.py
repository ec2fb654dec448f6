"""Sensors besides the camera: `Ranging`, and the calibration of `Wheels`."""

import msgspec

from coloc_graph.team.checks import require_finite, require_not_negative


class Ranging(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Range and bearing sensor: systematic errors, noise and tolerances.

    Parameters
    ----------
    range_sigma, range_sigma_per_m2 : float
        Noise of a range r: `range_sigma` + `range_sigma_per_m2` r^2 [m].
    bearing_sigma_deg, across_sigma : float
        Noise of a bearing: the hypotenuse of `bearing_sigma_deg` and `across_sigma` [m] / r; 0: it measures none.
    range_memory, bearing_memory : float
        Correlation times of the errors of one target [s]; 0: independent.
    offset, scale : float
        It reads `offset` [m] + `scale` r at range r.
    bearing_offset_deg : float
        It reads this more than the bearing.
    depth : float
        1 where it measures depth (a camera, by the size in the image), 0 where it measures range: its r is
        r (1 - `depth` (1 - cos(bearing))).
    robot_offset : float
        Ranges to robots read this much more than those to landmarks [m].
    x, y : float
        Position on the body [m].
    two_way : bool
        True of radio (UWB): a range is that between the antennas of both robots, at their `x`, `y`, and both `offset`s
        add to it. Otherwise it is that to the origin of the other body.
    offset_sigma, scale_sigma, bearing_offset_sigma_deg, depth_sigma, robot_offset_sigma, place_sigma : float
        Tolerances, `place_sigma` of x and of y; a number with one is estimated along with the poses.
    """

    range_sigma: float
    bearing_sigma_deg: float = 0.0
    range_sigma_per_m2: float = 0.0
    across_sigma: float = 0.0
    range_memory: float = 0.0
    bearing_memory: float = 0.0
    offset: float = 0.0
    scale: float = 1.0
    bearing_offset_deg: float = 0.0
    depth: float = 0.0
    robot_offset: float = 0.0
    x: float = 0.0
    y: float = 0.0
    offset_sigma: float = 0.0
    scale_sigma: float = 0.0
    bearing_offset_sigma_deg: float = 0.0
    depth_sigma: float = 0.0
    robot_offset_sigma: float = 0.0
    place_sigma: float = 0.0
    two_way: bool = False

    def __post_init__(self) -> None:
        require_finite(self)
        for name in ("range_sigma", "scale"):
            if getattr(self, name) <= 0:
                raise ValueError(f"`{name}` is {getattr(self, name)}; give a number above 0")
        if not -0.5 <= self.depth <= 1.5:
            raise ValueError(f"`depth` is {self.depth}; give 0 where it measures range, 1 where it measures depth")
        noise = ("bearing_sigma_deg", "range_sigma_per_m2", "across_sigma", "range_memory", "bearing_memory")
        tolerances = ("offset_sigma", "scale_sigma", "bearing_offset_sigma_deg", "depth_sigma", "robot_offset_sigma")
        require_not_negative(self, (*noise, *tolerances, "place_sigma"))

    @property
    def has_bearings(self) -> bool:
        """True if it measures bearings: their noise is stated."""
        return self.bearing_sigma_deg > 0 or self.across_sigma > 0


class Wheels(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Calibration of wheel odometry; its noise is in the run, sample by sample.

    Parameters
    ----------
    scale, turn_scale : float
        True motion and turn relative to those reported.
    delay : float
        Time by which the motion is later than reported, as of odometry made of commands [s].
    scale_sigma, turn_scale_sigma, delay_sigma : float
        Tolerances; a number with one is estimated along with the poses.
    direction_sigma_deg : float
        Tolerance of the body's x axis from the direction in which the wheels drive. Nothing measured shows it: it is
        part of each heading's uncertainty.
    """

    scale: float = 1.0
    turn_scale: float = 1.0
    delay: float = 0.0
    scale_sigma: float = 0.0
    turn_scale_sigma: float = 0.0
    delay_sigma: float = 0.0
    direction_sigma_deg: float = 0.0

    def __post_init__(self) -> None:
        require_finite(self)
        for name in ("scale", "turn_scale"):
            if getattr(self, name) <= 0:
                raise ValueError(f"`{name}` is {getattr(self, name)}; give a number above 0")
        require_not_negative(self, ("scale_sigma", "turn_scale_sigma", "delay_sigma", "direction_sigma_deg"))
