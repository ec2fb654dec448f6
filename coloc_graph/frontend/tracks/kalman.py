"""Kalman filters of image points that move at nearly constant velocity.

The filters are scalar code: of the few points of an image numpy would take twenty times as long.

Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, 6.2
(white-noise acceleration).

`kernel/filters.c` computes the same, and is changed along with it: `tests/frontend/test_kernel.py` compares them.
"""

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from coloc_graph.frontend.compiled import kernel

Array = NDArray[np.float64]

#: Symmetric matrix (2, 2) as its entries xx, xy, yy.
Symmetric = tuple[float, float, float]

LOG_2_PI = math.log(2 * math.pi)


class PointFilter:
    """State of one point: position [px], velocity [px/s], and their covariances.

    `p` are the entries of the position's covariance, `b` those of the cross covariance row by row, `w` those of the
    velocity's. `unseen` is the time since the last measurement [s].
    """

    __slots__ = ("b", "du", "dv", "p", "u", "unseen", "v", "w")

    def __init__(self, u: float, v: float, covariance: Symmetric, speed_variance: float) -> None:
        self.u, self.v, self.du, self.dv = u, v, 0.0, 0.0
        self.p: Symmetric = covariance
        self.b = (0.0, 0.0, 0.0, 0.0)
        self.w: Symmetric = (speed_variance, 0.0, speed_variance)
        self.unseen = 0.0

    def predict(self, dt: float, q: float) -> None:
        """Predict by dt [s] with a spectral density q of the acceleration."""
        self.unseen += dt
        self.u += dt * self.du
        self.v += dt * self.dv
        (p00, p01, p11), (b00, b01, b10, b11), (w00, w01, w11) = self.p, self.b, self.w
        added = dt * dt * dt / 3 * q
        self.p = (
            p00 + dt * (2 * b00 + dt * w00) + added,
            p01 + dt * (b01 + b10 + dt * w01),
            p11 + dt * (2 * b11 + dt * w11) + added,
        )
        added = dt * dt / 2 * q
        self.b = b00 + dt * w00 + added, b01 + dt * w01, b10 + dt * w01, b11 + dt * w11 + added
        self.w = w00 + q * dt, w01, w11 + q * dt

    def compare(self, u: float, v: float, covariance: Symmetric, jerk: float, gate: float) -> tuple[float, ...] | None:
        """Compare with a measurement.

        Parameters
        ----------
        u, v, covariance
            Measurement [px], and its covariance [px^2].
        jerk
            Standard deviation of a sudden change of velocity [px/s].
        gate
            Bound on the squared distance under a sudden change of velocity.

        Returns
        -------
        tuple or None
            Squared Mahalanobis distance, log likelihood [1/px^2], and squared distance under a sudden change of
            velocity; None beyond the gate.
        """
        dx, dy = u - self.u, v - self.v
        s00, s01, s11 = self.p[0] + covariance[0], self.p[1] + covariance[1], self.p[2] + covariance[2]
        shift = (jerk * self.unseen) ** 2
        j00, j11 = s00 + shift, s11 + shift
        if dx * dx >= gate * j00 or dy * dy >= gate * j11:
            return None
        jerked = (j11 * dx * dx - 2 * s01 * dx * dy + j00 * dy * dy) / (j00 * j11 - s01 * s01)
        if not jerked < gate:
            return None
        determinant = s00 * s11 - s01 * s01
        squared = (s11 * dx * dx - 2 * s01 * dx * dy + s00 * dy * dy) / determinant
        return squared, -LOG_2_PI - 0.5 * math.log(determinant) - 0.5 * squared, jerked

    def allow_jerk(self, jerk: float) -> None:
        """Allow a sudden change of velocity since the last measurement."""
        dt, change = self.unseen, jerk * jerk
        self.p = self.p[0] + dt * dt * change, self.p[1], self.p[2] + dt * dt * change
        self.b = self.b[0] + dt * change, self.b[1], self.b[2], self.b[3] + dt * change
        self.w = self.w[0] + change, self.w[1], self.w[2] + change

    def update(self, u: float, v: float, covariance: Symmetric) -> None:
        """Update by a measurement."""
        (p00, p01, p11), (b00, b01, b10, b11), (w00, w01, w11) = self.p, self.b, self.w
        c00, c01, c11 = covariance
        s00, s01, s11 = p00 + c00, p01 + c01, p11 + c11
        determinant = s00 * s11 - s01 * s01
        i00, i01, i11 = s11 / determinant, -s01 / determinant, s00 / determinant
        # gains of position and velocity
        k00, k01 = p00 * i00 + p01 * i01, p00 * i01 + p01 * i11
        k10, k11 = p01 * i00 + p11 * i01, p01 * i01 + p11 * i11
        g00, g01 = b00 * i00 + b10 * i01, b00 * i01 + b10 * i11
        g10, g11 = b01 * i00 + b11 * i01, b01 * i01 + b11 * i11
        dx, dy = u - self.u, v - self.v
        self.u += k00 * dx + k01 * dy
        self.v += k10 * dx + k11 * dy
        self.du += g00 * dx + g01 * dy
        self.dv += g10 * dx + g11 * dy
        self.p = k00 * c00 + k01 * c01, k00 * c01 + k01 * c11, k10 * c01 + k11 * c11
        self.b = (
            b00 - k00 * b00 - k01 * b10,
            b01 - k00 * b01 - k01 * b11,
            b10 - k10 * b00 - k11 * b10,
            b11 - k10 * b01 - k11 * b11,
        )
        self.w = w00 - g00 * b00 - g01 * b10, w01 - g00 * b01 - g01 * b11, w11 - g10 * b01 - g11 * b11
        self.unseen = 0.0


class PointFilters:
    """Filters of the `points` of an image, and how they move.

    Parameters
    ----------
    acceleration
        Spectral density of the acceleration along each axis [px^2/s^3].
    jerk
        Standard deviation of an occasional sudden change of velocity [px/s].
    velocity_sigma
        Standard deviation of a new point's velocity [px/s].
    """

    def __init__(self, acceleration: float, jerk: float, velocity_sigma: float) -> None:
        self.set_motion(acceleration, jerk, velocity_sigma)
        self.time: float | None = None
        self.points: list[PointFilter] = []

    def set_motion(self, acceleration: float, jerk: float, velocity_sigma: float) -> None:
        """Set how points move from now on; see the parameters of the class."""
        self._q, self.jerk, self._velocity_sigma = acceleration, jerk, velocity_sigma

    def reach(self, point: PointFilter, dt: float) -> float:
        """Return the standard deviation of a point's position [px], had its velocity changed at once `dt` [s] ago."""
        return math.sqrt((point.p[0] + point.p[2]) / 2 + (self.jerk * dt) ** 2)

    def __len__(self) -> int:
        return len(self.points)

    @property
    def position(self) -> Array:
        """Positions of the points, (n, 2) [px]."""
        return np.array([(one.u, one.v) for one in self.points]).reshape(-1, 2)

    def predict(self, time: float) -> None:
        """Predict all points to a later time [s]; an earlier one changes nothing."""
        dt = 0.0 if self.time is None else time - self.time
        self.time = time if self.time is None else max(time, self.time)
        if dt > 0:
            for one in self.points:
                one.predict(dt, self._q)

    def add(self, u: float, v: float, covariance: Symmetric) -> None:
        """Add a point with unknown velocity."""
        new = PointFilter if kernel is None else kernel.PointFilter
        self.points.append(new(u, v, covariance, self._velocity_sigma**2))

    def keep(self, which: Iterable[bool]) -> None:
        """Remove all points but those of a mask (n,)."""
        self.points = [one for one, kept in zip(self.points, which, strict=True) if kept]
