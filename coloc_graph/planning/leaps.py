"""Targets to which an observer can leap: clear of walls and robots, on its way too; `Leaps`, `possible_leaps`."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.se2 import Planar, between, wrap
from coloc_graph.planning.belief import POSE, Belief, leap_model
from coloc_graph.planning.course import Course
from coloc_graph.planning.floor_map import FloorMap
from coloc_graph.planning.formation import Gait
from coloc_graph.planning.prediction import Predictor
from coloc_graph.planning.room import TO_ROBOT, Room
from coloc_graph.planning.route import clear_way, reachable

Array = NDArray[np.float64]

ADVANCES = (0.25, 0.5, 0.7, 0.85, 1.0, 1.15, 1.35)  # of a target ahead of the front observer, in leaps of the gait
BEHIND = (-1.2, -0.8, -0.4)  # the same of one that comes up once the front is at the goal
WIDTHS = (0.7, 1.0, 1.7)  # of a target's distance from the course, in those of the gait
TOE_INS = (0.0, 1.0, 1.5)  # of a target's heading against the course, in those of the gait
AHEAD = 0.8  # a robot may look along the course this far ahead of where it stands [m]
LEFT_BEHIND = 1.5  # a robot further behind the foremost one comes up to it where it cannot leap ahead of it [m]
COME_UP = 0.3  # by which a robot comes up at least to one in front of it [m]
TURNS = (0.0, 0.35, 0.7, 1.0)  # share of a corner by which a target is turned
LOOKS_BACK = 0.35  # a robot looks along an earlier part of the course from this angle on, beside its toe-in [rad]
BEND = 0.1  # turn of the course that is a corner [rad]
MAX_LEAP = 1.5  # advance of a target [m]
TO_WALL = 0.25  # least distance of a robot's middle from walls [m]
STEP = 0.1  # distance between places of a leap that are checked [m]
ROUND_STEP = 0.5  # leaps whose lengths differ by less go round robots at the same distance [m]
MANY = 4  # observers from which on fewer targets are compared, each of which costs more
FAILED = 0.15  # targets nearer to one that failed are avoided [m]
ASIDE = (0.25, 0.45)  # lengths of a step aside [m]
DIRECTIONS = 8  # directions of a step aside
BESIDE = (-0.3, 0.0, 0.3)  # distances ahead of a robot, beside which another comes to look where it looks [m]


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

    def covariances(self, belief: Belief, which: NDArray[np.int64]) -> Array:
        """Return the covariances (b, d, d) of a team after some (b,) of these leaps; `belief` is before them."""
        at = belief.index(self.leaper)
        pose = slice(at, at + POSE)
        F, P = self.F[which], np.repeat(belief.covariance[None], len(which), axis=0)
        P[:, pose] = F @ P[:, pose]
        P[:, :, pose] = P[:, :, pose] @ F.mT
        P[:, pose, pose] += self.Q[which]
        return P


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
    come_up: bool = False,
    absent: Sequence[str] = (),
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
    come_up
        True for targets behind the foremost robot, once that is at the goal or far ahead.
    absent
        Robots that are taken to be in nobody's way, to find out whether they are.
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
    foremost = belief.poses[anchors[0]][2] + predictor.camera_yaw(anchors[0])
    looks_back = abs(float(wrap(foremost - before))) > 1.5 * np.radians(gait.toe_in_deg) + LOOKS_BACK
    if looks_back and predictor.anew:  # it has passed a corner, and looks as before that: turn on from there
        before, turning = foremost, True
    toe_ins = TOE_INS if len(observers) < MANY else TOE_INS[:2]
    advances: tuple[float, ...] = ADVANCES
    if come_up:
        at_goal = front > course.length - ADVANCES[0] * gait.leap
        left_behind = predictor.anew and front - ways[leaper] > LEFT_BEHIND
        advances = BEHIND if at_goal or left_behind else ()
    ahead_of = {}
    for advance in advances:
        way = front + min(advance * gait.leap, MAX_LEAP)
        # near a corner a robot may look into it
        ahead_of[advance] = way, course.at(way), float(wrap(course.at(way + AHEAD)[2] - before))
    for advance, side, width, toe, turned in product(advances, (-1.0, 1.0), WIDTHS, toe_ins, TURNS):
        way, (x, y, heading), bend = ahead_of[advance]
        if advance < 0 and way < ways[leaper] + COME_UP:
            continue
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
    present = [name for name in anchors if name not in absent]
    others = np.array([belief.poses[name][:2] for name in present]).reshape(-1, 2)
    slips = [belief.leapt.get(name, 0.0) if roomy else predictor.known_slip for name in present]
    good = _clear(np.array(belief.poses[leaper][:2]), places[:, :2], others, slips, predictor.floor_map, predictor.room)
    good &= ~_failed(places, (*avoid, belief.poses[leaper]))
    return _leaps(
        belief, leaper, anchors, predictor, places[good], np.array(gains)[good], np.array(by_gait, bool)[good]
    )


def steps_aside(
    belief: Belief,
    leaper: str,
    course: Course,
    gait: Gait,
    observers: Sequence[str],
    predictor: Predictor,
    avoid: Sequence[Planar] = (),
) -> Leaps:
    """Find short leaps of an observer that makes way: in all directions, straight, near to robots that stand.

    They stop off by so little that they need less room (`Room.apart`).
    """
    ways = {name: course.way_of(belief.poses[name]) for name in observers}
    anchors = tuple(sorted((name for name in observers if name != leaper), key=lambda name: -ways[name]))
    x, y, yaw = belief.poses[leaper]
    toe_in, ahead = math.radians(gait.toe_in_deg), course.at(ways[leaper])[2] - predictor.camera_yaw(leaper)
    looks = (yaw, ahead, ahead + toe_in, ahead - toe_in)
    angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    places = np.array([(x + step * np.cos(a), y + step * np.sin(a), w) for step, a, w in product(ASIDE, angles, looks)])
    leapt = np.hypot(*(places[:, :2] - (x, y)).T)
    room = predictor.room.apart(leapt, least=0.0)
    others = np.array([belief.poses[name][:2] for name in anchors])
    away = np.hypot(*np.moveaxis(places[:, None, :2] - others, -1, 0))
    good = ~_failed(places, avoid) & (away > room[:, None]).all(axis=1)
    if (free := predictor.free) is not None:
        good &= free(places[:, :2], predictor.room.off_walls(leapt, least=TO_WALL))
    good &= np.array([
        clear_way(np.array([(x, y), place]), others, free, to_robot=one)
        for place, one in zip(places[:, :2], room.tolist(), strict=True)
    ])  # fmt: skip
    places = places[good]
    gains = np.array([course.way_of(place) - ways[leaper] for place in places.tolist()]) / len(observers)
    return _leaps(belief, leaper, anchors, predictor, places, gains, np.zeros(len(places), bool))


def leaps_beside(
    belief: Belief,
    leaper: str,
    course: Course,
    gait: Gait,
    observers: Sequence[str],
    predictor: Predictor,
    avoid: Sequence[Planar] = (),
) -> Leaps:
    """Find leaps of an observer to beside each of the others, to look where that one looks, not along the course."""
    anchors = tuple(name for name in observers if name != leaper)
    targets = []
    for name, side, width, ahead, toe in product(anchors, (-1.0, 1.0), WIDTHS, BESIDE, TOE_INS):
        x, y, yaw = belief.poses[name]
        looks = yaw + predictor.camera_yaw(name)
        c, s = math.cos(looks), math.sin(looks)
        lateral, turn = side * width * gait.abreast, -2 * side * toe * math.radians(gait.toe_in_deg)
        place = x + ahead * c - lateral * s, y + ahead * s + lateral * c
        targets.append((*place, looks + turn - predictor.camera_yaw(leaper)))
    places, start = np.array(targets), np.array(belief.poses[leaper][:2])
    others = np.array([belief.poses[name][:2] for name in anchors])
    slips = [predictor.known_slip] * len(anchors)
    good = _clear(start, places[:, :2], others, slips, predictor.floor_map, predictor.room)
    places = places[good & ~_failed(places, avoid)]
    way = course.way_of(belief.poses[leaper])
    gains = np.array([course.way_of(place) - way for place in places.tolist()]) / len(observers)
    return _leaps(belief, leaper, anchors, predictor, places, gains, np.zeros(len(places), bool))


def _failed(places: Array, avoid: Sequence[Planar]) -> NDArray[np.bool_]:
    """Return which targets (n, 3) are nearly one of those to `avoid`."""
    failed = np.zeros(len(places), bool)
    for x, y, yaw in avoid:
        near = np.hypot(places[:, 0] - x, places[:, 1] - y) < FAILED
        failed |= near & (np.abs(places[:, 2] - yaw) < FAILED)
    return failed


def _leaps(
    belief: Belief,
    leaper: str,
    anchors: tuple[str, ...],
    predictor: Predictor,
    places: Array,
    gains: Array,
    by_gait: NDArray[np.bool_],
) -> Leaps:
    """Leaps to targets (n, 3), with what they do to what is known."""
    start, targets = belief.poses[leaper], [(x, y, yaw) for x, y, yaw in places.tolist()]
    made = [leap_model(between(start, target), belief.floor, predictor.wheels) for target in targets]
    F = np.array([one for one, _ in made]).reshape(-1, 6, 6)
    Q = np.array([one for _, one in made]).reshape(-1, 6, 6)
    margins = predictor.margins(np.hypot(*(places[:, :2] - np.array(start[:2])).T), (*anchors, leaper))
    times = np.array([predictor.leap_time(start, target) for target in targets])
    return Leaps(leaper, anchors, places, gains, F, Q, margins, by_gait, times)


def _clear(
    start: Array,
    targets: Array,
    others: Array,
    slips: Sequence[float | None],
    floor_map: FloorMap | None,
    room: Room,
) -> NDArray[np.bool_]:
    """Return which targets (n, 2) a robot can reach from `start`, clear of others and walls.

    In a straight line, if there are such; else round what is in its way. The others come from leaps of `slips` [m];
    None to let that be.
    """
    leapt = np.hypot(*(targets - start).T)
    longest = float(leapt.max(initial=STEP))
    along = np.linspace(0.0, 1.0, int(np.ceil(longest / STEP)) + 1)[:, None]
    way = start + along * (targets - start)[:, None]
    to_robot, to_wall = room.further(along[:, 0] * leapt[:, None])
    good, straight = np.ones((2, len(targets)), bool)
    for other, slip in zip(others, slips, strict=True):
        good &= np.hypot(*np.moveaxis(targets - other, -1, 0)) > (TO_ROBOT if slip is None else room.apart(leapt, slip))
        # it may stand nearer already
        least = min(TO_ROBOT, float(np.hypot(*(start - other))) - 0.01) + to_robot
        straight &= (np.hypot(*np.moveaxis(way - other, -1, 0)) > least).all(axis=1)
    if floor_map is not None:
        straight &= floor_map.clear(way, TO_WALL + to_wall).all(axis=1)
        good &= floor_map.clear(targets, room.off_walls(leapt, least=TO_WALL))
    # few are in the way of a pair; of more robots some are
    if not (good & straight).any():
        free = None if floor_map is None else floor_map.clear
        further = room.further(leapt)[0]
        for low in np.unique(np.floor(leapt[good] / ROUND_STEP)):
            some = good & (np.floor(leapt / ROUND_STEP) == low)
            straight[some] = reachable(start, targets[some], others, free, TO_ROBOT + float(further[some].max()))
    return np.asarray(good & straight)
