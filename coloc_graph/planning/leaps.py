"""Targets to which an observer can leap: clear of walls and robots, on its way too; `Leaps`, `possible_leaps`."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.se2 import Planar, between, wrap
from coloc_graph.planning.belief import Belief, leap_model
from coloc_graph.planning.clearance import apart, off_walls
from coloc_graph.planning.course import Course
from coloc_graph.planning.floor_map import FloorMap
from coloc_graph.planning.formation import Gait
from coloc_graph.planning.prediction import Predictor
from coloc_graph.planning.route import TO_ROBOT, reachable

Array = NDArray[np.float64]

ADVANCES = (0.25, 0.5, 0.7, 0.85, 1.0, 1.15, 1.35)  # of a target ahead of the front observer, in leaps of the gait
WIDTHS = (0.7, 1.0, 1.7)  # of a target's distance from the course, in those of the gait
TOE_INS = (0.0, 1.0, 1.5)  # of a target's heading against the course, in those of the gait
AHEAD = 0.8  # a robot may look along the course this far ahead of where it stands [m]
TURNS = (0.0, 0.35, 0.7, 1.0)  # share of a corner by which a target is turned
BEND = 0.1  # turn of the course that is a corner [rad]
MAX_LEAP = 1.5  # advance of a target [m]
TO_WALL = 0.25  # least distance of a robot's middle from walls [m]
STEP = 0.1  # distance between places of a leap that are checked [m]
MANY = 4  # observers from which on fewer targets are compared, each of which costs more
FAILED = 0.15  # targets nearer to one that failed are avoided [m]


@dataclass(frozen=True, eq=False)
class Leaps:
    """Leaps of one observer.

    Attributes
    ----------
    leaper, anchors
        The observer that leaps, and those that stay.
    targets
        Poses (n, 3) in the world: x [m], y [m], yaw [rad].
    gains
        Way (n,) by which each brings the middle of the observers on [m].
    F, Q
        How each leap changes the error of its pose, and the covariance that it adds, (n, 6, 6).
    margins
        Distances (n, r, 2) of markers from the borders of images at which the views do not miss them [px].
    by_gait
        True (n,) for those of the gait itself.
    times
        Time (n,) of each until all robots stand [s].
    """

    leaper: str
    anchors: tuple[str, ...]
    targets: Array
    gains: Array
    F: Array
    Q: Array
    margins: Array
    by_gait: NDArray[np.bool_]
    times: Array


def possible_leaps(
    belief: Belief,
    leaper: str,
    course: Course,
    gait: Gait,
    observers: Sequence[str],
    predictor: Predictor,
    avoid: Sequence[Planar] = (),
    *,
    in_lane: bool = False,
    roomy: bool = True,
) -> Leaps:
    """Find the leaps of an observer: those of a gait, and longer, shorter, wider ones; at corners also half turned.

    Parameters
    ----------
    belief, leaper
        The team where it stands, and the observer that is to leap.
    course, gait, observers, predictor
        The way, the gait that leads along it, the robots that leap, and their cameras, speed and map.
    avoid
        Targets that have failed.
    in_lane
        True for targets in the gait's formation alone, and, at corners, beside the course.
    roomy
        True for targets that are so far from others as both may stop off.
    """
    ways = {name: course.way_of(belief.poses[name]) for name in observers}
    anchors = tuple(sorted((name for name in observers if name != leaper), key=lambda name: -ways[name]))
    front = ways[anchors[0]]
    targets, gains, by_gait = [], [], []
    lane = -1.0 if observers.index(leaper) % 2 else 1.0
    if len(observers) > 2:  # beside the foremost one
        x, y, heading = course.at(front)
        ahead = belief.poses[anchors[0]]
        lane = 1.0 if (ahead[1] - y) * np.cos(heading) - (ahead[0] - x) * np.sin(heading) < 0 else -1.0
    before = course.at(front)[2]
    turning = any(abs(float(wrap(course.at(front + ahead)[2] - before))) > BEND for ahead in (AHEAD, 2 * AHEAD))
    toe_ins = TOE_INS if len(observers) < MANY else TOE_INS[:2]
    ahead_of = {}
    for advance in ADVANCES:
        way = front + min(advance * gait.leap, MAX_LEAP)
        # near a corner a robot may look into it
        ahead_of[advance] = way, course.at(way), float(wrap(course.at(way + AHEAD)[2] - before))
    for advance, side, width, toe, turned in product(ADVANCES, (-1.0, 1.0), WIDTHS, toe_ins, TURNS):
        way, (x, y, heading), bend = ahead_of[advance]
        straight = abs(bend) < BEND
        if straight and turned < 1.0:
            continue
        own = straight and side == lane and width == toe == 1.0
        if in_lane and not own and not (turning and width == toe == 1.0):
            continue
        c, s = np.cos(heading), np.sin(heading)
        lateral, turn = side * width * gait.abreast / 2, -side * toe * np.radians(gait.toe_in_deg)
        looks = before + turned * bend + turn
        targets.append((x - lateral * s, y + lateral * c, looks - predictor.camera_yaw(leaper)))
        gains.append((way - ways[leaper]) / len(observers))
        by_gait.append(own and advance == 1.0)
    places = np.array(targets).reshape(-1, 3)
    others = np.array([belief.poses[name][:2] for name in anchors])
    slips = [belief.leapt.get(name, 0.0) if roomy else None for name in anchors]
    good = _clear(np.array(belief.poses[leaper][:2]), places[:, :2], others, slips, predictor.floor_map)
    for x, y, yaw in (*avoid, belief.poses[leaper]):
        near = np.hypot(places[:, 0] - x, places[:, 1] - y) < FAILED
        good &= ~(near & (np.abs(places[:, 2] - yaw) < FAILED))
    places, kept = places[good], np.array(gains)[good]
    made = [
        leap_model(between(belief.poses[leaper], (x, y, yaw)), belief.floor, predictor.wheels)
        for x, y, yaw in places.tolist()
    ]
    F = np.array([one for one, _ in made]).reshape(-1, 6, 6)
    Q = np.array([one for _, one in made]).reshape(-1, 6, 6)
    leapt = np.hypot(*(places[:, :2] - np.array(belief.poses[leaper][:2])).T)
    margins = predictor.margins(leapt, (*anchors, leaper))
    times = np.array([predictor.leap_time(belief.poses[leaper], (x, y, w)) for x, y, w in places.tolist()])
    return Leaps(leaper, anchors, places, kept, F, Q, margins, np.array(by_gait, bool)[good], times)


def _clear(
    start: Array, targets: Array, others: Array, slips: Sequence[float | None], floor_map: FloorMap | None
) -> NDArray[np.bool_]:
    """Return which targets (n, 2) a robot can reach from `start`, clear of others and walls.

    In a straight line, if there are such; else round what is in its way. The others come from leaps of `slips` [m];
    None to let that be.
    """
    leapt = np.hypot(*(targets - start).T)
    longest = float(leapt.max(initial=STEP))
    along = np.linspace(0.0, 1.0, int(np.ceil(longest / STEP)) + 1)[:, None]
    way = start + along * (targets - start)[:, None]
    good, straight = np.ones((2, len(targets)), bool)
    for other, slip in zip(others, slips, strict=True):
        good &= np.hypot(*np.moveaxis(targets - other, -1, 0)) > (TO_ROBOT if slip is None else apart(leapt, slip))
        # it may stand nearer already
        least = min(TO_ROBOT, float(np.hypot(*(start - other))) - 0.01)
        straight &= np.hypot(*np.moveaxis(way - other, -1, 0)).min(axis=1) > least
    if floor_map is not None:
        straight &= floor_map.clear(way, TO_WALL).all(axis=1)
        good &= floor_map.clear(targets, off_walls(leapt, least=TO_WALL))
    # few are in the way of a pair; of more robots some are
    if not (good & straight).any():
        free = None if floor_map is None else floor_map.clear
        straight[good] = reachable(start, targets[good], others, free)
    return np.asarray(good & straight)
