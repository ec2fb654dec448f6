"""Incremental solving stance by stance, of a logged run or of a team in the field."""

import time
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from coloc_graph.backend import Estimator, StanceEstimate
from coloc_graph.backend.fixed_lag import LAG
from coloc_graph.backend.graph import PoseKeys, slips_of
from coloc_graph.backend.landmarks import landmarks_of
from coloc_graph.errors import ColocError
from coloc_graph.frontend import (
    PairMeasurement,
    Scale,
    StanceTracks,
    UnusedSighting,
    WheelTrack,
    measure_pair,
    measured_pairs,
    share_clock_offsets,
    sight_landmarks,
    sight_movers,
    sight_standing,
    unsighted_movers,
)
from coloc_graph.frontend.clock_evidence import ClockEvidence
from coloc_graph.frontend.learnt_noise import NoiseBelief, measured_again
from coloc_graph.frontend.stance_ranges import StanceRanges, merged
from coloc_graph.measurements import Measurement, Odometry, Sighting
from coloc_graph.pipeline.clocks import CorrectedRun, RunClocks, run_clocks, stance_evidence
from coloc_graph.pipeline.lever_arm import MIN_REJECTED, LeverArm, mend_lever_arms, of_bodies
from coloc_graph.pipeline.options import SolveOptions
from coloc_graph.pipeline.ranges import instants_in, of_targets, place_ranges, standing_of
from coloc_graph.run import OdometrySample, Ranges, Recorded, Run, Stance
from coloc_graph.run.recorded import Restated
from coloc_graph.team import Team


def measure_stance(
    run: Recorded, stance: Stance, options: SolveOptions, tracks: StanceTracks | None = None
) -> Iterator[PairMeasurement]:
    """Yield the measurement of each pair of observers of a stance.

    Without the offset of their clocks, which all stances determine together: `share_clock_offsets`.
    """
    options = options.resolved()
    frontend = options.frontend
    assert frontend is not None
    # a joint estimate uses the spans itself, and the heights for initial values
    scale: Scale = "heights" if options.method == "joint" else frontend.scale
    tracks = tracks or StanceTracks(run, stance, frontend.tracker)
    pairs = measured_pairs(tracks, stance.end)
    for pair in pairs:
        yield measure_pair(run, stance, *pair, replace(frontend, scale=scale), tracks, pairs, alone=False)


@dataclass(frozen=True)
class _Known:
    """State after a stance that the next one needs; immutable, so that an earlier state can be restored."""

    stance: Stance | None = None
    posed: frozenset[str] = frozenset()  # robots that have a pose at the stance
    last: Mapping[str, tuple[int, float]] = field(default_factory=dict)  # stance and time of each robot's last pose
    standing: frozenset[str] = frozenset()  # robots that have not moved since their last pose
    sighted: frozenset[tuple[str, str]] = frozenset()  # landmarks, by the observer that has not moved since it saw them
    unused: tuple[UnusedSighting, ...] = ()

    def stayed(self, stance: Stance) -> set[str]:
        """Robots that stay from the last stance to this one."""
        before = self.stance
        return set() if before is None else {r for r in stance.anchors if PoseKeys.stays(r, before, stance)}


class OdometryAndSightings:
    """Sightings of robots and landmarks, and wheel odometry of each robot from one pose to its next.

    Takes the stances in their order, and reads the odometry between two poses only.
    """

    def __init__(self, team: Team, *, odometry: bool = True) -> None:
        self.team, self._odometry = team, odometry
        self._slips = slips_of(team)
        self._known, self._earlier = _Known(), _Known()
        self._samples: dict[str, list[OdometrySample]] = {robot: [] for robot in team.names}  # since each last pose

    @property
    def unused(self) -> list[UnusedSighting]:
        """Landmarks and movers that were seen and are not used."""
        return list(self._known.unused)

    def withdraw(self) -> None:
        """Remove the last stance; only once until another was added."""
        self._known = self._earlier
        self._samples = {robot: [] for robot in self.team.names}  # they are read again

    def of_stance(self, run: Recorded, stance: Stance, measured: Sequence[PairMeasurement]) -> list[Measurement]:
        """Return sightings and odometry of a stance whose pairs are all `measured`."""
        known = self._known
        stayed = known.stayed(stance)
        wheels = {robot: self._wheels(run, robot, stance) for robot in self.team.names}
        sightings = sight_movers(run, stance, measured, wheels)
        unsighted = unsighted_movers(run, stance, measured, wheels, sightings)
        sightings += sight_standing(run, stance, measured, known.stance)
        # a robot that stayed learns nothing new of a landmark that it has sighted
        sighted = {one for one in known.sighted if one[0] in stayed - self._slips.keys()}
        landmarks, unused = _landmarks(run, stance, measured, sighted)
        sightings += landmarks
        posed = [robot for m in measured if m.relative_pose for robot, _ in m.relative_pose.ends]
        posed += [robot for s in sightings for robot, _ in s.ends if robot in self._samples]  # landmarks have no wheels
        here = {*stance.observers, *posed, *(stayed & known.posed)}
        standing = known.standing & (stayed - self._slips.keys())
        times = {s.seen: s.time for s in sightings if s.seen in stance.movers}
        now = {robot: (stance.index, times.get(robot, stance.start)) for robot in here}
        self._earlier = known
        self._known = _Known(
            stance,
            frozenset(here),
            {**known.last, **now},
            frozenset(standing | here),
            frozenset(sighted | {(one.observer, one.seen) for one in landmarks}),
            (*known.unused, *unused, *unsighted),
        )
        made: list[Measurement] = [*sightings]
        for robot in sorted((here - standing) & known.last.keys()) if self._odometry else ():
            before, begun = known.last[robot]
            driven = wheels[robot].between(before, stance.index, begun, now[robot][1], run.team.clock_sigma)
            made += [] if driven is None else [driven]
        return made

    def _wheels(self, run: Recorded, robot: str, stance: Stance) -> WheelTrack:
        samples = self._samples[robot]
        newest = samples[-1].time if samples else None
        samples += [one for one in run.odometry(robot, newest, stance.end) if newest is None or one.time > newest]
        if robot in self._known.last:
            begun = bisect_right(samples, self._known.last[robot][1], key=lambda one: one.time)
            del samples[: max(begun - 1, 0)]
        return WheelTrack(robot, samples)


def _landmarks(
    run: Recorded, stance: Stance, measured: Sequence[PairMeasurement], known: set[tuple[str, str]]
) -> tuple[list[Sighting], list[UnusedSighting]]:
    """Return sightings of landmarks by the observers, without the (observer, landmark) that are `known`."""
    seen = (
        (robot, what)
        for one in measured
        for robot, what in zip((one.homography.robot_i, one.homography.robot_j), one.landmarks, strict=True)
    )
    return sight_landmarks(run, stance, seen, known)


@dataclass(frozen=True, eq=False)
class EnteredStance:
    """A stance in the estimate.

    Parameters
    ----------
    stance : Stance
        The stance.
    estimate : StanceEstimate
        Poses of its robots as estimated when it was added.
    measurements : tuple of Measurement
        Its measurements, and the odometry into it.
    pairs : tuple of PairMeasurement
        Measurements of all pairs, unusable ones included.
    warnings : tuple of str
        Warnings on clocks and odometry, as they are known with this stance.
    """

    stance: Stance
    estimate: StanceEstimate
    measurements: tuple[Measurement, ...]
    pairs: tuple[PairMeasurement, ...]
    warnings: tuple[str, ...] = ()


class IncrementalSolver:
    """Incremental solver: measures each stance when it is over, and adds it to an estimator.

    Parameters
    ----------
    team : Team
        The team.
    options : SolveOptions, optional
        As of `solve`.
    """

    def __init__(self, team: Team, options: SolveOptions | None = None) -> None:
        self.options = (options or SolveOptions()).resolved()
        self.team = team
        robot_models = self.options.robot_models(team) or None
        lag = LAG if self.options.lag is None else int(self.options.lag)
        self.estimator = Estimator(
            team.reference, team.names, team.floor, slips_of(team), robot_models, landmarks_of(team), lag
        )
        #: All pairs of all stances, unusable ones included.
        self.measured: tuple[PairMeasurement, ...] = ()
        #: Warnings on clocks and lever arms.
        self.warnings: list[str] = []
        #: Clocks that turned out to be wrong; their stamps are corrected from then on.
        self.clocks: RunClocks | None = None
        #: Lever arms of odometry that were found; it is moved to the body from then on.
        self.arms: dict[str, LeverArm] = {}
        self._doubted = MIN_REJECTED  # rejections from which on lever arms are looked for
        self._evidence: list[ClockEvidence] = []
        #: Time of the front end and of the estimator for each stance [s].
        self.seconds: list[tuple[float, float]] = []
        #: Noise of marker centres as it is known from the stances that are in, and before the last.
        self.noise = self._earlier_noise = self._next_noise = NoiseBelief.of(team)
        self._motions = OdometryAndSightings(team, odometry=self.options.odometry)
        self._ranges: dict[int, StanceRanges] = {}  # by the stance with which they came
        self._instants: dict[tuple[str, int], float] = {}  # when moving robots were sighted
        self._posed: dict[int, tuple[str, ...]] = {}  # robots that have a pose, by stance
        self._history: list[tuple[Stance, dict[str, list[Ranges]]]] = []  # ranges of landmarks that are not located
        self._unlocated = StanceRanges((), {})
        self._measuring = 0.0

    def measure(
        self, run: Recorded, stance: Stance, pairs: Iterable[PairMeasurement] | None = None
    ) -> tuple[PairMeasurement, ...]:
        """Return the measurements of a stance, with the clock offsets estimated until now.

        `pairs` come from `measure_stance`, here or in another process.
        """
        started = time.perf_counter()
        as_it_is, run = run, self._as_corrected(run)

        def again() -> tuple[tuple[PairMeasurement, ...], list[str]]:
            noisy = Restated(run, self.noise.used(run.team))
            return share_clock_offsets(
                list(measure_stance(noisy, stance, self.options)), run.team.clock_sigma, self.measured
            )

        if pairs is None or self.clocks is not None:
            shared, warnings = again()
        else:
            shared, warnings = share_clock_offsets(list(pairs), run.team.clock_sigma, self.measured)
        if said := stance_evidence(run, stance, shared):
            before = [one for one in self._evidence if one.stance != stance.index]
            self._evidence = [*before, *(self.clocks.of_stamps(one) if self.clocks else one for one in said)]
            clocks = run_clocks(self.team, (*self.estimator.stances, stance), self._evidence)
            if clocks is not None:
                self.clocks, run = clocks, clocks.corrected(as_it_is)
                shared, warnings = again()
        self.warnings = [*(self.clocks.sentences() if self.clocks else ()), *map(str, self.arms.values()), *warnings]
        self._next_noise = self.noise.updated(shared)
        shared = measured_again(shared, self._next_noise.used(run.team))
        self._measuring = time.perf_counter() - started
        return shared

    def ranges_before(self, run: Run, stance: Stance) -> dict[str, list[Ranges]]:
        """Return the recorded ranges since the last stance, up to the end of this one, by robot."""
        if self.options.method != "joint" or not run.has_ranges:
            return {}
        since = self.estimator.stances[-1].end if self.estimator.stances else stance.start
        return {robot: list(run.ranges(robot, since, stance.end)) for robot in self.team.names}

    def enter(
        self,
        run: Recorded,
        stance: Stance,
        measured: tuple[PairMeasurement, ...] | None = None,
        ranges: Mapping[str, Sequence[Ranges]] | None = None,
    ) -> EnteredStance:
        """Add a stance with its measurements by `measure`, and the `ranges` since the last stance.

        Raises
        ------
        MeasurementError
            A stance after the first has no anchor and no odometry into it.
        """
        shared = self.measure(run, stance) if measured is None else measured
        run = self._as_corrected(run)
        started = time.perf_counter()
        noisy = Restated(run, self._next_noise.used(self.team))
        motions = [] if self.team.floor is None else self._motions.of_stance(noisy, stance, shared)
        made = of_bodies((*(m.relative_pose for m in shared if m.relative_pose is not None), *motions), self.arms)
        adding = time.perf_counter()
        before = next(reversed(self.estimator.stances), None)
        # the first stance has no anchors, whatever it names
        here = stance if before else replace(stance, anchors=())
        try:
            said = self.estimator.add(here, made, after=before.index if before else None)
        except ColocError:
            if self.team.floor is not None:
                self._motions.withdraw()
            raise
        said, made = self._mended(said, made)
        said = self._enter_ranges(run, here, before, said, made, ranges or {})
        self.seconds.append((self._measuring + adding - started, time.perf_counter() - adding))
        self.measured += tuple(replace(one, with_team=None) for one in shared)
        self._earlier_noise, self.noise = self.noise, self._next_noise
        return EnteredStance(here, said, made, shared, tuple(self.warnings))

    def _mended(
        self, said: StanceEstimate, made: tuple[Measurement, ...]
    ) -> tuple[StanceEstimate, tuple[Measurement, ...]]:
        """Look for lever arms that explain what was rejected; the estimate and measurements of the last stance."""
        if sum(isinstance(one.measurement, Odometry | Sighting) for one in self.estimator.rejected) < self._doubted:
            return said, made
        self._doubted *= 2  # each time takes a few batch estimates
        found, again = mend_lever_arms(self.estimator)
        if again is None:
            return said, made
        self.arms |= found
        self.warnings += map(str, found.values())
        made = tuple(one for one in self.estimator.measurements if said.stance in (stance for _, stance in one.ends))
        residuals = tuple(map(self.estimator.residual, made))
        return replace(again, residuals=residuals, landmarks=said.landmarks), made

    def _enter_ranges(
        self,
        run: Recorded,
        stance: Stance,
        before: Stance | None,
        said: StanceEstimate,
        made: Iterable[Measurement],
        recorded: Mapping[str, Sequence[Ranges]],
    ) -> StanceEstimate:
        """Add the ranges since a stance `before`, placed by the estimate without them."""
        self._instants |= instants_in(made)
        self._posed[stance.index] = tuple(said.poses)
        if not any(recorded.values()):
            return said
        known = {name: one.T_world_body.matrix() for name, one in self.estimator.static_poses().items()}
        names = {one.name for one in self.team.landmarks} - known.keys()
        self._history.append((stance, {robot: of_targets(each, names) for robot, each in recorded.items()}))
        del self._history[: -self.estimator.lag]
        others = {*self.team.names, *known}
        here = {robot: of_targets(each, others) for robot, each in recorded.items()}
        found = self._placed(run, [stance] if before is None else [before, stance], here, known)
        if names and any(one for _, each in self._history for one in each.values()):
            earlier = {robot: [one for _, each in self._history for one in each[robot]] for robot in recorded}
            late = self._placed(run, [one for one, _ in self._history], earlier, {})
            new = {one.target for one in late.ranges}
            self._unlocated = late if not new else StanceRanges((), {})
            if new:  # now that it is located, all ranges of it count
                found = merged([found, late])
                self._history = [
                    (one, {robot: of_targets(every, names - new) for robot, every in each.items()})
                    for one, each in self._history
                ]
        self._ranges[stance.index] = found
        if not found.ranges:
            return said
        later = self.estimator.insert(*found.ranges)
        return replace(
            later,
            rejected=(*said.rejected, *later.rejected),
            agreement=said.agreement,
            residuals=said.residuals,
            landmarks=said.landmarks,
        )

    def _placed(
        self,
        run: Recorded,
        stances: Sequence[Stance],
        recorded: Mapping[str, Sequence[Ranges]],
        landmarks: Mapping[str, Any],
    ) -> StanceRanges:
        """Average the ranges of some stances at the present poses."""
        poses = {
            one.index: {robot: self.estimator.pose(robot, one.index).matrix() for robot in self._posed[one.index]}
            for one in stances
        }
        begin, end = stances[0].start, stances[-1].end
        wheels = {
            robot: list(run.odometry(robot, begin, end)) if self.options.odometry else [] for robot in self.team.names
        }
        standing = standing_of(stances, poses, self._instants)
        return place_ranges(self.team, standing, wheels, recorded, stances, landmarks)

    @property
    def ranges(self) -> StanceRanges:
        """All ranges, and the number of samples that are not used."""
        return merged([*self._ranges.values(), self._unlocated])

    def _as_corrected(self, run: Any) -> Any:
        return run if self.clocks is None or isinstance(run, CorrectedRun) else self.clocks.corrected(run)

    @property
    def unused(self) -> list[UnusedSighting]:
        """Landmarks and movers that were seen and are not used."""
        return self._motions.unused

    def withdraw(self) -> None:
        """Remove the last stance, as if it had never been added; `EstimationError` where it is the first."""
        index = self.estimator.withdraw().index
        self.noise = self._earlier_noise
        if self.team.floor is not None:
            self._motions.withdraw()
        self._ranges.pop(index, None)
        self._history = [one for one in self._history if one[0].index != index]
        self.measured = tuple(one for one in self.measured if one.homography.stance != index)
        self.seconds.pop()
