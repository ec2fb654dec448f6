"""How far a robot's clock is ahead of the coordinator's: four timestamps, the least round trip, and drift."""

import math
import threading
from collections import deque
from dataclasses import dataclass

import numpy as np

#: So many exchanges are kept; fewer than `LEAST` say nothing.
KEPT, LEAST = 64, 8
#: Drift of a quartz from one that is right (one sigma), before it is measured.
QUARTZ = 40e-6
#: What cannot be seen of an asymmetry: this share of the least round trip, and no less than this [ns].
ASYMMETRY, FLOOR = 0.25, 20_000.0
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
    """At `at` [ns, coordinator] the robot was ahead by `offset`, give or take half of `round_trip`."""

    at: int
    offset: float
    round_trip: float


class ClockFilter:
    """What is known of one robot's clock; for several threads.

    An exchange is: the coordinator asked at t1 and heard at t4, the robot heard at t2 and answered at t3, each by its
    own clock [ns]. The robot is ahead by (t2 - t1 + t3 - t4) / 2 where both ways took as long; for certain by no less
    than t3 - t4 and no more than t2 - t1, which is how a clock that jumps is found out.
    """

    def __init__(self) -> None:
        self._kept: deque[_Exchange] = deque(maxlen=KEPT)
        self._base: int | None = None
        self._fit: tuple[int, float, float, float, float] | None = None
        self._lock = threading.Lock()
        #: How often the clock jumped.
        self.jumps = 0

    def add(self, t1: int, t2: int, t3: int, t4: int) -> None:
        """Take in an exchange. `ValueError` for one that cannot have been."""
        round_trip = (t4 - t1) - (t3 - t2)
        if t4 < t1 or t3 < t2 or round_trip < 0:
            raise ValueError("an exchange whose answers come before its questions")
        with self._lock:
            at = (t1 + t4) // 2
            known = self._estimate(at)
            if known is not None:
                slack = JUMP + 6 * known.sigma
                if not t3 - t4 - slack <= known.offset <= t2 - t1 + slack:
                    self._kept.clear()
                    self._fit = None
                    self.jumps += 1
            self._kept.append(_Exchange(at, ((t2 - t1) + (t3 - t4)) / 2, float(round_trip)))
            self._refit()

    def estimate(self, at: int) -> ClockEstimate | None:
        """How far it is ahead at an instant of the coordinator's clock [ns]; None where that is not known."""
        with self._lock:
            return self._estimate(at)

    def synchronised(self, at: int, limit: float) -> bool:
        """Whether it is known to `limit` [s] now, an instant of the coordinator's clock [ns]."""
        known = self.estimate(at)
        return known is not None and known.sigma <= 1e9 * limit and at - self._kept[-1].at < HOLDS

    def to_coordinator(self, stamp: int) -> int:
        """An instant of the robot's clock by the coordinator's [ns]; as it is where nothing is known."""
        with self._lock:
            if self._fit is None:
                return stamp
            at, offset, drift, _, _ = self._fit
            return at + round((stamp - at - offset) / (1 + drift))

    def to_robot(self, instant: int) -> int:
        """An instant of the coordinator's clock by the robot's [ns]."""
        known = self.estimate(instant)
        return instant if known is None else instant + round(known.offset)

    def _estimate(self, at: int) -> ClockEstimate | None:
        if self._fit is None:
            return None
        since, offset, drift, sigma, drift_sigma = self._fit
        away = at - since
        return ClockEstimate(offset + drift * away, drift, math.hypot(sigma, drift_sigma * away))

    def _refit(self) -> None:
        """The line through the exchanges of short round trips, each weighed by what it may be off."""
        if len(self._kept) < LEAST:
            return
        last = self._kept[-1].at
        away = np.array([one.at - last for one in self._kept], float)
        offset = np.array([one.offset for one in self._kept])
        trip = np.array([one.round_trip for one in self._kept])
        least = trip.min()
        sigma = FLOOR + (trip - least) / 2  # what a longer trip was longer by, it may have been one way
        base = offset[np.argmin(trip)]
        # with the prior that clocks drift little; away is in ns, so that drift has no unit
        A = np.column_stack([np.ones_like(away), away]) / sigma[:, None]
        prior = np.diag([0.0, 1 / QUARTZ**2])
        information = A.T @ A + prior
        covariance = np.linalg.inv(information)
        at_last, drift = covariance @ (A.T @ ((offset - base) / sigma))
        common = max(FLOOR, ASYMMETRY * least)  # shared by all of them: no number of exchanges averages it away
        self._fit = (last, float(base + at_last), float(drift), float(math.hypot(common, math.sqrt(covariance[0, 0]))),
                     float(math.sqrt(covariance[1, 1])))  # fmt: skip
