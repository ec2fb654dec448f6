"""Initial values of a planar range graph: each robot's odometry as a rigid body, aligned by what robots measured."""

from collections.abc import Iterable
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
    chains, first = _odometry(graph)
    robots = list(first)
    names = [name for name in graph.names if is_landmark(name)]
    problem = _Alignment(graph, chains, robots, names)
    if not problem.size:
        return dict(chains)
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
            f"the ranges leave open where {loose} is against {robots[0]}: range it from more places, to more robots or "
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
    values: dict[str, Any] = {name: gtsam.Pose2(*T[robots.index(name[0])]).compose(one) for name, one in chains.items()}
    return values | dict(zip(names, L, strict=True))


def _odometry(graph: RangeGraph) -> tuple[dict[str, gtsam.Pose2], dict[str, str]]:
    """Poses in the first pose of their robot, and the first pose of each robot."""
    chains: dict[str, gtsam.Pose2] = {}
    first: dict[str, str] = {}
    for one in graph.relatives:
        if is_pose(one.value) and one.first[0] == one.second[0]:
            if one.first[0] not in first:
                first[one.first[0]], chains[one.first] = one.first, gtsam.Pose2()
            if one.first in chains:
                chains.setdefault(one.second, chains[one.first].compose(one.value))
    poses = [name for name in graph.names if not is_landmark(name)]
    lost = [name for name in poses if name not in chains]
    if lost or not first:
        raise InputError(
            f"{len(lost)} of {len(poses)} poses{f', as {lost[0]},' if lost else ''} have no odometry from the first "
            "pose of their robot: give each robot one chain of relative poses"
        )
    return chains, first


class _Alignment:
    """Residuals of ranges and of landmarks' positions by the placement of robots and landmarks."""

    def __init__(
        self, graph: RangeGraph, chains: dict[str, gtsam.Pose2], robots: list[str], landmarks: list[str]
    ) -> None:
        self._robots, self._landmarks, self._chains = robots, landmarks, chains
        ranges = _thinned([one for one in graph.ranges if one.first[0] != one.second[0]])
        self._range = np.array([one.distance for one in ranges])
        self._i, self._j = self._ends(one.first for one in ranges), self._ends(one.second for one in ranges)
        seen = _thinned([one for one in graph.relatives if not is_pose(one.value)])
        self._seen = np.array([one.value for one in seen]).reshape(-1, 2)
        self._by, self._of = self._ends(one.first for one in seen), self._ends(one.second for one in seen)
        self._free = 3 * (len(robots) - 1)
        self.size = self._free + 2 * len(landmarks)
        self._scale = float(np.median(self._range)) if len(ranges) else 1.0

    def _ends(self, names: Iterable[str]) -> tuple[NDArray[np.int64], Array, NDArray[np.int64]]:
        """Robot (-1: a landmark), pose in its first, and landmark of each name."""
        every = list(names)
        marks = {name: n for n, name in enumerate(self._landmarks)}
        poses = [self._chains.get(name, gtsam.Pose2()) for name in every]
        return (
            np.array([-1 if is_landmark(name) else self._robots.index(name[0]) for name in every], np.int64),
            np.array([(one.x(), one.y(), one.theta()) for one in poses]).reshape(-1, 3),
            np.array([marks.get(name, 0) for name in every], np.int64),
        )

    def drawn(self, rng: np.random.Generator) -> Array:
        """Draw an alignment."""
        robots = np.column_stack([
            self._scale * rng.standard_normal((self._free // 3, 2)), rng.uniform(-np.pi, np.pi, self._free // 3),
        ])  # fmt: skip
        return np.concatenate([robots.ravel(), self._scale * rng.standard_normal(2 * len(self._landmarks))])

    def parts(self, x: Array) -> tuple[Array, Array]:
        """Placements of robots (n, 3), the first at 0, and positions of landmarks (m, 2)."""
        return np.vstack([np.zeros(3), x[: self._free].reshape(-1, 3)]), x[self._free :].reshape(-1, 2)

    def places(self, x: Array) -> Array:
        """Positions of robots' first poses but the first robot's, and of landmarks, (n, 2)."""
        T, L = self.parts(x)
        return np.vstack([T[1:, :2], L])

    def owner(self, column: int) -> str:
        """Name of what a variable places."""
        return self.owner_of_place(column // 3 if column < self._free else (column - self._free) // 2 + self._free // 3)

    def owner_of_place(self, row: int) -> str:
        """Name of what a row of `places` is of."""
        return (*self._robots[1:], *self._landmarks)[row]

    def residuals(self, x: Array) -> Array:
        """Residuals in units of the odometry's drift."""
        T, L = self.parts(x)
        apart = self._at(self._j, T, L)[0] - self._at(self._i, T, L)[0]
        by, yaw = self._at(self._by, T, L)
        d = self._at(self._of, T, L)[0] - by
        c, s = np.cos(yaw), np.sin(yaw)
        seen = np.stack([c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1]], axis=1) - self._seen
        return np.concatenate([np.hypot(*apart.T) - self._range, seen.ravel()]) / DRIFT

    @staticmethod
    def _at(ends: tuple[NDArray[np.int64], Array, NDArray[np.int64]], T: Array, L: Array) -> tuple[Array, Array]:
        robot, pose, mark = ends
        placed = T[robot.clip(0)]
        c, s = np.cos(placed[:, 2]), np.sin(placed[:, 2])
        x, y = placed[:, 0] + c * pose[:, 0] - s * pose[:, 1], placed[:, 1] + s * pose[:, 0] + c * pose[:, 1]
        p = np.stack([x, y], axis=1)
        if len(L):
            p = np.where((robot < 0)[:, None], L[mark], p)
        return p, placed[:, 2] + pose[:, 2]


def _thinned(measured: list[Any]) -> list[Any]:
    return measured[:: max(1, len(measured) // MAX_MEASUREMENTS)]
