"""Distances that robots keep from each other and from walls, so that a slip of their wheels touches nothing; `Room`."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coloc_graph.planning.slip import WheelErrors, stop_sigma
from coloc_graph.team.shared_view import BODY_RADIUS

TO_ROBOT = 0.42  # least distance between the middles of two robots, where they stand and on the way [m]
TO_WALL = 0.22  # least distance of a driving robot's middle from walls [m]
SAFE = 4.5  # robots touch nothing unless they stop further off than this number of standard deviations
SIGMAS = (SAFE, 3.0, 2.0, 1.0)  # numbers that are tried in turn where a way is too narrow


@dataclass(frozen=True)
class Room:
    """Distances that a plan keeps.

    Attributes
    ----------
    wheels
        Errors of the wheels by which robots veer and stop off; None for `stop_sigma` of a leap alone.
    sigmas
        Number of standard deviations by which robots may stop off and still touch nothing.
    """

    wheels: WheelErrors | None = None
    sigmas: float = SAFE

    def apart(
        self, leapt: ArrayLike, other: ArrayLike | None = None, *, least: float = TO_ROBOT
    ) -> NDArray[np.float64]:
        """Return the distance, at `least`, of a way from where robots stop after leaps (...) [m].

        With the leaps of the `other` ones (...) [m], that between where both stop.
        """
        sigma = stop_sigma(leapt, self.wheels)
        if other is not None:
            sigma = np.hypot(sigma, stop_sigma(other, self.wheels))
        return np.maximum(least, 2 * BODY_RADIUS + self.sigmas * sigma)

    def off_walls(self, leapt: ArrayLike, *, least: float = TO_WALL) -> NDArray[np.float64]:
        """Return the distance, at `least`, from walls of where robots are to stop after leaps (...) [m]."""
        return np.maximum(least, BODY_RADIUS + self.sigmas * stop_sigma(leapt, self.wheels))

    def further(self, driven: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return by how much more a robot keeps from robots and walls after it has driven (...) [m] by its wheels [m].

        Nothing without errors of wheels.
        """
        if self.wheels is None:
            return np.zeros(np.shape(driven)), np.zeros(np.shape(driven))
        return self.apart(driven) - TO_ROBOT, self.off_walls(driven) - TO_WALL
