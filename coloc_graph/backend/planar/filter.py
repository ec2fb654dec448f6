"""Centralised EKF of a ranging run: current poses, and the initial values of the optimisation.

It estimates robots, landmarks and errors of wheels and sensors, and needs no initial poses: a robot gets one when its
first measurements determine it. Sources: Leung, Barfoot, Liu, "Decentralized localization of sparsely-communicating
robot networks", 2010 (its centralised filter); Smith, Self, Cheeseman, "Estimating uncertain spatial relationships in
robotics", 1990.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.planar.initial_pose import RigidAlignmentRansac
from coloc_graph.backend.planar.range_alignment import RangeAlignment
from coloc_graph.backend.sensor_model import (
    RANGING,
    WHEELS,
    Pose,
    Sensors,
    WheelsModel,
)
from coloc_graph.geometry.se2 import between, compose, wrap
from coloc_graph.measurements import Keyframes
from coloc_graph.team import Ranging, Team, Wheels

Array = NDArray[np.float64]

INNOVATION_GATES = (15.1, 18.4)  # squared Mahalanobis distance of one and two dimensions that has a p-value of 1e-4
ALIGNMENT_PERIOD = 0.5  # s between ranges of one pair without a bearing, by which something is placed
INITIAL_PERIOD = 1.0  # s between measurements of one target by one robot, for initial values
INITIAL_SIGMAS = (0.15, 0.15, 0.1)  # m, m, rad: of a robot's initial pose
LANDMARK_SIGMA = 30.0  # m: of a landmark's initial position
#: Reason for which a robot has no pose.
UNLOCATED = "measure it together with two robots or landmarks of known positions, several times"


class Models:
    """Wheels and sensors of a team, with the tolerances of their errors."""

    def __init__(self, team: Team, keyframes: Keyframes) -> None:
        self.team = team
        robots = [team[name] for name in keyframes.robots]
        self.wheels = [
            WheelsModel(steps, robot.wheels or Wheels()) for robot, steps in zip(robots, keyframes.steps, strict=True)
        ]
        self.sensors = Sensors([robot.ranging or Ranging(range_sigma=1.0, bearing_sigma_deg=1.0) for robot in robots])
        self.wheels_sigmas = np.array(
            [(m.wheels.scale_sigma, m.wheels.turn_scale_sigma, m.wheels.delay_sigma) for m in self.wheels]
        )
        self.ranging_sigmas = self.sensors.tolerances
        positions = {one.name: one for one in team.landmarks}
        known = [positions[name] for name in keyframes.landmarks]
        self.map = np.array([one.position or (math.nan, math.nan) for one in known], float).reshape(-1, 2)
        self.map_sigmas = np.array([one.position_sigma for one in known], float)

    @property
    def map_known(self) -> bool:
        """True if a landmark's position is stated: the world is then the map."""
        return bool(np.isfinite(self.map).any())


def filter_forward(team: Team, keyframes: Keyframes, *, period: float = 0.0) -> "Filter":
    """Run the filter over all keyframes and measurements, in the order of time; `period` as of `Filter`."""
    one = Filter(team, keyframes, period)
    for index in range(len(keyframes.measured)):
        one.take(index)
    for robot, times in enumerate(keyframes.times):
        one.go(robot, len(times) - 1)
    return one


def aligned(values: Sequence[Array], before: Keyframes, now: Keyframes) -> list[Array]:
    """Return values (n, ...) by robot of the keyframes `now`, from those of the keyframes `before`; NaN of new ones."""
    found = []
    for one, old, begin, times in zip(values, before.begins, now.begins, now.times, strict=True):
        there = one[begin - old :]
        found.append(np.concatenate([there, np.full((len(times) - len(there), *one.shape[1:]), np.nan)]))
    return found


def unlocated(team: Team, keyframes: Keyframes) -> dict[str, str]:
    """Return by robot that no measurements locate what would; it ends as soon as all are located."""
    one = Filter(team, keyframes, INITIAL_PERIOD)
    for index in range(len(keyframes.measured)):
        if len(one.placed_at) == len(keyframes.robots):
            break
        one.take(index)
    return one.unlocated()


class Filter:
    """EKF whose state is the robots, their calibration errors and the landmarks.

    A target is used by a robot once a `period` [s] when both have poses: initial values need no more.

    `poses` (n, 3) and `covariances` (n, 3, 3) of each robot's keyframes are those at their times, NaN before its
    initial pose, at the keyframe `placed_at`; `used` (k,) are the measurements that were used.
    """

    def __init__(self, team: Team, keyframes: Keyframes, period: float = 0.0) -> None:
        self._period, self._used_at = period, dict[tuple[int, int], float]()
        self.keyframes, self.models = keyframes, Models(team, keyframes)
        robots, landmarks = len(keyframes.robots), len(keyframes.landmarks)
        self._robots = robots
        self._wheels, self._ranging = 3 * robots, (3 + WHEELS) * robots
        self._marks = self._ranging + RANGING * robots
        size = self._marks + 2 * landmarks
        self.mean, self.P = np.zeros(size), np.zeros((size, size))
        self.P[self._wheels : self._marks, self._wheels : self._marks] = np.diag(
            np.concatenate([self.models.wheels_sigmas.ravel(), self.models.ranging_sigmas.ravel()]) ** 2
        )
        self._known = np.isfinite(self.models.map[:, 0])
        for n in np.flatnonzero(self._known):
            at = slice(self._marks + 2 * n, self._marks + 2 * n + 2)
            self.mean[at] = self.models.map[n]
            self.P[at, at] = np.eye(2) * self.models.map_sigmas[n] ** 2
        self._at = [0] * robots
        self._placed = [False] * robots
        self._placing = [RigidAlignmentRansac() for _ in range(robots)]
        self._aligning: dict[int, RangeAlignment] = {}  # by robot, or number of robots plus landmark
        self._aligned_at: dict[tuple[int, int], float] = {}
        # odometry pose of each robot in a frame of its own, until it has an initial pose
        self._own: list[Pose] = [(0.0, 0.0, 0.0)] * robots
        reference = keyframes.robots.index(team.reference)
        if not self.models.map_known:
            self._placed[reference] = True
        self.poses = [np.full((len(t), 3), np.nan) for t in keyframes.times]
        self.covariances = [np.full((len(t), 3, 3), np.nan) for t in keyframes.times]
        self.used = np.zeros(len(keyframes.measured), bool)
        self.placed_at: dict[int, int] = {}
        if not self.models.map_known:
            self.placed_at[reference] = 0
            self._note(reference)

    @property
    def landmarks(self) -> Array:
        """Positions (m, 2) of the landmarks [m]; NaN of those that were never seen."""
        return np.where(self._known[:, None], self.mean[self._marks :].reshape(-1, 2), np.nan)

    @property
    def wheels(self) -> Array:
        """Errors (robots, 3) of the wheels."""
        return self.mean[self._wheels : self._ranging].reshape(-1, WHEELS)

    @property
    def ranging(self) -> Array:
        """Errors (robots, 7) of the sensors."""
        return self.mean[self._ranging : self._marks].reshape(-1, RANGING)

    def whole(self) -> list[Array]:
        """Return the poses of all keyframes, those before a robot's initial pose by odometry backwards."""
        out = []
        for robot, poses in enumerate(self.poses):
            poses = poses.copy()
            for k in range(self.placed_at.get(robot, 0) - 1, -1, -1):
                delta, _ = self.models.wheels[robot].step(k, self.wheels[robot])
                back = between(delta, (0.0, 0.0, 0.0))
                poses[k] = compose(_pose(poses[k + 1]), back)
            out.append(poses)
        return out

    def take(self, index: int) -> None:
        """Process the next measurement."""
        m = self.keyframes.measured
        robot, target, time = int(m.robot[index]), int(m.target[index]), float(m.time[index])
        if time - self._used_at.get((robot, target), -math.inf) < self._period:
            return
        begins = self.keyframes.begins
        self.go(robot, int(m.keyframe[index]) - begins[robot])
        if target < self._robots:
            self.go(target, int(m.target_keyframe[index]) - begins[target])
        range_, bearing = float(m.range[index]), float(m.bearing[index])
        both = (self._knows(robot) and self._knows(target)) or (
            self._align(robot, target, range_, time)
            if math.isnan(bearing)
            else self._ready(robot, target, range_, bearing)
        )
        if both:
            self.used[index] = self._update(robot, target, range_, bearing, m.share[index].tolist())
            if self.used[index]:
                self._used_at[robot, target] = time

    def follow(self, keyframes: Keyframes, models: "Models") -> None:
        """Go on with keyframes of which more have come, and older ones have left."""
        left = np.subtract(keyframes.begins, self.keyframes.begins).tolist()
        for robot, gone in enumerate(left):
            self.go(robot, gone)
            self._at[robot] -= gone
        self.poses = aligned(self.poses, self.keyframes, keyframes)
        self.covariances = aligned(self.covariances, self.keyframes, keyframes)
        self.placed_at = {robot: max(at - left[robot], 0) for robot, at in self.placed_at.items()}
        self.used = np.zeros(len(keyframes.measured), bool)
        self.keyframes, self.models = keyframes, models
        for robot in self.placed_at:
            self._note(robot)

    @property
    def is_complete(self) -> bool:
        """True if all robots and landmarks have initial values."""
        return all(self._placed) and bool(self._known.all())

    def landmark(self, number: int) -> Array | None:
        """Return the position (2,) of a landmark [m]; None while it is not known."""
        at = self._marks + 2 * number
        return self.mean[at : at + 2] if self._known[number] else None

    def unlocated(self) -> dict[str, str]:
        """Return by robot that has no pose what would give it one."""
        return {
            name: self._aligning[n].why if n in self._aligning else UNLOCATED
            for n, name in enumerate(self.keyframes.robots)
            if n not in self.placed_at
        }

    def _knows(self, target: int) -> bool:
        """Return whether a robot has a pose, or a landmark (the number of robots plus its own) a position."""
        return self._placed[target] if target < self._robots else bool(self._known[target - self._robots])

    def _ready(self, robot: int, target: int, range_: float, bearing: float) -> bool:
        """Use a measurement for the initial pose of one of its ends; return whether it may update both."""
        is_robot = target < self._robots
        seen = self.models.sensors.place(robot, range_, bearing, is_robot)
        if not self._placed[robot]:
            if self._knows(target):
                self._place(robot, compose(self._own[robot], (*seen, 0.0))[:2], self._point(target))
            return False
        world = compose(self._pose(robot), (*seen, 0.0))[:2]
        if is_robot:
            self._place(target, self._own[target][:2], world)
            return False
        self._place_landmark(target, world, LANDMARK_SIGMA)
        return True

    def _align(self, robot: int, target: int, range_: float, time: float) -> bool:
        """Use a range without a bearing as `_ready` does; no end has an initial pose that it may update."""
        placed = self._placed[robot]
        if placed == self._knows(target) or time - self._aligned_at.get((robot, target), -math.inf) < ALIGNMENT_PERIOD:
            return False
        self._aligned_at[robot, target] = time
        sensors, is_robot = self.models.sensors, target < self._robots
        antenna = sensors.antenna(robot)
        other = sensors.antenna(target) if is_robot and sensors.two_way[robot] else (0.0, 0.0)
        loose = target if placed else robot
        world = self._point(robot, antenna) if placed else self._point(target, other)
        own = (0.0, 0.0)
        if loose < self._robots:
            own = compose(self._own[loose], (*(other if placed else antenna), 0.0))[:2]
        aligning = self._aligning.setdefault(loose, RangeAlignment(turns=loose < self._robots))
        sigmas = [sensors.ranging[robot].range_sigma, sensors.ranging[robot].offset_sigma]
        aligning.add(own, world, sensors.distance(robot, range_, target if is_robot else None), math.hypot(*sigmas))
        pose = aligning.pose()
        if pose is not None and loose < self._robots:
            self._begin(loose, pose)
        elif pose is not None:
            self._place_landmark(loose, pose[:2], INITIAL_SIGMAS[0])
        return False

    def _point(self, target: int, antenna: tuple[float, float] = (0.0, 0.0)) -> tuple[float, float]:
        """Return the position of a landmark, or of a point of a robot's body [m]."""
        if target < self._robots:
            return compose(self._pose(target), (*antenna, 0.0))[:2]
        at = self._marks + 2 * (target - self._robots)
        return float(self.mean[at]), float(self.mean[at + 1])

    def _place_landmark(self, target: int, world: tuple[float, float], sigma: float) -> None:
        at = self._marks + 2 * (target - self._robots)
        self.mean[at : at + 2] = world
        self.P[at : at + 2, at : at + 2] = np.eye(2) * sigma**2
        self._known[target - self._robots] = True

    def _place(self, robot: int, local: tuple[float, float], world: tuple[float, float]) -> None:
        self._placing[robot].add(local, world)
        frame = self._placing[robot].pose()
        if frame is not None:
            self._begin(robot, frame)

    def _begin(self, robot: int, frame: Pose) -> None:
        """Give a robot its initial pose, by that of its own frame in the world."""
        at = slice(3 * robot, 3 * robot + 3)
        self.mean[at] = compose(frame, self._own[robot])
        self.P[at, at] = np.diag(np.square(INITIAL_SIGMAS))
        self._placed[robot] = True
        self.placed_at[robot] = self._at[robot]
        self._note(robot)

    def _pose(self, robot: int) -> Pose:
        return _pose(self.mean[3 * robot : 3 * robot + 3])

    def _note(self, robot: int) -> None:
        k, at = self._at[robot], slice(3 * robot, 3 * robot + 3)
        if k < len(self.poses[robot]):  # a robot that defines the world may have no keyframe yet
            self.poses[robot][k], self.covariances[robot][k] = self.mean[at], self.P[at, at]

    def go(self, robot: int, k: int) -> None:
        """Predict a robot's pose by odometry up to a keyframe."""
        model = self.models.wheels[robot]
        of_errors = slice(self._wheels + WHEELS * robot, self._wheels + WHEELS * (robot + 1))
        at = slice(3 * robot, 3 * robot + 3)
        first = self._at[robot]
        if first >= k:
            return
        deltas, derivatives = model.steps(slice(first, k), self.mean[of_errors])
        for step, delta, by_errors in zip(range(first, k), deltas.tolist(), derivatives, strict=True):
            self._at[robot] += 1
            if not self._placed[robot]:
                self._own[robot] = compose(self._own[robot], delta)
                continue
            _, _, yaw = self._pose(robot)
            c, s = math.cos(yaw), math.sin(yaw)
            R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            F = np.eye(3)
            F[0, 2], F[1, 2] = -s * delta[0] - c * delta[1], c * delta[0] - s * delta[1]
            self.mean[at] = compose(self._pose(robot), delta)
            rows = F @ self.P[at] + (R @ by_errors) @ self.P[of_errors]
            own = rows[:, at] @ F.T + rows[:, of_errors] @ (R @ by_errors).T
            self.P[at], self.P[:, at] = rows, rows.T
            self.P[at, at] = own + R @ model.covariances[step] @ R.T
            self._note(robot)

    def _update(self, robot: int, target: int, range_: float, bearing: float, share: list[float]) -> bool:
        is_robot, sensors = target < self._robots, self.models.sensors
        to = 3 * target if is_robot else self._marks + 2 * (target - self._robots)
        one, targets = np.array([robot]), np.array([target]) if is_robot and sensors.two_way[robot] else None
        there, pose = self.mean[None, [to, to + 1, to + 1 + is_robot]], self.mean[None, 3 * robot : 3 * robot + 3]
        found = sensors.between(one, pose, targets, there, self.ranging, np.array([is_robot]))
        parts = [found.by_pose[0], found.by_target[0, :, : 2 + is_robot], found.by_errors[0]]
        begin = self._ranging + RANGING * robot
        columns = [
            3 * robot,
            3 * robot + 1,
            3 * robot + 2,
            *range(to, to + 2 + is_robot),
            *range(begin, begin + RANGING),
        ]
        if found.by_target_errors is not None:
            parts.append(found.by_target_errors[0])
            columns += range(self._ranging + RANGING * target, self._ranging + RANGING * (target + 1))
        H = np.hstack(parts)
        PH = self.P[:, columns] @ H.T
        variances = (sensors.sigmas(one, np.array([range_]))[0] ** 2).tolist()
        S, off = PH[columns].T @ H.T, np.array([range_, bearing]) - found.values[0]
        if math.isnan(bearing):
            information, PH, off = 1 / (S[:1, :1] + variances[0] / share[0]), PH[:, :1], off[:1]
        else:
            off[1] = wrap(off[1])
            (a, b), (_, d) = S.tolist()
            a, d = a + variances[0] / share[0], d + variances[1] / share[1]
            information = np.array([[d, -b], [-b, a]]) / (a * d - b * b)  # a third of the time of `linalg.solve`
        if off @ information @ off > INNOVATION_GATES[len(off) - 1]:
            return False
        gain = PH @ information
        self.mean += gain @ off
        self.P -= gain @ PH.T
        self._note(robot)
        if is_robot:
            self._note(target)
        return True


def _pose(values: Array) -> Pose:
    x, y, yaw = values.tolist()
    return x, y, yaw
