"""Refinement of a whole plan: stops, waypoints and durations moved to a lower variance at the end; `Refinement`.

Each stance is changed in turn. What comes before it is a covariance, and what comes after it is one `Steps`, so that
many changes of a stance are compared by the variance at the end of the mission at once.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.se2 import Planar, between
from coloc_graph.planning.belief import OBSERVER, POSE, Belief, leap_model, updated
from coloc_graph.planning.clearance import ROOM, leapt_to, reaches
from coloc_graph.planning.gaits import MIN_STANCE_DURATION
from coloc_graph.planning.leaps import TO_WALL
from coloc_graph.planning.mover_path import CLEARANCE, commonly_seen
from coloc_graph.planning.plan import PlannedStance
from coloc_graph.planning.prediction import Predictor
from coloc_graph.planning.rollout import end_weights, what_costs
from coloc_graph.planning.route import Free, clear_way, from_way
from coloc_graph.planning.steps import Steps

Array = NDArray[np.float64]
Window = list[PlannedStance]

STEPS = (0.15, 0.05) * 4  # changes in each round, of places [m] and headings [rad]
INSTANTS = 24  # instants of a drive at which its pixels are linearised
SHARE_OF_TIME = 0.15  # relative change of a duration by which its worth is found
POWERS = (0.5, 0.25)  # of a duration's worth by which the duration is changed
SEEN = 0.9  # share of a drive that lies in the common view
APART = 0.5  # robots that stand come no nearer to each other than this, if they are not nearer already [m]
SAMPLE = 0.1  # distance between places of a drive that are checked [m]
TRIED = 8  # changes of a stance, the best first, that are checked for being possible
WORTHWHILE = 1e-4  # relative decrease of the variance below which nothing is changed
MAX_STEPS = 1.5  # a combined change is at most this many steps long, in each number


@dataclass
class _Chain:
    """Stances, what each brings, the leaps before each, and what comes after each."""

    stances: Window
    information: list[Array]
    leaps: list[Steps]
    after: list[Steps]


@dataclass(frozen=True, eq=False)
class _Place:
    """Stance `k` of a chain while a sweep changes it: covariance, poses and leaps [m] of robots before its leaps."""

    k: int
    P: Array
    poses: Mapping[str, Planar]
    leapt: Mapping[str, float]


class Refinement:
    """Lowers the variance at the end of a mission by small changes of its stances.

    Parameters
    ----------
    predictor
        Predicts the stances; its map, if any, keeps robots off walls.
    observers, mover
        Names of the robots that leap, and of the one that drives.
    arrived
        Returns whether observers that stand there are at the goal.
    timed
        True to count the time of leaps into the time of a mission.
    """

    def __init__(
        self,
        predictor: Predictor,
        observers: Sequence[str],
        mover: str,
        arrived: Callable[[Mapping[str, Planar]], bool],
        timed: bool,
    ) -> None:
        self._predictor, self._observers, self._mover = predictor, tuple(observers), mover
        self._arrived, self._timed = arrived, timed
        self._weights = end_weights(len(observers))
        self._every = np.arange(len(self._weights))
        self._none = np.zeros((len(self._weights), len(self._weights)))
        self._eye = np.eye(len(self._weights))

    def refined(
        self, belief: Belief, stances: Sequence[PlannedStance], seconds: float, steps: Sequence[float] = STEPS
    ) -> tuple[Window, float]:
        """Return stances that promise less variance at the end in as much time, and the variance [m^2].

        Parameters
        ----------
        belief
            The team before the first of the stances.
        stances
            The stances; observers that stand in the first one without a leap stay where they are.
        seconds
            Time of the stances, with `timed` that of the leaps, too [s].
        steps
            Changes of places [m] and headings [rad] in each round.
        """
        P, chain = self._start(belief), self._chain(belief, list(stances))
        for step in steps:
            worth = self._retime(belief, P, chain, seconds)
            self._sweep(belief, P, chain, step, worth if self._timed else 0.0)
        self._retime(belief, P, chain, seconds)
        return chain.stances, self._value(P, chain.leaps, chain.information)

    def reasons(self, belief: Belief, stances: Sequence[PlannedStance]) -> list[str]:
        """Return for each stance what costs most at the end of the mission after it, in one line."""
        chain, P, found = self._chain(belief, list(stances)), self._start(belief), []
        for leap, brought, after in zip(chain.leaps, chain.information, chain.after, strict=True):
            P = updated(leap.A @ P @ leap.A.mT + leap.C, self._every, brought)
            found.append(what_costs(P, partial(after.variance, weights=self._weights)))
        return found

    def _start(self, belief: Belief) -> Array:
        rows = belief.rows(self._observers, self._mover)
        return belief.covariance[np.ix_(rows, rows)]

    def _chain(self, belief: Belief, stances: Window) -> _Chain:
        information = [self._informations([stance])[0] for stance in stances]
        chain = _Chain(stances, information, self._leaps(belief, belief.poses, stances), [])
        chain.after = [Steps(self._eye, self._none, self._none)] * len(stances)
        self._look_back(chain, len(stances) - 1)
        return chain

    def _look_back(self, chain: _Chain, last: int) -> None:
        """Compute anew what comes after each stance before the `last` one."""
        for k in range(last, 0, -1):
            stance = Steps(self._eye, chain.information[k], self._none)
            chain.after[k - 1] = chain.leaps[k].then(stance.then(chain.after[k]))

    def _informations(self, stances: Sequence[PlannedStance]) -> Array:
        """Information (n, d, d) that stances of the same robots bring on all observers and the markers."""
        own, _ = self._predictor.informations(stances, INSTANTS)
        blocks = [OBSERVER * self._observers.index(name) + np.arange(OBSERVER) for name in stances[0].standing]
        rows = np.concatenate([*blocks, self._every[-2:]])
        out = np.zeros((len(stances), *self._none.shape))
        out[:, rows[:, None], rows] = own
        return out

    def _leaps(self, belief: Belief, poses: Mapping[str, Planar], stances: Sequence[PlannedStance]) -> list[Steps]:
        """Effects of the leaps before each of some stances, from `poses` on."""
        found, poses = [], dict(poses)
        for stance in stances:
            A, C = self._eye.copy(), self._none.copy()
            for name in _leapers(poses, stance):
                at = OBSERVER * self._observers.index(name)
                pose, D = slice(at, at + POSE), between(poses[name], stance.standing[name])
                A[pose, pose], C[pose, pose] = leap_model(D, belief.floor, self._predictor.wheels)
            found.append(Steps(A, self._none, C))
            poses.update(stance.standing)
        return found

    def leap_times(self, poses: Mapping[str, Planar], stances: Sequence[PlannedStance]) -> tuple[float, ...]:
        """Return the time before each of some stances until all robots stand [s]."""
        found, poses = [], dict(poses)
        for stance in stances:
            leaps = [self._predictor.leap_time(poses[one], stance.standing[one]) for one in _leapers(poses, stance)]
            found.append(max(leaps, default=0.0))
            poses.update(stance.standing)
        return tuple(found)

    def _value(self, P: Array, leaps: Sequence[Steps], information: Sequence[Array]) -> float:
        for leap, brought in zip(leaps, information, strict=True):
            P = updated(leap.A @ P @ leap.A.mT + leap.C, self._every, brought)
        return float(np.diag(P) @ self._weights)

    def _retime(self, belief: Belief, P: Array, chain: _Chain, seconds: float) -> float:
        """Spend the time where it lowers the variance most; return what a second is worth [m^2/s].

        A duration grows with the root of its worth, as shares of an optimal design do.
        """
        now = np.array([stance.duration for stance in chain.stances])
        worths, Q = [], P
        for k, stance in enumerate(chain.stances):
            Q = chain.leaps[k].A @ Q @ chain.leaps[k].A.mT + chain.leaps[k].C
            durations = stance.duration * np.array([1 - SHARE_OF_TIME, 1 + SHARE_OF_TIME])
            both = self._informations([replace(stance, duration=float(one)) for one in durations])
            short, long = chain.after[k].variance(updated(Q[None], self._every, both), self._weights)
            worths.append(max(float(short - long), 1e-30) / float(durations[1] - durations[0]))
            Q = updated(Q, self._every, chain.information[k])
        left = seconds - (sum(self.leap_times(belief.poses, chain.stances)) if self._timed else 0.0)
        options = []
        for power in (*POWERS, 0.0):
            durations = _scaled(now * np.array(worths) ** power, left)
            stances = [replace(one, duration=float(t)) for one, t in zip(chain.stances, durations, strict=True)]
            information = [self._informations([stance])[0] for stance in stances]
            options.append((self._value(P, chain.leaps, information), stances, information))
        _, chain.stances, chain.information = min(options, key=lambda each: each[0])
        self._look_back(chain, len(now) - 1)
        return float(np.median(worths))

    def _sweep(self, belief: Belief, P: Array, chain: _Chain, step: float, worth: float) -> None:
        """Change each stance in turn: the mover's waypoints, and where those who leap to it stand."""
        poses, leapt = dict(belief.poses), dict(belief.leapt)
        for k in range(len(chain.stances)):
            place = _Place(k, P, poses, leapt)
            self._improve(belief, chain, place, _drives(chain.stances[k]), step, worth)
            for name in _leapers(poses, chain.stances[k]):
                self._improve(belief, chain, place, _stops(chain.stances, k, name), step, worth)
            leap = chain.leaps[k]
            P = updated(leap.A @ P @ leap.A.mT + leap.C, self._every, chain.information[k])
            leapt = leapt_to(leapt, poses, chain.stances[k])
            poses = {**poses, **chain.stances[k].standing}

    def _improve(
        self,
        belief: Belief,
        chain: _Chain,
        place: _Place,
        change: tuple[int, Callable[[Array], Window]],
        step: float,
        worth: float,
    ) -> None:
        """Change the numbers of a stance and keep the best possible change that lowers the variance.

        The numbers are changed one by one, and all at once to where parabolas through their variances are least.
        """
        numbers, changed = change
        k = place.k
        each = step * np.eye(numbers)
        moves = [np.zeros(numbers), *each, *-each]
        options = [changed(move) for move in moves]
        value, made = self._compared(belief, chain, place, options, worth)
        up, down, now = value[1 : numbers + 1], value[numbers + 1 :], value[0]
        curved, slope = (up + down) / 2 - now, (up - down) / 2
        lowest = np.where(curved > 0, -slope / np.maximum(2 * curved, 1e-30), -np.sign(slope) * MAX_STEPS)
        combined = step * np.clip(lowest, -MAX_STEPS, MAX_STEPS)
        more = [changed(combined), changed(combined / 2)]
        value_more, made_more = self._compared(belief, chain, place, more, worth)
        value, options, made = np.concatenate([value, value_more]), options + more, made + made_more
        least = [self._seen(place.poses, one) for one in options[0]]
        for n in np.argsort(value)[:TRIED].tolist():
            if value[n] > (1 - WORTHWHILE) * now:
                return
            if self._possible(chain, place, options[n], least):
                end = k + len(options[n])
                chain.stances[k:end] = options[n]
                chain.leaps[k:end], chain.information[k:end] = made[n]
                self._look_back(chain, end - 1)
                return

    def _compared(
        self, belief: Belief, chain: _Chain, place: _Place, options: Sequence[Window], worth: float
    ) -> tuple[Array, list[tuple[list[Steps], list[Array]]]]:
        """Variance (n,) at the end [m^2] of changes of some stances from one on, with their leaps and information."""
        k, many = place.k, len(options[0])
        leaps = [self._leaps(belief, place.poses, option) for option in options]
        P = np.repeat(place.P[None], len(options), axis=0)
        information = []
        for i in range(many):
            A, C = (np.array([getattr(one[i], name) for one in leaps]) for name in ("A", "C"))
            if all(option[i] is chain.stances[k + i] for option in options):
                brought = np.repeat(chain.information[k + i][None], len(options), axis=0)
            else:
                brought = self._informations([option[i] for option in options])
            information.append(brought)
            P = updated(A @ P @ A.mT + C, self._every, brought)
        value = chain.after[k + many - 1].variance(P, self._weights)
        if worth:
            value = value + worth * np.array([sum(self.leap_times(place.poses, option)) for option in options])
        made = [(leaps[n], [brought[n] for brought in information]) for n in range(len(options))]
        return value, made

    def _possible(self, chain: _Chain, place: _Place, option: Window, least: Sequence[float]) -> bool:
        """Return whether robots can stand, leap and drive so, and the mover is seen as well as before."""
        poses, leapt, free = dict(place.poses), dict(place.leapt), self._predictor.free
        stood, came = dict(place.poses), dict(place.leapt)
        for i, old in enumerate(chain.stances[place.k :]):
            stance = option[i] if i < len(option) else old
            at = {name: pose[:2] for name, pose in stance.standing.items()}
            for name in _leapers(poses, stance) if i < len(option) else ():
                others = [other for one, other in at.items() if one != name]
                if not reaches(poses[name][:2], at[name], others, free):
                    return False
            leapt, came = leapt_to(leapt, poses, stance), leapt_to(came, stood, old)
            if i >= len(option) and leapt == came:
                break
            if not self._clear(stance, leapt, old, came):
                return False
            if stance is not old and self._seen(poses, stance) < min(least[i], SEEN):
                return False
            poses.update(stance.standing)
            stood.update(old.standing)
        return place.k + len(option) < len(chain.stances) or self._arrived(poses)

    def _clear(
        self, stance: PlannedStance, leapt: Mapping[str, float], old: PlannedStance, came: Mapping[str, float]
    ) -> bool:
        """Return whether a stance is clear of robots and walls, or no less than the `old` one.

        Robots come to where they stand from leaps of `leapt` [m], in the old one of `came`.
        """
        spare, before = _spare(stance, leapt), _spare(old, came)
        if (spare < np.minimum(before, 0.0) - 1e-9).any():
            return False
        free = self._predictor.free
        if free is None:
            return True
        near = ~_off_walls(stance, leapt, free)
        if stance is old:
            return not (near & _off_walls(old, came, free)).any()
        drive = np.array(stance.waypoints)
        return not near.any() and bool(free(drive, CLEARANCE / 2).all()) and clear_way(drive, (), free)

    def _seen(self, poses: Mapping[str, Planar], stance: PlannedStance) -> float:
        """Share of a drive that lies in the common view; 0 if an end of it does not."""
        leapers = [*_leapers(poses, stance)]
        leapt = max((math.dist(poses[name][:2], stance.standing[name][:2]) for name in leapers), default=0.0)
        names, standing = tuple(stance.standing), np.array(list(stance.standing.values()))
        at = np.array(stance.waypoints)
        counts = np.maximum(np.hypot(*np.diff(at, axis=0).T) / SAMPLE, 1.0).astype(int)
        parts = [np.linspace(a, b, n + 1) for a, b, n in zip(at, at[1:], counts, strict=False)]
        model = self._predictor.model(names, stance.mover)
        seen = commonly_seen(model, standing, np.concatenate(parts), self._predictor.margins(leapt, names))
        return float(seen.mean()) if seen[0] and seen[-1] else 0.0


def _spare(stance: PlannedStance, leapt: Mapping[str, float]) -> Array:
    """Distances (n + 1, n) of robots, and of the mover's way, from those that stand, beyond what they need [m]."""
    places = np.array([pose[:2] for pose in stance.standing.values()])
    slips = np.array([leapt.get(name, 0.0) for name in stance.standing])
    spare = np.hypot(*np.moveaxis(places[:, None] - places, -1, 0)) - ROOM.apart(slips[:, None], slips, least=APART)
    np.fill_diagonal(spare, 0.0)
    return np.vstack([spare, from_way(stance.waypoints, places) - ROOM.apart(slips, least=CLEARANCE)])


def _off_walls(stance: PlannedStance, leapt: Mapping[str, float], free: Free) -> NDArray[np.bool_]:
    """Return which robots that stand keep off walls."""
    places = np.array([pose[:2] for pose in stance.standing.values()])
    return free(places, ROOM.off_walls([leapt.get(name, 0.0) for name in stance.standing], least=TO_WALL))


def _leapers(poses: Mapping[str, Planar], stance: PlannedStance) -> list[str]:
    """Robots that leap to a stance from somewhere else."""
    return [name for name in stance.leapers if poses[name] != stance.standing[name]]


def _drives(stance: PlannedStance) -> tuple[int, Callable[[Array], Window]]:
    """Number of coordinates of a stance's waypoints, and the stance once they are moved."""
    points = np.array(stance.waypoints)

    def changed(move: Array) -> Window:
        if not move.any():
            return [stance]
        moved = points + move.reshape(-1, 2)
        return [replace(stance, waypoints=tuple((float(x), float(y)) for x, y in moved))]

    return points.size, changed


def _stops(stances: Sequence[PlannedStance], k: int, name: str) -> tuple[int, Callable[[Array], Window]]:
    """Numbers of where a robot stands from stance k on, and the stances, to its next leap, once they are changed."""
    last = k  # stance in which it stands there for the last time
    while last + 1 < len(stances) and name in stances[last + 1].anchors:
        last += 1

    def changed(move: Array) -> Window:
        window = list(stances[k : last + 2])
        x, y, yaw = (float(a + b) for a, b in zip(stances[k].standing[name], move, strict=True))
        for n in range(last - k + 1):
            if move.any():
                window[n] = replace(window[n], standing={**window[n].standing, name: (x, y, yaw)})
        return window

    return 3, changed


def _scaled(durations: Array, total: float) -> Array:
    """Durations (n,) [s] scaled to a total, but none shorter than a stance may be."""
    long = np.ones(len(durations), bool)
    scaled = durations
    while long.any():
        left = total - MIN_STANCE_DURATION * float((~long).sum())
        scaled = np.where(long, durations * left / durations[long].sum(), MIN_STANCE_DURATION)
        short = long & (scaled < MIN_STANCE_DURATION)
        if not short.any():
            break
        long &= ~short
        scaled = np.full(len(durations), MIN_STANCE_DURATION)
    return np.asarray(scaled)
