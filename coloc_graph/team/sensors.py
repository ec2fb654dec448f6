"""Sensors besides the camera: `Ranging`, and the calibration of `Wheels`."""

import msgspec

from coloc_graph.team.checks import require_finite, require_not_negative


class Ranging(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A sensor of range and bearing: what it measures, how noisy, and for how long it errs alike.

    It reads `offset` [m] + `scale` r at range r, and `bearing_offset_deg` more than the bearing. One standard deviation
    is `range_sigma` + `range_sigma_per_m2` r^2 [m] of a range (as where the range is made of the size of an image), and
    the hypotenuse of `bearing_sigma_deg` and of `across_sigma` [m] / r of a bearing. Errors of the same target's next
    measurement are alike for `range_memory` and `bearing_memory` [s], their time of correlation (0: independent).
    A camera that makes the range of a size in its image tells how far a target is in front of it, and not how far away:
    its r is r (1 - `depth` (1 - cos(bearing))) with a `depth` of 1, or near it; what measures range has 0. Ranges to
    robots read `robot_offset` [m] more than those to landmarks.
    It sits at `x`, `y` [m] on the body. `*_sigma` of what is not noise are tolerances (`place_sigma` is that of x and
    of y): what has one is found along with the poses.
    """

    range_sigma: float
    bearing_sigma_deg: float
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

    def __post_init__(self) -> None:
        require_finite(self)
        for name in ("range_sigma", "bearing_sigma_deg", "scale"):
            if getattr(self, name) <= 0:
                raise ValueError(f"`{name}` is {getattr(self, name)}; give a number above 0")
        if not -0.5 <= self.depth <= 1.5:
            raise ValueError(f"`depth` is {self.depth}; give 0 where it measures range, 1 where it measures depth")
        noise = ("range_sigma_per_m2", "across_sigma", "range_memory", "bearing_memory")
        tolerances = ("offset_sigma", "scale_sigma", "bearing_offset_sigma_deg", "depth_sigma", "robot_offset_sigma")
        require_not_negative(self, (*noise, *tolerances, "place_sigma"))


class Wheels(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Calibration of wheel odometry: the motion is `scale` and `turn_scale` times what it reports, `delay` [s] later.

    A delay is what odometry has that is made of commands. `*_sigma` are tolerances: what has one is found along with
    the poses. How noisy odometry is the run itself says, sample by sample.
    """

    scale: float = 1.0
    turn_scale: float = 1.0
    delay: float = 0.0
    scale_sigma: float = 0.0
    turn_scale_sigma: float = 0.0
    delay_sigma: float = 0.0

    def __post_init__(self) -> None:
        require_finite(self)
        for name in ("scale", "turn_scale"):
            if getattr(self, name) <= 0:
                raise ValueError(f"`{name}` is {getattr(self, name)}; give a number above 0")
        require_not_negative(self, ("scale_sigma", "turn_scale_sigma", "delay_sigma"))
