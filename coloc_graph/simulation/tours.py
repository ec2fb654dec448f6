"""Drives of the mover in a stance: `scatter` for uniformly spread marker points, `patrol` for images."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.geometry.se2 import wrap
from coloc_graph.simulation.paths import SPEED, Array, Leg, drive, stop_and_go, travel
from coloc_graph.simulation.scenarios import Box
from coloc_graph.team.shared_view import View, positions_in_view

#: Half the straight stretch on which a pose is passed [m]: a late capture sees the marker move evenly.
RUN_IN = 0.03

#: Between the captures of one burst [s], and how many fit the straight stretch.
BURST_SPACING = 0.05
MAX_BURST = 5

#: Robots and their images stay this far [px] from the border: tracks; images, where a spot has a size.
TRACK_MARGIN = 1.0
IMAGE_MARGIN = 8.0

#: Depths at which images are taken, from the pair's middle [m]; a short stance is less deep, to be wide.
NEAR = 0.45
FAR = 2.2
FAR_IN_HASTE = 1.5


@dataclass(frozen=True, eq=False)
class Tour:
    """A drive of the mover, the instants (n,) [s] of captures, and which markers (n, m) to record.

    `by_view` (r, n, m) says so of each camera, where they do not all see the same.
    """

    leg: Leg
    instants: Array
    recorded: NDArray[np.bool_]
    by_view: NDArray[np.bool_] | None = None


def no_common_view(where: str) -> InputError:
    """The error for a pair that has no view in common."""
    return InputError(
        f"{where}: the two standing robots have no common view of the marker plane; "
        "bring them nearer, or turn their cameras towards each other"
    )


def scatter(
    views: tuple[View, View],
    markers: Array,
    box: Box,
    middle: tuple[float, float],
    points: int,
    burst: int,
    start: float,
    rng: np.random.Generator,
    where: str,
) -> Tour:
    """Markers (m, 3) [body, m] at exactly `points` places spread uniformly over the common view within a box.

    A place and a yaw of the body are drawn for a random marker; the others are recorded where both cameras
    see them within the box. The poses are driven through in a short order, each along its own heading, with
    `burst` captures `BURST_SPACING` apart. `where` names the stance in an error.
    """
    poses, recorded = _draw(views, markers, box, middle, points, burst, rng, where)
    order, ahead = _short_order(poses)
    poses, recorded, ahead = poses[order], recorded[order], ahead[order]
    along = ahead[:, None] * RUN_IN * np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
    entry_exit = np.repeat(poses, 2, axis=0)
    entry_exit[0::2, :2] -= along
    entry_exit[1::2, :2] += along
    leg, reached = drive(entry_exit, start, reverse=True)
    passed = leg.times[reached].reshape(-1, 2).mean(axis=1)
    offsets = (np.arange(burst) - (burst - 1) / 2) * BURST_SPACING
    instants = (passed[:, None] + offsets).ravel()
    recorded = np.repeat(recorded, burst, axis=0)
    leave_out(recorded, int(recorded.sum()) - points)
    used = recorded.any(axis=1)
    return Tour(leg, instants[used], recorded[used])


def leave_out(recorded: NDArray[np.bool_], surplus: int) -> None:
    """Strike the last `surplus` records, so that exactly the number asked for is left."""
    if surplus > 0:
        rows, columns = np.nonzero(recorded)
        recorded[rows[-surplus:], columns[-surplus:]] = False


def _draw(
    views: tuple[View, View],
    markers: Array,
    box: Box,
    middle: tuple[float, float],
    points: int,
    burst: int,
    rng: np.random.Generator,
    where: str,
) -> tuple[Array, NDArray[np.bool_]]:
    """Poses (n, 3) of the body and which markers (n, m) both cameras see there: at least `points` in all."""
    low = np.array([middle[0] + box.x[0], middle[1] + box.y[0]])
    high = np.array([middle[0] + box.x[1], middle[1] + box.y[1]])
    poses, seen, found, tried = [], [], 0, 0
    while found * burst < points:
        n = max(1000, 4 * points)
        if tried >= 50_000 and found * 2000 < tried:
            raise no_common_view(where)
        tried += n
        P, turn = rng.uniform(low, high, (n, 2)), rng.uniform(-np.pi, np.pi, n)
        which = rng.integers(len(markers), size=n)
        ok = both_see(views, np.column_stack([P, np.full(n, markers[0, 2])]))
        P, turn, which = P[ok], turn[ok], which[ok]
        c, s = np.cos(turn), np.sin(turn)
        R_world_body = np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)
        arms = np.einsum("nij,mj->nmi", R_world_body, markers[:, :2])
        body = P - arms[np.arange(len(P)), which]
        xy = body[:, None] + arms
        both = both_see(views, np.concatenate([xy, np.full((*xy.shape[:2], 1), markers[0, 2])], axis=-1))
        both &= ((xy >= low) & (xy <= high)).all(axis=-1)
        # a pose that shows n markers is found n times as often: thinned so that all places stay equally likely
        kept = rng.uniform(size=len(both)) * both.sum(axis=-1) < 1
        poses.append(np.column_stack([body, turn])[kept])
        seen.append(both[kept])
        found += int(both[kept].sum())
    all_poses, all_seen = np.concatenate(poses), np.concatenate(seen)
    enough = int(np.searchsorted(np.cumsum(all_seen.sum(axis=1)) * burst, points)) + 1
    return all_poses[:enough], all_seen[:enough]


def both_see(views: tuple[View, View], points_world: Array) -> NDArray[np.bool_]:
    """Mask (...) of the points (..., 3) [world, m] in view of both cameras."""
    return views[0].sees(points_world, TRACK_MARGIN) & views[1].sees(points_world, TRACK_MARGIN)


def sees(view: View, points_world: Array) -> NDArray[np.bool_]:
    """Mask (...) of the points (..., 3) [world, m] in a view."""
    return view.sees(points_world, TRACK_MARGIN)


def _short_order(poses: Array) -> tuple[NDArray[np.int64], Array]:
    """Return a short order (n,) of poses (n, 3), always to the one soonest reached.

    With the direction in which each is passed: forwards (1) or backwards (-1).
    """
    n = len(poses)
    order, ahead = np.zeros(n, np.int64), np.ones(n)
    left = np.ones(n, bool)
    at = int(np.argmin(poses[:, 0]))
    for i in range(n):
        order[i], left[at] = at, False
        step = poses[:, :2] - poses[at, :2]
        heading = np.arctan2(step[:, 1], step[:, 0])
        cost = np.hypot(*step.T) / SPEED + np.abs(wrap(heading - poses[at, 2], np.pi))
        cost += np.abs(wrap(heading - poses[:, 2], np.pi))
        cost[~left] = np.inf
        to = int(np.argmin(cost))
        if i + 1 < n:
            ahead[to] = 1.0 if np.cos(heading[to] - poses[to, 2]) >= 0 else -1.0
        at = to
    return order, ahead


def patrol(
    views: tuple[View, View],
    markers: Array,
    middle: tuple[float, float],
    frames: int,
    fps: float,
    start: float,
    rng: np.random.Generator,
    where: str,
    stopping: bool = False,
) -> Tour:
    """A drive from corner to corner of the common view, and `frames` captures at `fps` [1/s] from its start.

    The corners are taken in an order that spreads the markers widely however early the drive ends. With `stopping`
    it stops and goes on its way, softly.
    """

    def driven(waypoints: Array) -> Leg:
        leg = travel(waypoints, start)
        return stop_and_go(leg) if stopping else leg

    duration = frames / fps
    left = bool(rng.integers(2))  # which of the far corners comes first
    for far in np.arange(FAR, FAR_IN_HASTE - 1e-9, -0.1):
        lap = _corners(views, markers, middle, float(far), left, where)
        leg = driven(lap[:3])
        if leg.times[-1] - start <= duration:
            break
    waypoints = lap
    leg = driven(waypoints)
    while leg.times[-1] - start < duration:
        waypoints = np.concatenate([waypoints, lap])
        leg = driven(waypoints)
    instants = start + (np.arange(frames, dtype=np.float64) + 0.5) / fps
    return Tour(leg.cut(duration), instants, np.ones((frames, len(markers)), bool))


def _corners(
    views: tuple[View, View], markers: Array, middle: tuple[float, float], far: float, left: bool, where: str
) -> Array:
    """Places (4, 2) of the body where both cameras see all markers at any yaw: near, far corners, middle."""
    region = positions_in_view(views, markers, middle, (NEAR, far), IMAGE_MARGIN)
    if len(region) < 3:
        raise no_common_view(where)
    side = 1.0 if left else -1.0
    directions = np.array([[-1.0, 0.0], [1.0, 1.5 * side], [1.0, -1.5 * side]])
    extreme = np.argmax(region @ directions.T, axis=0)
    return np.vstack([region[extreme], region.mean(axis=0)])
