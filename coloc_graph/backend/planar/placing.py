"""Where a robot is when its first measurements say it: its own track, laid on what is known of the world."""

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.planar.model import Pose

Array = NDArray[np.float64]

#: So many points must agree, this far apart [m], to so much [m]; and this part of all.
LEAST = 4
APART = 0.5
NEAR = 0.3
MOST_OF = 0.7
#: The newest so many are looked at.
NEWEST = 24


class Placing:
    """Points of a robot's own frame, and where they are in the world: `place` says where its frame is."""

    def __init__(self) -> None:
        self._local: list[tuple[float, float]] = []
        self._world: list[tuple[float, float]] = []

    def add(self, local: tuple[float, float], world: tuple[float, float]) -> None:
        """Take in a point."""
        self._local, self._world = [*self._local, local][-NEWEST:], [*self._world, world][-NEWEST:]

    def place(self) -> Pose | None:
        """The pose of the robot's own frame in the world; None while too little agrees."""
        if len(self._local) < LEAST:
            return None
        local, world = np.array(self._local), np.array(self._world)
        best: NDArray[np.bool_] | None = None
        for i, j in itertools.combinations(range(len(local)), 2):
            d_local, d_world = local[j] - local[i], world[j] - world[i]
            if min(np.hypot(*d_local), np.hypot(*d_world)) < APART:
                continue
            turn = math.atan2(d_world[1], d_world[0]) - math.atan2(d_local[1], d_local[0])
            pose = _laid(local[[i, j]], world[[i, j]], turn)
            agree = np.hypot(*(_moved(pose, local) - world).T) < NEAR
            if agree.sum() >= max(LEAST, MOST_OF * len(local)) and (best is None or agree.sum() > best.sum()):
                best = agree
        if best is None:
            return None
        local, world = local[best], world[best]
        p, q = local - local.mean(axis=0), world - world.mean(axis=0)
        turn = math.atan2(float((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum()), float((p * q).sum()))
        return _laid(local, world, turn)


def _laid(local: Array, world: Array, turn: float) -> Pose:
    """The pose that turns by so much and lays the middle of the ones on that of the others."""
    middle = _moved((0.0, 0.0, turn), local.mean(axis=0, keepdims=True))[0]
    x, y = world.mean(axis=0) - middle
    return float(x), float(y), turn


def _moved(pose: Pose, points: Array) -> Array:
    c, s = math.cos(pose[2]), math.sin(pose[2])
    moved: Array = points @ np.array([[c, s], [-s, c]]) + np.array(pose[:2])
    return moved
