"""A drive as it happens: ISAM2 over the last seconds, whose older poses are summed up: `IncrementalDrive`.

A filter goes along for where robots and landmarks first appear. What is estimated of a keyframe is kept twice: at its
time, and as it leaves the window, by when what came after it has had its say.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.planar.estimate import DriveEstimate, Errors, trajectory
from coloc_graph.backend.planar.factors import DriveFactors, landmark_key, pose_key
from coloc_graph.backend.planar.filter import Filter
from coloc_graph.backend.planar.model import compose
from coloc_graph.backend.planar.summary import Found, summed_up
from coloc_graph.keyframes import Drive
from coloc_graph.team import Team
from coloc_graph.trajectory import Trajectory

Array = NDArray[np.float64]

#: Poses this far back are still corrected [s], and what came in meanwhile is taken in so often [s].
LAG, EVERY = 20.0, 1.0
#: Covariances of a robot's keyframes closer than this [s] are those of the first of them: they change slowly.
ALIKE = 0.5
#: A variable is linearised anew where it has changed by more than this: poses [m, rad], errors and landmarks.
MOVED, TURNED, CHANGED = 0.1, 0.05, 0.05


@dataclass(frozen=True, eq=False)
class Latest:
    """Where the robots are at a time [UTC s]: by name, (x, y, heading), and its covariance (3, 3) in the body frame."""

    time: float
    poses: dict[str, tuple[Array, Array]]


class IncrementalDrive:
    """Estimates a drive in the order of time: `advance` takes in what was measured until a time."""

    def __init__(self, team: Team, drive: Drive, *, lag: float = LAG) -> None:
        self.drive, self._lag = drive, lag
        self._filter = Filter(team, drive)
        self._factors = DriveFactors(drive, self._filter.models)
        parameters = gtsam.ISAM2Params()
        parameters.setFactorization("CHOLESKY")
        parameters.relinearizeSkip = 1
        parameters.findUnusedFactorSlots = True
        thresholds = gtsam.ISAM2ThresholdMap()
        for kind, size in (
            ("x", [MOVED, MOVED, TURNED]),
            ("l", [CHANGED] * 2),
            ("w", [CHANGED] * 3),
            ("r", [CHANGED] * 5),
        ):
            thresholds.insert((kind, np.array(size)))
        parameters.setRelinearizeThreshold(thresholds)
        self._smoother = gtsam.IncrementalFixedLagSmoother(lag, parameters)
        robots = len(drive.robots)
        self._entered = [0] * robots  # how many keyframes of each are in
        self._left = [0] * robots  # and how many have left again
        self._newest: list[tuple[float, float, float]] = [(0.0, 0.0, 0.0)] * robots
        self._landmarks: set[int] = set()
        self._next = 0
        self._waiting: list[int] = []
        self._taken = np.zeros(len(drive.measured), bool)
        self._smoothed = [np.full((len(times), 3), np.nan) for times in drive.times]
        self._online = [np.full((len(times), 3), np.nan) for times in drive.times]
        self._smoothed_C = [np.full((len(times), 3, 3), np.nan) for times in drive.times]
        self._online_C = [np.full((len(times), 3, 3), np.nan) for times in drive.times]

    def advance(self, time: float) -> Latest:
        """Take in all that was measured before a time [UTC s]; where the robots are then."""
        m = self.drive.measured
        while self._next < len(m) and m.time[self._next] < time:
            self._filter.take(self._next)
            self._waiting.append(self._next)
            self._next += 1
        graph, values, stamps = gtsam.NonlinearFactorGraph(), gtsam.Values(), dict[int, float]()
        first = self._enter_robots(time, graph, values, stamps)
        self._enter_measured(time, graph, values, stamps)
        for robot, count in enumerate(self._entered):
            if count:
                stamps[pose_key(robot, count - 1)] = time
                variables = self._factors.wheels_variable(robot), self._factors.ranging_variable(robot)
                stamps |= {key: time for key in variables if key is not None}
        stamps |= {landmark_key(number): time for number in self._landmarks}
        if not stamps:
            return Latest(time, {})
        self._note_leaving(time)
        self._smoother.update(graph, values, gtsam.FixedLagSmootherKeyTimestampMap(stamps))
        return self._latest(time, first)

    def _enter_robots(
        self, time: float, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, stamps: dict[int, float]
    ) -> list[int]:
        """New keyframes of the robots that have a place; how many each had before."""
        drive, factors = self.drive, self._factors
        before = list(self._entered)
        for robot, times in enumerate(drive.times):
            if robot not in self._filter.out.placed_at:
                continue
            until = int(np.searchsorted(times, time))
            if not self._entered[robot] and until:
                self._enter_first(robot, until, graph, values, stamps, time)
            model = factors.models.wheels[robot]
            errors = self._errors(robot)
            for k in range(self._entered[robot], until):
                delta, _ = model.step(k - 1, errors)
                self._newest[robot] = compose(self._newest[robot], delta)
                values.insert(pose_key(robot, k), gtsam.Pose2(*self._newest[robot]))
                graph.add(factors.step(robot, k - 1))
                stamps[pose_key(robot, k)] = float(times[k])
            self._entered[robot] = max(until, self._entered[robot])
        return before

    def _enter_first(
        self,
        robot: int,
        until: int,
        graph: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        stamps: dict[int, float],
        time: float,
    ) -> None:
        """All keyframes so far of a robot that has just been placed, its errors, and what is known of them."""
        factors = self._factors
        for key, size in ((factors.wheels_variable(robot), 3), (factors.ranging_variable(robot), 5)):
            if key is not None:
                values.insert(key, np.zeros(size))
        for prior in factors.priors([robot], []):
            graph.add(prior)
        poses = self._filter.out.whole(self.drive, factors.models)[robot]
        if not factors.models.map_known and not any(self._entered):
            graph.add(factors.gauge(pose_key(robot, 0), gtsam.Pose2(*poses[0].tolist())))
        known = min(until, int(np.isfinite(poses[:, 0]).sum()))
        for k in range(known):
            values.insert(pose_key(robot, k), gtsam.Pose2(*poses[k].tolist()))
            stamps[pose_key(robot, k)] = time
            if k:
                graph.add(factors.step(robot, k - 1))
        x, y, yaw = poses[known - 1].tolist()
        self._entered[robot], self._newest[robot] = known, (x, y, yaw)

    def _enter_measured(
        self, time: float, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, stamps: dict[int, float]
    ) -> None:
        """What was measured between what is in; what is measured of robots without a place waits for it."""
        m, robots, factors = self.drive.measured, len(self.drive.robots), self._factors
        waiting = []
        for index in self._waiting:
            ends = [(int(m.robot[index]), int(m.keyframe[index]))]
            target = int(m.target[index])
            if target < robots:
                ends.append((target, int(m.target_keyframe[index])))
            if any(k < self._left[robot] for robot, k in ends):
                continue  # it came too late
            if any(k >= self._entered[robot] for robot, k in ends):
                waiting.append(index)
                continue
            landmark = target - robots
            if landmark >= 0 and not factors.is_exact(landmark) and landmark not in self._landmarks:
                place = self._filter.landmark(landmark)
                if place is None:
                    waiting.append(index)
                    continue
                values.insert(landmark_key(landmark), place)
                self._landmarks.add(landmark)
                for prior in factors.priors([], [landmark]):
                    graph.add(prior)
            graph.add(factors.measured(index))
            self._taken[index] = True
        self._waiting = waiting

    def _errors(self, robot: int) -> Array:
        key = self._factors.wheels_variable(robot)
        if key is None or not self._smoother.getLinearizationPoint().exists(key):
            return np.zeros(3)
        return np.asarray(self._smoother.calculateEstimateVector(key))

    def _note_leaving(self, time: float) -> None:
        """Keep what is estimated of keyframes that the next update leaves behind."""
        for robot, times in enumerate(self.drive.times):
            last = self._entered[robot] - 1
            while self._left[robot] < last and times[self._left[robot]] < time - self._lag:
                k = self._left[robot]
                if not self._note(self._smoothed, self._smoothed_C, robot, k):
                    break
                self._left[robot] += 1

    def _note(self, poses: list[Array], covariances: list[Array], robot: int, k: int) -> bool:
        key = pose_key(robot, k)
        if not self._smoother.getLinearizationPoint().exists(key):
            return False
        pose = self._smoother.calculateEstimatePose2(key)
        poses[robot][k] = pose.x(), pose.y(), pose.theta()
        times, C = self.drive.times[robot], covariances[robot]
        first = int(np.searchsorted(times, times[k] - ALIKE))
        if first < k and np.isfinite(C[first, 0, 0]) and np.array_equal(C[first], C[k - 1]):
            C[k] = C[k - 1]
        else:
            C[k] = self._smoother.marginalCovariance(key)
        return True

    def _latest(self, time: float, before: list[int]) -> Latest:
        """Where the robots are, and what is to be kept of their new keyframes."""
        latest = {}
        for robot, name in enumerate(self.drive.robots):
            k = self._entered[robot] - 1
            if k >= before[robot]:
                self._note(self._online, self._online_C, robot, k)
            if k >= 0:
                x, y, yaw = self._online[robot][k].tolist()
                self._newest[robot] = x, y, yaw
                latest[name] = self._online[robot][k], self._online_C[robot][k]
        return Latest(time, latest)

    def _found(self) -> Found:
        smoother, factors, models = self._smoother, self._factors, self._factors.models

        def variable(key: int) -> tuple[Array, Array]:
            return smoother.calculateEstimateVector(key), smoother.marginalCovariance(key)

        errors = [
            factors.errors_in(robot, variable) if count else Errors(None, None)
            for robot, count in enumerate(self._entered)
        ]
        landmarks = {}
        for number in range(len(self.drive.landmarks)):
            key = landmark_key(number)
            if number in self._landmarks:
                landmarks[number] = (smoother.calculateEstimatePoint2(key), smoother.marginalCovariance(key))
            elif factors.is_exact(number):
                landmarks[number] = (models.map[number], np.eye(2) * models.map_sigmas[number] ** 2)
        return Found(self._smoothed, self._smoothed_C, landmarks, errors)

    def finish(self) -> tuple[DriveEstimate, dict[str, Trajectory]]:
        """The estimate of all keyframes as they left, and, by robot, what was thought of each at its time."""
        for robot, count in enumerate(self._entered):
            for k in range(self._left[robot], count):
                self._note(self._smoothed, self._smoothed_C, robot, k)
        estimate = summed_up(self._factors, self._found(), self._taken, 0)
        online = {}
        for robot, name in enumerate(self.drive.robots):
            there = np.isfinite(self._online[robot][:, 0])
            if there.any():
                online[name] = trajectory(
                    name, self.drive.times[robot][there], self._online[robot][there], self._online_C[robot][there]
                )
        return estimate, online
