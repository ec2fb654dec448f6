"""Path of the mover in a stance: waypoints by optimal design within the common view; `MoverPlanner`."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, permutations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coloc_graph.planning.drive import SPEED, drive_through, there_and_back
from coloc_graph.planning.room import Room
from coloc_graph.planning.route import Free, clear_way
from coloc_graph.planning.stance_information import Seen, StanceModel

Array = NDArray[np.float64]
Waypoint = tuple[float, float]

CELL = 0.2  # distance between places that are weighed [m]
AHEAD = (0.3, 2.6)  # the cells begin and end this far ahead of an observer [m]
ASIDE = 1.6  # and go this far to either side [m]
YAWS = (0.0, np.pi / 2)  # headings at which each place is weighed [rad]
CLEARANCE = 0.45  # distance of the mover's middle from robots that stand [m]
ROUNDS = 12  # steps of the multiplicative algorithm
MERGED = 0.35  # places nearer to each other are one waypoint [m]
MAX_PLACES = 5  # number of places with large shares through which drives are tried
WORTH = 0.5  # a share is large above this, relative to equal shares
KNOTS = 8  # number of places through which drives are tried, with the outermost ones
LONGER = 10  # number of drives through three places that are tried with a fourth
KEPT = 3  # number of drives that are kept
SPREAD = 14  # cells of a common view by which stances are compared
BEND = 0.04  # RMS distance of a view's cells from a line below which they are taken for the line [m]
SAMPLES = 24  # instants at which a drive is compared with the places


@dataclass(frozen=True, eq=False)
class Cells:
    """Places of the mover in the common view of a stance.

    Attributes
    ----------
    places
        Places (n, 2) [m] where cameras see all its markers at any heading, and it is clear of robots and walls.
    seen
        Information of one image of each camera there.
    by_variables
        Derivatives (k, d) of the variables of `seen` by those of the stance.
    standing
        Places (r, 2) of the robots that stand [m].
    room
        Distances (r,) that the mover keeps from each of them in any case [m].
    free
        Returns which places are free of walls; None without a map.
    slips
        By which the mover keeps more, the further it has driven; None for no more.
    watching
        Observers, as indices, that see the mover at all places; () where some two do.
    """

    places: Array
    seen: Seen
    by_variables: Array
    standing: Array
    room: Array
    free: Free | None = None
    slips: Room | None = None
    watching: tuple[int, ...] = ()

    def clear(self, points: Array) -> bool:
        """Return whether a drive through points (n, 2) is clear of the robots that stand and of walls."""
        to_robot = np.maximum(CLEARANCE - CELL / 10, self.room)
        return clear_way(points, self.standing, self.free, to_robot=to_robot, room=self.slips)


def cells(
    model: StanceModel,
    standing: Array,
    margins: Array,
    free: Free | None = None,
    leapt: ArrayLike = 0.0,
    slips: Room | None = None,
    groups: Sequence[tuple[int, ...]] = ((),),
) -> Cells:
    """Find the places of the common view of observers at poses (r, 3), and what an image from each brings.

    Markers are at least `margins` (r, 2) [px] from the borders of the images: left and right, upper and lower.
    The observers come from leaps of `leapt` () or (r,) [m], and they and the mover slip by `slips`. All of one of the
    `groups` of observers see the mover at each place, that of the largest common view; of () some two.
    """
    slips = slips or Room()
    room = np.broadcast_to(slips.apart(leapt), len(standing))
    views = [places_in_common_view(model, standing, margins, room, free, group) for group in groups]
    number = max(range(len(views)), key=lambda n: len(views[n]))
    places, watching = views[number], groups[number]
    drive = np.concatenate([np.column_stack([places, np.full(len(places), yaw)]) for yaw in YAWS])
    counts = np.isin(np.arange(len(standing)), watching or np.arange(len(standing)))
    seen = model.see(standing, drive, counts).mean_of(len(YAWS))
    return Cells(places, seen, model.by_variables, standing[:, :2], room, free, slips, watching)


def places_in_common_view(
    model: StanceModel,
    standing: Array,
    margins: Array,
    room: Array,
    free: Free | None = None,
    group: tuple[int, ...] = (),
) -> Array:
    """Places (n, 2) [m] where two cameras see all markers of the mover at any heading, clear of robots and walls.

    Or the cameras of a `group` of observers, as indices.
    """
    xy = _grid(model, standing)
    away = np.hypot(*np.moveaxis(xy[:, None] - standing[None, :, :2], -1, 0))
    xy = xy[(away > np.maximum(CLEARANCE, room)).all(axis=1)]
    if free is not None:
        xy = xy[free(xy, CLEARANCE / 2)]
    return np.asarray(xy[commonly_seen(model, standing, xy, margins, group)])


def commonly_seen(
    model: StanceModel, standing: Array, places: Array, margins: Array, group: tuple[int, ...] = ()
) -> NDArray[np.bool_]:
    """Return at which places (n, 2) two cameras, or those of a `group`, see all markers of the mover at any heading."""
    seen = model.in_view(standing, _rim(model, places).reshape(-1, 3), margins).reshape(len(standing), len(places), 4)
    whole = np.asarray(seen.all(axis=2))
    return np.asarray(whole[list(group)].all(axis=0) if group else whole.sum(axis=0) >= 2)


def _rim(model: StanceModel, places: Array) -> Array:
    """Four points (n, 4, 3) of the circle on which markers of a mover at places (n, 2) are [m]."""
    reach = float(np.hypot(*model.p_markers[:, :2].T).max())
    rim = reach * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    return np.concatenate([places[:, None] + rim, np.full((len(places), 4, 1), model.p_markers[0, 2])], axis=-1)


def _grid(model: StanceModel, standing: Array) -> Array:
    """Places (n, 2) of a grid ahead of the first observer's camera."""
    x, y, yaw = model.camera(standing[0])
    ahead, aside = np.meshgrid(np.arange(*AHEAD, CELL), np.arange(-ASIDE, ASIDE + 1e-9, CELL), indexing="ij")
    c, s = np.cos(yaw), np.sin(yaw)
    return np.column_stack([x + c * ahead.ravel() - s * aside.ravel(), y + s * ahead.ravel() + c * aside.ravel()])


def design(found: Cells, covariance: Array, rows: NDArray[np.int64], goal: Array, images: float) -> Array:
    """Return the shares (n,) of a stance's images that make the goal's variance least.

    Parameters
    ----------
    found
        Places of the common view.
    covariance
        Covariance (m, m) of the team before the stance, and the `rows` of it that are the stance's variables.
    goal
        Derivatives (q, m) of what is to be known by the team's variables.
    images
        Number of images of each camera.

    Notes
    -----
    Multiplicative algorithm for optimal designs: a share grows with the root of its sensitivity (Silvey, Titterington
    and Torsney, 1978).
    """
    shares = np.full(len(found.places), 1 / len(found.places))
    small, Gr = _as_seen(found, covariance, rows, goal)
    for _ in range(ROUNDS):
        total = found.seen.total(images * shares)
        # G C restricted to what is seen, after it
        after = Gr @ np.linalg.inv(np.eye(len(total)) + total @ small)
        gain = found.seen.sensitivities(images * shares, after)
        shares = shares * np.sqrt(np.maximum(gain, 0.0))
        shares /= shares.sum()
    return np.asarray(shares)


def _as_seen(found: Cells, covariance: Array, rows: NDArray[np.int64], goal: Array) -> tuple[Array, Array]:
    """Covariance (k, k) of the variables of `Cells.seen` before the stance, and that (q, k) of the goal with them."""
    by = found.by_variables.T
    return by.T @ covariance[np.ix_(rows, rows)] @ by, goal @ covariance[:, rows] @ by


def best_drives(
    found: Cells,
    shares: Array,
    covariance: Array,
    rows: NDArray[np.int64],
    goal: Array,
    *,
    duration: float,
    fps: float,
    speed: float = SPEED,
) -> list[tuple[Waypoint, ...]]:
    """Find the clear drives of a `duration` [s] that leave the goal's variance least, the best one first.

    The design's shares ignore that a robot must drive from place to place. Drives through two, three and four of the
    places that matter are compared by the information of the places that they pass.

    Parameters
    ----------
    found, shares
        Places of the common view, and the shares of the best design.
    covariance, rows, goal
        As for `design`.
    duration, fps, speed
        Duration of the drive [s], images a second, and speed [m/s].
    """
    points = found.places[_knots(found.places, shares)]
    clear = np.zeros((len(points), len(points)), bool)
    for a, b in combinations(range(len(points)), 2):
        clear[a, b] = clear[b, a] = found.clear(points[[a, b]])
    paths = [list(pair) for pair in combinations(range(len(points)), 2) if clear[pair]]
    paths += [[a, b, c] for a, b, c in permutations(range(len(points)), 3) if a < c and clear[a, b] and clear[b, c]]
    value = _values(found, points, paths, covariance, rows, goal, duration, fps, speed)
    longer = [
        [*paths[n], more]
        for n in np.argsort(value)[:LONGER].tolist()
        for more in range(len(points))
        if more not in paths[n] and clear[paths[n][-1], more]
    ]
    value = np.concatenate([value, _values(found, points, longer, covariance, rows, goal, duration, fps, speed)])
    paths += longer
    return [tuple((float(x), float(y)) for x, y in points[paths[n]]) for n in np.argsort(value)[:KEPT].tolist()]


def _bends(points: Array, chosen: Array) -> Array:
    """RMS distance (...) from the line that fits best [m], of points (..., n, 2) that are `chosen` (..., n)."""
    weight = chosen / np.maximum(chosen.sum(axis=-1, keepdims=True), 1.0)
    off = points - (weight[..., None] * points).sum(axis=-2, keepdims=True)
    xx, xy, yy = ((weight * off[..., i] * off[..., j]).sum(axis=-1) for i, j in ((0, 0), (0, 1), (1, 1)))
    least = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
    return np.asarray(np.sqrt(np.maximum(least, 0.0)))


def _knots(places: Array, shares: Array) -> list[int]:
    """Places that matter: those with the largest shares, and the outermost ones."""
    left = shares.copy()
    chosen: list[int] = []
    while len(chosen) < MAX_PLACES and left.max() > WORTH / len(places):
        chosen.append(int(np.argmax(left)))
        left[np.hypot(*(places - places[chosen[-1]]).T) < MERGED] = 0.0
    apart = np.min([np.hypot(*(places - places[n]).T) for n in chosen], axis=0)
    while len(chosen) < min(KNOTS, len(places)):
        chosen.append(int(np.argmax(apart)))
        apart = np.minimum(apart, np.hypot(*(places - places[chosen[-1]]).T))
    return chosen


def _values(
    found: Cells,
    points: Array,
    paths: list[list[int]],
    covariance: Array,
    rows: NDArray[np.int64],
    goal: Array,
    duration: float,
    fps: float,
    speed: float,
) -> Array:
    """Variance (n,) of the goal after each of n drives."""
    if not paths:
        return np.zeros(0)
    instants = (np.arange(SAMPLES) + 0.5) / SAMPLES * duration
    at = np.array([drive_through(there_and_back(points[p], duration, speed), speed).at(instants)[:, :2] for p in paths])
    away = np.hypot(*np.moveaxis(at[:, :, None] - found.places, -1, 0))
    nearest = away.argmin(axis=2)
    seen = away.min(axis=2) < CELL
    images = np.zeros((len(paths), len(found.places)))
    np.add.at(images, (np.repeat(np.arange(len(paths)), SAMPLES), nearest.ravel()), seen.ravel())
    images *= duration * fps / SAMPLES
    total = found.seen.total(images)
    small, Gr = _as_seen(found, covariance, rows, goal)
    drop = total @ np.linalg.inv(np.eye(len(small)) + small @ total)
    return np.asarray(np.trace(goal @ covariance @ goal.T) - np.einsum("qi,nij,qj->n", Gr, drop, Gr, optimize=True))


def patrol(places: Array, heading: float = 0.0) -> tuple[Waypoint, ...]:
    """Return the drive of the paper's missions: near, both far corners, and the middle of places (n, 2) in view.

    `heading` [rad] is the direction of travel.
    """
    c, s = np.cos(heading), np.sin(heading)
    directions = np.array([[-1.0, 0.0], [1.0, 1.5], [1.0, -1.5]]) @ np.array([[c, s], [-s, c]])
    corners = places[np.argmax(places @ directions.T, axis=0)]
    return tuple((float(x), float(y)) for x, y in np.vstack([corners, places.mean(axis=0)]))


def evenly_seen(
    model: StanceModel, standing: Array, margins: Array, free: Free | None = None, *, by_last: bool = False
) -> tuple[Array, Array]:
    """Return what an image brings in many stances, spread evenly over the common view of each.

    Parameters
    ----------
    model
        The stance's robots; all but the last observer stand in the same places in all.
    standing
        Poses (b, r, 3) of the observers.
    margins
        Distances (b, r, 2) of the markers from the borders of the images [px].
    free
        Returns which places are free of walls.
    by_last
        True where only places count that the last observer sees.

    Returns
    -------
    tuple
        Information (b, d, d), and the number (b,) of cells of the common view, 0 of one that is a line: a drive there
        determines no homography.
    """
    xy, r = _grid(model, standing[0]), standing.shape[1]
    if free is not None:
        xy = xy[free(xy, CLEARANCE / 2)]
    points = _rim(model, xy)
    # all but the last observer are the same in all: what none of them sees need not be asked of the last
    alone = (
        model.in_view(standing[:1], points.reshape(1, -1, 3), 0.0)[0, :-1].reshape(r - 1, -1, 4).all(axis=2).any(axis=0)
    )
    xy, points = xy[alone], points[alone]
    if not len(xy):  # it looks at a wall
        return np.zeros((len(standing), model.variables, model.variables)), np.zeros(len(standing), int)
    everywhere = np.broadcast_to(points.reshape(-1, 3), (len(standing), 4 * len(xy), 3))
    seen = model.in_view(standing, everywhere, margins).reshape(len(standing), -1, len(xy), 4)
    whole = np.asarray(seen.all(axis=3))
    common = whole.sum(axis=1) >= 2
    if by_last:
        common &= whole[:, -1]
    away = np.hypot(*np.moveaxis(xy[None, :, None] - standing[:, None, :, :2], -1, 0)).min(axis=2)
    common &= away > CLEARANCE
    count = np.where(_bends(xy, common) >= BEND, common.sum(axis=1), 0)
    # a few cells of each, spread by a fixed order
    rank = np.random.default_rng(0).permutation(len(xy))
    chosen = np.argsort(np.where(common, rank, len(xy) + rank), axis=1)[:, :SPREAD]
    used = np.take_along_axis(common, chosen, axis=1)
    yaw = np.where(rank[chosen] % 2, YAWS[1], YAWS[0])
    drive = np.concatenate([xy[chosen], yaw[..., None]], axis=-1)
    weight = used / np.maximum(used.sum(axis=1, keepdims=True), 1)
    return model.of_stance(model.see(standing, drive).total(weight)), count
