"""Points in an image that move at nearly constant speed: many Kalman filters at once.

Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, 6.2
(white-noise acceleration).
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class PointFilters:
    """n points: `place` (n, 2) [px] and `speed` (n, 2) [px/s] at the `time` [s] of the last prediction.

    Covariances are kept in blocks: of the place `place_covariance` (n, 2, 2), of both, and of the speed. `acceleration`
    [px^2/s^3] is the spectral density of the acceleration in each axis, `jerk` [px/s] by how much a speed may change at
    once, now and then, `speed_sigma` [px/s] what a new point may do.
    """

    def __init__(self, acceleration: float, jerk: float, speed_sigma: float) -> None:
        self._q, self._jerk, self._speed_sigma = acceleration, jerk, speed_sigma
        self.time: float | None = None
        self.place, self.speed = np.zeros((0, 2)), np.zeros((0, 2))
        self.place_covariance = np.zeros((0, 2, 2))
        self._both, self._of_speed = np.zeros((0, 2, 2)), np.zeros((0, 2, 2))
        self._unseen = np.zeros(0)  # for how long [s]

    def __len__(self) -> int:
        return len(self.place)

    def predict(self, time: float) -> None:
        """Where all are at a later time; an earlier one changes nothing."""
        dt = 0.0 if self.time is None else time - self.time
        self.time = time if self.time is None else max(time, self.time)
        if dt <= 0 or not len(self):
            return
        self._unseen = self._unseen + dt
        self.place = self.place + dt * self.speed
        swept, q = dt * self._of_speed, self._q * dt * np.eye(2)
        self.place_covariance = (
            self.place_covariance + dt * (self._both + self._both.mT) + dt * swept + (dt * dt / 3) * q
        )
        self._both = self._both + swept + (dt / 2) * q
        self._of_speed = self._of_speed + q

    def against(self, uv: Array, covariance: Array) -> tuple[Array, Array, Array]:
        """Squared distances (n, m) of measurements (m, 2) with covariances (m, 2, 2), in units of what is uncertain;
        the logarithms of their densities [1/px^2]; and the squared distances had the speed changed at once."""
        dx, dy = np.moveaxis(uv - self.place[:, None], -1, 0)
        S = self.place_covariance[:, None] + covariance
        s00, s01, s11 = S[..., 0, 0], S[..., 0, 1], S[..., 1, 1]
        determinant = s00 * s11 - s01 * s01
        squared = (s11 * dx * dx - 2 * s01 * dx * dy + s00 * dy * dy) / determinant
        shift = np.square(self._jerk * self._unseen)[:, None]
        s00, s11 = s00 + shift, s11 + shift
        jerked = (s11 * dx * dx - 2 * s01 * dx * dy + s00 * dy * dy) / (s00 * s11 - s01 * s01)
        return squared, -np.log(2 * np.pi) - 0.5 * np.log(determinant) - 0.5 * squared, jerked

    def jerk(self, which: NDArray[np.int64]) -> None:
        """Points `which` changed their speed at once since they were measured last."""
        change, dt = self._jerk**2 * np.eye(2), self._unseen[which, None, None]
        self.place_covariance[which] += dt * dt * change
        self._both[which] += dt * change
        self._of_speed[which] += change

    def update(self, which: NDArray[np.int64], uv: Array, covariance: Array) -> None:
        """Points `which` (k,) are measured at (k, 2) with covariances (k, 2, 2)."""
        P, B = self.place_covariance[which], self._both[which]
        S = P + covariance
        inverse = np.empty_like(S)
        inverse[:, 0, 0], inverse[:, 1, 1] = S[:, 1, 1], S[:, 0, 0]
        inverse[:, 0, 1] = inverse[:, 1, 0] = -S[:, 0, 1]
        inverse /= (S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] ** 2)[:, None, None]
        to_place, to_speed = P @ inverse, B.mT @ inverse
        off = (uv - self.place[which])[..., None]
        self.place[which] += (to_place @ off)[..., 0]
        self.speed[which] += (to_speed @ off)[..., 0]
        self.place_covariance[which] = to_place @ covariance
        self._both[which] = B - to_place @ B
        self._of_speed[which] -= to_speed @ B
        self._unseen[which] = 0.0

    def add(self, uv: Array, covariance: Array) -> None:
        """New points at (k, 2) with covariances (k, 2, 2), of unknown speed."""
        zero = np.zeros_like(uv)
        fast = np.broadcast_to(self._speed_sigma**2 * np.eye(2), covariance.shape)
        self.place, self.speed = np.concatenate([self.place, uv]), np.concatenate([self.speed, zero])
        self.place_covariance = np.concatenate([self.place_covariance, covariance])
        self._both = np.concatenate([self._both, np.zeros_like(covariance)])
        self._of_speed = np.concatenate([self._of_speed, fast])
        self._unseen = np.concatenate([self._unseen, np.zeros(len(uv))])

    def keep(self, which: NDArray[np.bool_]) -> None:
        """Forget all others."""
        self.place, self.speed = self.place[which], self.speed[which]
        self.place_covariance = self.place_covariance[which]
        self._both, self._of_speed = self._both[which], self._of_speed[which]
        self._unseen = self._unseen[which]
