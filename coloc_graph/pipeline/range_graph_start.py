"""Initial values of a planar range graph: what relative poses tie is a rigid body, and measurements align bodies."""

from collections import defaultdict
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from coloc_graph.errors import EstimationError, InputError
from coloc_graph.exchange.range_graph import RangeGraph, is_landmark, is_pose

Array = NDArray[np.float64]

STARTS = 16  # random alignments from which the search begins
MIN_STARTS = 6  # starts after which the search may end
MIN_ALIKE = 3  # of them that found the best alignment
MAX_MEASUREMENTS = 500  # ranges, and landmarks' positions, that align robots
DRIFT = 0.5  # m, error of a range by the odometry's drift
MIN_SINGULAR = 1e-3  # singular value of the alignment below which it leaves something open
APART = 0.5  # m, distance from which on two alignments differ
SAME_COST = 3.0  # half chi2 by which the best alignment must be better than another


def initial_values(graph: RangeGraph) -> dict[str, Any]:
    """Return the initial values of all variables, in the first pose of the first robot.

    Raises
    ------
    InputError
        Poses are not planar, or not connected by odometry to their robot's first.
    EstimationError
        Ranges leave robots open, or mirrored.
    """
    if not graph.planar:
        raise InputError("range graphs in 3D are converted, not solved: give one in 2D (VERTEX_SE2)")
    poses, body_of, bodies = _bodies(graph)
    names = [name for name in graph.names if is_landmark(name)]
    problem = _Alignment(graph, poses, body_of, bodies, names)
    if not problem.size:
        return dict(poses)
    rng, found = np.random.default_rng(0), []
    for _ in range(STARTS):
        fit = least_squares(problem.residuals, problem.drawn(rng), loss="soft_l1", max_nfev=80)
        found.append((float(fit.cost), np.asarray(fit.x), np.asarray(fit.jac)))
        costs = np.sort([one[0] for one in found])
        if len(costs) >= MIN_STARTS and costs[MIN_ALIKE - 1] - costs[0] < 1e-3 * (1 + costs[0]):
            break
    found.sort(key=lambda one: one[0])
    cost, x, J = found[0]
    singular = np.linalg.svd(J)
    if len(J) < problem.size or singular.S[-1] < MIN_SINGULAR:
        loose = problem.owner(int(np.abs(singular.Vh[-1]).argmax()))
        raise EstimationError(
            f"the ranges leave open where {loose} is against {bodies[0]}: range it from more places, to more robots or "
            "landmarks"
        )
    for other, y, _ in found[1:]:
        off = np.abs(problem.places(y) - problem.places(x))
        if other - cost < SAME_COST and off.max() > APART:
            raise EstimationError(
                f"the ranges fit two arrangements, in which {problem.owner_of_place(int(off.max(axis=1).argmax()))} is "
                "elsewhere, as mirrored: range it while robots drive curves, or measure a bearing"
            )
    T, L = problem.parts(x)
    placed = [gtsam.Pose2(*one) for one in T]
    values: dict[str, Any] = {name: placed[body_of[name]].compose(one) for name, one in poses.items()}
    return values | dict(zip(names, L, strict=True))


def _bodies(graph: RangeGraph) -> tuple[dict[str, gtsam.Pose2], dict[str, int], list[str]]:
    """Return poses in the first pose of their body, the body of each by number, and the robots of each body.

    A pose is placed along measurements of its own robot, where these lead to it, rather than by those of others.
    """
    steps: dict[str, list[tuple[str, gtsam.Pose2, bool]]] = defaultdict(list)
    for one in graph.relatives:
        if is_pose(one.value):
            steps[one.first].append((one.second, one.value, False))
            steps[one.second].append((one.first, one.value, True))
    poses: dict[str, gtsam.Pose2] = {}
    body_of: dict[str, int] = {}
    robots: list[dict[str, None]] = []
    names = [name for name in graph.names if not is_landmark(name)]
    for root in names:
        if root in poses:
            continue
        robots.append({})
        own, others = [(root, gtsam.Pose2())], list[tuple[str, gtsam.Pose2]]()
        while own or others:
            name, pose = own.pop() if own else others.pop(0)
            if name in poses:
                continue
            poses[name], body_of[name] = pose, len(robots) - 1
            robots[-1][name[0]] = None
            # reversed: a stack gives the first one first
            for other, step, back in reversed(steps[name]):
                if other not in poses:
                    there = pose.compose(step.inverse() if back else step)
                    (own if other[0] == name[0] else others).append((other, there))
    body = {name[0]: body_of[name] for name in reversed(names)}
    lost = [name for name in names if body_of[name] != body[name[0]]]
    if lost or not names:
        raise InputError(
            f"{len(lost)} of {len(names)} poses{f', as {lost[0]},' if lost else ''} have no odometry from the first "
            "pose of their robot: give each robot one chain of relative poses"
        )
    return poses, body_of, [" and ".join(one) for one in robots]


class _Alignment:
    """Residuals of ranges and of landmarks' positions by the placement of bodies and landmarks."""

    def __init__(
        self,
        graph: RangeGraph,
        poses: dict[str, gtsam.Pose2],
        body_of: dict[str, int],
        bodies: list[str],
        landmarks: list[str],
    ) -> None:
        self._bodies, self._landmarks, self._poses, self._body_of = bodies, landmarks, poses, body_of
        ranges = _thinned([one for one in graph.ranges if body_of.get(one.first) != body_of.get(one.second)])
        self._range = np.array([one.distance for one in ranges])
        seen = _thinned([one for one in graph.relatives if not is_pose(one.value)])
        self._seen = np.array([one.value for one in seen]).reshape(-1, 2)
        measured = (*ranges, *seen)
        self._ends = self._named([one.first for one in measured] + [one.second for one in measured])
        self._free = 3 * (len(bodies) - 1)
        self.size = self._free + 2 * len(landmarks)
        self._scale = float(np.median(self._range)) if len(ranges) else 1.0

    def _named(self, every: list[str]) -> tuple[NDArray[np.int64], Array, NDArray[np.int64]]:
        """Body (-1: a landmark), pose in its first, and landmark of each name."""
        marks = {name: n for n, name in enumerate(self._landmarks)}
        poses = [self._poses.get(name, gtsam.Pose2()) for name in every]
        return (
            np.array([self._body_of.get(name, -1) for name in every], np.int64),
            np.array([(one.x(), one.y(), one.theta()) for one in poses]).reshape(-1, 3),
            np.array([marks.get(name, 0) for name in every], np.int64),
        )

    def drawn(self, rng: np.random.Generator) -> Array:
        """Draw an alignment."""
        bodies = np.column_stack([
            self._scale * rng.standard_normal((self._free // 3, 2)), rng.uniform(-np.pi, np.pi, self._free // 3),
        ])  # fmt: skip
        return np.concatenate([bodies.ravel(), self._scale * rng.standard_normal(2 * len(self._landmarks))])

    def parts(self, x: Array) -> tuple[Array, Array]:
        """Placements of bodies (n, 3), the first at 0, and positions of landmarks (m, 2)."""
        return np.vstack([np.zeros(3), x[: self._free].reshape(-1, 3)]), x[self._free :].reshape(-1, 2)

    def places(self, x: Array) -> Array:
        """Positions of bodies' first poses but the first body's, and of landmarks, (n, 2)."""
        T, L = self.parts(x)
        return np.vstack([T[1:, :2], L])

    def owner(self, column: int) -> str:
        """Name of what a variable places."""
        return self.owner_of_place(column // 3 if column < self._free else (column - self._free) // 2 + self._free // 3)

    def owner_of_place(self, row: int) -> str:
        """Name of what a row of `places` is of."""
        return (*self._bodies[1:], *self._landmarks)[row]

    def residuals(self, x: Array) -> Array:
        """Residuals in units of the odometry's drift."""
        T, L = self.parts(x)
        body, pose, mark = self._ends
        placed = T[body.clip(0)]
        c, s = np.cos(placed[:, 2]), np.sin(placed[:, 2])
        p = np.empty((len(body), 2))
        p[:, 0] = placed[:, 0] + c * pose[:, 0] - s * pose[:, 1]
        p[:, 1] = placed[:, 1] + s * pose[:, 0] + c * pose[:, 1]
        if len(L):
            p = np.where((body < 0)[:, None], L[mark], p)
        n, ranges = len(body) // 2, len(self._range)
        d = p[n:] - p[:n]
        yaw, by = (placed[:, 2] + pose[:, 2])[ranges:n], d[ranges:]
        c, s = np.cos(yaw), np.sin(yaw)
        seen = np.stack([c * by[:, 0] + s * by[:, 1], -s * by[:, 0] + c * by[:, 1]], axis=1) - self._seen
        return np.concatenate([np.hypot(*d[:ranges].T) - self._range, seen.ravel()]) / DRIFT


def _thinned(measured: list[Any]) -> list[Any]:
    return measured[:: max(1, len(measured) // MAX_MEASUREMENTS)]
