"""The graph of a run with stances and ranges for other programs: relative poses, and ranges between antennas.

It is planar, since ranges know no heights: x, y and heading of the relative poses of `relative_edges`. A range is one
between two poses: of the antennas, which are poses of their own where an antenna is not at the body's origin or its
robot was driving. They are tied to the pose of the stance by what the estimate takes as exact: the place of the
antenna, and the odometry from that pose. The formats hold one variance for each range: the sum of its covariances with
all ranges of the same pair of poses, so that together they say no more than they do in the estimate. Offsets and scales
of the sensors are taken as estimated.

All measured values are then shifted, all at once and by as little as possible, so that the optimum is the estimate.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend import Estimate
from coloc_graph.backend.factors import GAUGE_SIGMA
from coloc_graph.backend.landmarks import ALWAYS, MAP
from coloc_graph.backend.sensor_model import RANGING, Sensors
from coloc_graph.backend.solver import eliminated, with_stack
from coloc_graph.exchange.range_graph import (
    LANDMARK,
    RangeGraph,
    RangeValue,
    RelativeValue,
    factors_of,
    is_landmark,
    key_of,
    values_of,
)
from coloc_graph.exchange.range_graph_files import letters_of
from coloc_graph.exchange.relative_edges import relative_edges
from coloc_graph.geometry.lie import floor_pose, se3_inverse
from coloc_graph.geometry.se2 import Planar, compose
from coloc_graph.measurements import Node, Range
from coloc_graph.team import Team

Array = NDArray[np.float64]

TIE_SIGMA = 1e-4  # m, rad: of the pose of an antenna in that of its robot's body
PLANAR = [3, 4, 2]  # x, y and heading in GTSAM's tangent of a pose in space
MAX_SHIFTS = 5  # rounds of shifting measured values; each leaves a hundredth of the distance before
SHIFTED = 1e-9  # m, rad: step towards the optimum below which nothing is shifted


def ranges_in(estimate: Estimate) -> tuple[Range, ...]:
    """Return the ranges that an estimate uses."""
    rejected = {id(one.measurement) for one in estimate.rejected}
    key, values = estimate.graph.pose_keys.key, estimate.values
    return tuple(
        one
        for one in estimate.graph.measurements
        if isinstance(one, Range) and id(one) not in rejected and all(values.exists(key(end)) for end in one.ends)
    )


def group_letters(team: Team) -> dict[str, str]:
    """Return the letter of each robot, of the poses of sighted landmarks, and of the map."""
    return letters_of((*team.names, "landmarks", MAP))


def stance_graph(estimate: Estimate, team: Team) -> RangeGraph:
    """Return the graph of an estimate of stances and ranges; the estimate is its optimum, given the reference's pose.

    Poses have the letter of their robot by `group_letters`: those of stances first, then antennas. A landmark that was
    only ranged has its number in the team.

    Raises
    ------
    EstimationError
        The graph leaves a variable open.
    """
    poses = _Poses(estimate, team)
    ranges = tuple(value for one in ranges_in(estimate) for value in poses.ranges(one))
    relatives = [
        RelativeValue(max(poses.times[i], poses.times[j]), i, j, _planar(edge.T_i_j), (C + C.T)[PLANAR][:, PLANAR] / 2)
        for edge in relative_edges(estimate, shifted=False)
        for i, j, C in [(poses.names[edge.i], poses.names[edge.j], np.linalg.inv(edge.information))]
    ]
    graph = RangeGraph(
        planar=True,
        times=poses.times,
        initial=poses.initial,
        relatives=(*relatives, *poses.ties),
        ranges=ranges,
    )
    reference = poses.names[estimate.graph.reference_key]
    return with_stack(len(graph.initial), partial(_shifted, graph, reference))


class _Poses:
    """Variables of the graph of an estimate: poses of stances and landmarks, and of antennas as ranges need them."""

    def __init__(self, estimate: Estimate, team: Team) -> None:
        self._key, values = estimate.graph.pose_keys.key, estimate.values
        self._letters = group_letters(team)
        self.names: dict[int, str] = {}
        self.initial: dict[str, Any] = {}
        self.times: dict[str, float] = {}
        self.ties: list[RelativeValue] = []
        self._counts: dict[str, int] = {}
        self._antennas: dict[tuple[str, Planar], str] = {}
        for robot, path in estimate.trajectories.items():
            assert path.stances is not None
            for stance, time in zip(path.stances.tolist(), path.times.tolist(), strict=True):
                self._add(robot, self._key((robot, stance)), values, time)
        start = min(self.times.values())
        numbers = {one.name: number for number, one in enumerate(team.landmarks)}
        static = {**estimate.landmarks} | ({} if estimate.map is None else {MAP: estimate.map})
        for name, one in static.items():
            key = self._key((name, ALWAYS))
            if one.has_heading:
                self._add(name if name == MAP else "landmarks", key, values, start)
            else:
                self.names[key] = f"{LANDMARK}{numbers[name]}"
                self.initial[self.names[key]] = one.T_world_body.translation()[:2]
        calibrated = estimate.calibration.sensors
        stated = {robot.name: robot.ranging for robot in team.robots}
        self._sensors = {
            name: found.ranging if (found := calibrated.get(name)) and found.ranging else sensor
            for name, sensor in stated.items()
        }

    def _add(self, group: str, key: int, values: gtsam.Values, time: float) -> None:
        if key not in self.names:
            self.names[key] = name = self._next(group)
            self.initial[name], self.times[name] = _planar(values.atPose3(key)), time

    def _next(self, group: str) -> str:
        letter = self._letters[group]
        self._counts[letter] = self._counts.get(letter, 0) + 1
        return f"{letter}{self._counts[letter] - 1}"

    def ranges(self, one: Range) -> Iterator[RangeValue]:
        """Yield the ranges of a measurement, between poses that are added where there are none."""
        sensor, of_robot = self._sensors[one.robot], one.target_stance >= 0
        assert sensor is not None
        target = self._sensors[one.target] if of_robot and sensor.two_way else None
        ends, at = [], []
        for end, moved, antenna in zip(one.ends, (one.moved, one.target_moved), (sensor, target), strict=True):
            name = self.names[self._key(end)]
            pose = self.initial[name]
            at_pose = (*pose.tolist(), 0.0) if is_landmark(name) else (pose.x(), pose.y(), pose.theta())
            T_world_pose = floor_pose(*at_pose)
            T_world_body = T_world_pose @ floor_pose(*moved.T)
            x, y = (0.0, 0.0) if antenna is None else (antenna.x, antenna.y)
            at.append((T_world_body, T_world_body @ np.array([x, y, 0.0, 1.0])))
            ends.append([self._end(end, name, one.time, compose(body, (x, y, 0.0))) for body in moved.tolist()])
        (body, mine), (_, other) = at
        xy = (se3_inverse(body) @ other[..., None])[:, :2, 0]
        number = np.zeros(len(xy), int)
        expected = Sensors([sensor]).expected(number, xy, np.zeros((len(xy), RANGING)), np.full(len(xy), of_robot))
        off = expected.values[:, 0] + (0.0 if target is None else target.offset) - one.range
        slope = sensor.scale * expected.by_errors[:, 0, 1] / np.hypot(xy[:, 0] - sensor.x, xy[:, 1] - sensor.y)
        distance = np.linalg.norm(other - mine, axis=1) - off / slope
        variance = np.abs(one.covariance).sum(axis=1) / slope**2
        distance = np.maximum(distance, np.sqrt(variance))  # without its offset it may be below 0, which no format has
        for i, j, value, noise in zip(*ends, distance.tolist(), variance.tolist(), strict=True):
            yield RangeValue(one.time, i, j, value, noise)

    def _end(self, end: Node, name: str, time: float, place: Planar) -> str:
        """Return the name of the pose at a place in another."""
        if not any(place):
            return name
        if (found := self._antennas.get((name, place))) is not None:
            return found
        self._antennas[name, place] = new = self._next(end[0])
        step = gtsam.Pose2(*place)
        self.initial[new], self.times[new] = self.initial[name].compose(step), time
        self.ties.append(RelativeValue(time, name, new, step, TIE_SIGMA**2 * np.eye(3)))
        return new


def _planar(pose: gtsam.Pose3) -> gtsam.Pose2:
    return gtsam.Pose2(pose.x(), pose.y(), pose.rotation().yaw())


def _shifted(graph: RangeGraph, reference: str) -> RangeGraph:
    """Return a graph with measured values by which its initial values are the optimum, `reference` being held."""
    values, key = values_of(graph.initial), key_of(reference)
    gauge = gtsam.PriorFactorPose2(key, values.atPose2(key), gtsam.noiseModel.Isotropic.Sigma(3, GAUGE_SIGMA))
    for _ in range(MAX_SHIFTS):
        factors = factors_of(graph)
        factors.add(gauge)
        linear = factors.linearize(values)
        tree, _ = eliminated(linear, gtsam.Ordering.ColamdGaussianFactorGraph(linear), by_qr=True)
        step = tree.optimize()
        if max(np.abs(step.at(key)).max() for key in values.keys()) < SHIFTED:  # noqa: SIM118
            break
        graph = _with_residuals_of(graph, values.retract(step))
    return graph


def _with_residuals_of(graph: RangeGraph, values: gtsam.Values) -> RangeGraph:
    """Return a graph with the residuals at its initial values that it has at other ones."""
    there: dict[str, Any] = {
        name: values.atPoint2(key_of(name)) if is_landmark(name) else values.atPose2(key_of(name))
        for name in graph.initial
    }
    here = graph.initial
    relatives = []
    for one in graph.relatives:
        residual = gtsam.Pose2.Logmap(one.value.between(there[one.first].between(there[one.second])))
        moved = here[one.first].between(here[one.second]).compose(gtsam.Pose2.Expmap(-residual))
        relatives.append(replace(one, value=moved))
    ranges = [
        replace(one, distance=one.distance + _apart(here, one) - _apart(there, one)) for one in graph.ranges
    ]  # fmt: skip
    return replace(graph, relatives=tuple(relatives), ranges=tuple(ranges))


def _apart(values: Mapping[str, Any], one: RangeValue) -> float:
    """Return the distance of the ends of a range [m]."""
    ends = (values[name] for name in (one.first, one.second))
    first, second = (end if isinstance(end, np.ndarray) else end.translation() for end in ends)
    return float(np.linalg.norm(second - first))
