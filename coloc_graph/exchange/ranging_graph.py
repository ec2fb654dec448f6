"""The graph of a ranging run for other programs: odometry, and bearings and ranges as those of calibrated sensors.

Errors of wheels and sensors are taken as estimated, without their uncertainty (`ranging_factors` has it).
A measurement becomes the bearing and range of its target from the robot's body, with the covariance that noise,
correlation in time and robust weight leave it: one with the gradient of the original, so that the optimum is the
estimate. A range without a bearing is that from body to body, in whose direction antennas off the middle are not.
Outliers are left out.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend import Estimate
from coloc_graph.backend.planar.factors import CAUCHY, GAUGE_SIGMA
from coloc_graph.backend.sensor_model import RANGING, Sensors, WheelsModel
from coloc_graph.exchange.range_graph import (
    LANDMARK,
    BearingRangeValue,
    Prior,
    RangeGraph,
    RangeValue,
    RelativeValue,
    is_landmark,
)
from coloc_graph.exchange.range_graph_files import letters_of
from coloc_graph.geometry.lie import rotation_z, se3_inverse, yaw
from coloc_graph.geometry.se2 import wrap
from coloc_graph.team import Ranging, Team, Wheels

Array = NDArray[np.float64]

MIN_LANDMARK_SIGMA = 1e-3  # m, of the prior of a landmark whose position is exact


def ranging_graph(estimate: Estimate, team: Team) -> RangeGraph:
    """Return the graph of a ranging run: poses by `letters_of` the robots, landmarks by their number in the team."""
    problem = estimate.ranging
    letters = letters_of(problem.robots)
    initial: dict[str, Any] = {}
    times: dict[str, float] = {}
    for name, numbers in problem.numbers.items():
        path = estimate.trajectories[name]
        poses = np.column_stack([path.positions[:, :2], yaw(path.T_world_body)]).tolist()
        for number, pose, time in zip(numbers.tolist(), poses, path.times.tolist(), strict=True):
            initial[f"{letters[name]}{number}"] = gtsam.Pose2(*pose)
            times[f"{letters[name]}{number}"] = time
    places = {name: one.planar[:2] for name, one in estimate.landmarks.items()}
    marks = {one.name: f"{LANDMARK}{number}" for number, one in enumerate(team.landmarks)}
    start = min(times.values())
    priors = []
    for one in team.landmarks:
        if one.position is not None and one.name in places:
            C = max(one.position_sigma, MIN_LANDMARK_SIGMA) ** 2 * np.eye(2)
            priors.append(Prior(start, marks[one.name], np.array(one.position), C))
    if not problem.on_map:
        first = next(iter(initial))
        priors.append(Prior(times[first], first, initial[first], GAUGE_SIGMA**2 * np.eye(3)))
    calibrated = estimate.calibration.sensors
    wheels = {name: calibrated[name].wheels or team[name].wheels or Wheels() for name in problem.robots}
    stated = [team[name].ranging or Ranging(range_sigma=1.0, bearing_sigma_deg=1.0) for name in problem.robots]
    sensors = [calibrated[name].ranging or one for name, one in zip(problem.robots, stated, strict=True)]
    measured = tuple(_measured(estimate, Sensors(stated), Sensors(sensors), {**letters, **marks}))
    return RangeGraph(
        planar=True,
        times=times,
        initial={**initial, **{marks[name]: np.array(at) for name, at in places.items()}},
        priors=tuple(priors),
        relatives=tuple(_steps(estimate, wheels, letters)),
        bearings=tuple(one for one in measured if isinstance(one, BearingRangeValue)),
        ranges=tuple(one for one in measured if isinstance(one, RangeValue)),
    )


def _steps(estimate: Estimate, wheels: dict[str, Wheels], letters: dict[str, str]) -> Iterator[RelativeValue]:
    problem = estimate.ranging
    for name, numbers in problem.numbers.items():
        keyframes, own = problem.keyframes, problem.robots.index(name)
        model = WheelsModel(keyframes.steps[own], wheels[name])
        begins = numbers[:-1][np.diff(numbers) == 1]
        steps, _ = model.steps(begins, np.zeros(3))
        scales = np.array([model.wheels.scale, model.wheels.scale, model.wheels.turn_scale])
        turn = rotation_z(steps[:, 2])  # GTSAM's tangent is that of the later pose
        covariances = turn.mT @ (model.covariances[begins] * np.outer(scales, scales)) @ turn
        for number, step, C in zip(begins.tolist(), steps, covariances, strict=True):
            ends = f"{letters[name]}{number}", f"{letters[name]}{number + 1}"
            yield RelativeValue(float(keyframes.times[own][number + 1]), *ends, gtsam.Pose2(*step), C)


def _measured(
    estimate: Estimate, stated: Sensors, sensors: Sensors, names: dict[str, str]
) -> Iterator[BearingRangeValue | RangeValue]:
    problem = estimate.ranging
    m, used = problem.keyframes.measured, np.flatnonzero(problem.used)
    if not len(used):
        return
    robot, of_robot = m.robot[used], m.target[used] < len(problem.robots)
    row_of = {name: dict(zip(of.tolist(), range(len(of)), strict=True)) for name, of in problem.numbers.items()}
    ends = []
    for one in (problem.measurements[row] for row in used.tolist()):
        here = estimate.trajectories[one.robot].T_world_body[row_of[one.robot][one.keyframe]]
        if one.target in row_of:
            there = estimate.trajectories[one.target].T_world_body[row_of[one.target][one.target_keyframe]]
        else:
            there = estimate.landmarks[one.target].T_world_body.matrix()
        ends.append((here, there))
    T_here, T_there = np.array(ends).transpose(1, 0, 2, 3)
    poses, targets = (np.column_stack([T[:, :2, 3], yaw(T)]) for T in (T_here, T_there))
    points = (se3_inverse(T_here) @ T_there[:, :, 3:])[:, :2, 0]
    nothing = np.zeros((len(problem.robots), RANGING))
    antennas = np.where(sensors.two_way[robot] & of_robot, m.target[used], -1)
    expected = sensors.between(robot, poses, antennas, targets, nothing, of_robot)
    residuals = expected.values - np.stack([m.range[used], m.bearing[used]], axis=-1)
    residuals[:, 1] = wrap(residuals[:, 1])
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    by_xy = expected.by_target[:, :, :2] @ np.array([[c, -s], [s, c]]).transpose(2, 0, 1)
    distance = np.hypot(*points.T)
    polar = np.empty_like(by_xy)
    polar[:, 0, 0], polar[:, 0, 1] = -points[:, 1] / distance**2, points[:, 0] / distance**2
    polar[:, 1] = points / distance[:, None]
    J = polar @ np.linalg.inv(by_xy)
    share = m.share[used]
    off = np.nansum(share * problem.residuals[used] ** 2, axis=1) / CAUCHY**2
    sigmas = stated.sigmas(robot, m.range[used]) * problem.noise[robot]
    with np.errstate(divide="ignore", invalid="ignore"):
        variances = sigmas**2 / share * (1 + off)[:, None]
        C = J @ (variances[:, :, None] * J.mT)
        moved = (J @ residuals[..., None])[..., 0]
    bearing = np.arctan2(points[:, 1], points[:, 0]) - moved[:, 0]
    alone = np.isnan(bearing)
    scales = np.array([sensors.ranging[one].scale for one in robot.tolist()])
    distance = np.maximum(distance - np.where(alone, residuals[:, 0] / scales, moved[:, 1]), 0.0)
    for n, one in enumerate(problem.measurements[row] for row in used.tolist()):
        first, second = f"{names[one.robot]}{one.keyframe}", names[one.target]
        if one.target_keyframe >= 0:
            second = f"{second}{one.target_keyframe}"
        if alone[n]:
            yield RangeValue(one.time, first, second, float(distance[n]), float(variances[n, 0] / scales[n] ** 2))
        else:
            whole = (C[n] + C[n].T) / 2
            yield BearingRangeValue(one.time, first, second, float(bearing[n]), float(distance[n]), whole)


def without_bearings(graph: RangeGraph) -> tuple[RangeGraph, str]:
    """Return a graph without bearings, and what it lost: landmarks keep positions in poses, robots ranges alone."""
    relatives, ranges = list(graph.relatives), list(graph.ranges)
    for one in graph.bearings:
        if is_landmark(one.second):
            c, s = np.cos(one.bearing), np.sin(one.bearing)
            J = np.array([[-one.distance * s, c], [one.distance * c, s]])
            at = one.distance * np.array([c, s])
            relatives.append(RelativeValue(one.time, one.first, one.second, at, J @ one.covariance @ J.T))
        else:
            ranges.append(RangeValue(one.time, one.first, one.second, one.distance, float(one.covariance[1, 1])))
    lost = len(ranges) - len(graph.ranges)
    said = f"left out: {lost} bearings between robots, which PyFG cannot express; jrl holds them" if lost else ""
    return replace(graph, relatives=tuple(relatives), ranges=tuple(ranges), bearings=()), said


def planar_g2o(graph: RangeGraph, robots: dict[str, str]) -> tuple[str, str]:
    """Return the poses and odometry of a graph in the g2o format, and what it cannot hold.

    `robots` are names by letter.
    """
    poses = {name: number for number, name in enumerate(name for name in graph.initial if not is_landmark(name))}
    marks, ends = len(graph.initial) - len(poses), len(graph.bearings) + len(graph.ranges)
    said = (
        f"left out: {ends} ranges and bearings and {marks} landmarks, which a pose graph cannot express; the poses are "
        "those with them, and jrl, pyfg or gtsam hold them"
    )
    lines = [f"# {said}"]
    for name, number in poses.items():
        lines.append(f"# {number} is {robots[name[0]]}@{name[1:]}")
        lines.append(f"VERTEX_SE2 {number} {_pose(graph.initial[name])}")
    # nothing else ties robots to each other
    firsts = {name[0]: number for name, number in reversed(poses.items())}
    lines += [f"FIX {number}" for number in firsts.values()]
    for one in graph.relatives:
        upper = np.linalg.inv(one.covariance)[np.triu_indices(3)].tolist()
        numbers = " ".join(map(repr, upper))
        lines.append(f"EDGE_SE2 {poses[one.first]} {poses[one.second]} {_pose(one.value)} {numbers}")
    return "\n".join(lines) + "\n", said


def _pose(pose: gtsam.Pose2) -> str:
    return " ".join(repr(float(number)) for number in (pose.x(), pose.y(), pose.theta()))


def planar_dot(graph: RangeGraph, robots: dict[str, str], landmarks: Iterable[str]) -> str:
    """Draw robots and landmarks, one box for all poses of a robot, with the number of measurements between them."""
    marks = dict(enumerate(landmarks))
    counts = Counter(name[0] for name in graph.initial if not is_landmark(name))
    ends = [(one.first, one.second) for one in graph.bearings] + [(one.first, one.second) for one in graph.ranges]
    pairs = Counter((first[0], second if is_landmark(second) else second[0]) for first, second in ends)
    lines = ["graph ranging {", "  node [shape=box, style=rounded, fontname=Helvetica];"]
    lines += [f'  {letter} [label="{robots[letter]}: {count} poses"];' for letter, count in counts.items()]
    lines += [
        f'  {name} [label="{marks[int(name[1:])]}", shape=hexagon, style=solid, color="#555555"];'
        for name in graph.initial
        if is_landmark(name)
    ]
    lines += [f'  {i} -- {j} [label="{count}", style=dashed];' for (i, j), count in pairs.items()]
    return "\n".join([*lines, "}"]) + "\n"
