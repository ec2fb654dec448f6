"""Clocks of a run's robots, found from motion that two sensors saw, and the run with its stamps corrected."""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import msgspec
import numpy as np
from scipy.special import chdtrc

from coloc_graph.backend import Estimate
from coloc_graph.backend.blame import EQUAL_CHI2
from coloc_graph.frontend import PairMeasurement
from coloc_graph.frontend.clock_evidence import ClockEvidence, Sensor, clock_evidence
from coloc_graph.frontend.pairing.clock_offset import MAX_CLOCK_SIGMA
from coloc_graph.frontend.pairing.correspondence import PAIRING_WINDOW
from coloc_graph.frontend.tracks.interpolation import MAX_GAP
from coloc_graph.pipeline.clock_model import (
    MIN_STEP,
    SensorClock,
    beside,
    estimated_clocks,
)
from coloc_graph.run import Detections, Image, OdometrySample, Stance
from coloc_graph.team import Team

T = TypeVar("T")

FIRST_CHECKED = 6  # stances that are compared first, of those in which clocks are doubted
UNFIT_P_VALUE = 1e-6  # probability of a fit as bad as this by noise below which clocks are doubted
MIN_INLIERS = 0.8  # share of inliers below which they are doubted, too
MIN_STANCES = 2  # stances whose motion says so before a clock is called wrong
REJECTION_PRICE = 25.0  # chi2 that a rejection or a bump counts for where two explanations are compared
LEFT_SIGMA = 5e-3  # corrected clocks agree to this at least; the homographies tell the rest [s]


@dataclass(frozen=True, eq=False)
class RunClocks:
    """Clocks of a run by sensor, as errors against the one that most robots share, else the reference robot's.

    The corrected ones agree to `sigma` [s]; 0 of cameras that take images rarely and at once, which are paired one to
    one. `apart` [s] is the time between the images of two cameras that show no instant in common.
    """

    clocks: Mapping[Sensor, SensorClock]
    sigma: float
    apart: float = 0.0

    @property
    def price(self) -> float:
        """Chi2 that the corrections of cameras' clocks have to gain: `REJECTION_PRICE` for each."""
        cameras = [clock.segments for (_, kind), clock in self.clocks.items() if kind == "camera"]
        return REJECTION_PRICE * sum(bool(one.offset or one.drift) for segments in cameras for one in segments)

    def of_stamps(self, evidence: ClockEvidence) -> ClockEvidence:
        """Return evidence of the run with corrected stamps as evidence of the stamps as they are."""
        errors = (_error(self.clocks.get(sensor), evidence.time) for sensor in (evidence.first, evidence.second))
        first, second = errors
        return replace(evidence, offset=replace(evidence.offset, value=evidence.offset.value + second - first))

    def corrected(self, run: Any) -> Any:
        """Return the run with its stamps corrected."""
        return CorrectedRun(run, self)

    def sentences(self) -> list[str]:
        """Descriptions of what was corrected."""
        said: list[str] = []
        if self.apart:
            said.append(
                f"the cameras' images are {1e3 * self.apart:.0f} ms apart, and none were taken at the same instant: "
                f"clocks are taken to differ by {1e3 * self.sigma:.0f} ms (1 sigma); take images at once, or state how "
                "exact the clocks are as `clock_sigma` of the team"
            )
        robots = list(dict.fromkeys(robot for robot, _ in self.clocks))
        for robot in robots:
            doubt = ""
            if len(robots) == 2:
                (other,) = (one for one in robots if one != robot)
                doubt = f"; of two clocks alone, {other}'s clock may be the wrong one"
            camera, wheels = self.clocks.get((robot, "camera")), self.clocks.get((robot, "wheels"))
            first = camera or wheels
            if first is not None:
                said += _told(f"{robot}'s clock", first, doubt)
            if camera and wheels and not camera.agrees(wheels):
                said += _told(f"the clock of {robot}'s odometry", wheels, doubt)
        return said


def _error(clock: SensorClock | None, time: float) -> float:
    """Error that is corrected at a right time [s]."""
    if clock is None:
        return 0.0
    return next((one.error(time) for one in reversed(clock.segments) if time >= one.start), 0.0)


def _told(name: str, clock: SensorClock, doubt: str) -> Iterator[str]:
    known = f"by motion in {clock.stances} stance{'s' * (clock.stances != 1)}{doubt}"
    remedy = "the stamps were corrected; synchronise the robots' computers"
    first = clock.segments[0]
    if first.offset:
        way = "ahead of" if first.offset > 0 else "behind"
        yield (
            f"{name} is {abs(first.offset):.3f} s {way} the other robots' ({known}, "
            f"sigma {1e3 * first.sigma:.1f} ms): {remedy}"
        )
    for before, after in itertools.pairwise(clock.segments):
        jump = after.error(after.start) - before.error(after.start)
        if abs(jump) > MIN_STEP:
            way = "ahead" if jump > 0 else "back"
            yield f"{name} was set {way} by {abs(jump):.3f} s at about {after.start:.0f} s ({known}): {remedy}"
    if first.drift:
        yield f"{name} drifts by {1e6 * first.drift:+.0f} ppm ({known}): {remedy}"


def suspicious(measured: Iterable[PairMeasurement]) -> Iterator[PairMeasurement]:
    """Pairs that saw the same motion, and measured nothing or what does not fit: as where their clocks differ."""
    for one in measured:
        h = one.homography
        if one.seen is not None and all(one.seen):
            unfit = h.dof > 0 and float(chdtrc(h.dof, h.chi2)) < UNFIT_P_VALUE
            if h.unusable or unfit or h.inliers < MIN_INLIERS * h.points:
                yield one


def clocks_of_images_apart(measured: Sequence[PairMeasurement]) -> RunClocks | None:
    """Return clocks that differ by what lies between the images of two cameras; None where some were taken at once."""
    nearest = []
    for one in measured:
        if one.seen is not None and all(one.seen):
            times_i, times_j = (np.unique(np.concatenate([track.times for track in own])) for own in one.seen)
            nearest.append(float(np.median(np.abs(times_j[None] - times_i[:, None]).min(axis=1))))
    apart = max(nearest, default=0.0)
    return RunClocks({}, apart, apart) if PAIRING_WINDOW < apart < MAX_GAP else None


def unknown_clocks(run: Any) -> RunClocks | None:
    """Return clocks of which nothing is known, for a run whose team states that they agree; None for any other run."""
    cameras = [robot.name for robot in run.team.robots if robot.camera_if_any]
    return None if run.team.clock_sigma or len(cameras) < 2 else RunClocks({}, MAX_CLOCK_SIGMA)


def implausibility(estimate: Estimate) -> float:
    """Chi2 above its expected value, and a price for each rejection and bump."""
    return estimate.chi2 - estimate.dof + REJECTION_PRICE * (len(estimate.rejected) + len(estimate.bumped))


def clocks_instead(run: Any, plain: Estimate, loose: Estimate) -> str | None:
    """Weigh the estimate with unknown clocks against another; the sentence on it, None where it explains less."""
    gain = implausibility(plain) - implausibility(loose) - REJECTION_PRICE
    if gain < -EQUAL_CHI2:
        return None
    cameras = [f"{robot.name}'s clock" for robot in run.team.robots if robot.camera_if_any]
    said = (
        f"{' or '.join(cameras)} is off: with unknown clocks the measurements agree (chi2/dof "
        f"{loose.chi2 / max(loose.dof, 1):.1f})"
    )
    if gain < EQUAL_CHI2:
        others = [one.description for one in plain.bumped] + [
            f"the {one.measurement} is wrong" for one in plain.rejected
        ]
        said += f"; or else {', and '.join(others)}: both explain the measurements equally well" if others else ""
    return f"{said}; synchronise the robots' computers, or let the mover stop and go, which shows the offset"


def contradicts(estimate: Estimate) -> bool:
    """Return whether the measurements of an estimate contradict each other."""
    chance = float(chdtrc(estimate.dof, estimate.chi2)) if estimate.dof > 0 else 1.0
    return bool(estimate.rejected or estimate.bumped) or chance < UNFIT_P_VALUE


def misfit(estimate: Estimate) -> float:
    """Return how badly an estimate explains its measurements: chi2 and the price of rejections, by residual."""
    dropped = len(estimate.rejected) + len(estimate.bumped)
    return (estimate.chi2 + REJECTION_PRICE * dropped) / max(estimate.dof, 1)


def stance_evidence(run: Any, stance: Stance, measured: Sequence[PairMeasurement]) -> list[ClockEvidence]:
    """Return what the motion of a stance says of clocks, if one of its pairs is `suspicious`."""
    doubted = next(suspicious(measured), None) is not None
    return list(clock_evidence(run, stance, _seen(measured))) if doubted else []


def _seen(measured: Sequence[PairMeasurement]) -> dict[tuple[str, str], Any]:
    """Tracks by pair of observers."""
    return {(one.homography.robot_i, one.homography.robot_j): one.seen for one in measured if one.seen is not None}


def _spread(every: Sequence[T]) -> list[T]:
    """Up to `FIRST_CHECKED` of some things, evenly spread."""
    picked = np.unique(np.linspace(0, len(every) - 1, min(FIRST_CHECKED, len(every))).round().astype(int))
    return [every[k] for k in picked.tolist()]


def _wheels_differ(run: Any, stances: Sequence[Stance], measured: Mapping[int, Sequence[PairMeasurement]]) -> bool:
    """Return whether odometry of some stances has another clock than the cameras that saw the robot move."""
    some = _spread(stances)
    evidence = [
        one for stance in some for one in clock_evidence(run, stance, _seen(measured[stance.index][:1]), rough=True)
    ]
    return run_clocks(run.team, run.stances, evidence) is not None


def clocks_of_run(run: Any, measured: Sequence[PairMeasurement], *, any_pair: bool = False) -> RunClocks | None:
    """Find clocks that are wrong, from the stances in which a pair is `suspicious`, or from `any_pair`.

    None where no stamp needs a correction.
    """
    by_stance: dict[int, list[PairMeasurement]] = {stance.index: [] for stance in run.stances}
    for one in measured:
        by_stance[one.homography.stance].append(one)
    doubted = [k for k, pairs in by_stance.items() if any_pair or next(suspicious(pairs), None) is not None]
    if not doubted:
        if not _wheels_differ(run, [stance for stance in run.stances if by_stance[stance.index]], by_stance):
            return None
        doubted = list(by_stance)
    found: dict[int, list[ClockEvidence]] = {}
    # most often it is not the clocks: some stances tell that, and that others are right is to be known only if they are
    for stances in (_spread(doubted), by_stance):
        for stance in run.stances:
            if stance.index in stances and stance.index not in found:
                found[stance.index] = list(clock_evidence(run, stance, _seen(by_stance[stance.index])))
        clocks = run_clocks(run.team, run.stances, [one for every in found.values() for one in every])
        if clocks is None:
            break
    return clocks


def run_clocks(team: Team, stances: Sequence[Stance], evidence: Sequence[ClockEvidence]) -> RunClocks | None:
    """Estimate the clocks of a run.

    Parameters
    ----------
    team : Team
        Its robots; the clock that most of them share, else the reference robot's, is the run's time.
    stances : sequence of Stance
        All stances, in the order of time.
    evidence : sequence of ClockEvidence
        Offsets between sensors.

    Returns
    -------
    RunClocks or None
        None where no stamp needs a correction.
    """
    clocks = {
        sensor: clock
        for sensor, clock in estimated_clocks(team, stances, evidence).items()
        if clock.is_right or clock.stances >= MIN_STANCES
    }
    if all(clock.is_right for clock in clocks.values()):
        return None
    sigmas = [one.sigma for (_, kind), clock in clocks.items() if kind == "camera" for one in clock.segments]
    at_once = any(one.synchronous for one in evidence)
    return RunClocks(clocks, 0.0 if at_once else max([LEFT_SIGMA, *sigmas]))


class CorrectedRun:
    """A run whose stamps are corrected; all else is as it is recorded."""

    def __init__(self, run: Any, clocks: RunClocks) -> None:
        self._run, self._clocks = run, clocks
        known = all((robot.name, "camera") in clocks.clocks for robot in run.team.robots if robot.camera_if_any)
        sigma = clocks.sigma if known else max(clocks.sigma, run.team.clock_sigma)
        self.team: Team = msgspec.structs.replace(run.team, clock_sigma=sigma)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._run, name)

    def detections(self, robot: str, start: float, end: float) -> Iterator[Detections]:
        """Detections, as `Recorded`."""
        return self._read(self._run.detections, robot, "camera", start, end)

    def images(self, robot: str, start: float, end: float) -> Iterator[Image]:
        """Images, as `Recorded`."""
        return self._read(self._run.images, robot, "camera", start, end)

    def odometry(self, robot: str, start: float | None = None, end: float | None = None) -> Iterator[OdometrySample]:
        """Odometry, as `Recorded`."""
        return self._read(self._run.odometry, robot, "wheels", start, end)

    def _read(self, read: Any, robot: str, kind: Any, start: float | None, end: float | None) -> Iterator[Any]:
        clocks = self._clocks.clocks
        clock = clocks.get((robot, kind)) or clocks.get(beside((robot, kind)))
        if clock is None or clock.is_right:
            yield from read(robot, start, end)
            return
        newest = -np.inf
        for segment, begin, finish in clock.spans(start, end):
            for one in read(robot, begin, finish):
                time = segment.right(one.time)
                if time > newest:
                    newest = time
                    yield replace(one, time=time)
