"""A plan for a whole mission with what it promises: `Mission`, and `leap_frog`, which plans one of a gait."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.geometry.se2 import Planar
from coloc_graph.planning.belief import Belief
from coloc_graph.planning.formation import Gait
from coloc_graph.planning.mover_path import best_drives, cells, commonly_seen, design, patrol
from coloc_graph.planning.plan import Plan, PlannedStance
from coloc_graph.planning.prediction import Predictor, Promise

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Mission:
    """A plan, what each of its stances promises, and the seconds that its leaps take.

    Attributes
    ----------
    plan
        The stances.
    promises
        Of each stance, the expected correspondences and the team's covariance after it.
    leap_times
        Time before each stance until all robots stand [s].
    start
        The team before the first stance.
    reasons
        Of each stance, one line on what decided; empty where nothing was chosen.
    """

    plan: Plan
    promises: tuple[Promise, ...]
    leap_times: tuple[float, ...]
    start: Belief
    reasons: tuple[str, ...] = ()

    @property
    def end(self) -> Belief:
        """The team after the last stance."""
        return self.promises[-1].belief

    @property
    def end_sigma(self) -> float:
        """Standard deviation of the observers' last positions [m]: root of the mean trace of their covariances."""
        return self.end.position_sigma(self.plan.observers)

    @property
    def heading_sigma(self) -> float:
        """Standard deviation of the observers' last headings [rad]."""
        return self.end.heading_sigma(self.plan.observers)

    @property
    def capture_time(self) -> float:
        """Time in which images are taken [s]."""
        return sum(stance.duration for stance in self.plan.stances)

    @property
    def points(self) -> float:
        """Expected number of correspondences."""
        return sum(promise.points for promise in self.promises)

    @property
    def duration(self) -> float:
        """Duration of the mission [s]."""
        return self.capture_time + sum(self.leap_times)


def stances_of(gait: Gait, length: float) -> int:
    """Return the number of stances in which the middle of a pair comes to a length [m], but for a tenth of a leap."""
    return max(math.ceil(length / gait.leap + 0.4), 1)


def leap_frog(
    predictor: Predictor,
    gait: Gait,
    length: float,
    seconds: float,
    pair: tuple[str, str],
    mover: str,
    *,
    designed: bool = True,
) -> Mission:
    """Plan a leap-frog along the x axis, the mover's drive of each stance by optimal design.

    Parameters
    ----------
    predictor
        Predicts the stances.
    gait
        Formation of the pair.
    length
        Way of the pair [m].
    seconds
        Duration of each stance [s].
    pair, mover
        Names of the observers, the first of which stands still before the second stance, and of the mover.
    designed
        False for the paper's patrol from corner to corner.

    Raises
    ------
    InputError
        If the observers see too little of the floor together.
    """
    goal = (length, 0.0)
    starts = {name: predictor.stop(gait, pair, k) for k, name in enumerate(pair)}
    start = belief = Belief.start(predictor.team, {**starts, mover: (1.5, 0.0, 0.0)})
    stances, promises, times = [], [], []
    for k in range(stances_of(gait, length)):
        anchor, leaper = pair[k % 2], pair[(k + 1) % 2]
        target = predictor.stop(gait, pair, k + 1)
        times.append(predictor.leap_time(belief.poses[leaper], target) if k else 0.0)
        if k:
            belief = belief.after_leap(leaper, target, predictor.wheels)
        standing = {anchor: belief.poses[anchor], leaper: target}
        stance, promise = best_stance(
            predictor, belief, standing, (anchor,) if k else (), mover, seconds, goal, designed
        )
        stances.append(stance)
        promises.append(promise)
        belief = promise.belief
    return Mission(Plan(tuple(stances)), tuple(promises), tuple(times), start)


def stance_there(
    predictor: Predictor,
    belief: Belief,
    standing: dict[str, Planar],
    anchors: tuple[str, ...],
    mover: str,
    seconds: float,
    goal: tuple[float, float],
) -> tuple[PlannedStance, Promise]:
    """Choose the mover's drive as `best_stance` where nobody leaps: nearer to robots and walls where there is no other.

    Raises
    ------
    InputError
        As `best_stance`.
    """
    problem = None
    for _ in predictor.ever_nearer():
        try:
            return best_stance(predictor, belief, standing, anchors, mover, seconds, goal)
        except InputError as error:
            problem = error
    assert problem is not None
    raise problem


def best_stance(
    predictor: Predictor,
    belief: Belief,
    standing: dict[str, Planar],
    anchors: tuple[str, ...],
    mover: str,
    seconds: float,
    goal: tuple[float, float],
    leapt: float = 0.0,
    designed: bool = True,
) -> tuple[PlannedStance, Promise]:
    """Choose the mover's drive in a stance of a team, `belief`, that stands there after a leap of `leapt` [m].

    Where stances are planned anew, all observers that are no anchors see the whole drive, and with them one that is;
    or the last observer does, and one anchor. Where there is no anchor, all do, or some two at each place.

    Raises
    ------
    InputError
        If the observers see too little of the floor together, or no drive is clear of robots and walls.
    """
    names = tuple(standing)
    margins = predictor.margins(leapt, names)
    slips = [0.0 if predictor.anew and name in anchors else belief.leapt.get(name, 0.0) for name in names]
    at = np.array(list(standing.values()))
    model, given = predictor.model(names, mover), (at, margins, predictor.free, slips, predictor.room)
    for groups in _groups(names, anchors) if predictor.anew else [[()]]:
        found = cells(model, *given, groups)
        if len(found.places) > 1:
            break
    else:
        raise InputError(
            f"{' and '.join(names)} have no common view of the floor where they are to stand: "
            "bring them nearer, or turn their cameras towards each other"
        )
    if not designed:
        drives = [patrol(found.places)]
    else:
        rows, G = belief.rows(names, mover), np.vstack(belief.goal_rows(names, goal))
        shares = design(found, belief.covariance, rows, G, seconds * predictor.fps)
        drives = best_drives(
            found, shares, belief.covariance, rows, G, duration=seconds, fps=predictor.fps, speed=predictor.speed
        )
        drives.append(patrol(found.places))
        drives = [drive for drive in drives if found.clear(np.array(drive))]
        if not drives:
            raise InputError(f"{mover} finds no drive before {' and '.join(names)} that is clear: give it more room")
    options = [PlannedStance(standing, anchors, mover, drive, seconds) for drive in drives]
    if found.watching:
        options = _watched(predictor, options, found.watching, margins)
    promises = [predictor.of_stance(belief, option) for option in options]
    best = min(range(len(options)), key=lambda n: promises[n].belief.end_variance(names, goal))
    return options[best], promises[best]


def _watched(
    predictor: Predictor, options: list[PlannedStance], group: tuple[int, ...], margins: Array
) -> list[PlannedStance]:
    """Name the observers that see each drive: a `group`, as indices, and others that see all of it.

    Drives on which one robot hides the mover from one of the group are left out, where there are others.
    """
    watched: list[tuple[bool, PlannedStance]] = []
    for option in options:
        names, at = tuple(option.standing), np.array(list(option.standing.values()))
        model, drive = predictor.model(names, option.mover), np.array(option.waypoints)
        sees = np.asarray(predictor.sees(option).all(axis=1))
        others = [n for n in np.flatnonzero(sees).tolist() if commonly_seen(model, at, drive, margins, (n,)).all()]
        watching = tuple(name for n, name in enumerate(names) if n in group or n in others)
        watched.append((bool(sees[list(group)].all()), replace(option, watching=watching)))
    whole = [option for seen, option in watched if seen]
    return whole or [option for _, option in watched]


def _groups(names: Sequence[str], anchors: Sequence[str]) -> Iterator[list[tuple[int, ...]]]:
    """Yield groups of observers, as indices, one of which has to see the mover; then others, if none of them can.

    A group without members are some two.
    """
    others = tuple(n for n, name in enumerate(names) if name not in anchors)
    yield [(names.index(anchor), *others) for anchor in anchors] or [others]
    if not anchors:
        yield [()]
    elif len(others) > 1:
        yield [(names.index(anchor), others[-1]) for anchor in anchors]
