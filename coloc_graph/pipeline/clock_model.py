"""Errors of sensors' clocks by least squares, from offsets between them.

Each robot's camera and wheels share a clock unless they contradict it. Clocks are constant, or drift, between steps.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coloc_graph.frontend.clock_evidence import ClockEvidence, Sensor
from coloc_graph.run import Stance
from coloc_graph.team import Team

Array = NDArray[np.float64]

SIGNIFICANT = 5.0  # an offset that is corrected exceeds its sigma by this factor
MIN_OFFSET = 3e-3  # and this [s]
MIN_WHEEL_OFFSET = 0.01  # and of odometry, which may be filtered [s]
MIN_STEP = 0.05  # smallest step of a clock within a run [s]
STEP_CHI2 = 50.0  # chi2 that a step must explain
DRIFT_CHI2 = 25.0  # chi2 that drifts must explain
MIN_DRIFT = 2e-3  # change of an offset over the run that a drift makes at least [s]
MIN_FOR_DRIFT = 4  # stances that tell a drift
DRIFT_SIGMA = 1e-3  # prior of a drift: crystals keep time to 1e-4, and NTP slews by 5e-4 at most [s/s]
SAME_SIGMA = 5e-3  # camera and wheels of one robot share a clock to this [s]
SAME_RATE = 1e-6  # and drift alike to this [s/s]
MAX_CONTRADICTORY = 0.25  # share of the evidence that may fit no clock
UNKNOWN = 100.0  # standard deviation of an offset of which nothing is known [s]
ROBUST = 4.0  # evidence that is off by more sigmas counts less


@dataclass(frozen=True)
class Segment:
    """Error of a clock (its time minus the right one) from a right time `start` [UTC s] on.

    It is `offset` [s] at `origin` [UTC s], known to `sigma` [s], and grows by `drift` [s/s]. `offset` is 0 where the
    one `measured` [s] is not significant.
    """

    start: float
    offset: float
    measured: float
    sigma: float
    drift: float
    origin: float

    def error(self, time: float) -> float:
        """Error at a right time [s]."""
        return self.offset + self.drift * (time - self.origin)

    def right(self, stamp: float) -> float:
        """Corrected time of a stamp [UTC s]."""
        return (stamp - self.offset + self.drift * self.origin) / (1 + self.drift)


@dataclass(frozen=True)
class SensorClock:
    """Error of a sensor's clock as `segments` in the order of time, known from motion in `stances` stances."""

    sensor: Sensor
    segments: tuple[Segment, ...]
    stances: int

    @property
    def is_right(self) -> bool:
        """True if nothing is corrected."""
        return not any(one.offset or one.drift for one in self.segments)

    def agrees(self, other: "SensorClock") -> bool:
        """True if another sensor's clock is wrong in the same way."""
        ours, theirs = self.segments[0], other.segments[0]
        sigma = float(np.hypot(ours.sigma, theirs.sigma))
        return abs(ours.offset - theirs.offset) < max(SIGNIFICANT * sigma, MIN_STEP)

    def spans(self, start: float | None, end: float | None) -> Iterator[tuple[Segment, float | None, float | None]]:
        """Segments within a right time, each with the stamps of its begin and end."""
        for number, one in enumerate(self.segments):
            until = self.segments[number + 1].start if number + 1 < len(self.segments) else np.inf
            low = max(-np.inf if start is None else start, one.start)
            high = min(np.inf if end is None else end, until)
            if low <= high:
                begin, finish = (bound + one.error(bound) if np.isfinite(bound) else None for bound in (low, high))
                yield one, begin, finish


def beside(sensor: Sensor) -> Sensor:
    """The other sensor of the same robot."""
    return sensor[0], "wheels" if sensor[1] == "camera" else "camera"


def _usual(clocks: Mapping[Sensor, Sequence[Segment]]) -> Segment | None:
    """The best known clock of those that most robots share; None where as many share the reference's."""
    first = {sensor: segments[0] for sensor, segments in clocks.items()}

    def shared(offset: float) -> int:
        return len({robot for (robot, _), one in first.items() if abs(one.measured - offset) < MIN_STEP})

    usual = max([0.0, *(one.measured for one in first.values())], key=lambda one: (shared(one), -abs(one)))
    alike = [one for one in first.values() if abs(one.measured - usual) < MIN_STEP]
    return min(alike, key=lambda one: one.sigma) if abs(usual) >= MIN_STEP else None


def estimated_clocks(
    team: Team, stances: Sequence[Stance], evidence: Sequence[ClockEvidence]
) -> dict[Sensor, SensorClock]:
    """Return the clock of each sensor that is tied to one whose clock is right: as most robots', else the reference's.

    See `run_clocks`.
    """
    if not evidence:
        return {}
    parts = _split(sorted(evidence, key=lambda one: one.time))
    if any(_contradictory(part) for part in parts):
        return {}  # no clock explains it: what was compared is not the same motion
    solved = [_solve(team, part) for part in parts]
    sensors = list(dict.fromkeys(sensor for one in evidence for sensor in (one.first, one.second)))
    clocks: dict[Sensor, list[Segment]] = {}
    for sensor in sensors:
        for number, (part, offsets) in enumerate(zip(parts, solved, strict=True)):
            start = -np.inf if not number else _between(stances, parts[number - 1][-1].stance, part[0].stance)
            known = offsets.get(sensor) or offsets.get(beside(sensor))
            if known is None:
                continue
            offset, drift, sigma = known
            origin = float(np.mean([one.time for one in part]))
            start = start if sensor in clocks else -np.inf
            clocks.setdefault(sensor, []).append(Segment(start, 0.0, offset, sigma, drift, origin))
    usual = _usual(clocks)
    count = {sensor: len({one.stance for one in evidence if sensor in (one.first, one.second)}) for sensor in clocks}
    return {
        sensor: SensorClock(sensor, tuple(_significant(sensor, one, usual) for one in segments), count[sensor])
        for sensor, segments in clocks.items()
    }


def _significant(sensor: Sensor, one: Segment, usual: Segment | None) -> Segment:
    """Return a clock's error against the `usual` clock, which is corrected where it is significant."""
    measured, sigma = one.measured, one.sigma
    if usual is not None:
        measured, sigma = measured - usual.measured, float(np.hypot(sigma, usual.sigma))
    least = MIN_OFFSET if sensor[1] == "camera" else MIN_WHEEL_OFFSET
    offset = measured if abs(measured) > max(SIGNIFICANT * sigma, least) else 0.0
    return replace(one, offset=offset, measured=measured, sigma=sigma)


def _between(stances: Sequence[Stance], before: int, after: int) -> float:
    """Time between two stances."""
    end = next(one.end for one in stances if one.index == before)
    start = next(one.start for one in stances if one.index == after)
    return (end + start) / 2


def _split(evidence: list[ClockEvidence]) -> list[list[ClockEvidence]]:
    """Evidence of constant or drifting clocks, cut where a clock was set."""
    whole = _chi2(evidence)
    best: tuple[float, list[ClockEvidence], list[ClockEvidence]] | None = None
    stances = sorted({one.stance for one in evidence})
    for first in stances[2:-1]:  # one stance alone tells no step
        before = [one for one in evidence if one.stance < first]
        after = [one for one in evidence if one.stance >= first]
        gain = whole - _chi2(before) - _chi2(after)
        if best is None or gain > best[0]:
            best = gain, before, after
    if best is None or best[0] < STEP_CHI2 or _largest_step(best[1], best[2]) < MIN_STEP:
        return [evidence]
    return [*_split(best[1]), *_split(best[2])]


def _contradictory(evidence: Sequence[ClockEvidence]) -> bool:
    """Return whether much of the evidence fits no constant or drifting clocks, or only such as no computer has."""
    values, _, residuals = _fit(evidence, drifting=len({one.stance for one in evidence}) >= MIN_FOR_DRIFT)
    if any(abs(drift) > SIGNIFICANT * DRIFT_SIGMA for _, drift in values.values()):
        return True
    return bool((np.abs(residuals) > 2 * ROBUST).mean() > MAX_CONTRADICTORY)


def _largest_step(before: Sequence[ClockEvidence], after: Sequence[ClockEvidence]) -> float:
    """Largest change of an offset between two sensors [s]."""
    sides = [_by_pair(part) for part in (before, after)]
    shared = sides[0].keys() & sides[1].keys()
    return max((abs(float(np.median(sides[0][p]) - np.median(sides[1][p]))) for p in shared), default=0.0)


def _by_pair(evidence: Sequence[ClockEvidence]) -> dict[tuple[Sensor, Sensor], list[float]]:
    found: dict[tuple[Sensor, Sensor], list[float]] = {}
    for one in evidence:
        pair, sign = ((one.first, one.second), 1) if one.first < one.second else ((one.second, one.first), -1)
        found.setdefault(pair, []).append(sign * one.offset.value)
    return found


def _chi2(evidence: Sequence[ClockEvidence]) -> float:
    """Squared error of constant or drifting offsets; errors beyond `ROBUST` sigmas count linearly."""
    _, _, residuals = _fit(evidence, drifting=len({one.stance for one in evidence}) >= MIN_FOR_DRIFT)
    size = np.abs(residuals)
    return float(np.where(size < ROBUST, size**2, 2 * ROBUST * size - ROBUST**2).sum())


def _solve(team: Team, evidence: Sequence[ClockEvidence]) -> dict[Sensor, tuple[float, float, float]]:
    """Offset [s], drift [s/s] and sigma [s] of each sensor's clock, relative to those of most robots."""
    values, covariance, residuals = _fit(evidence, drifting=False)
    drifting, more, rest = _fit(evidence, drifting=True)
    times = [one.time for one in evidence]
    enough = len({one.stance for one in evidence}) >= MIN_FOR_DRIFT
    sensors = list(values)
    rates = dict.fromkeys(sensors, 0.0)
    if enough and float((residuals**2).sum() - (rest**2).sum()) > DRIFT_CHI2:
        n, slopes = len(sensors), np.array([drifting[sensor][1] for sensor in sensors])
        right = _right(team, sensors, np.array([drifting[sensor][0] for sensor in sensors]))
        for k, sensor in enumerate(sensors):
            slope = float(slopes[k] - slopes[right])
            sigma = float(np.sqrt(max(_difference(more, n + k, n + right), 0.0)))
            if abs(slope) * (max(times) - min(times)) > MIN_DRIFT and abs(slope) > SIGNIFICANT * sigma:
                rates[sensor] = slope
        if any(rates.values()):
            values, covariance = drifting, more
    offsets = np.array([values[sensor][0] for sensor in sensors])
    right = _right(team, sensors, offsets)
    found = {}
    for k, sensor in enumerate(sensors):
        sigma = float(np.sqrt(max(_difference(covariance, k, right), 0.0)))
        if sigma < 1.0:  # tied to the one that is right
            found[sensor] = float(offsets[k] - offsets[right]), rates[sensor], sigma
    return found


def _difference(covariance: Array, i: int, j: int) -> float:
    """Variance of the difference of two unknowns."""
    return float(covariance[i, i] + covariance[j, j] - 2 * covariance[i, j])


def _right(team: Team, sensors: Sequence[Sensor], offsets: Array) -> int:
    """Number of the sensor whose time is the run's: the reference's camera, or one whose clock most robots share."""
    robots = np.array([sensor[0] for sensor in sensors])
    shared = [len(set(robots[np.abs(offsets - one) < MIN_STEP])) for one in offsets]

    def order(k: int) -> tuple[bool, int, bool]:
        robot, kind = sensors[k]
        return robot != team.reference, -shared[k], kind != "camera"

    return min(range(len(sensors)), key=order)


def _fit(
    evidence: Sequence[ClockEvidence], *, drifting: bool
) -> tuple[dict[Sensor, tuple[float, float]], Array, Array]:
    """Offset and drift of each sensor by robust least squares, their covariance, and the residuals in sigmas.

    Camera and wheels of one robot are tied, but for those that contradict it, which count as one large residual each.
    """
    sensors = list(dict.fromkeys(sensor for one in evidence for sensor in (one.first, one.second)))
    number = {sensor: k for k, sensor in enumerate(sensors)}
    origin = float(np.mean([one.time for one in evidence]))
    n, width = len(sensors), len(sensors) * (2 if drifting else 1)
    rows, right = np.zeros((len(evidence), width)), np.zeros(len(evidence))
    for row, one in enumerate(evidence):
        for sensor, sign in ((one.first, -1.0), (one.second, 1.0)):
            rows[row, number[sensor]] = sign / one.offset.sigma
            if drifting:
                rows[row, n + number[sensor]] = sign * (one.time - origin) / one.offset.sigma
        right[row] = one.offset.value / one.offset.sigma
    untied = 0
    ties = [(robot, kind) for robot, kind in sensors if kind == "camera" and (robot, "wheels") in number]
    while True:
        tied, alike = np.zeros((len(ties), width)), np.zeros((len(ties), width))
        for row, (robot, _) in enumerate(ties):
            camera, wheels = number[robot, "camera"], number[robot, "wheels"]
            tied[row, camera], tied[row, wheels] = -1 / SAME_SIGMA, 1 / SAME_SIGMA
            if drifting:
                alike[row, n + camera], alike[row, n + wheels] = -1 / SAME_RATE, 1 / SAME_RATE
        prior = np.full(width, 1 / UNKNOWN)
        prior[n:] = 1 / DRIFT_SIGMA
        weights = np.ones(len(rows))
        for _ in range(10):
            normal = (rows.T * weights) @ rows + tied.T @ tied + alike.T @ alike + np.diag(prior**2)
            x = np.linalg.solve(normal, rows.T @ (weights * right))
            residuals = right - rows @ x
            weights = np.minimum(1.0, ROBUST / np.maximum(np.abs(residuals), 1e-9))
        off = np.abs(tied @ x)
        if not len(off) or off.max() < SIGNIFICANT:
            break
        del ties[int(off.argmax())]
        untied += 1
    residuals = np.append(residuals, np.full(untied, SIGNIFICANT))
    values = {sensor: (float(x[k]), float(x[n + k]) if drifting else 0.0) for sensor, k in number.items()}
    return values, np.asarray(np.linalg.inv(normal), float), residuals
