"""Pose of a robot between two stances: by wheel odometry if available, otherwise interpolated."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.se2 import wrap
from coloc_graph.viewer.scene import Layer, Scene

Array = NDArray[np.float64]

AHEAD = 1.5  # m, distance from an observer to the markers that it watches


def pose_at(scene: Scene, layer: Layer, number: int, time: Array) -> Array:
    """Return x, y, z [m] and heading [rad] of a robot, (n, 4), at ascending times (n,); NaN without any pose.

    An observer stands from the beginning of a stance to its end. In between it follows its odometry, corrected linearly
    so that it ends at the next pose.
    """
    out = np.full((len(time), 4), np.nan)
    if not len(layer.rows[number]):
        return out
    keys, poses = _keys(scene, layer, number)
    after = np.searchsorted(keys, time, side="right")
    before = np.maximum(after - 1, 0)
    after = np.minimum(np.maximum(after, 1), len(keys) - 1)
    since, gap = time - keys[before], keys[after] - keys[before]
    a, b = poses[before], poses[after]
    if (since <= 0).all() or (a == b).all():  # it stands, as at most times that are looked at
        out[:] = a
        return out
    share = np.clip(since / np.where(gap > 0, gap, 1.0), 0, 1)
    turn = wrap(b[:, 3] - a[:, 3])
    out[:, :3] = a[:, :3] + share[:, None] * (b[:, :3] - a[:, :3])
    out[:, 3] = a[:, 3] + share * turn
    wheels = scene.wheels.get(scene.robots[number])
    moving = (share > 0) & (share < 1) & (np.abs(b[:, :2] - a[:, :2]).max(axis=1) > 0)
    if wheels is None or not len(wheels) or not moving.any():
        return out
    way = [wheels.pose_at(t[moving]) for t in (keys[before], time, keys[after])]
    a, b, s = a[moving], b[moving], share[moving, None]
    now, end = _ahead(a, way[0], way[1]), _ahead(a, way[0], way[2])
    miss = b[:, [0, 1, 3]] - end
    miss[:, 2] = wrap(miss[:, 2])
    bent = now + s * miss
    if np.isfinite(bent).all():
        out[np.ix_(moving, [0, 1, 3])] = bent
    return out


def extent(scene: Scene, samples: int = 400) -> tuple[Array, Array]:
    """Return minimum and maximum x, y [m] of all poses, of the paths between, and of the last observers' views.

    As `Scene.bounds` where there are no poses.
    """
    low, high = scene.bounds
    if not scene.layers or not len(scene):
        return low, high
    times = np.linspace(float(scene.starts[0]), float(scene.ends.max()), samples)
    for number in range(len(scene.robots)):
        way = pose_at(scene, scene.layers[0], number, times)[:, :2]
        if np.isfinite(way).all():
            low, high = np.minimum(low, way.min(axis=0)), np.maximum(high, way.max(axis=0))
    layer = scene.layers[0]
    for number in map(scene.robots.index, scene.stances[-1].observers):
        x, y, _ = layer.xyz[number, -1]
        before = np.array([x + AHEAD * np.cos(layer.yaw[number, -1]), y + AHEAD * np.sin(layer.yaw[number, -1])])
        if np.isfinite(before).all():
            low, high = np.minimum(low, before), np.maximum(high, before)
    return low, high


@lru_cache(maxsize=64)
def _keys(scene: Scene, layer: Layer, number: int) -> tuple[Array, Array]:
    """Return the ascending times (k,) of a robot's known poses, and these poses (k, 4)."""
    rows = layer.rows[number]
    poses = np.concatenate([layer.xyz[number, rows], layer.yaw[number, rows, None]], axis=1)
    stands = scene.standing[number, rows]
    at = layer.times[number, rows]
    keys = np.stack([np.where(stands, scene.starts[rows], at), np.where(stands, scene.ends[rows], at)], axis=1).ravel()
    return np.maximum.accumulate(keys), np.repeat(poses, 2, axis=0)


def _ahead(pose: Array, before: Array, after: Array) -> Array:
    """Return poses (n, 4) moved by the odometry from `before` to `after` (n, 3): x, y, heading (n, 3)."""
    turn = pose[:, 3] - before[:, 2]
    c, s = np.cos(turn), np.sin(turn)
    x, y = (after[:, :2] - before[:, :2]).T
    return np.stack([pose[:, 0] + c * x - s * y, pose[:, 1] + s * x + c * y, after[:, 2] + turn], axis=1)
