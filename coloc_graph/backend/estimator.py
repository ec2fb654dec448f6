"""Incremental estimation stance by stance: ISAM2 with QR, and a log from which it can be rebuilt."""

from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from math import ceil
from pathlib import Path
from typing import Literal, overload

import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend import checkpoint
from coloc_graph.backend.batch import joint, smooth
from coloc_graph.backend.checkpoint import Base, Entry, WaitingStance, base_of
from coloc_graph.backend.chi2_test import UNCHECKED, Agreement
from coloc_graph.backend.estimate import Estimate, Rejection, StanceEstimate, rejection_of
from coloc_graph.backend.estimator_state import EstimatorState
from coloc_graph.backend.factors import Method, require_robot_models
from coloc_graph.backend.fixed_lag import LAG, MAX_STANCES_PER_LAG
from coloc_graph.backend.forgetting import Past, require_all
from coloc_graph.backend.graph import Link, require_anchor, require_reference, require_robots, slips_of
from coloc_graph.backend.insertion import InsertionPlan, InsertionPlanner
from coloc_graph.backend.landmarks import landmarks_of, map_positions, positions_of
from coloc_graph.backend.planar import LAG as SECONDS
from coloc_graph.backend.planar import KeyframeEstimator
from coloc_graph.backend.validation import require_valid
from coloc_graph.errors import EstimationError, InputError, MeasurementError
from coloc_graph.measurements import Measurement, Range, RelativePose, Sighting
from coloc_graph.run import Stance
from coloc_graph.team import Floor, Landmark, Robot, Slip, Team

Array = NDArray[np.float64]


def _rejection(link: Link, off: Agreement) -> Rejection:
    assert isinstance(link, RelativePose | Sighting | Range)
    return rejection_of(link, off)


class Estimator(EstimatorState):
    """Incremental estimator of a team: `add` each stance when it is over, ask for poses at any time.

    Parameters
    ----------
    reference : str
        Robot whose first pose is the world frame.
    robots : iterable of str
        Names of all robots.
    floor : Floor or None
        Floor that the robots stand on; None: no prior on heights and tilts.
    slips : mapping of str to Slip
        Robots that stay put within a tolerance.
    robot_models : mapping of str to Robot
        Mounts and markers, which are then calibrated along with the poses, as by `joint`; None: poses alone.
    landmarks : mapping of str to Landmark
        Landmarks that may be sighted.
    lag : int
        Where mounts are calibrated, number of last stances whose poses stay variables. Poses before them keep their
        estimates, while their measurements go on to count, linearised; so a stance costs the same in a run of any
        length. A measurement of an older pose that comes late makes all of them variables again, which takes as long
        as a batch estimate.
    forgets : bool
        Forget what is older than the lag, with either method, so that memory stays bounded in a mission of any length.
        Poses that leave the lag are dropped, measurements of them are refused, and what needs all measurements (a batch
        estimate, a checkpoint, removing something) is not available once something was forgotten.

    Raises
    ------
    EstimationError
        The reference is not one of the robots, a robot's model is missing, or the lag is not positive.

    Notes
    -----
    Invalid measurements (NaN, a bad covariance, an unknown robot) raise `MeasurementError`. After any exception the
    estimator is as it was. Outliers are listed in `rejected`. A measurement that is not connected to the reference
    waits until it is. Not thread-safe.
    """

    def __init__(
        self,
        reference: str,
        robots: Iterable[str],
        floor: Floor | None = None,
        slips: Mapping[str, Slip] | None = None,
        robot_models: Mapping[str, Robot] | None = None,
        landmarks: Mapping[str, Landmark] | None = None,
        lag: int = LAG,
        *,
        forgets: bool = False,
    ) -> None:
        if lag < 1:
            raise EstimationError(f"a lag of {lag} stances leaves no pose to estimate: give 1 or more")
        self.lag, self.forgets = lag, forgets
        self.reference, self.robots, self.floor, self.slips = reference, tuple(robots), floor, dict(slips or {})
        self.robot_models, self.landmarks = dict(robot_models or {}), dict(landmarks or {})
        self._on_map = map_positions(self.landmarks)
        if reference not in self.robots:
            raise EstimationError(f"the reference robot {reference} is not one of {', '.join(self.robots)}")
        if self.robot_models:
            require_robot_models(self.robots, self.robot_models)
        self._waiting: dict[int, WaitingStance] = {}
        self._begin(Base())

    def _forget(self) -> None:
        """Drop everything of the poses that were marginalised."""
        live = self._live
        if not self.forgets or not live.marginalised:
            return
        live.forget()
        recent = set(islice(reversed(self._stances), self.lag))
        nodes = {
            (robot, index)
            for robot in self.robots
            for index in self._stances
            if index in recent or self._pose_keys.find((robot, index)) in live.tied
        }
        kept = {index for _, index in nodes}
        self._stances = {index: stance for index, stance in self._stances.items() if index in kept}
        self._pose_keys = self._pose_keys.kept(nodes)
        self._log = [one for one in self._log if all(node in self._pose_keys for node in one.ends)]
        there = set(map(id, self._log))
        self._rejected = {key: one for key, one in self._rejected.items() if key in there}
        self._instants = {node: time for node, time in self._instants.items() if node in nodes}
        self._disconnected = [one for one in self._disconnected if all(node in self._pose_keys for node in one.ends)]
        self._journal = []
        variables = live.factors_of.variables
        self._past = Past(
            *live.begun,
            frozenset(live.tied),
            {} if variables is None else dict(variables.anchors),
            self._pose_keys.kept(),
            dict(self._stances),
            tuple(self._log),
            dict(self._rejected),
            dict(self._instants),
            frozenset(self._newly),
            tuple(self._disconnected),
        )

    def _replay(self, base: Base | Past, journal: Iterable[Entry]) -> None:
        """Repeat all inputs in their order, which gives the same numbers.

        ISAM2 linearises each pose where it was when it came, so that no batch gives the same numbers.
        """
        self._begin(base)
        for entry in journal:
            self._enter(entry.stance, entry.measurements)

    @contextmanager
    def _all_or_nothing(self) -> Iterator[None]:
        """Restore the estimator where the body of the `with` fails or is interrupted."""
        base, journal, early = self._past or self._base, self._journal, dict(self._waiting)
        count = len(journal)
        self._changed = False
        try:
            yield
        except BaseException:
            self._waiting = early
            if self._changed:
                self._replay(base, journal[:count])
            raise

    @overload
    @classmethod
    def of(cls, team: Team, method: Method = "joint", lag: int = LAG, *, forgets: bool = False) -> "Estimator": ...

    @overload
    @classmethod
    def of(
        cls, team: Team, method: Literal["ranging"], lag: float = SECONDS, *, forgets: bool = False
    ) -> KeyframeEstimator: ...

    @classmethod
    def of(
        cls,
        team: Team,
        method: Method | Literal["ranging"] = "joint",
        lag: float | None = None,
        *,
        forgets: bool = False,
    ) -> "Estimator | KeyframeEstimator":
        """Return the estimator of a team: with its mounts to be calibrated, or of poses alone (`smooth`).

        By method `ranging` that of keyframes in place of stances, with a lag in seconds (`KeyframeEstimator`).
        """
        if method == "ranging":
            return KeyframeEstimator(team, lag=SECONDS if lag is None else lag, forgets=forgets)
        robot_models = {robot.name: robot for robot in team.robots} if method == "joint" else None
        known = team.reference, team.names, team.floor, slips_of(team), robot_models, landmarks_of(team)
        return cls(*known, LAG if lag is None else int(lag), forgets=forgets)

    def __repr__(self) -> str:
        return (
            f"Estimator({len(self._stances)} stances, {len(self._log)} measurements, {len(self._rejected)} rejected, "
            f"{len(self._live.tied)} poses tied, {len(self._disconnected)} links and {len(self._waiting)} stances "
            "waiting)"
        )

    def estimate(self) -> Estimate:
        """Return the batch estimate of all inputs.

        With hindsight others may be rejected than when they came.

        Raises
        ------
        EstimationError
            There is no stance yet.
        """
        optimised = joint if self.robot_models else smooth
        return optimised(self.graph, start=self._live.values() if self._live.tied else None)

    def add(
        self, stance: Stance, measurements: Iterable[Measurement] = (), *, after: int | None = None
    ) -> StanceEstimate:
        """Add a stance with its measurements and the odometry into it.

        Parameters
        ----------
        stance : Stance
            The stance; its index is larger than those before.
        measurements : iterable of Measurement
            Measured in the stance, and on the way into it.
        after : int or None
            Index of its predecessor, since which its anchors have stayed; None: the one numbered before it.

        Returns
        -------
        StanceEstimate
            Poses of its robots. A stance that arrives before its predecessor waits for it: all its robots are
            `disconnected`.

        Raises
        ------
        MeasurementError
            A measurement is invalid, or the stance is not the next one.
        EstimationError
            The graph cannot be solved with it.
        """
        taken = tuple(measurements)
        follows = stance.index - 1 if after is None else after
        forgotten = self._past is not None and stance.index < max(self._stances)
        if forgotten or stance.index in self._stances or stance.index in self._waiting:
            raise MeasurementError(
                f"stance {stance.index} was added before: add it once, and late measurements by `insert`"
            )
        require_robots(stance, self.robots)
        require_valid(taken, self.floor)
        # the first stance is the one that has no anchors: no robot can have stayed since another
        is_first = not self._stances and after is None and not stance.anchors
        if is_first:
            require_reference(self.reference, stance)
        elif follows not in self._stances:
            self._waiting[stance.index] = WaitingStance(stance, taken, follows)
            return StanceEstimate(stance.index, {}, {}, stance.observers)
        elif follows != (last := next(reversed(self._stances))):
            raise MeasurementError(
                f"stance {stance.index} follows stance {follows}, but so does stance {last}: number the stances in the "
                "order of time"
            )
        with self._all_or_nothing():
            estimate = self._enter(stance, taken)
            while early := self._next_early():
                del self._waiting[early.stance.index]
                later = self._enter_early(early)
                estimate = replace(later, rejected=(*estimate.rejected, *later.rejected))
        return estimate

    def _enter_early(self, early: WaitingStance) -> StanceEstimate:
        try:
            return self._enter(early.stance, early.measurements)
        except EstimationError as error:
            index = early.stance.index
            raise type(error)(
                f"{error}; stance {index} waits for stance {early.after}: correct it, or drop it by `discard({index})`"
            ) from error

    def discard(self, index: int) -> None:
        """Drop a stance that waits for its predecessor; `MeasurementError` where none of this index waits."""
        if index not in self._waiting:
            raise MeasurementError(f"stance {index} cannot be discarded: it does not wait for another")
        del self._waiting[index]

    def _next_early(self) -> WaitingStance | None:
        last = next(reversed(self._stances))
        return next((early for early in self._waiting.values() if early.after == last), None)

    def insert(self, *measurements: Measurement) -> StanceEstimate:
        """Add measurements of earlier stances, and return the poses of the last stance."""
        if not self._stances:
            raise MeasurementError("there is no stance yet for a measurement: add one first")
        require_valid(measurements, self.floor)
        with self._all_or_nothing():
            return self._enter(None, measurements)

    def revoke(self, *measurements: Measurement) -> StanceEstimate:
        """Remove measurements, as if they had never been added, and return the poses of the last stance.

        Measurements that were rejected because they contradicted these are taken back.
        """
        added = set(map(id, self._log))
        for one in measurements:
            if id(one) not in added:
                raise EstimationError(f"the {one} cannot be removed: it was not added")
        with self._all_or_nothing():
            self._take_out(self.stances, set(map(id, measurements)), set(self._rejected))
        return self._at(next(reversed(self._stances.values())), self.rejected, UNCHECKED)

    def withdraw(self) -> Stance:
        """Remove the last stance with its measurements, as if it had never been added, and return it.

        Raises
        ------
        EstimationError
            It is the first one.
        """
        if len(self._stances) < 2:
            raise EstimationError("the first stance defines the world and cannot be removed: make a new estimator")
        *left, stance = self.stances
        gone = {
            id(one)
            for one in self._log
            if any(index == stance.index for _, index in one.ends)
            or (isinstance(one, Range) and one.time > left[-1].end)
        }
        with self._all_or_nothing():
            self._take_out(tuple(left), gone, self._newly)
        return stance

    def _take_out(self, stances: tuple[Stance, ...], gone: Set[int], suspected: Set[int]) -> None:
        """Keep these stances and all measurements but those `gone`; try the rejected ones in `suspected` again.

        Measurements are named by identity.
        """
        require_all(self._kept, "remove anything")
        measurements = tuple(one for one in self._log if id(one) not in gone)
        rejected = {key: one for key, one in self._rejected.items() if key not in gone}
        self._changed = True
        self._begin(base_of(stances, measurements, rejected))
        again = [
            m for m in (one.measurement for key, one in rejected.items() if key in suspected) if isinstance(m, Link)
        ]
        if again:
            found = {id(one.measurement): one for one in self._update(self._plan([*self._disconnected, *again]))[0]}
            left = {key: one for key, one in rejected.items() if key not in suspected} | found
            # anew, so that nothing depends on the order in which they were tried
            self._begin(base_of(stances, measurements, left))

    def save(self, path: str | Path) -> None:
        """Write a checkpoint atomically, from which `resume` continues."""
        require_all(self._kept, "write a checkpoint")
        team = self.reference, self.robots, self.floor, self.slips, self.robot_models, self.landmarks, self.lag
        came = self._base, tuple(self._journal), tuple(self._waiting.values())
        checkpoint.write(checkpoint.Checkpoint(*team, *came), Path(path))

    @classmethod
    def resume(cls, path: str | Path) -> "Estimator":
        """Rebuild the estimator of a checkpoint, bit for bit.

        All inputs are repeated, which takes as long as it took.

        Raises
        ------
        InputError
            The file is no checkpoint of this version, or a damaged one.
        """
        saved = checkpoint.read(Path(path))
        estimator = cls(
            saved.reference, saved.robots, saved.floor, saved.slips, saved.robot_models, saved.landmarks, saved.lag
        )
        try:
            estimator._replay(saved.base, saved.journal)
        except EstimationError as error:
            raise InputError(f"{path}: is a damaged checkpoint ({error}); solve the run again") from error
        estimator._waiting = {one.stance.index: one for one in saved.waiting}
        return estimator

    def _enter(self, stance: Stance | None, taken: tuple[Measurement, ...]) -> StanceEstimate:
        before = next(reversed(self._stances.values()), None)
        if any(map(self._is_marginalised, taken)):
            self._changed = True
            self._begin(base_of(self.stances, self.measurements, self._rejected))
        links: list[Link] = [*self._disconnected, *taken, *self._new_map_positions(taken)]
        if stance is not None:
            if before is not None:
                require_anchor(stance, taken)
                links += [stay for stay in self._pose_keys.stay_puts(before, stance) if stay.slip is not None]
            self._pose_keys.accept(self._pose_keys.after(before, stance))
            self._stances[stance.index] = stance
        try:
            instants = self._checked(taken)
            plan = self._plan(links)
        except BaseException:
            if stance is not None:
                self._pose_keys.forget(before, stance)
                del self._stances[stance.index]
            raise
        rejected, agreement, self._disconnected = self._update(plan)
        self._marginalise()
        self._journal.append(Entry(stance, taken))
        self._log += taken
        self._instants |= instants
        self._rejected |= {id(one.measurement): one for one in rejected}
        self._newly = (set() if stance is not None else self._newly) | {id(one.measurement) for one in rejected}
        said = self._at(next(reversed(self._stances.values())), rejected, agreement, taken)
        self._forget()
        return said

    def _new_map_positions(self, taken: Iterable[Measurement]) -> tuple[Link, ...]:
        """Positions on the map of the landmarks that are sighted for the first time."""
        waiting = set(map(id, self._disconnected))
        return tuple(
            one
            for one in positions_of(self._on_map, (m.seen for m in taken if isinstance(m, Sighting)))
            if id(one) not in waiting and self._pose_keys.key(one.ends[1]) not in self._live.tied
        )

    def _plan(self, links: list[Link]) -> InsertionPlan:
        live = self._live
        # before anything is tied, nothing was forgotten
        reference = -1 if live.tied else self._pose_keys.key((self.reference, next(iter(self._stances))))
        return InsertionPlanner(live.factors_of, self._keys, live.tied, reference, live.pose, live.errors).sort(links)

    def _update(self, plan: InsertionPlan) -> tuple[tuple[Rejection, ...], Agreement, list[Link]]:
        """Put poses and links into the graph, without outliers; return these, and what nothing ties then."""
        self._changed = True
        ties = list[Rejection]()
        try:
            while not (outcome := self._live.enter(plan)).inserted:
                ties += (_rejection(*one) for one in outcome.rejected)
                wrong = {id(link) for link, _ in outcome.rejected}
                plan = self._plan([link for link in plan.links if id(link) not in wrong])
        except Exception as failure:
            raise EstimationError(f"the graph cannot be solved with this, and was restored: {failure}") from failure
        found = (*ties, *(_rejection(*one) for one in outcome.rejected))
        return found, outcome.agreement, plan.disconnected

    def _marginalise(self) -> None:
        """Marginalise the poses of old stances where mounts are calibrated, or the past is forgotten."""
        most = ceil(MAX_STANCES_PER_LAG * self.lag)
        if not (self.robot_models or self.forgets) or len(self._stances) < most:
            return
        recent = list(islice(reversed(self._stances), most))
        key, live = self._pose_keys.key, self._live
        find = self._pose_keys.find
        keep = {key((robot, index)) for robot in self.robots for index in recent[: self.lag]}
        if not {find((robot, recent[-1])) for robot in self.robots} & live.tied - live.marginalised.keys() - keep:
            return
        for robot in self.robots:
            # a robot that was not seen for long is seen again, or its odometry goes on
            keys = (find((robot, index)) for index in reversed(self._stances))
            keep.update(islice((one for one in keys if one in live.tied), 1))
        live.marginalise(keep | set(self._pose_keys.static().values()))

    def _is_marginalised(self, measurement: Measurement) -> bool:
        """Return whether a measurement is of a pose that is no variable any more."""
        if not self._live.marginalised:
            return False
        nodes = (node for node in measurement.ends if node in self._pose_keys)
        return any(self._pose_keys.key(node) in self._live.marginalised for node in nodes)

    def _at(
        self,
        stance: Stance,
        rejected: tuple[Rejection, ...],
        agreement: Agreement,
        taken: Sequence[Measurement] = (),
    ) -> StanceEstimate:
        """Return the poses of a stance, and what was `taken` in, as it fits them."""
        tied = {}
        for robot in self.robots:
            key = self._pose_keys.key((robot, stance.index))
            if key in self._live.tied:
                tied[robot] = key
        seen = self.landmarks.keys() & {one.seen for one in taken if isinstance(one, Sighting)}
        return StanceEstimate(
            stance.index,
            {robot: self._live.pose(key) for robot, key in tied.items()},
            {robot: self._live.covariance(key) for robot, key in tied.items()},
            tuple(robot for robot in stance.observers if robot not in tied),
            rejected,
            agreement,
            self._residuals(taken),
            self.static_poses(seen) if seen else {},
        )
