"""Kalman filters of image points that move at nearly constant velocity, many at once.

Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, 6.2
(white-noise acceleration).
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class PointFilters:
    """Bank of n Kalman filters with states of position and velocity.

    `position` (n, 2) [px] with `position_covariance` (n, 2, 2) [px^2] and `velocity` (n, 2) [px/s] are those of the
    last prediction.

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
        self.position, self.velocity = np.zeros((0, 2)), np.zeros((0, 2))
        self.position_covariance = np.zeros((0, 2, 2))
        self._cross, self._velocity_covariance = np.zeros((0, 2, 2)), np.zeros((0, 2, 2))
        self._unseen = np.zeros(0)  # for how long [s]

    def set_motion(self, acceleration: float, jerk: float, velocity_sigma: float) -> None:
        """Set how points move from now on; see the parameters of the class."""
        self._q, self._jerk, self._velocity_sigma = acceleration, jerk, velocity_sigma

    def reach(self, dt: float) -> Array:
        """Standard deviation of where each point is (n,) [px], had its velocity changed at once `dt` [s] ago."""
        variance = np.trace(self.position_covariance, axis1=1, axis2=2) / 2
        return np.asarray(np.sqrt(variance + (self._jerk * dt) ** 2))

    def __len__(self) -> int:
        return len(self.position)

    def predict(self, time: float) -> None:
        """Predict all points to a later time [s]; an earlier one changes nothing."""
        dt = 0.0 if self.time is None else time - self.time
        self.time = time if self.time is None else max(time, self.time)
        if dt <= 0 or not len(self):
            return
        self._unseen = self._unseen + dt
        self.position = self.position + dt * self.velocity
        swept, q = dt * self._velocity_covariance, self._q * dt * np.eye(2)
        self.position_covariance = (
            self.position_covariance + dt * (self._cross + self._cross.mT) + dt * swept + (dt * dt / 3) * q
        )
        self._cross = self._cross + swept + (dt / 2) * q
        self._velocity_covariance = self._velocity_covariance + q

    def distances(self, uv: Array, covariance: Array) -> tuple[Array, Array, Array]:
        """Compare the predictions with measurements.

        Parameters
        ----------
        uv, covariance
            Measurements, (m, 2) [px], and their covariances, (m, 2, 2) [px^2].

        Returns
        -------
        tuple of numpy.ndarray
            Squared Mahalanobis distances, log likelihoods [1/px^2], and squared distances under a sudden change of
            velocity, (n, m) each.
        """
        dx, dy = np.moveaxis(uv - self.position[:, None], -1, 0)
        S = self.position_covariance[:, None] + covariance
        s00, s01, s11 = S[..., 0, 0], S[..., 0, 1], S[..., 1, 1]
        determinant = s00 * s11 - s01 * s01
        squared = (s11 * dx * dx - 2 * s01 * dx * dy + s00 * dy * dy) / determinant
        shift = np.square(self._jerk * self._unseen)[:, None]
        s00, s11 = s00 + shift, s11 + shift
        jerked = (s11 * dx * dx - 2 * s01 * dx * dy + s00 * dy * dy) / (s00 * s11 - s01 * s01)
        return squared, -np.log(2 * np.pi) - 0.5 * np.log(determinant) - 0.5 * squared, jerked

    def jerk(self, which: NDArray[np.int64]) -> None:
        """Allow points `which` (k,) a sudden change of velocity since their last measurement."""
        change, dt = self._jerk**2 * np.eye(2), self._unseen[which, None, None]
        self.position_covariance[which] += dt * dt * change
        self._cross[which] += dt * change
        self._velocity_covariance[which] += change

    def update(self, which: NDArray[np.int64], uv: Array, covariance: Array) -> None:
        """Update points `which` (k,) by measurements (k, 2) with covariances (k, 2, 2)."""
        P, B = self.position_covariance[which], self._cross[which]
        S = P + covariance
        inverse = np.empty_like(S)
        inverse[:, 0, 0], inverse[:, 1, 1] = S[:, 1, 1], S[:, 0, 0]
        inverse[:, 0, 1] = inverse[:, 1, 0] = -S[:, 0, 1]
        inverse /= (S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] ** 2)[:, None, None]
        to_position, to_velocity = P @ inverse, B.mT @ inverse
        off = (uv - self.position[which])[..., None]
        self.position[which] += (to_position @ off)[..., 0]
        self.velocity[which] += (to_velocity @ off)[..., 0]
        self.position_covariance[which] = to_position @ covariance
        self._cross[which] = B - to_position @ B
        self._velocity_covariance[which] -= to_velocity @ B
        self._unseen[which] = 0.0

    def add(self, uv: Array, covariance: Array) -> None:
        """Add points at (k, 2) with covariances (k, 2, 2) and unknown velocity."""
        zero = np.zeros_like(uv)
        fast = np.broadcast_to(self._velocity_sigma**2 * np.eye(2), covariance.shape)
        self.position, self.velocity = np.concatenate([self.position, uv]), np.concatenate([self.velocity, zero])
        self.position_covariance = np.concatenate([self.position_covariance, covariance])
        self._cross = np.concatenate([self._cross, np.zeros_like(covariance)])
        self._velocity_covariance = np.concatenate([self._velocity_covariance, fast])
        self._unseen = np.concatenate([self._unseen, np.zeros(len(uv))])

    def keep(self, which: NDArray[np.bool_]) -> None:
        """Remove all points but those of a mask (n,)."""
        self.position, self.velocity = self.position[which], self.velocity[which]
        self.position_covariance = self.position_covariance[which]
        self._cross, self._velocity_covariance = self._cross[which], self._velocity_covariance[which]
        self._unseen = self._unseen[which]
