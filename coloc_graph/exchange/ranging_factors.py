"""Factors of a ranging run for GTSAM, linearised at the estimate: `gtsam_files` of a run without stances.

Errors of wheels and sensors are variables with their priors, as in the estimate, since its covariances contain their
uncertainty. Measurements keep the robust weights of their residuals, outliers too.
"""

import csv
import io
from collections.abc import Callable

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend import Estimate
from coloc_graph.backend.linear_system import Rows
from coloc_graph.backend.planar.factors import KeyframeFactors, State, robust
from coloc_graph.backend.planar.filter import Models
from coloc_graph.exchange.gtsam_files import SCRIPT
from coloc_graph.exchange.range_graph import LANDMARK, key_of
from coloc_graph.exchange.range_graph_files import letters_of
from coloc_graph.geometry.lie import yaw
from coloc_graph.team import Team

Array = NDArray[np.float64]

WHEELS_KEY = "w"  # kind of the keys of wheels
SENSOR_KEY = "s"  # and of sensors
DIRECTION_KEY = "d"  # and of directions of bodies
WHEELS_KIND = "wheel errors: scale, turn scale, delay [s]"
SENSOR_KIND = "range sensor errors: offset [m], scale, bearing [rad], x, y [m], depth, offset of robots [m]"
DIRECTION_KIND = "direction [rad]"  # of a body, from the way in which its wheels drive; gtsam_script.txt has it, too


def ranging_gtsam_files(estimate: Estimate, team: Team) -> dict[str, str]:
    """Return the files of a ranging run's estimate for GTSAM, by name, as `gtsam_files` does."""
    problem = estimate.ranging
    factors = KeyframeFactors(problem.keyframes, Models(team, problem.keyframes), problem.noise)
    state = _state_of(estimate, factors)
    graph, values, names = _Portable(factors, state, team).of(np.isfinite(problem.residuals[:, 0]))
    out = io.StringIO()
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(["key", "kind", "of"])
    rows.writerows([key, *name] for key, name in names.items())
    return {
        "graph.txt": graph.serialize(),
        "values.txt": values.serialize(),
        "keys.csv": out.getvalue(),
        "solve.py": SCRIPT.read_text(encoding="utf-8"),
    }


def _state_of(estimate: Estimate, factors: KeyframeFactors) -> State:
    """Return the variables of the solver at an estimate; NaN where a keyframe has no pose."""
    keyframes, shared = factors.keyframes, factors.start()
    poses = np.full((len(factors), 3), np.nan)
    for robot, name in enumerate(keyframes.robots):
        errors = estimate.calibration.sensors[name].errors
        for found, own in ((errors.wheels, factors.wheels(shared)), (errors.ranging, factors.ranging(shared))):
            if found is not None:
                own[robot] = found[0]
        if name in estimate.trajectories:
            path = estimate.trajectories[name]
            own = factors.first[robot] + estimate.ranging.numbers[name]
            poses[own] = np.column_stack([path.positions[:, :2], yaw(path.T_world_body)])
    for number, name in enumerate(keyframes.landmarks):
        if name in estimate.landmarks:
            factors.landmarks(shared)[number] = estimate.landmarks[name].planar[:2]
    return State(poses, shared)


class _Portable:
    """GTSAM's variables and factors of the state of a ranging run."""

    def __init__(self, factors: KeyframeFactors, state: State, team: Team) -> None:
        self._factors, self._state = factors, state
        self._graph, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._turns = np.tile(np.eye(3), (len(factors), 1, 1))  # from GTSAM's tangent, that of the body, to the world
        c, s = np.cos(state.poses[:, 2]), np.sin(state.poses[:, 2])
        self._turns[:, :2, :2] = np.array([[c, -s], [s, c]]).transpose(2, 0, 1)
        keyframes, letters = factors.keyframes, letters_of(factors.keyframes.robots)
        robots = len(keyframes.robots)
        sensors = ("all robots",) if factors.radios else keyframes.robots
        number = np.arange(len(factors)) - factors.first[factors.robot]
        robot = factors.robot.tolist()
        marks = {one.name: n for n, one in enumerate(team.landmarks)}
        self._keys = [
            *(key_of(f"{letters[keyframes.robots[one]]}{k}") for one, k in zip(robot, number.tolist(), strict=True)),
            *(gtsam.mrsymbol(ord(WHEELS_KEY), one + 1, 0) for one in range(robots)),
            *(gtsam.mrsymbol(ord(SENSOR_KEY), one + 1, 0) for one in range(len(sensors))),
            *(key_of(f"{LANDMARK}{marks[name]}") for name in keyframes.landmarks),
        ]
        self._names = [
            *(("planar pose", f"{keyframes.robots[one]}@{k}") for one, k in zip(robot, number.tolist(), strict=True)),
            *((WHEELS_KIND, name) for name in keyframes.robots),
            *((SENSOR_KIND, name) for name in sensors),
            *(("position", f"landmark {name}") for name in keyframes.landmarks),
        ]

    def of(
        self, used: NDArray[np.bool_]
    ) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, dict[int, tuple[str, str]]]:
        """Return the factors of all poses and of the `used` measurements (n,), their variables, and the keys' names."""
        factors, state = self._factors, self._state
        placed = np.isfinite(state.poses[:, 0])
        for pose in np.flatnonzero(placed).tolist():
            self._values.insert(self._keys[pose], gtsam.Pose2(*state.poses[pose].tolist()))
        begins = np.flatnonzero(placed[:-1] & placed[1:] & (factors.robot[:-1] == factors.robot[1:]))
        steps, measured = factors.steps(state, begins), robust(factors.measured(state, np.flatnonzero(used)))[0]
        self._add_shared([steps, measured])
        for one in (steps, measured):
            self._add(one)
        if not factors.models.map_known:
            first = int(np.flatnonzero(placed)[0])
            self._add(factors.gauge(state, first, state.poses[first]))
        names = {key: name for key, name in zip(self._keys, self._names, strict=True) if self._values.exists(key)}
        return self._graph, self._values, names | self._add_directions(placed)

    def _add_directions(self, placed: NDArray[np.bool_]) -> dict[int, tuple[str, str]]:
        """Add the directions of bodies, which are in no measurement and in the sigmas of all headings."""
        names: dict[int, tuple[str, str]] = {}
        for robot in sorted(set(self._factors.robot[placed].tolist())):
            sigma = np.deg2rad(self._factors.models.wheels[robot].wheels.direction_sigma_deg)
            if sigma > 0:
                key = gtsam.mrsymbol(ord(DIRECTION_KEY), robot + 1, 0)
                noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma)
                self._values.insert(key, np.zeros(1))
                self._graph.add(gtsam.PriorFactorVector(key, np.zeros(1), noise))
                names[key] = DIRECTION_KIND, self._factors.keyframes.robots[robot]
        return names

    def _add_shared(self, rows: list[Rows]) -> None:
        """Add the errors and landmarks that factors are on, with their priors."""
        factors, keys, poses = self._factors, self._factors.keys, len(self._factors)
        there = {key for one in rows for _, parts in keys.blocks(one) for slot, _ in parts for key in slot.tolist()}
        for key in sorted(key for key in there if key >= poses):
            span = keys.span(key)
            own = slice(span.start - 3 * poses, span.stop - 3 * poses)
            free, value = factors.free[own], self._state.shared[own]
            noise = gtsam.noiseModel.Diagonal.Sigmas(np.where(free, factors.sigmas[own], 1.0))
            point = len(value) == 2
            prior = gtsam.PriorFactorPoint2 if point else gtsam.PriorFactorVector
            self._values.insert(self._keys[key], value)
            self._graph.add(prior(self._keys[key], np.where(free, factors.start()[own], value), noise))

    def _add(self, rows: Rows) -> None:
        """Add linearised factors."""
        noise = gtsam.noiseModel.Unit.Create(rows.jacobians.shape[1])
        poses = len(self._factors)
        for index, parts in self._factors.keys.blocks(rows):
            if not parts:
                continue
            columns: list[list[int] | Array] = []
            for slot, block in parts:
                is_pose = slot[0] < poses
                columns += [[self._keys[key] for key in slot.tolist()], block @ self._turns[slot] if is_pose else block]
            make: Callable[..., gtsam.JacobianFactor] = gtsam.JacobianFactor
            for one in zip(*columns, -rows.residuals[index], strict=True):
                self._graph.add(gtsam.LinearContainerFactor(make(*one, noise), self._values))
