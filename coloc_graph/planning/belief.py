"""Poses, mounts and markers of a team with their joint covariance, and how leaps and stances change it; `Belief`."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.geometry.se2 import Planar, between, wrap
from coloc_graph.planning.slip import WheelErrors
from coloc_graph.team import Team

Array = NDArray[np.float64]

POSE = 6  # roll, pitch, yaw [rad], x, y, z [m] in the body frame
MOUNT = 6  # height [m], tilt, roll, yaw [rad], x, y [m] of a mount
OBSERVER = POSE + MOUNT  # numbers of an observer: pose, mount
BLOCK = OBSERVER + 2  # numbers of a robot: pose, mount, markers (span, height)
UNKNOWN = 1.0  # standard deviation of a pose that nothing is known of [m, rad]
FIXED = 1e-6  # standard deviation of the pose that defines the world [m, rad]
MIN_TILT_SIGMA = 1e-5  # a floor that is stated as flat is taken to be flat to this [rad, m]
BODY_LENGTH = 0.05  # a floor that tilts a body raises it by the tilt times this [m]

WHEELS = WheelErrors()
MIN_ODOMETRY_SIGMAS = (1e-3, 5e-4, 5e-4)  # wheel odometry is not taken to be better: heading [rad], x, y [m]


@dataclass(frozen=True, eq=False)
class Belief:
    """Poses of robots in the world, and the joint covariance (..., 14 n, 14 n) of all that is unknown of them.

    Of each robot in turn: pose (6,) in GTSAM's tangent, rotation first, body frame; mount (6,): height [m], tilt, roll,
    yaw [rad], x, y [m]; markers (2,): span (relative), height [m].

    `leapt` are the distances of the planned leaps to where robots stand [m], without those whose place is known.
    """

    robots: tuple[str, ...]
    poses: Mapping[str, Planar]
    covariance: Array
    floor: tuple[float, float]
    leapt: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def start(cls, team: Team, poses: Mapping[str, Planar]) -> "Belief":
        """Return what is known before the first stance: calibrations as stated, and the reference's pose.

        Raises
        ------
        InputError
            If the team states no floor.
        """
        if team.floor is None:
            raise InputError("plans are made for teams on a floor: give the team a [floor]")
        robots = tuple(poses)
        tilt = max(math.radians(team.floor.tilt_sigma_deg), MIN_TILT_SIGMA)
        height = max(team.floor.height_sigma, tilt * BODY_LENGTH, MIN_TILT_SIGMA)
        sigmas = np.zeros(BLOCK * len(robots))
        for n, name in enumerate(robots):
            robot, free = team[name], FIXED if name == team.reference else UNKNOWN
            at = BLOCK * n
            sigmas[at : at + POSE] = tilt, tilt, free, free, free, height
            if (mount := robot.mount_if_any) is not None:
                turned = np.radians([mount.tilt_sigma_deg, mount.roll_sigma_deg, mount.yaw_sigma_deg])
                sigmas[at + POSE : at + OBSERVER] = mount.height_sigma, *turned, *2 * (mount.position_sigma,)
            if robot.markers is not None and robot.markers.span:
                relative = robot.markers.span_sigma / robot.markers.span
                sigmas[at + OBSERVER : at + BLOCK] = relative, robot.markers.height_sigma
        return cls(robots, dict(poses), np.diag(sigmas**2), (tilt, height))

    def index(self, robot: str) -> int:
        """Return the row at which a robot's block begins."""
        return BLOCK * self.robots.index(robot)

    def rows(self, observers: Sequence[str], mover: str) -> NDArray[np.int64]:
        """Return the rows of a stance's variables, in the order of `StanceModel`."""
        blocks = [self.index(name) + np.arange(OBSERVER) for name in observers]
        return np.concatenate([*blocks, self.index(mover) + np.array([OBSERVER, OBSERVER + 1])])

    def after_leap(self, robot: str, target: Planar, wheels: WheelErrors | None = WHEELS) -> "Belief":
        """Return what is known once a robot has driven to a target in the world; without `wheels`, without odometry."""
        D, at = between(self.poses[robot], target), self.index(robot)
        F, Q = leap_model(D, self.floor, wheels)
        block = np.eye(self.covariance.shape[-1])
        block[at : at + POSE, at : at + POSE] = F
        covariance = block @ self.covariance @ block.T
        covariance[..., at : at + POSE, at : at + POSE] += Q
        leapt = {**self.leapt, robot: math.hypot(D[0], D[1])}
        return replace(self, poses={**self.poses, robot: target}, covariance=covariance, leapt=leapt)

    def after_stance(self, observers: Sequence[str], mover: str, information: Array) -> "Belief":
        """Return what is known once a stance has brought `information` (d, d) on its variables."""
        return replace(self, covariance=updated(self.covariance, self.rows(observers, mover), information))

    def position_covariance(self, robot: str) -> Array:
        """Covariance (..., 2, 2) of a robot's position in the world [m^2]."""
        c, s = math.cos(self.poses[robot][2]), math.sin(self.poses[robot][2])
        R, at = np.array([[c, -s], [s, c]]), self.index(robot) + 3
        return np.asarray(R @ self.covariance[..., at : at + 2, at : at + 2] @ R.T)

    def planar_covariance(self, robot: str) -> Array:
        """Covariance (3, 3) of a robot's x, y [m] in the world and yaw [rad]."""
        c, s = math.cos(self.poses[robot][2]), math.sin(self.poses[robot][2])
        R, at = np.array([[0.0, c, -s], [0.0, s, c], [1.0, 0.0, 0.0]]), self.index(robot) + 2
        return np.asarray(R @ self.covariance[at : at + 3, at : at + 3] @ R.T)

    def position_sigma(self, robots: Sequence[str]) -> float:
        """Root of the mean, over robots, of the trace of the positions' covariances [m]."""
        return math.sqrt(np.mean([np.trace(self.position_covariance(name)) for name in robots]))

    def heading_sigma(self, robots: Sequence[str]) -> float:
        """Root of the mean variance of the robots' headings [rad]."""
        rows = [self.index(name) + 2 for name in robots]
        return math.sqrt(np.mean([self.covariance[n, n] for n in rows]))

    def end_variance(self, robots: Sequence[str], goal: tuple[float, float]) -> float:
        """Mean variance of a point at the `goal` x, y [m] that moves with each robot [m^2].

        This is the position's covariance, and the heading's times the square of the way that remains.
        """
        return float(np.mean([np.trace(J @ self.covariance @ J.T) for J in self.goal_rows(robots, goal)]))

    def goal_rows(self, robots: Sequence[str], goal: tuple[float, float]) -> list[Array]:
        """Derivatives (2, 14 n) of a point at the goal that moves with a robot, of each robot."""
        rows = []
        for name in robots:
            (x, y, yaw), at = self.poses[name], self.index(name)
            c, s = math.cos(yaw), math.sin(yaw)
            J = np.zeros((2, self.covariance.shape[-1]))
            J[:, at + 3 : at + 5] = [[c, -s], [s, c]]
            J[:, at + 2] = y - goal[1], goal[0] - x
            rows.append(J)
        return rows


def updated(covariance: Array, rows: NDArray[np.int64], information: Array) -> Array:
    """Return covariances (..., n, n) once there is information (..., d, d) on `rows` of their variables."""
    P = covariance[..., :, rows]
    S = np.eye(len(rows)) + information @ covariance[..., rows[:, None], rows]
    gain = P @ np.linalg.solve(S, information)
    new = covariance - gain @ P.mT
    return np.asarray((new + new.mT) / 2)


def leap_model(D: Planar, floor: tuple[float, float], wheels: WheelErrors | None = WHEELS) -> tuple[Array, Array]:
    """Return how a leap D = T_before_after changes a pose's error, (6, 6), and the covariance (6, 6) that it adds.

    The robot turns towards its target, drives straight, and turns to its new heading; `floor` are sigmas of tilt [rad]
    and height [m], which are drawn anew where it stands.
    """
    distance, first = math.hypot(D[0], D[1]), math.atan2(D[1], D[0])
    second = wrap(D[2] - first)
    c, s = math.cos(D[2]), math.sin(D[2])
    F = np.zeros((POSE, POSE))
    F[2, 2] = 1.0
    # xi' = Ad(D^-1) xi: what is off in the heading before moves the place after
    F[3:5, 3:5] = [[c, s], [-s, c]]
    F[3:5, 2] = np.array([[c, s], [-s, c]]) @ [-D[1], D[0]]
    Q = np.diag([floor[0] ** 2, floor[0] ** 2, 0.0, 0.0, 0.0, floor[1] ** 2])
    if wheels is None:
        Q[2:5, 2:5] = UNKNOWN**2 * np.eye(3)
        return F, Q
    turned, veer = wheels.turned**2 * abs(first), wheels.veer**2 * distance
    # along and across the line that it drives, then in the body after the second turn
    line = np.zeros((3, 3))
    line[0, 0] = turned + veer + wheels.turned**2 * abs(second)
    line[1, 1] = wheels.along**2 * distance
    line[2, 2] = (turned + veer / 3) * distance**2
    line[0, 2] = line[2, 0] = (turned + veer / 2) * distance
    c, s = math.cos(second), math.sin(second)
    R = np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])
    Q[2:5, 2:5] = R @ line @ R.T + np.diag(np.square(MIN_ODOMETRY_SIGMAS))
    return F, Q
