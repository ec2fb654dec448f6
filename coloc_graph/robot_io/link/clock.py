"""Offset of a robot's clock from the coordinator's: four timestamps, guaranteed bounds, drift; `ClockFilter`."""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from coloc_graph.errors import RobotError
from coloc_graph.machine import machine

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
class _Exchange:
    """Bounds `least` and `most` of the offset [ns] at the time `at` [ns, coordinator]."""

    at: int
    least: int
    most: int


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
        self._kept: deque[_Exchange] = deque(maxlen=MAX_EXCHANGES)
        self._fit: _Fit | None = None
        self._jumps = 0
        self._lock = machine.new_lock()

    def add(self, t1: int, t2: int, t3: int, t4: int) -> None:
        """Add an exchange [ns]. Raises `ValueError` if it is impossible."""
        if t4 < t1 or t3 < t2 or (t4 - t1) < (t3 - t2):
            raise ValueError("an answer was received before its question was sent")
        one = _Exchange((t1 + t4) // 2, least=t3 - t4, most=t2 - t1)
        with self._lock:
            if self._kept and one.at < self._kept[-1].at:
                return  # overtaken by a later one
            if self._fit is not None:
                known = self._fit.estimate(one.at)
                slack = JUMP + 6 * known.sigma
                if not one.least - slack <= known.offset <= one.most + slack:
                    self._kept.clear()
                    self._jumps += 1
            self._kept.append(one)
            self._fit = _fitted(list(self._kept))

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
            fit, enough = self._fit, len(self._kept) >= MIN_EXCHANGES
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


def _fitted(kept: list[_Exchange]) -> _Fit:
    last, base = kept[-1].at, kept[-1].least
    age = np.array([last - one.at for one in kept], float)
    least = np.array([one.least - base for one in kept], float)
    most = np.array([one.most - base for one in kept], float)
    drift, drift_sigma = _drift(age, (least + most) / 2, most - least)
    # the bounds of each, as they are at the last one, for two sigmas of the drift
    least = np.sort(least + (drift - 2 * drift_sigma) * age)[::-1]
    most = np.sort(most + (drift + 2 * drift_sigma) * age)
    width = float(most[0] - least[0])
    # how sharp a bound is: the five next to it are about twice as far from it as it is from the truth
    sixth = min(5, len(kept) - 1)
    blunt = math.hypot(least[0] - least[sixth], most[sixth] - most[0]) / 4
    sigma = math.hypot(FLOOR, ASYMMETRY * width, blunt)
    if len(kept) < MIN_EXCHANGES or width < 0:
        sigma = max(sigma, abs(width) / 2)
    return _Fit(last, base, float(least[0] + most[0]) / 2, drift, sigma, drift_sigma)


def _drift(age: np.ndarray, middle: np.ndarray, trip: np.ndarray) -> tuple[float, float]:
    """Slope [s/s] and its sigma of a line through all exchanges, weighted by their possible errors [ns]."""
    sigma = FLOOR + (trip - trip.min()) / 2  # what a trip was longer by, it may have been one way
    A = np.column_stack([np.ones_like(age), -age]) / sigma[:, None]
    near = middle[np.argmin(trip)]
    information = A.T @ A + np.diag([0.0, 1 / QUARTZ_DRIFT**2])
    covariance = np.linalg.inv(information)
    return float((covariance @ (A.T @ ((middle - near) / sigma)))[1]), float(math.sqrt(covariance[1, 1]))
