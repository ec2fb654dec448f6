"""GTSAM's factors of a drive: steps by the wheels, ranges and bearings, and what is known before."""

import math
from collections.abc import Callable, Iterable

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.planar.estimate import Errors
from coloc_graph.backend.planar.filter import Models
from coloc_graph.backend.planar.model import NO_ERRORS, NOTHING_OFF
from coloc_graph.keyframes import Drive

Array = NDArray[np.float64]

POSE, LANDMARK, WHEELS, RANGING = (ord(letter) for letter in "xlwr")
#: A landmark that is known better than this is where it is said to be [m].
EXACT = 1e-3
#: What is stated without a tolerance, beside what has one, is exact to this [m, rad, s, relative].
LEAST_SIGMA = 1e-6
#: The world's frame is fixed this firmly where no landmark fixes it [m, rad].
GAUGE_SIGMA = 1e-4
#: Beyond so many sigmas a measurement weighs less and less: a barcode that was read wrong is tens of sigmas off.
CAUCHY = 3.0


def pose_key(robot: int, keyframe: int) -> int:
    """The key of a robot's keyframe, both by number."""
    return int(gtsam.mrsymbol(POSE, robot + 1, keyframe))


def landmark_key(number: int) -> int:
    """The key of a landmark, by number."""
    return int(gtsam.mrsymbol(LANDMARK, 1, number))


def wheels_key(robot: int) -> int:
    """The key of the errors of a robot's wheels."""
    return int(gtsam.mrsymbol(WHEELS, robot + 1, 0))


def ranging_key(robot: int) -> int:
    """The key of the errors of a robot's sensor."""
    return int(gtsam.mrsymbol(RANGING, robot + 1, 0))


class DriveFactors:
    """Makes the factors of a drive. `noise` (robots, 3) multiplies the standard deviations of ranges, bearings, steps.

    Residuals are whitened, so that all factors of a kind share a noise model; that of measurements is robust.
    """

    def __init__(self, drive: Drive, models: Models, noise: Array | None = None) -> None:
        self.drive, self.models = drive, models
        self.noise = np.ones((len(drive.robots), 3)) if noise is None else noise
        self._has_wheels = [bool(row.any()) for row in models.wheels_sigmas]
        self._has_ranging = [bool(row.any()) for row in models.ranging_sigmas]
        self._exact: NDArray[np.bool_] = np.isfinite(models.map[:, 0]) & (models.map_sigmas < EXACT)
        self._whiten: list[Array] = [
            # e^T C^-1 e with C = L L^T
            np.linalg.inv(np.linalg.cholesky(model.covariances)).reshape(-1, 3, 3) / self.noise[robot, 2]
            for robot, model in enumerate(models.wheels)
        ]
        cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY)
        self._three = gtsam.noiseModel.Unit.Create(3)
        self._two = gtsam.noiseModel.Robust.Create(cauchy, gtsam.noiseModel.Unit.Create(2))

    def whiten(self, robot: int) -> Array:
        """What makes a robot's steps (n, 3, 3) those of unit variance."""
        return self._whiten[robot]

    def is_exact(self, landmark: int) -> bool:
        """Whether a landmark is where it is said to be, and so no variable."""
        return bool(self._exact[landmark])

    def step(self, robot: int, k: int) -> gtsam.CustomFactor:
        """The wheels' word on the way of a robot from keyframe k to the next, on both and on the wheels' errors."""
        model, W = self.models.wheels[robot], self._whiten[robot][k]
        (w00, _, _), (w10, w11, _), (w20, w21, w22) = W.tolist()
        a_key, b_key = pose_key(robot, k), pose_key(robot, k + 1)
        errors_key = self.wheels_variable(robot)

        def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
            a, b = values.atPose2(a_key), values.atPose2(b_key)
            errors = NO_ERRORS if errors_key is None else values.atVector(errors_key)
            yaw = a.theta()
            c, s = math.cos(yaw), math.sin(yaw)
            dx, dy = b.x() - a.x(), b.y() - a.y()
            x, y = c * dx + s * dy, -s * dx + c * dy
            delta, by_errors = model.step(k, errors)
            # in units of what the wheels say: with the noise fixed in metres, a smaller world would have less of it
            p, q = model.units(errors)
            e0, e1 = p * (x - delta[0]), p * (y - delta[1])
            e2 = q * math.remainder(b.theta() - yaw - delta[2], math.tau)
            if jacobians is not None:
                turn = b.theta() - yaw
                ct, st = p * math.cos(turn), p * math.sin(turn)
                jacobians[0] = W @ np.array([[-p, 0.0, p * y], [0.0, -p, -p * x], [0.0, 0.0, -q]])
                jacobians[1] = W @ np.array([[ct, -st, 0.0], [st, ct, 0.0], [0.0, 0.0, q]])
                if errors_key is not None:
                    (x0, y0, w0), (x1, y1, w1), (x2, y2, w2) = by_errors
                    jacobians[2] = W @ np.array(
                        [
                            [-p * (x0 + e0), -p * x1, -p * x2],
                            [-p * (y0 + e1), -p * y1, -p * y2],
                            [-q * w0, -q * (w1 + e2), -q * w2],
                        ]
                    )
            return np.array([w00 * e0, w10 * e0 + w11 * e1, w20 * e0 + w21 * e1 + w22 * e2])

        keys = [a_key, b_key] if errors_key is None else [a_key, b_key, errors_key]
        return gtsam.CustomFactor(self._three, keys, error)

    def measured(self, index: int) -> gtsam.CustomFactor:
        """A range and bearing, on the pose it was measured from, the target's, and the errors of the sensor."""
        m = self.drive.measured
        robot, target = int(m.robot[index]), int(m.target[index])
        model = self.models.ranging[robot]
        range_, bearing = float(m.range[index]), float(m.bearing[index])
        w_range, w_bearing = (
            math.sqrt(share) / (sigma * scale)
            for share, sigma, scale in zip(
                m.share[index].tolist(), model.sigmas(range_), self.noise[robot, :2].tolist(), strict=True
            )
        )
        key = pose_key(robot, int(m.keyframe[index]))
        landmark = target - len(self.drive.robots)
        of_robot = landmark < 0
        target_key: int | None = None
        there = (0.0, 0.0)
        if of_robot:
            target_key = pose_key(target, int(m.target_keyframe[index]))
        elif not self._exact[landmark]:
            target_key = landmark_key(landmark)
        else:
            there = (float(self.models.map[landmark, 0]), float(self.models.map[landmark, 1]))
        errors_key = self.ranging_variable(robot)

        def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
            pose = values.atPose2(key)
            errors = NOTHING_OFF if errors_key is None else values.atVector(errors_key)
            target_yaw = 0.0
            if target_key is None:
                tx, ty = there
            elif of_robot:
                other = values.atPose2(target_key)
                tx, ty, target_yaw = other.x(), other.y(), other.theta()
            else:
                tx, ty = values.atPoint2(target_key)
            yaw = pose.theta()
            c, s = math.cos(yaw), math.sin(yaw)
            dx, dy = tx - pose.x(), ty - pose.y()
            x, y = c * dx + s * dy, -s * dx + c * dy
            expected = model.expected(x, y, errors)
            if jacobians is not None:
                rx, ry = (w_range * one for one in expected.range_by_xy)
                bx, by = (w_bearing * one for one in expected.bearing_by_xy)
                jacobians[0] = np.array([[-rx, -ry, rx * y - ry * x], [-bx, -by, bx * y - by * x]])
                place = 1
                if target_key is not None:
                    # of the target's own axes, or the world's, in the body
                    turn = target_yaw - yaw
                    ct, st = math.cos(turn), math.sin(turn)
                    rows = [[rx * ct + ry * st, -rx * st + ry * ct], [bx * ct + by * st, -bx * st + by * ct]]
                    jacobians[1] = np.array([[*row, 0.0] for row in rows] if of_robot else rows)
                    place = 2
                if errors_key is not None:
                    jacobians[place] = np.array(
                        [
                            [w_range * one for one in expected.range_by_errors()],
                            [w_bearing * one for one in expected.bearing_by_errors()],
                        ]
                    )
            off = math.remainder(expected.bearing - bearing, math.tau)
            return np.array([w_range * (expected.range - range_), w_bearing * off])

        keys = [key, *(one for one in (target_key, errors_key) if one is not None)]
        return gtsam.CustomFactor(self._two, keys, error)

    def priors(self, robots: Iterable[int], landmarks: Iterable[int]) -> list[gtsam.NonlinearFactor]:
        """What is known before of some robots' wheels and sensors, and of some landmarks."""
        factors: list[gtsam.NonlinearFactor] = []
        for robot in robots:
            for key, sigmas in (
                (self.wheels_variable(robot), self.models.wheels_sigmas[robot]),
                (self.ranging_variable(robot), self.models.ranging_sigmas[robot]),
            ):
                if key is not None:
                    noise = gtsam.noiseModel.Diagonal.Sigmas(np.maximum(sigmas, LEAST_SIGMA))
                    factors.append(gtsam.PriorFactorVector(key, np.zeros(len(sigmas)), noise))
        for landmark in landmarks:
            if np.isfinite(self.models.map[landmark, 0]) and not self._exact[landmark]:
                isotropic = gtsam.noiseModel.Isotropic.Sigma(2, self.models.map_sigmas[landmark])
                factors.append(gtsam.PriorFactorPoint2(landmark_key(landmark), self.models.map[landmark], isotropic))
        return factors

    def gauge(self, key: int, pose: gtsam.Pose2) -> gtsam.NonlinearFactor:
        """What fixes the world's frame where no landmark does."""
        return gtsam.PriorFactorPose2(key, pose, gtsam.noiseModel.Isotropic.Sigma(3, GAUGE_SIGMA))

    def wheels_variable(self, robot: int) -> int | None:
        """The key of the errors of a robot's wheels; None where they are exact."""
        return wheels_key(robot) if self._has_wheels[robot] else None

    def ranging_variable(self, robot: int) -> int | None:
        """The key of the errors of a robot's sensor; None where it is exact."""
        return ranging_key(robot) if self._has_ranging[robot] else None

    def errors_in(self, robot: int, variable: Callable[[int], tuple[Array, Array]]) -> Errors:
        """What is off of a robot's wheels and sensor, given what is found of a variable by its key."""
        keys = self.wheels_variable(robot), self.ranging_variable(robot)
        wheels, ranging = (None if key is None else variable(key) for key in keys)
        return Errors(wheels, ranging)
