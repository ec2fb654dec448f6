"""Initial pose of a robot: rigid alignment of its own track with known points, by RANSAC over all pairs."""

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.sensor_model import Pose

Array = NDArray[np.float64]

MIN_POINTS = 4  # points that must agree
MIN_SEPARATION = 0.5  # m, between the points of a pair
TOLERANCE = 0.3  # m, within which a point agrees
MIN_AGREEMENT = 0.7  # share of the points that must agree
NEWEST = 24  # newest points that are used


class RigidAlignmentRansac:
    """Rigid alignment of points in a robot's own frame with the same points in the world."""

    def __init__(self) -> None:
        self._local: list[tuple[float, float]] = []
        self._world: list[tuple[float, float]] = []

    def add(self, local: tuple[float, float], world: tuple[float, float]) -> None:
        """Add a point."""
        self._local, self._world = [*self._local, local][-NEWEST:], [*self._world, world][-NEWEST:]

    def pose(self) -> Pose | None:
        """Return the pose of the robot's own frame in the world; None while too few points agree."""
        if len(self._local) < MIN_POINTS:
            return None
        local, world = np.array(self._local), np.array(self._world)
        needed = max(MIN_POINTS, MIN_AGREEMENT * len(local))
        best: NDArray[np.bool_] | None = None
        for i, j in itertools.combinations(range(len(local)), 2):
            d_local, d_world = local[j] - local[i], world[j] - world[i]
            if min(np.hypot(*d_local), np.hypot(*d_world)) < MIN_SEPARATION:
                continue
            turn = math.atan2(d_world[1], d_world[0]) - math.atan2(d_local[1], d_local[0])
            pose = _laid(local[[i, j]], world[[i, j]], turn)
            agree = np.hypot(*(_moved(pose, local) - world).T) < TOLERANCE
            if agree.sum() >= needed and (best is None or agree.sum() > best.sum()):
                best = agree
        if best is None:
            return None
        local, world = local[best], world[best]
        p, q = local - local.mean(axis=0), world - world.mean(axis=0)
        turn = math.atan2(float((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum()), float((p * q).sum()))
        return _laid(local, world, turn)


def _laid(local: Array, world: Array, turn: float) -> Pose:
    """Return the pose of a given turn that maps the centre of the local points to that of the world's."""
    middle = _moved((0.0, 0.0, turn), local.mean(axis=0, keepdims=True))[0]
    x, y = world.mean(axis=0) - middle
    return float(x), float(y), turn


def _moved(pose: Pose, points: Array) -> Array:
    c, s = math.cos(pose[2]), math.sin(pose[2])
    moved: Array = points @ np.array([[c, s], [-s, c]]) + np.array(pose[:2])
    return moved
