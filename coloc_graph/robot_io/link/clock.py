"""How far a robot's clock is ahead of the coordinator's: four timestamps, bounds that hold for certain, and drift."""

import math
import threading
from collections import deque
from dataclasses import dataclass

import numpy as np

from coloc_graph.errors import RobotError

#: So many exchanges are kept; fewer than `LEAST` do not synchronise.
KEPT = 64
LEAST = 8
#: Drift of a quartz from one that is right (one sigma), before it is measured.
QUARTZ = 40e-6
#: What cannot be seen of an asymmetry: this share of the least round trip, and no less than this [ns].
ASYMMETRY = 0.1
FLOOR = 20_000.0
#: An exchange that contradicts what is known by more than this [ns] is of a clock that jumped.
JUMP = 1_000_000.0
#: What was found holds for so long without a new exchange [ns].
HOLDS = 5_000_000_000


@dataclass(frozen=True)
class ClockEstimate:
    """A robot's clock at an instant: `offset` [ns] that it is ahead of the coordinator's, `drift` (seconds a second),
    and the standard deviation of the offset [ns]."""

    offset: float
    drift: float
    sigma: float


@dataclass(frozen=True)
class _Exchange:
    """At `at` [ns, coordinator] the robot was ahead by at least `least` and at most `most` [ns]."""

    at: int
    least: int
    most: int


@dataclass(frozen=True)
class _Fit:
    """At `at` [ns, coordinator] the robot was ahead by `base + offset` [ns], with a drift; one sigma of each."""

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
    """What is known of one robot's clock; for several threads.

    An exchange is: the coordinator asked at t1 and heard at t4, the robot heard at t2 and answered at t3, each by its
    own clock [ns]. The robot is ahead by no less than t3 - t4 and no more than t2 - t1, whatever the network does: of
    many exchanges the narrowest of these bounds hold, moved by the drift to the newest, and the offset is halfway
    between them. A clock that leaves the bounds has jumped, and what was known of it is void.
    """

    def __init__(self) -> None:
        self._kept: deque[_Exchange] = deque(maxlen=KEPT)
        self._fit: _Fit | None = None
        self._jumps = 0
        self._lock = threading.Lock()

    def add(self, t1: int, t2: int, t3: int, t4: int) -> None:
        """Take in an exchange. `ValueError` for one that cannot have been."""
        if t4 < t1 or t3 < t2 or (t4 - t1) < (t3 - t2):
            raise ValueError("an exchange whose answer came before its question")
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
        """How often the clock jumped."""
        return self._jumps

    @property
    def known(self) -> bool:
        """Whether anything is known of it, though not how well."""
        return self._fit is not None

    def estimate(self, at: int) -> ClockEstimate | None:
        """How far it is ahead at an instant of the coordinator's clock [ns]; None where nothing is known."""
        fit = self._fit
        return None if fit is None else fit.estimate(at)

    def synchronised(self, at: int, limit: float = 1e-3) -> bool:
        """Whether it is known to `limit` [s] (one sigma) at an instant of the coordinator's clock [ns]."""
        with self._lock:
            fit, enough = self._fit, len(self._kept) >= LEAST
        return fit is not None and enough and at - fit.at < HOLDS and fit.estimate(at).sigma <= 1e9 * limit

    def to_coordinator(self, stamp: int) -> int:
        """An instant of the robot's clock by the coordinator's [ns]; `RobotError` before the first exchange."""
        fit = self._known_fit()
        return fit.at + round((stamp - fit.at - fit.base - fit.offset) / (1 + fit.drift))

    def to_robot(self, instant: int) -> int:
        """An instant of the coordinator's clock by the robot's [ns]; `RobotError` before the first exchange."""
        fit = self._known_fit()
        return instant + fit.base + round(fit.offset + fit.drift * (instant - fit.at))

    def _known_fit(self) -> _Fit:
        if self._fit is None:
            raise RobotError("nothing is known of the robot's clock yet: wait until its link is up")
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
    if len(kept) < LEAST or width < 0:
        sigma = max(sigma, abs(width) / 2)
    return _Fit(last, base, float(least[0] + most[0]) / 2, drift, sigma, drift_sigma)


def _drift(age: np.ndarray, middle: np.ndarray, trip: np.ndarray) -> tuple[float, float]:
    """The slope of a line through all exchanges, each weighed by what it may be off; all in ns, one sigma."""
    sigma = FLOOR + (trip - trip.min()) / 2  # what a trip was longer by, it may have been one way
    A = np.column_stack([np.ones_like(age), -age]) / sigma[:, None]
    near = middle[np.argmin(trip)]
    information = A.T @ A + np.diag([0.0, 1 / QUARTZ**2])
    covariance = np.linalg.inv(information)
    return float((covariance @ (A.T @ ((middle - near) / sigma)))[1]), float(math.sqrt(covariance[1, 1]))
