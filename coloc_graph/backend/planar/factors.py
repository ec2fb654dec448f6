"""Factors of a ranging run, linearised in batches: odometry, ranges and bearings, priors.

Variables are numbered: x, y and heading of all poses, robot after robot, then the shared ones: errors of wheels, errors
of sensors, positions of landmarks. Poses change along the world's axes.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.linear_system import Keys, Rows
from coloc_graph.backend.marginals import Marginals
from coloc_graph.backend.planar.filter import Models
from coloc_graph.backend.ranging import pose_key
from coloc_graph.backend.sensor_calibration import SensorErrors
from coloc_graph.backend.sensor_model import RANGING, WHEELS
from coloc_graph.geometry.se2 import wrap
from coloc_graph.measurements import Keyframes

Array = NDArray[np.float64]
Index = NDArray[np.int64]

SHARED = 1 << 40  # GTSAM's key of the first variable that is not a pose
EXACT_SIGMA = 1e-3  # m: tolerance of a landmark's position below which it is not estimated
UNKNOWN_SIGMA = 1e4  # m: prior of a landmark without a stated position, about the origin
GAUGE_SIGMA = 1e-4  # m, rad: prior that fixes the world frame where no landmark does
CAUCHY = 3.0  # sigmas: scale of the robust loss; a misread barcode is tens of sigmas off


@dataclass(frozen=True, eq=False)
class State:
    """Estimated variables: `poses` (n, 3) of all keyframes, NaN where there is none yet, and the `shared` ones (m,)."""

    poses: Array
    shared: Array


class KeyframeFactors:
    """Factors of a ranging run. `noise` (robots, 2) multiplies the standard deviations of ranges and bearings.

    `first` (robots + 1,) is each robot's first pose, `times` (n,) are the times of all. `observer` (m,) and `seen` (m,)
    are the poses of the observer and of the measured robot, -1 for landmarks. `free` is True of the shared variables
    that are estimated.
    """

    def __init__(self, keyframes: Keyframes, models: Models, noise: Array | None = None) -> None:
        self.keyframes, self.models = keyframes, models
        robots, landmarks = len(keyframes.robots), len(keyframes.landmarks)
        self.noise = np.ones((robots, 2)) if noise is None else noise
        self.first: Index = np.cumsum([0, *map(len, keyframes.times)])
        self.times = np.concatenate(keyframes.times)
        self.robot: Index = np.repeat(np.arange(robots), np.diff(self.first))
        m, zero = keyframes.measured, self.first[:-1] - np.array(keyframes.begins)
        self.of_robot = m.target < robots
        self.observer: Index = zero[m.robot] + m.keyframe
        self.seen: Index = np.where(self.of_robot, zero[np.minimum(m.target, robots - 1)] + m.target_keyframe, -1)
        known = np.isfinite(models.map[:, 0])
        self._exact: NDArray[np.bool_] = known & (models.map_sigmas < EXACT_SIGMA)
        self._ranging, self._marks = WHEELS * robots, (WHEELS + RANGING) * robots
        sigmas = [models.wheels_sigmas.ravel(), models.ranging_sigmas.ravel()]
        sigmas.append(np.repeat(np.where(known, models.map_sigmas, UNKNOWN_SIGMA), 2))
        self.sigmas = np.concatenate(sigmas)
        self.free: NDArray[np.bool_] = self.sigmas > 0
        self.free[self._marks :] = ~np.repeat(self._exact, 2)
        self._known_before = np.zeros(len(self.free))
        self._known_before[self._marks :] = np.where(known[:, None], models.map, 0.0).ravel()
        self._step_first: Index = np.cumsum([0, *map(len, models.wheels)])
        self._sigmas_measured = models.sensors.sigmas(m.robot, m.range)
        #: True if ranges are on the errors of two sensors: those of all are one key then, since a factor has three.
        self.radios = bool((models.sensors.two_way[m.robot] & self.of_robot).any())
        self._landmark: Index = np.maximum(m.target - robots, 0) if landmarks else np.zeros(len(m), int)

    def __len__(self) -> int:
        return len(self.times)

    @cached_property
    def _whiten(self) -> Array:
        """Inverses of the roots L of the covariances L L^T of all steps."""
        return np.linalg.inv(np.linalg.cholesky(np.concatenate([each.covariances for each in self.models.wheels])))

    def start(self) -> Array:
        """Return the prior means of the shared variables; landmarks of unknown positions at the origin."""
        return self._known_before.copy()

    def wheels(self, shared: Array) -> Array:
        """Return the errors of all wheels (robots, 3), a view of the shared variables."""
        return shared[: self._ranging].reshape(-1, WHEELS)

    def ranging(self, shared: Array) -> Array:
        """Return the errors of all sensors (robots, 7), a view of the shared variables."""
        return shared[self._ranging : self._marks].reshape(-1, RANGING)

    def landmarks(self, shared: Array) -> Array:
        """Return the positions of all landmarks (m, 2) [m], a view of the shared variables."""
        return shared[self._marks :].reshape(-1, 2)

    def is_exact(self, landmark: int) -> bool:
        """Return whether a landmark's position is exact, and not estimated."""
        return bool(self._exact[landmark])

    def steps_between(self, inside: NDArray[np.bool_]) -> Index:
        """Return the poses inside, of (n,), from which there are steps to others inside."""
        found: Index = np.flatnonzero(inside[:-1] & inside[1:] & (self.robot[:-1] == self.robot[1:]))
        return found

    def measured_between(self, inside: NDArray[np.bool_], landmarks: Collection[int]) -> Index:
        """Return the measurements between poses inside, of (n,), and of some landmarks and those that are exact."""
        placed = np.append(self._exact, False)
        placed[list(landmarks)] = True
        ends = np.append(inside, False)
        there = np.where(self.of_robot, ends[self.seen], placed[self._landmark])
        found: Index = np.flatnonzero(inside[self.observer] & there)
        return found

    def steps(self, state: State, poses: Index) -> Rows:
        """Linearise the odometry from some poses (n,), ascending, each to its robot's next."""
        a, b = state.poses[poses], state.poses[poses + 1]
        c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
        dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
        x, y = c * dx + s * dy, -s * dx + c * dy
        robots = self.robot[poses]
        errors = self.wheels(state.shared)
        said, by_errors, units = np.empty((len(poses), 3)), np.empty((len(poses), 3, 3)), np.empty((len(poses), 3))
        for robot in np.unique(robots).tolist():
            own = robots == robot
            model = self.models.wheels[robot]
            said[own], by_errors[own] = model.steps(poses[own] - self.first[robot], errors[robot])
            # in units of the odometry: with noise fixed in metres, a smaller world would fit better
            p, q = 1 / (model.wheels.scale + errors[robot, 0]), 1 / (model.wheels.turn_scale + errors[robot, 1])
            units[own] = p, p, q
        off = units * np.stack([x - said[:, 0], y - said[:, 1], wrap(b[:, 2] - a[:, 2] - said[:, 2])], axis=-1)
        J = np.zeros((len(poses), 3, 10))
        J[:, 0, 0], J[:, 0, 1], J[:, 0, 2] = -c, -s, y
        J[:, 1, 0], J[:, 1, 1], J[:, 1, 2] = s, -c, -x
        J[:, 2, 2] = -1.0
        J[:, :2, 3:5] = -J[:, :2, :2]
        J[:, 2, 5] = 1.0
        J[:, :, 6:9] = -by_errors
        J[:, :, :9] *= units[:, :, None]
        J[:, 0, 6] -= units[:, 0] * off[:, 0]
        J[:, 1, 6] -= units[:, 1] * off[:, 1]
        J[:, 2, 7] -= units[:, 2] * off[:, 2]
        J[:, :, 9] = off
        columns = np.concatenate(
            [3 * poses[:, None] + np.arange(6), self._shared(WHEELS * robots[:, None] + np.arange(WHEELS))], axis=1
        )
        whiten = self._whiten[self._step_first[robots] + poses - self.first[robots]]
        return Rows(whiten @ J, columns, (0, 3, 6))

    def measured(self, state: State, index: Index) -> Rows:
        """Linearise some ranges and bearings (n,), weighted by their shares of new information."""
        m, sensors = self.keyframes.measured, self.models.sensors
        robots, observer, of_robot = m.robot[index], self.observer[index], self.of_robot[index]
        seen, landmark = np.maximum(self.seen[index], 0), self._landmark[index]
        there = state.poses[seen]
        if len(self.keyframes.landmarks):
            there = np.where(of_robot[:, None], there, self.landmarks(state.shared)[landmark][:, [0, 1, 1]])
        targets = np.where(sensors.two_way[robots] & of_robot, m.target[index], -1) if self.radios else None
        found = sensors.between(robots, state.poses[observer], targets, there, self.ranging(state.shared), of_robot)
        off = np.stack([found.values[:, 0] - m.range[index], wrap(found.values[:, 1] - m.bearing[index])], axis=-1)
        errors, of_errors = found.by_errors, RANGING * robots[:, None] + np.arange(RANGING)
        if targets is not None and found.by_target_errors is not None:
            errors = np.zeros((len(index), 2, len(self.keyframes.robots), RANGING))
            rows = np.arange(len(index))
            errors[rows, :, robots] = found.by_errors
            errors[rows, :, targets] += found.by_target_errors  # 0 of those that are not two-way
            errors = errors.reshape(len(index), 2, self._marks - self._ranging)
            of_errors = np.broadcast_to(np.arange(errors.shape[2]), (len(index), errors.shape[2]))
        weights = np.sqrt(m.share[index]) / (self._sigmas_measured[index] * self.noise[robots])
        off = np.where(weights > 0, off, 0.0)  # a bearing that was not measured
        J = np.concatenate([found.by_pose, found.by_target, errors, off[:, :, None]], axis=2) * weights[:, :, None]
        ends, place = np.arange(3), self._shared(self._marks + 2 * landmark)[:, None] + np.array([0, 1, 1])
        columns = [3 * observer[:, None] + ends, np.where(of_robot[:, None], 3 * seen[:, None] + ends, place)]
        return Rows(J, np.concatenate([*columns, self._shared(self._ranging + of_errors)], axis=1), (0, 3, 6))

    def off(self, state: State) -> Array:
        """Return residuals (m, 2) of all measurements in units of their sigmas, without shares.

        NaN where an end has no pose, or where none was measured.
        """
        m = self.keyframes.measured
        with np.errstate(invalid="ignore"):
            return self.measured(state, np.arange(len(m))).residuals / np.sqrt(m.share)

    @cached_property
    def keys(self) -> Keys:
        """Keys of all variables: poses by their number, then wheels and sensors by robot, then landmarks.

        GTSAM's keys number the poses by keyframe and robot, and are the same whatever is in the window.
        """
        robots, landmarks = len(self.keyframes.robots), len(self.keyframes.landmarks)
        sensors = 1 if self.radios else robots
        of_sensors = RANGING * robots // max(sensors, 1)
        sizes = np.repeat([3, WHEELS, of_sensors, 2], [len(self), robots, sensors, landmarks])
        number = np.arange(len(self)) - self.first[self.robot] + np.array(self.keyframes.begins)[self.robot]
        names = np.concatenate(
            [pose_key(self.keyframes, self.robot, number), SHARED + np.arange(robots + sensors + landmarks)]
        )
        return Keys(names, sizes, np.concatenate([np.ones(3 * len(self), bool), self.free]))

    def values(self, state: State, names: Iterable[int]) -> gtsam.Values:
        """Return the values of some variables, by GTSAM's keys."""
        wanted, every, values = list(names), np.concatenate([state.poses.ravel(), state.shared]), gtsam.Values()
        for name, key in zip(wanted, self.keys.numbers(wanted).tolist(), strict=True):
            values.insert(name, every[self.keys.span(key)])
        return values

    def linear(self, state: State, rows: Iterable[Rows], *, priors: bool = True) -> gtsam.GaussianFactorGraph:
        """Return the linear factors of some rows, with the priors of the shared variables."""
        graph = gtsam.GaussianFactorGraph()
        for one in rows:
            self.keys.add(graph, one)
        for key in range(len(self), len(self.keys.sizes)) if priors else ():
            at = self.keys.span(key)
            own = slice(at.start - 3 * len(self), at.stop - 3 * len(self))
            self.keys.add_prior(graph, key, self.sigmas[own], (state.shared - self._known_before)[own])
        return graph

    def moved(self, state: State, found: gtsam.VectorValues, names: Sequence[int]) -> State:
        """Return the state after a step in some variables, by GTSAM's keys in ascending order."""
        poses, step = 3 * len(self), self.keys.step(found, names)
        return State(state.poses + step[:poses].reshape(-1, 3), state.shared + step[poses:])

    def shared_covariance(self, marginals: Marginals) -> Array:
        """Return the covariance (m, m) of the shared variables; 0 of exact ones."""
        shared = len(self.keys.sizes) - len(self)
        there = [name for name in range(SHARED, SHARED + shared) if marginals.has(name)]
        C = np.zeros((len(self.free),) * 2)
        if there:
            at = self.keys.variables(self.keys.numbers(there)) - 3 * len(self)
            C[np.ix_(at, at)] = marginals.joint(there)
        return C * self.free * self.free[:, None]

    def cost_before(self, state: State) -> float:
        """Return half chi2 of the priors of the shared variables."""
        off = (state.shared - self._known_before)[self.free] / self.sigmas[self.free]
        return 0.5 * float(off @ off)

    def gauge(self, state: State, pose: int, at: Array) -> Rows:
        """Return the prior of a pose (3,) that fixes the world frame where no landmark does."""
        J = np.zeros((1, 3, 4))
        J[0, :, :3], J[0, :, 3] = np.eye(3), state.poses[pose] - at
        return Rows(J / GAUGE_SIGMA, 3 * np.array([[pose]]) + np.arange(3), (0,))

    def errors_in(self, robot: int, shared: Array, covariance: Array) -> SensorErrors:
        """Return the errors of a robot's wheels and sensor, with the covariance (m, m) of the shared variables."""
        found = []
        for start, size, sigmas in (
            (WHEELS * robot, WHEELS, self.models.wheels_sigmas[robot]),
            (self._ranging + RANGING * robot, RANGING, self.models.ranging_sigmas[robot]),
        ):
            at = slice(start, start + size)
            found.append((shared[at], covariance[at, at]) if sigmas.any() else None)
        return SensorErrors(*found)

    def landmark_covariance(self, landmark: int, covariance: Array) -> Array:
        """Return the covariance (2, 2) of a landmark, from that of the shared variables (m, m)."""
        at = slice(self._marks + 2 * landmark, self._marks + 2 * landmark + 2)
        exact = np.eye(2) * self.models.map_sigmas[landmark] ** 2
        return exact if self._exact[landmark] else covariance[at, at]

    def _shared(self, numbers: Index) -> Index:
        return 3 * len(self) + numbers


def robust(rows: Rows) -> tuple[Rows, float]:
    """Return measurements with robust weights at their residuals (Cauchy), and their cost (half chi2)."""
    squared = (rows.residuals**2).sum(axis=1) / CAUCHY**2
    weighed = rows.jacobians / np.sqrt(1 + squared)[:, None, None]
    return rows._replace(jacobians=weighed), float(CAUCHY**2 / 2 * np.log1p(squared).sum())
