"""Offset of a robot's clock from the coordinator's: four timestamps, guaranteed bounds, drift; `ClockFilter`."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import RobotError
from coloc_graph.machine import machine

Array = NDArray[np.float64]

MAX_EXCHANGES = 64  # exchanges that are kept
MIN_EXCHANGES = 8  # exchanges that are needed to be synchronised
QUARTZ_DRIFT = 40e-6  # standard deviation of a quartz's drift [s/s], before it is measured
ASYMMETRY = 0.1  # standard deviation of the network's unobservable asymmetry, as a fraction of the least round trip
FLOOR = 20_000.0  # ns, least standard deviation of the offset
JUMP = 1_000_000.0  # ns by which an exchange contradicts the estimate if the clock has jumped
VALIDITY = 5_000_000_000  # ns for which the estimate holds without a new exchange


@dataclass(frozen=True)
class ClockEstimate:
    """Estimate of a robot's clock at one time.

    Attributes
    ----------
    offset
        Robot's clock minus the coordinator's [ns].
    drift
        Rate of change of the offset [s/s].
    sigma
        Standard deviation of the offset [ns].
    """

    offset: float
    drift: float
    sigma: float


@dataclass(frozen=True)
class _Fit:
    """Offset `base + offset` [ns] at the time `at` [ns, coordinator], drift, and one sigma of each."""

    at: int
    base: int
    offset: float
    drift: float
    sigma: float
    drift_sigma: float

    def estimate(self, at: int) -> ClockEstimate:
        away = at - self.at
        return ClockEstimate(
            self.base + self.offset + self.drift * away, self.drift, math.hypot(self.sigma, self.drift_sigma * away)
        )


class ClockFilter:
    """Estimator of one robot's clock offset; for several threads.

    Notes
    -----
    In an exchange the coordinator asks at t1 and receives the answer at t4, the robot receives at t2 and answers at t3,
    each by its own clock [ns]. The offset is at least t3 - t4 and at most t2 - t1, whatever the network does. Of many
    exchanges the narrowest bounds hold, moved by the drift to the newest, and the offset is halfway between them. If an
    exchange contradicts the bounds, the clock has jumped, and earlier exchanges are discarded.
    """

    def __init__(self) -> None:
        # exchanges that are kept: their time [ns, coordinator], and bounds of the offset then [ns]
        self._kept = np.zeros((3, 0), np.int64)
        self._fit: _Fit | None = None
        self._jumps = 0
        self._lock = machine.new_lock()

    def add(self, t1: int, t2: int, t3: int, t4: int) -> None:
        """Add an exchange [ns]. Raises `ValueError` if it is impossible."""
        if t4 < t1 or t3 < t2 or (t4 - t1) < (t3 - t2):
            raise ValueError("an answer was received before its question was sent")
        at, least, most = (t1 + t4) // 2, t3 - t4, t2 - t1
        with self._lock:
            if self._fit is not None:
                if at < self._fit.at:
                    return  # overtaken by a later one
                known = self._fit.estimate(at)
                slack = JUMP + 6 * known.sigma
                if not least - slack <= known.offset <= most + slack:
                    self._kept = self._kept[:, :0]
                    self._jumps += 1
            newest = np.array([[at], [least], [most]], np.int64)
            self._kept = np.concatenate([self._kept[:, 1 - MAX_EXCHANGES :], newest], axis=1)
            self._fit = _fitted(self._kept)

    @property
    def jumps(self) -> int:
        """Number of times that the clock jumped."""
        return self._jumps

    @property
    def known(self) -> bool:
        """True after the first exchange, however uncertain the offset is."""
        return self._fit is not None

    def estimate(self, at: int) -> ClockEstimate | None:
        """Estimate at a time of the coordinator's clock [ns]; None before the first exchange."""
        fit = self._fit
        return None if fit is None else fit.estimate(at)

    def synchronised(self, at: int, limit: float = 1e-3) -> bool:
        """Return whether the offset is known to `limit` [s, one sigma] at a time of the coordinator's clock [ns]."""
        with self._lock:
            fit, enough = self._fit, self._kept.shape[1] >= MIN_EXCHANGES
        return fit is not None and enough and at - fit.at < VALIDITY and fit.estimate(at).sigma <= 1e9 * limit

    def to_coordinator(self, stamp: int) -> int:
        """Convert a robot's time to the coordinator's [ns]. Raises `RobotError` before the first exchange."""
        fit = self._known_fit()
        return fit.at + round((stamp - fit.at - fit.base - fit.offset) / (1 + fit.drift))

    def to_robot(self, instant: int) -> int:
        """Convert a coordinator's time to the robot's [ns]. Raises `RobotError` before the first exchange."""
        fit = self._known_fit()
        return instant + fit.base + round(fit.offset + fit.drift * (instant - fit.at))

    def _known_fit(self) -> _Fit:
        if self._fit is None:
            raise RobotError("the robot's clock is not known yet: wait until its link is up")
        return self._fit


def _fitted(kept: NDArray[np.int64]) -> _Fit:
    """Fit offset and drift to exchanges (3, n): their times and bounds of the offset [ns]."""
    last, base, count = int(kept[0, -1]), int(kept[1, -1]), kept.shape[1]
    age = (last - kept[0]).astype(float)
    least, most = (kept[1:] - base).astype(float)
    drift, drift_sigma = _drift(age, (least + most) / 2, most - least)
    # the bounds of each, as they are at the last one, for two sigmas of the drift
    low, high = (least + (drift - 2 * drift_sigma) * age).tolist(), (most + (drift + 2 * drift_sigma) * age).tolist()
    low.sort(reverse=True)
    high.sort()
    width = high[0] - low[0]
    # how sharp a bound is: the five next to it are about twice as far from it as it is from the truth
    sixth = min(5, count - 1)
    blunt = math.hypot(low[0] - low[sixth], high[sixth] - high[0]) / 4
    sigma = math.hypot(FLOOR, ASYMMETRY * width, blunt)
    if count < MIN_EXCHANGES or width < 0:
        sigma = max(sigma, abs(width) / 2)
    return _Fit(last, base, (low[0] + high[0]) / 2, drift, sigma, drift_sigma)


def _drift(age: Array, middle: Array, trip: Array) -> tuple[float, float]:
    """Slope [s/s] and its sigma of a line through all exchanges, weighted by their possible errors [ns]."""
    shortest = int(trip.argmin())
    sigma = FLOOR + (trip - trip[shortest]) / 2  # what a trip was longer by, it may have been one way
    weight = sigma**-2
    total = float(weight.sum())
    mean = float(weight @ age) / total
    off = age - mean
    weighted = weight * off
    # slope of the offset over -age, about the weighted mean, with a prior of 0
    information = float(weighted @ off) + QUARTZ_DRIFT**-2
    return -float(weighted @ (middle - middle[shortest])) / information, information**-0.5
