"""The mover's drive in a stance of a mission: one smooth curve over the common view, at a steady speed."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from coloc_graph.simulation.paths import Array, Leg
from coloc_graph.simulation.scenarios import Box
from coloc_graph.simulation.tours import BURST_SPACING, Tour, both_see, leave_out, no_common_view
from coloc_graph.team.shared_view import View

SPEED = 0.3  # m/s, of the 0.5 m/s that an iRobot Create reaches
TURN_RATE = 1.5  # rad/s, slower than its wheels allow at that speed
WAYPOINTS = 10  # least number of waypoints of a curve
POINTS_PER_WAYPOINT = 20  # points asked for that call for one more waypoint
CANDIDATES = 200  # places drawn in the common view, of which the waypoints are chosen
TRIES = 50_000  # places drawn before a common view is given up
KNOTS_PER_LEG = 40  # samples of the curve between two waypoints


def meander(
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
    """Drive one curve through places spread uniformly over the common view within a box.

    Captures are evenly spaced along the curve, which makes the markers' places nearly uniform, too.

    Parameters
    ----------
    views
        Cameras of the two observers.
    markers
        Markers of the mover, (m, 3), body frame [m].
    box, middle
        Box of marker places, relative to the middle of the pair on the floor [m].
    points
        Number of correspondences to record, exactly.
    burst
        Captures at each place, `BURST_SPACING` apart.
    start
        Begin of the drive [UTC s].
    rng
        Random numbers of this stance.
    where
        Stance named in an error.

    Raises
    ------
    InputError
        If the two cameras have no common view within the box.
    """
    low = np.array([middle[0] + box.x[0], middle[1] + box.y[0]])
    high = np.array([middle[0] + box.x[1], middle[1] + box.y[1]])
    places = _places(views, float(markers[0, 2]), low, high, rng, where)
    places = _spread(places, max(WAYPOINTS, points // POINTS_PER_WAYPOINT))
    leg = _driven(_curve(places[_short_round(places)]), start)
    offsets = (np.arange(burst) - (burst - 1) / 2) * BURST_SPACING
    number = math.ceil(points / (burst * len(markers)))
    while True:
        way = (np.arange(number) + 0.5) / number * leg.distance[-1]
        instants = (np.interp(way, leg.distance, leg.times)[:, None] + offsets).ravel()
        recorded = _recorded(views, markers, leg, instants, low, high)
        lacking = points - int(recorded.sum())
        if lacking <= 0:
            break
        if number > 100 * points:
            raise no_common_view(where)
        number += max(1, lacking // (burst * len(markers)))
    leave_out(recorded, -lacking)
    used = recorded.any(axis=1)
    return Tour(leg, instants[used], recorded[used])


def _places(
    views: tuple[View, View], height: float, low: Array, high: Array, rng: np.random.Generator, where: str
) -> Array:
    """Draw places (CANDIDATES, 2) on the floor, uniform in the box, above which both cameras see a marker."""
    found, tried = np.zeros((0, 2)), 0
    while len(found) < CANDIDATES:
        if tried >= TRIES and len(found) * 2000 < tried:
            raise no_common_view(where)
        drawn = rng.uniform(low, high, (1000, 2))
        tried += len(drawn)
        seen = both_see(views, np.column_stack([drawn, np.full(len(drawn), height)]))
        found = np.concatenate([found, drawn[seen]])
    return found[:CANDIDATES]


def _spread(places: Array, count: int) -> Array:
    """Choose `count` of the places, each the farthest from those before it: their hull is that of all."""
    chosen = [0]
    apart = np.hypot(*(places - places[0]).T)
    while len(chosen) < min(count, len(places)):
        chosen.append(int(np.argmax(apart)))
        apart = np.minimum(apart, np.hypot(*(places - places[chosen[-1]]).T))
    return places[chosen]


def _short_round(places: Array) -> list[int]:
    """Order (n,) of a short round through places (n, 2) that begins at the nearest: nearest neighbour, then 2-opt.

    A round, not a way, since the drive then ends near the pair, where the next stance begins.
    """
    apart = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))
    order, left = [int(np.argmin(places[:, 0]))], set(range(len(places)))
    while left := left - {order[-1]}:
        order.append(min(left, key=lambda other: (apart[order[-1], other], other)))
    shorter = True
    while shorter:
        shorter = False
        for i in range(1, len(order) - 1):
            # reversing order[i..j] replaces the legs before i and after j
            at = np.array(order)
            after = np.append(at[i + 1 :], at[0])
            gain = apart[at[i - 1], at[i]] + apart[at[i:], after] - apart[at[i - 1], at[i:]] - apart[at[i], after]
            j = int(np.argmax(gain))
            if gain[j] > 1e-9:
                order[i : i + j + 1] = order[i : i + j + 1][::-1]
                shorter = True
    return order


def _curve(places: Array) -> Array:
    """Knots (n, 3) of x, y [m], heading [rad, unwrapped] of a smooth curve through places in order."""
    # centripetal parameters keep a spline through uneven places from overshooting
    at = np.concatenate([[0.0], np.cumsum(np.sqrt(np.hypot(*np.diff(places, axis=0).T)))])
    spline = CubicSpline(at, places)
    fine = np.interp(np.linspace(0, len(at) - 1, KNOTS_PER_LEG * (len(at) - 1) + 1), np.arange(len(at)), at)
    velocity = spline(fine, 1)
    return np.column_stack([spline(fine), np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))])


def _driven(knots: Array, start: float) -> Leg:
    """Knots driven at `SPEED`, slower where the robot would turn faster than `TURN_RATE`."""
    step = np.diff(knots, axis=0)
    taken = np.maximum(np.hypot(step[:, 0], step[:, 1]) / SPEED, np.abs(step[:, 2]) / TURN_RATE)
    return Leg(start + np.concatenate([[0.0], np.cumsum(taken)]), knots)


def _recorded(
    views: tuple[View, View], markers: Array, leg: Leg, instants: Array, low: Array, high: Array
) -> NDArray[np.bool_]:
    """Markers (n, m) that both cameras see within the box at instants (n,)."""
    x, y, yaw = (np.interp(instants, leg.times, column) for column in leg.knots.T)
    c, s = np.cos(yaw), np.sin(yaw)
    mx, my = markers[:, 0], markers[:, 1]
    xy = np.stack([x[:, None] + c[:, None] * mx - s[:, None] * my, y[:, None] + s[:, None] * mx + c[:, None] * my], -1)
    seen = both_see(views, np.concatenate([xy, np.full((*xy.shape[:2], 1), markers[0, 2])], axis=-1))
    return np.asarray(seen & ((xy >= low) & (xy <= high)).all(axis=-1))
