"""Find stances in a run that was recorded without any, from each robot's movements by its odometry.

A robot that is pushed or carried while its odometry is constant counts as standing; the estimate finds a pushed anchor
by its `slip`, or by measurements that contradict it.
"""

import bisect
import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from coloc_graph.run import Motion, Stance

Array = NDArray[np.float64]
#: Begin and end of an interval [UTC s].
Span = tuple[float, float]

MIN_IMAGES = 2  # of an observer in a stance


class MotionThresholds(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Thresholds of motion.

    Attributes
    ----------
    speed, turn_deg
        Speed [m/s] and turn rate [deg/s] above which a robot moves.
    window
        Duration over which they are measured [s].
    settle
        Time after a movement from which the robot counts as standing [s].
    pause
        Stances of the same robots with a shorter gap are merged [s].
    shortest
        Shorter stances are dropped [s].
    """

    speed: float = 0.01
    turn_deg: float = 2.0
    window: float = 0.5
    settle: float = 0.3
    pause: float = 2.0
    shortest: float = 1.0

    def __post_init__(self) -> None:
        for name, value in msgspec.structs.asdict(self).items():
            above = name in ("speed", "turn_deg", "window")
            if not 0 <= value < np.inf or (above and value == 0):
                what = "above 0" if above else "that is not negative"
                raise ValueError(f"`{name}` is {value}; give a number {what}")

    @property
    def step(self) -> float:
        """Distance within one window above which a robot moves [m]."""
        return self.speed * self.window

    @property
    def turned(self) -> float:
        """Rotation within one window above which a robot moves [rad]."""
        return float(np.deg2rad(self.turn_deg)) * self.window


@dataclass(frozen=True)
class Movements:
    """Intervals in which a robot `moved`, disjoint and in order; it stood otherwise.

    Known from `start` to `end` [UTC s]. `crept` are those in which it was always slower than a movement, yet changed
    its position.
    """

    robot: str
    start: float
    end: float
    moved: tuple[Span, ...]
    crept: tuple[Span, ...] = ()

    def motions(self) -> list[Motion]:
        """Starts and ends of the movements, as records of a run."""
        return [
            motion
            for begin, end in self.moved
            for motion in (Motion(self.robot, begin, True), Motion(self.robot, end, False))
        ]

    def standing(self, settle: float = 0.0) -> list[Span]:
        """Intervals in which the robot stands, each from `settle` [s] after a movement on."""
        begins = [self.start, *(end + settle for _, end in self.moved)]
        ends = [*(begin for begin, _ in self.moved), self.end]
        return [(begin, end) for begin, end in zip(begins, ends, strict=True) if end > begin]


def movements(robot: str, times: ArrayLike, poses: ArrayLike, thresholds: MotionThresholds) -> Movements:
    """Find the movements of a robot by its odometry.

    Parameters
    ----------
    robot
        Name of the robot.
    times
        Ascending times, (n,) [UTC s], n >= 1.
    poses
        x, y [m], yaw [rad], (n, 3). Between two samples with a large gap it moved if they differ.
    thresholds
        Thresholds of motion.
    """
    t, p = np.asarray(times, float), np.array(poses, float)
    p[:, 2] = np.unwrap(p[:, 2])
    half = thresholds.window / 2
    fast = _differ(_at(t, p, t + half), _at(t, p, t - half), thresholds)
    before, after = np.append(t[0], t[:-1]), np.append(t[1:], t[-1])
    about = np.stack([np.maximum(t - half, before), np.minimum(t + half, after)], axis=1)[fast]
    jumped = np.flatnonzero(_differ(p[1:], p[:-1], thresholds))
    moved = _union([*about.tolist(), *zip(t[jumped].tolist(), t[jumped + 1].tolist(), strict=True)])
    known = Movements(robot, float(t[0]), float(t[-1]), moved)
    crept = tuple(span for span in known.standing() if _creeps(t, p, span, thresholds))
    return replace(known, moved=_union([*moved, *crept]), crept=crept)


def _at(t: Array, p: Array, times: Array) -> Array:
    return np.stack([np.interp(times, t, column) for column in p.T], axis=1)


def _differ(a: Array, b: Array, thresholds: MotionThresholds) -> NDArray[np.bool_]:
    """True for pairs of poses (n, 3) and (n, 3) that a movement separates."""
    off = np.atleast_2d(a - b)
    return np.asarray((np.hypot(off[:, 0], off[:, 1]) > thresholds.step) | (np.abs(off[:, 2]) > thresholds.turned))


def _creeps(t: Array, p: Array, span: Span, thresholds: MotionThresholds) -> bool:
    """True if a robot that seems to stand creeps; at both ends it may still brake or set off."""
    half = thresholds.window / 2
    inside = p[(t >= span[0] + half) & (t <= span[1] - half)]
    return bool(len(inside)) and bool(_differ(inside, inside[:1], thresholds).any())


def _union(spans: Sequence[Sequence[float]]) -> tuple[Span, ...]:
    """Merge intervals that touch."""
    joined: list[list[float]] = []
    for begin, end in sorted((span[0], span[1]) for span in spans):
        if joined and begin <= joined[-1][1]:
            joined[-1][1] = max(joined[-1][1], end)
        else:
            joined.append([begin, end])
    return tuple((begin, end) for begin, end in joined)


def derive_stances(
    team: Sequence[Movements],
    cameras: Mapping[str, Array],
    marked: Collection[str],
    thresholds: MotionThresholds,
) -> list[Stance]:
    """Find intervals in which at least two robots stand and observe while another one with markers moves.

    Parameters
    ----------
    team
        Movements of each robot.
    cameras
        Ascending times of the images that each robot took [UTC s]; a robot without images observes nothing.
    marked
        Robots with markers.
    thresholds
        Thresholds of motion.

    Returns
    -------
    list of Stance
        A stance ends when a robot that takes part starts or stops moving, except for pauses of the movers. A robot that
        observes in two stances and stood in between is an anchor.
    """
    at_rest = {one.robot: one.standing() for one in team}
    settled = {one.robot: one.standing(thresholds.settle) for one in team}
    moved = {one.robot: one.moved for one in team if one.robot in marked}
    instants = {time for spans in (*settled.values(), *(one.moved for one in team)) for span in spans for time in span}
    found: list[Stance] = []
    for begin, end in itertools.pairwise(sorted(instants)):
        observers = tuple(
            robot for robot in _throughout(settled, begin, end) if _images(cameras, robot, begin, end) >= MIN_IMAGES
        )
        movers = _throughout(moved, begin, end)
        if len(observers) < 2 or not movers:
            continue
        before = found[-1] if found else None
        if (
            before is not None
            and (before.observers, before.movers) == (observers, movers)
            and begin - before.end <= thresholds.pause
            and {*observers} <= {*_throughout(at_rest, before.start, end)}
        ):
            found[-1] = replace(before, end=end)
        else:
            found.append(Stance(len(found), begin, end, observers, movers))
    found = [one for one in found if one.end - one.start >= thresholds.shortest]
    anchors = [(), *(_anchors(before, after, at_rest) for before, after in itertools.pairwise(found))]
    return [replace(one, index=k, anchors=anchors[k]) for k, one in enumerate(found)]


def _throughout(spans: Mapping[str, Sequence[Span]], begin: float, end: float) -> tuple[str, ...]:
    """Robots with an interval that contains the given one; intervals are disjoint and in order."""
    found = []
    for robot, every in spans.items():
        k = bisect.bisect_right(every, (begin, np.inf)) - 1
        if k >= 0 and every[k][0] <= begin and end <= every[k][1]:
            found.append(robot)
    return tuple(found)


def _images(cameras: Mapping[str, Array], robot: str, begin: float, end: float) -> int:
    first, last = np.searchsorted(cameras.get(robot, np.empty(0)), [begin, end])
    return int(last - first)


def _anchors(before: Stance, after: Stance, at_rest: Mapping[str, Sequence[Span]]) -> tuple[str, ...]:
    stood = _throughout(at_rest, before.start, after.end)
    return tuple(robot for robot in after.observers if robot in before.observers and robot in stood)
