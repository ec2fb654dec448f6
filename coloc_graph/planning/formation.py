"""Periodic formations of two observers that leap over each other: `Gait`."""

import math
from dataclasses import dataclass

from coloc_graph.errors import InputError
from coloc_graph.geometry.se2 import Planar

MAX_LEAP = 2.5  # advance of the pair a stance above which two cameras share no view of the floor [m]
BODY_WIDTH = 0.34  # width of an iRobot Create, the least distance between the lanes of two that pass [m]


@dataclass(frozen=True)
class Gait:
    """Periodic leap-frog of two observers in two lanes.

    Attributes
    ----------
    leap
        Advance of the pair a stance [m]; an observer drives twice as far.
    abreast
        Distance between the two lanes [m].
    toe_in_deg
        Angle by which each observer is turned towards the other's lane [deg].

    Raises
    ------
    InputError
        If a number is not finite, or two robots cannot leap over each other so.
    """

    leap: float = 0.185
    abreast: float = 0.72
    toe_in_deg: float = 17.0

    def __post_init__(self) -> None:
        if not 0 < self.leap <= MAX_LEAP:
            raise InputError(f"a leap of {self.leap} m is not possible: give a leap above 0 and up to {MAX_LEAP} m")
        if not BODY_WIDTH <= self.abreast <= 4:
            raise InputError(
                f"robots {self.abreast} m abreast cannot pass each other and share a view: give {BODY_WIDTH} to 4 m"
            )
        if not -60 <= self.toe_in_deg <= 60:
            raise InputError(f"a toe-in of {self.toe_in_deg} deg leaves no common view: give -60 to 60 deg")

    @classmethod
    def of_paper(cls, l: float = 0.8, theta_deg: float = 34.0, leap: float = 0.185) -> "Gait":  # noqa: E741
        """Gait of the paper's figures: distance `l` [m] between the observers, angle `theta_deg` between them.

        Raises
        ------
        InputError
            If the distance is not longer than the leap.
        """
        if not l > leap:
            raise InputError(f"observers {l} m apart cannot leap {leap} m: give a distance above the leap")
        return cls(leap, math.sqrt(l**2 - leap**2), theta_deg / 2)

    @property
    def apart(self) -> float:
        """Distance between the two observers [m]."""
        return math.hypot(self.leap, self.abreast)

    def stop(self, k: int) -> Planar:
        """Return standing pose number k (x [m], y [m], yaw [rad]) of a team that goes along the x axis."""
        side = -1.0 if k % 2 else 1.0
        return self.leap * k, self.abreast / 2 * side, -math.radians(self.toe_in_deg) * side


#: The formation of the paper's hallway: 0.74 m apart, 34 deg between the cameras, leaps of 18.5 cm.
PAPER = Gait()
