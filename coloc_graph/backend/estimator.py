"""The estimate kept up to date while stances come in: ISAM2 with QR, and a log from which it can be rebuilt."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend import checkpoint
from coloc_graph.backend.batch import find_bumps, joint, smooth
from coloc_graph.backend.calibration import Variables
from coloc_graph.backend.checkpoint import Base, Early, Entry
from coloc_graph.backend.chi2_test import UNCHECKED, Agreement
from coloc_graph.backend.estimate import Bump, Estimate, Rejection, StanceEstimate
from coloc_graph.backend.factors import Factors, Method, require_rigs
from coloc_graph.backend.graph import (
    Link,
    PoseGraph,
    PoseKeys,
    instants_of,
    require_anchor,
    require_ends,
    require_reference,
    require_robots,
    slips_of,
)
from coloc_graph.backend.insertion import InsertionPlan, InsertionPlanner
from coloc_graph.backend.isam2_graph import Isam2Graph, rebuilt
from coloc_graph.backend.landmarks import Placed, landmarks_of, map_of, of_seen
from coloc_graph.backend.validation import require_valid
from coloc_graph.errors import EstimationError, InputError, MeasurementError
from coloc_graph.measurements import Measurement, Node, RelativePose, Sighting
from coloc_graph.run import Stance
from coloc_graph.team import Floor, Landmark, Robot, Slip, Team

Array = NDArray[np.float64]


def _refusal(link: Link, off: Agreement) -> Rejection:
    assert isinstance(link, RelativePose | Sighting)
    return Rejection(link, f"contradicted by the other measurements ({off.sigmas:.0f} sigmas)")


def _base(
    stances: tuple[Stance, ...], measurements: tuple[Measurement, ...], rejected: Mapping[int, Rejection]
) -> Base:
    numbers = {id(one): number for number, one in enumerate(measurements)}
    return Base(stances, measurements, {numbers[key]: one.reason for key, one in rejected.items()})


class Estimator:
    """Localises a team while it moves: `add` a stance when it is over, and ask for poses at any time.

    What is no measurement (NaN, a covariance that is none, a robot that is not there) raises `MeasurementError`
    before anything has changed, and after any exception the estimator is as it was. What all others contradict is
    left out and listed in `rejected`. What nothing ties to the reference waits until something does. With the `rigs` of
    the robots it calibrates their mounts along with the poses, as `joint` does. Not for several threads at once.
    """

    def __init__(
        self,
        reference: str,
        robots: Iterable[str],
        floor: Floor | None = None,
        slips: Mapping[str, Slip] | None = None,
        rigs: Mapping[str, Robot] | None = None,
        landmarks: Mapping[str, Landmark] | None = None,
    ) -> None:
        self.reference, self.robots, self.floor, self.slips = reference, tuple(robots), floor, dict(slips or {})
        self.rigs, self.landmarks = dict(rigs or {}), dict(landmarks or {})
        self._on_map = map_of(self.landmarks)
        if reference not in self.robots:
            raise EstimationError(f"the reference robot {reference} is not one of {', '.join(self.robots)}")
        if self.rigs:
            require_rigs(self.robots, self.rigs)
        self._early: dict[int, Early] = {}
        self._begin(Base())

    def _begin(self, base: Base) -> None:
        """Hold the stances and measurements of `base`, optimised in batch, and nothing else."""
        self._base, self._journal = base, list[Entry]()  # what came since, in its order
        self._places = PoseKeys(self.robots, self.slips, self.landmarks)
        self._stances: dict[int, Stance] = {}
        for before, stance in zip((None, *base.stances), base.stances, strict=False):
            self._places.accept(self._places.after(before, stance))
            self._stances[stance.index] = stance
        self._log = list(base.measurements)  # everything that ever came, the rejected too
        self._rejected = {  # by the measurement's identity
            id(self._log[number]): Rejection(self._log[number], why) for number, why in base.rejected.items()
        }
        self._newly: set[int] = set()  # those rejected since the last stance came, it included
        self._loose: list[Link] = []  # what nothing ties to the reference
        self._instants: dict[Node, float] = {}
        self._instants = self._checked(self._log)  # when moving robots were sighted
        self._live = Isam2Graph(self._new_factors())
        if base.stances:
            kept = self.graph.without(one.measurement for one in self.rejected)
            self._live, links = rebuilt(kept, self.method)
            inside = set(map(id, links))
            self._loose = [one for one in kept.links if id(one) not in inside and len(set(self._keys(one))) == 2]

    def _replay(self, base: Base, journal: Iterable[Entry]) -> None:
        """Become what `base` and all that came since have made: the same numbers, since it is done in the same way.

        ISAM2 linearises each pose where it was when it came, so that no batch gives the same numbers.
        """
        self._begin(base)
        for entry in journal:
            self._enter(entry.stance, entry.measurements)

    @contextmanager
    def _all_or_nothing(self) -> Iterator[None]:
        """Leave the estimator as it was where what is done in here fails or is interrupted."""
        base, journal, count, early = self._base, self._journal, len(self._journal), dict(self._early)
        self._changed = False
        try:
            yield
        except BaseException:
            self._early = early
            if self._changed:
                self._replay(base, journal[:count])
            raise

    @classmethod
    def of(cls, team: Team, method: Method = "joint") -> "Estimator":
        """The estimator of a team: with its mounts to be calibrated, or of poses alone (`smooth`)."""
        rigs = {robot.name: robot for robot in team.robots} if method == "joint" else None
        return cls(team.reference, team.names, team.floor, slips_of(team), rigs, landmarks_of(team))

    @property
    def method(self) -> Method:
        """Whether mounts are calibrated along (`joint`) or taken as stated (`smooth`)."""
        return "joint" if self.rigs else "smooth"

    def _new_factors(self) -> Factors:
        return Factors(self.floor, Variables(self.robots, self.rigs, self.landmarks) if self.rigs else None)

    @property
    def stances(self) -> tuple[Stance, ...]:
        """The stances that are in, in their order."""
        return tuple(self._stances.values())

    @property
    def measurements(self) -> tuple[Measurement, ...]:
        """Every measurement that is in, the rejected ones too."""
        return tuple(self._log)

    @property
    def rejected(self) -> tuple[Rejection, ...]:
        """What all other measurements contradict."""
        return tuple(self._rejected.values())

    @property
    def waiting(self) -> tuple[int, ...]:
        """The stances that came before the one they follow, and wait for it."""
        return tuple(sorted(self._early))

    @property
    def graph(self) -> PoseGraph:
        """Everything that is in, as a graph; `EstimationError` while there is no stance."""
        return PoseGraph(
            self.reference, self.robots, self.stances, self.measurements, self.floor, self.slips, self.rigs,
            self.landmarks, self._on_map,
        )  # fmt: skip

    def __repr__(self) -> str:
        return (
            f"Estimator({len(self._stances)} stances, {len(self._log)} measurements, {len(self._rejected)} rejected, "
            f"{len(self._live.tied)} poses tied, {len(self._loose)} links and {len(self._early)} stances waiting)"
        )

    def pose(self, robot: str, stance: int | None = None) -> gtsam.Pose3:
        """T_world_body of a robot at a stance, by default the last at which it is tied; `EstimationError` if none."""
        return self._live.pose(self._tied_key(robot, stance))

    def covariance(self, robot: str, stance: int | None = None) -> Array:
        """Covariance (6, 6) of that pose: GTSAM's tangent, rotation [rad] first, then translation [m], body frame."""
        return self._live.covariance(self._tied_key(robot, stance))

    def placed(self, names: Collection[str] | None = None) -> dict[str, Placed]:
        """Where the landmarks are that were sighted, and the map (`landmarks.MAP`), by name; only of `names`."""
        return {
            name: Placed(self._live.pose(key), self._live.covariance(key))
            for name, key in self._places.still().items()
            if key in self._live.tied and (names is None or name in names)
        }

    def residual(self, measurement: Measurement) -> float:
        """How far a measurement is from where all stand now, RMS in units of its noise; NaN where an end of it has no
        pose."""
        i, j = self._keys(measurement)
        return self._live.residual((measurement, i, j)) if i != j and {i, j} <= self._live.tied else float("nan")

    def estimate(self) -> Estimate:
        """All poses at all stances with their covariances, optimised to the end: what the method makes of it in batch.

        Raises `EstimationError` while there is no stance.
        """
        graph = self.graph
        kept = graph.without(one.measurement for one in self.rejected)
        values = self._live.values() if self._live.tied else None
        optimised = joint if self.rigs else smooth
        return replace(optimised(kept, refuse=False, start=values), source=graph, rejected=self.rejected)

    def bumps(self) -> tuple[Bump, ...]:
        """The anchors that did not stay put, by all that is in, the rejected too; it takes a few batches."""
        return find_bumps(self.method, self.graph)

    def add(
        self, stance: Stance, measurements: Iterable[Measurement] = (), *, after: int | None = None
    ) -> StanceEstimate:
        """Take in a stance with what was measured in it and on the way to it; where its robots stand comes back.

        `after` is the stance that it follows, since which its anchors have stayed: the one numbered before it unless
        said otherwise. A stance that comes too early waits for that one, and is then `disconnected`.
        """
        taken = tuple(measurements)
        follows = stance.index - 1 if after is None else after
        if stance.index in self._stances or stance.index in self._early:
            raise MeasurementError(f"stance {stance.index} is in already; add it once, and what comes late by `insert`")
        require_robots(stance, self.robots)
        require_valid(taken, self.floor)
        # the first stance is the one that has no anchors: nobody can have stayed since another
        is_first = not self._stances and after is None and not stance.anchors
        if is_first:
            require_reference(self.reference, stance)
        elif follows not in self._stances:
            self._early[stance.index] = Early(stance, taken, follows)
            return StanceEstimate(stance.index, {}, {}, stance.observers)
        elif follows != (last := next(reversed(self._stances))):
            raise MeasurementError(
                f"stance {stance.index} is said to follow stance {follows}, which stance {last} follows: number the "
                "stances in the order of time"
            )
        with self._all_or_nothing():
            estimate = self._enter(stance, taken)
            while early := self._next_early():
                del self._early[early.stance.index]
                later = self._enter_early(early)
                estimate = replace(later, rejected=(*estimate.rejected, *later.rejected))
        return estimate

    def _enter_early(self, early: Early) -> StanceEstimate:
        try:
            return self._enter(early.stance, early.measurements)
        except EstimationError as error:
            index = early.stance.index
            raise type(error)(
                f"{error}; stance {index} waits for stance {early.after}: drop it by `discard({index})`, or correct it"
            ) from error

    def discard(self, index: int) -> None:
        """Drop a stance that waits for an earlier one; `MeasurementError` where none of this number waits."""
        if index not in self._early:
            raise MeasurementError(f"stance {index} does not wait for another, so that it cannot be discarded")
        del self._early[index]

    def _next_early(self) -> Early | None:
        last = next(reversed(self._stances))
        return next((early for early in self._early.values() if early.after == last), None)

    def insert(self, *measurements: Measurement) -> StanceEstimate:
        """Take in measurements that come late, of stances that are in; the last stance's poses come back."""
        if not self._stances:
            raise MeasurementError("there is no stance that a measurement could belong to: add one first")
        require_valid(measurements, self.floor)
        with self._all_or_nothing():
            return self._enter(None, measurements)

    def revoke(self, measurement: Measurement) -> StanceEstimate:
        """Take a measurement out again, as if it had never come; the last stance's poses come back.

        What was rejected because it contradicted this one is taken back.
        """
        if not any(one is measurement for one in self._log):
            raise EstimationError(f"the {measurement} is not in, so that it cannot be taken out")
        with self._all_or_nothing():
            self._take_out(self.stances, {id(measurement)}, set(self._rejected))
        return self._at(next(reversed(self._stances.values())), self.rejected, UNCHECKED)

    def withdraw(self) -> Stance:
        """Take the last stance out again with all that was measured in it and on the way to it, as if it had never
        come; it comes back. `EstimationError` where it is the first."""
        if len(self._stances) < 2:
            raise EstimationError("the first stance is where the world is, and cannot be taken out: begin anew")
        *left, stance = self.stances
        gone = {id(one) for one in self._log if any(index == stance.index for _, index in one.ends)}
        with self._all_or_nothing():
            self._take_out(tuple(left), gone, self._newly)
        return stance

    def _take_out(self, stances: tuple[Stance, ...], gone: Set[int], doubted: Set[int]) -> None:
        """Keep these stances and all measurements but those `gone`, by identity; of the rejected, try those `doubted`
        again."""
        measurements = tuple(one for one in self._log if id(one) not in gone)
        rejected = {key: one for key, one in self._rejected.items() if key not in gone}
        self._changed = True
        self._begin(_base(stances, measurements, rejected))
        again = [m for m in (one.measurement for key, one in rejected.items() if key in doubted) if isinstance(m, Link)]
        if again:
            found = {id(one.measurement): one for one in self._update(self._entering([*self._loose, *again]))[0]}
            left = {key: one for key, one in rejected.items() if key not in doubted} | found
            # anew, so that nothing depends on the order in which they were tried
            self._begin(_base(stances, measurements, left))

    def save(self, path: str | Path) -> None:
        """Write a checkpoint, whole or not at all, from which `resume` goes on."""
        team = self.reference, self.robots, self.floor, self.slips, self.rigs, self.landmarks
        came = self._base, tuple(self._journal), tuple(self._early.values())
        checkpoint.write(checkpoint.Checkpoint(*team, *came), Path(path))

    @classmethod
    def resume(cls, path: str | Path) -> "Estimator":
        """The estimator of a checkpoint, as it was to the last bit; `InputError` where the file is none.

        Everything enters again as it came, which takes as long as it took.
        """
        saved = checkpoint.read(Path(path))
        estimator = cls(saved.reference, saved.robots, saved.floor, saved.slips, saved.rigs, saved.landmarks)
        try:
            estimator._replay(saved.base, saved.journal)
        except EstimationError as error:
            raise InputError(f"{path}: is a damaged checkpoint ({error}); solve the run again") from error
        estimator._early = {one.stance.index: one for one in saved.early}
        return estimator

    def _enter(self, stance: Stance | None, taken: tuple[Measurement, ...]) -> StanceEstimate:
        before = next(reversed(self._stances.values()), None)
        links: list[Link] = [*self._loose, *taken, *self._newly_on_map(taken)]
        if stance is not None:
            if before is not None:
                require_anchor(stance, taken)
                links += [stay for stay in self._places.stay_puts(before, stance) if stay.slip is not None]
            self._places.accept(self._places.after(before, stance))
            self._stances[stance.index] = stance
        try:
            instants = self._checked(taken)
            entering = self._entering(links)
        except BaseException:
            if stance is not None:
                self._places.forget(before, stance)
                del self._stances[stance.index]
            raise
        rejected, agreement = self._update(entering)
        self._journal.append(Entry(stance, taken))
        self._log += taken
        self._instants |= instants
        self._rejected |= {id(one.measurement): one for one in rejected}
        self._newly = (set() if stance is not None else self._newly) | {id(one.measurement) for one in rejected}
        self._loose = entering.loose
        said = self._at(next(reversed(self._stances.values())), rejected, agreement)
        seen = {one.seen for one in taken if isinstance(one, Sighting)}
        return replace(said, residuals=tuple(map(self.residual, taken)), landmarks=self.placed(seen))

    def _newly_on_map(self, taken: Iterable[Measurement]) -> tuple[Link, ...]:
        """What the map says of the landmarks that are seen for the first time."""
        waiting = set(map(id, self._loose))
        return tuple(
            one
            for one in of_seen(self._on_map, (m.seen for m in taken if isinstance(m, Sighting)))
            if id(one) not in waiting and self._places.key(one.ends[1]) not in self._live.tied
        )

    def _checked(self, taken: Sequence[Measurement]) -> dict[Node, float]:
        """Times at which moving robots were sighted; raises where a measurement relates what is not there."""
        for measured in taken:
            require_ends(measured, self._places, self._stances)
        return instants_of(taken, self._stances, self._instants)

    def _entering(self, links: list[Link]) -> InsertionPlan:
        reference = self._places.key((self.reference, next(iter(self._stances))))
        live = self._live
        return InsertionPlanner(live.factors_of, self._keys, live.tied, reference, live.pose, live.errors).sort(links)

    def _update(self, entering: InsertionPlan) -> tuple[tuple[Rejection, ...], Agreement]:
        """Put poses and links into the graph, without those that all others contradict."""
        self._changed = True
        try:
            outcome = self._live.enter(entering)
        except Exception as failure:
            raise EstimationError(f"the graph cannot take this in, and is as it was: {failure}") from failure
        return tuple(_refusal(link, off) for link, off in outcome.rejected), outcome.agreement

    def _keys(self, link: Link) -> tuple[int, int]:
        i, j = map(self._places.key, link.ends)
        return i, j

    def _tied_key(self, robot: str, stance: int | None) -> int:
        if robot not in self.robots:
            raise EstimationError(f"robot {robot} is not in the team ({', '.join(self.robots)})")
        for index in reversed(self._stances) if stance is None else (stance,):
            if index in self._stances and (key := self._places.key((robot, index))) in self._live.tied:
                return key
        raise EstimationError(f"robot {robot} has no pose{'' if stance is None else f' at stance {stance}'}")

    def _at(self, stance: Stance, rejected: tuple[Rejection, ...], agreement: Agreement) -> StanceEstimate:
        keys = {robot: self._places.key((robot, stance.index)) for robot in self.robots}
        tied = {robot: key for robot, key in keys.items() if key in self._live.tied}
        return StanceEstimate(
            stance.index,
            {robot: self._live.pose(key) for robot, key in tied.items()},
            {robot: self._live.covariance(key) for robot, key in tied.items()},
            tuple(robot for robot in stance.observers if robot not in tied),
            rejected,
            agreement,
        )
