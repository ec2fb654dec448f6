"""Several robots that drive about in front of standing cameras, and what detectors make of their lights: `crowd`."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coloc_graph.geometry.se2 import wrap
from coloc_graph.run.messages import Detections, Flag
from coloc_graph.simulation.blinking import Blinking
from coloc_graph.simulation.paths import SPEED, TURN_RATE, Array
from coloc_graph.team.shared_view import View

ROOM = 0.42  # m, least distance between the middles of two robots
STEP = 0.02  # s, time step of their movement
#: Two lights nearer to each other than this are detected as one [px].
MERGING = 4.0


@dataclass(frozen=True)
class Faults:
    """Errors of a detector: `noise_px` an axis, `missed` of all lights, `false_detections` an image on average.

    Lights that touch are one detection, flagged as merged.
    """

    noise_px: float = 0.3
    missed: float = 0.02
    false_detections: float = 5.0


@dataclass(frozen=True, eq=False)
class Seen:
    """Detections of one camera, with the light of each.

    `images` are the detections; the light is mover * markers + marker, -1 where it is none or several.
    """

    images: list[Detections]
    lights: list[NDArray[np.int64]]


def wander(movers: int, seconds: float, area: ArrayLike, rng: np.random.Generator) -> Array:
    """Simulate robots that drive about in an area and avoid each other; return poses (n, movers, 3) every `STEP`.

    Poses are x, y [m], yaw [rad]. The area (4,), or (movers, 4) for each robot, is x from and to, y from and to [m].
    """
    areas = np.broadcast_to(np.asarray(area, float), (movers, 4))
    low, high = areas[:, ::2], areas[:, 1::2]
    poses = np.empty((movers, 3))
    for robot in range(movers):
        for _ in range(1000):
            poses[robot] = *rng.uniform(low[robot], high[robot]), rng.uniform(-np.pi, np.pi)
            if all(np.hypot(*(poses[robot] - other)[:2]) > ROOM for other in poses[:robot]):
                break
        else:
            raise ValueError(f"{movers} robots do not fit into the area")
    goals = rng.uniform(low, high)
    out = np.empty((round(seconds / STEP), movers, 3))
    for k in range(len(out)):
        for robot, (x, y, yaw) in enumerate(poses):
            way = goals[robot] - (x, y)
            turn = float(wrap(np.arctan2(way[1], way[0]) - yaw))
            if np.hypot(*way) < 0.02:
                goals[robot] = rng.uniform(low[robot], high[robot])
            elif abs(turn) > 0.02:
                poses[robot, 2] += np.clip(turn, -TURN_RATE * STEP, TURN_RATE * STEP)
            else:
                there = poses[robot, :2] + SPEED * STEP * np.array([np.cos(yaw), np.sin(yaw)])
                others = np.delete(poses[:, :2], robot, axis=0)
                near, now = np.hypot(*(others - there).T), np.hypot(*(others - poses[robot, :2]).T)
                if ((near < ROOM) & (near < now)).any():
                    goals[robot] = rng.uniform(low[robot], high[robot])
                else:
                    poses[robot, :2] = there
        out[k] = poses
    return out


def lights_of(poses: Array, times: Array, p_markers: Array) -> Array:
    """Return positions (k, movers, m, 3) [m] of markers (m, 3) on robots with poses by `wander` (n, movers, 3).

    At `times` (k,) [s] since the first pose.
    """
    n, movers, _ = poses.shape
    at = np.clip(times / STEP, 0, n - 1)
    x, y = (np.stack([np.interp(at, np.arange(n), poses[:, r, c]) for r in range(movers)], 1) for c in range(2))
    yaw = np.stack([np.interp(at, np.arange(n), np.unwrap(poses[:, r, 2])) for r in range(movers)], 1)
    c, s = np.cos(yaw)[..., None], np.sin(yaw)[..., None]
    px, py, pz = p_markers.T
    xy = np.stack([x[..., None] + c * px - s * py, y[..., None] + s * px + c * py], axis=-1)
    return np.concatenate([xy, np.broadcast_to(pz[:, None], (*xy.shape[:-1], 1))], axis=-1)


def detect(
    view: View,
    robot: str,
    p_lights: Array,
    times: Array,
    faults: Faults,
    rng: np.random.Generator,
    blinking: Sequence[Blinking] = (),
) -> Seen:
    """Detect lights (k, ..., 3) [m] at `times` (k,) [s] with the camera of a standing robot.

    Where robots blink, lights are (k, movers, m, 3).
    """
    uv, inside = view.project(p_lights.reshape(len(times), -1, 3))
    for n, one in enumerate(blinking):
        own = slice(n * p_lights.shape[2], (n + 1) * p_lights.shape[2])
        inside[:, own] &= one.on(times)[:, None]
    images, labels = [], []
    size = np.array([view.camera.width, view.camera.height])
    for time, own, seen in zip(times.tolist(), uv, inside, strict=True):
        there = np.flatnonzero(seen)
        groups = _touching(own[there])
        merged = np.bincount(groups)[groups] > 1 if len(there) else np.zeros(0, bool)
        firsts = np.unique(groups, return_index=True)[1] if len(there) else np.zeros(0, np.int64)
        places = np.array([own[there][groups == groups[first]].mean(axis=0) for first in firsts]).reshape(-1, 2)
        is_merged, which = merged[firsts], np.where(merged[firsts], -1, there[firsts])
        kept = rng.uniform(size=len(places)) >= faults.missed
        wrong = rng.uniform(-0.5, size - 0.5, (rng.poisson(faults.false_detections), 2))
        found = np.concatenate([places[kept] + faults.noise_px * rng.standard_normal((int(kept.sum()), 2)), wrong])
        flags = np.zeros(len(found), np.uint8)
        flags[: kept.sum()][is_merged[kept]] = Flag.MERGED
        order = rng.permutation(len(found))
        none = np.zeros(len(found))
        covariance = np.broadcast_to(faults.noise_px**2 * np.eye(2), (len(found), 2, 2))
        images.append(Detections(robot, time, found[order], covariance, ("",) * len(found), flags[order], none, none))
        labels.append(np.concatenate([which[kept], np.full(len(wrong), -1)])[order].astype(np.int64))
    return Seen(images, labels)


def _touching(uv: Array) -> NDArray[np.int64]:
    """Connected group (n,) of each of n lights that touch, directly or through others."""
    near = np.linalg.norm(uv[:, None] - uv[None], axis=2) < MERGING
    groups = np.arange(len(uv))
    for _ in range(len(uv)):
        joined = np.where(near, groups[None], len(uv)).min(axis=1) if len(uv) else groups
        if (joined == groups).all():
            break
        groups = joined
    return groups


def crowd(
    views: Sequence[View],
    p_markers: Array,
    *,
    movers: int = 5,
    seconds: float = 60.0,
    fps: float = 100.0,
    area: tuple[float, float, float, float] = (0.7, 2.4, -0.8, 0.8),
    faults: Faults | None = None,
    blinking: Sequence[Blinking] = (),
    seed: int = 0,
    start: float = 1_700_000_000.0,
) -> tuple[list[Seen], Array]:
    """Simulate detections by cameras (of robots A, B, ...) of robots that wander in an area.

    Returns them with the positions (k, movers, m, 3) of the lights, which are always on, or `blinking`.
    """
    rng = np.random.default_rng(seed)
    times = np.arange(round(seconds * fps)) / fps
    p_lights = lights_of(wander(movers, seconds + STEP, area, rng), times, p_markers)
    names = [chr(ord("A") + n) for n in range(len(views))]
    faults = faults or Faults()
    return [
        detect(v, name, p_lights, start + times, faults, rng, blinking) for v, name in zip(views, names, strict=True)
    ], p_lights
