"""Clocks of robots in a ROS bag: header stamps against the times at which the bag received the messages.

All topics of a robot share its computer's clock, and all messages of a bag share the recorder's. The difference of the
two, less the transport latency, is the offset of the robot's clock: constant, stepping or drifting. Differences between
robots beyond what latency can explain are removed; what is left enters the team's `clock_sigma`.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coloc_graph.run.messages import RobotClock as RobotRecord
from coloc_graph.run.schemas import to_seconds

Array = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]

STEP = 0.1  # s, smallest step of a clock that is corrected; latency varies by less
STEP_SIGMAS = 8.0  # ratio of a step to the jitter of the stamps that it must exceed too
FAR = 0.1  # s, smallest offset between topics of one kind that is corrected; their latencies differ by less
APART = 1.0  # s, smallest offset between topics of different kinds that is corrected
SIGMAS = {"odometry": 5e-3, "image": 30e-3}  # s, uncertainty of a corrected offset due to latency, by kind of topic
WINDOW = 7  # messages on either side of a candidate step
MIN_MESSAGES = 5  # messages of a topic that are needed to judge its clock
DRIFT_SIGMAS = 5.0  # standard deviations that a drift must exceed
DRIFT_EFFECT = 5e-3  # s, change of the offset over the recording that it must exceed too
BIN = 1.0  # s, bins from each of which the message of least latency is taken for the drift
PACE = 1.5  # ratio of the paces of reception and stamps above which the bag was converted, not recorded live
QUIET = 0.9  # quantile of stamp minus reception, for messages of low latency


@dataclass(frozen=True, eq=False)
class StampedTopic:
    """Messages of one topic in the order of reception: `stamps` and `received` (n,) [ns]."""

    robot: str
    kind: str
    stamps: Nanoseconds
    received: Nanoseconds

    @property
    def offsets(self) -> Array:
        """Stamp minus reception (n,) [s]."""
        return (self.stamps - self.received) / 1e9

    @property
    def is_live(self) -> bool:
        """True if the messages were received at the pace of their stamps, and not when a bag was converted."""
        if len(self.stamps) < MIN_MESSAGES:
            return False
        stamped, came = (float(np.median(np.diff(one))) for one in (self.stamps, self.received))
        return stamped > 0 and 1 / PACE < came / stamped < PACE


@dataclass(frozen=True, eq=False)
class RobotClock:
    """Clock of one robot against the other robots' clocks.

    Attributes
    ----------
    offsets
        Offsets of the m segments between the steps, (m,) [s]; 0 if nothing is corrected.
    steps
        Reception times of steps, (m - 1,) [ns].
    drift, origin
        Drift within each segment [s/s], about a reception time [ns].
    jitter
        Scatter of the stamps [s].
    """

    robot: str
    topics: tuple[str, ...]
    offsets: Array
    steps: Nanoseconds
    drift: float
    origin: int
    jitter: float

    @property
    def is_right(self) -> bool:
        """True if no stamp of this robot is corrected."""
        return not self.offsets.any() and self.drift == 0

    def error(self, received: int) -> int:
        """Error of the clock [ns] for a message received at a time [ns]."""
        if self.is_right:
            return 0
        segment = int(np.searchsorted(self.steps, received, side="right"))
        return round(1e9 * float(self.offsets[segment]) + self.drift * (received - self.origin))

    def record(self) -> RobotRecord:
        """The same as a run records it."""
        steps = zip(self.steps.tolist(), np.diff(self.offsets).tolist(), strict=True)
        return RobotRecord(
            robot=self.robot,
            offset=float(self.offsets[0]),
            drift=self.drift,
            steps=tuple((to_seconds(at), jump) for at, jump in steps if jump),
            jitter=self.jitter,
            known=f"stamps against reception of {', '.join(self.topics)}",
        )

    def sentences(self) -> Iterator[str]:
        """Descriptions of what is corrected."""
        named = f"{self.robot}'s clock ({', '.join(self.topics)})"
        begin = float(self.offsets[0])
        if len(self.steps):
            for at, jump in zip(self.steps.tolist(), np.diff(self.offsets).tolist(), strict=True):
                way = "back" if jump < 0 else "ahead"
                yield f"{named} was set {way} by {abs(jump):.3f} s at {to_seconds(at):.3f} s"
        if begin or (len(self.steps) and self.offsets.any()):
            ahead = "ahead of" if begin > 0 else "behind"
            if begin:
                yield f"{named} is {abs(begin):.3f} s {ahead} the other robots' clocks"
        if self.drift:
            yield f"{named} drifts by {1e6 * self.drift:+.0f} ppm"


@dataclass(frozen=True, eq=False)
class BagClocks:
    """Clock of each topic, and the standard deviation `sigma` [s] of the observers' clocks after correction."""

    clocks: Mapping[str, RobotClock]
    sigma: float

    def records(self) -> tuple[RobotRecord, ...]:
        """Records of the clocks, one a robot: that of most of its topics."""
        clocks: dict[str, RobotClock] = {}
        for clock in self.clocks.values():
            before = clocks.get(clock.robot)
            if before is None or len(clock.topics) > len(before.topics):
                clocks[clock.robot] = clock
        return tuple(one.record() for _, one in sorted(clocks.items()))

    def sentences(self) -> list[str]:
        """Descriptions of what is corrected, and how."""
        said = [sentence for clock in dict.fromkeys(self.clocks.values()) for sentence in clock.sentences()]
        if said:
            said[-1] += "; the stamps were corrected by when the bag received the messages"
        return said


def bag_clocks(topics: Mapping[str, StampedTopic]) -> BagClocks:
    """Estimate the clock of every robot from its topics' stamps and reception times.

    Latency differs between kinds of topics (images take longer than odometry), so that robots are compared by topics
    of one kind. A topic whose stamps are off those of its robot's others by more than `APART` has a clock of its own.

    Parameters
    ----------
    topics
        Stamped topics by name. Ignored are those of few messages, and of bags whose reception times are not live.

    Returns
    -------
    BagClocks
        Corrections by topic, relative to the majority of the robots.
    """
    known = {name: topic for name, topic in topics.items() if topic.is_live}
    owned: dict[str, list[str]] = {}
    for name, topic in known.items():
        owned.setdefault(topic.robot, []).append(name)
    steps = {robot: _steps([known[name] for name in names]) for robot, names in owned.items()}
    offsets = {name: _segment_offsets(topic, steps[topic.robot]) for name, topic in known.items()}
    off = _relative(known, offsets)
    slopes = {robot: _drift([known[name] for name in names], steps[robot]) for robot, names in owned.items()}
    usual = float(np.median([slope for slope, _ in slopes.values()])) if slopes else 0.0
    clocks: dict[str, RobotClock] = {}
    for robot, names in owned.items():
        best = min(names, key=lambda name: (off[name][1], _jitter(known[name])))
        alike = tuple(name for name in names if np.abs(off[name][0] - off[best][0]).max() <= APART)
        begin = min(int(known[name].received[0]) for name in names)
        end = max(int(known[name].received[-1]) for name in names)
        slope, sigma = slopes[robot]
        drift = slope - usual
        if abs(drift) < DRIFT_SIGMAS * sigma or abs(drift) * (end - begin) / 1e9 < DRIFT_EFFECT:
            drift = 0.0
        for group in (alike, *((name,) for name in names if name not in alike)):
            value, least = off[best if best in group else group[0]]
            jitter = min(_jitter(known[name]) for name in group)
            value = np.where(np.abs(value) > max(least, 4 * jitter), value, 0.0)
            clock = RobotClock(robot, group, value, steps[robot], drift, (begin + end) // 2, jitter)
            clocks |= dict.fromkeys(group, clock)
    return BagClocks(clocks, _disagreement(known, clocks))


def _relative(topics: Mapping[str, StampedTopic], offsets: Mapping[str, Array]) -> dict[str, tuple[Array, float]]:
    """Offsets (m,) [s] of each topic against other robots' topics of its kind, and bounds of what latency explains."""
    found = {}
    for name, topic in topics.items():
        kin = [other for other, one in topics.items() if one.kind == topic.kind]
        if len({topics[other].robot for other in kin}) > 1:
            found[name] = offsets[name] - _majority([float(v) for other in kin for v in offsets[other]]), FAR
        else:  # no other robot has such a topic: only what no latency explains counts
            found[name] = offsets[name] - _majority([float(v) for every in offsets.values() for v in every]), APART
    return found


def _steps(topics: Sequence[StampedTopic]) -> Nanoseconds:
    """Reception times [ns] of a clock's steps on which its topics agree."""
    found: list[int] = []
    for topic in topics:
        d = topic.offsets
        if len(d) < 2 * WINDOW:
            continue
        windows = np.lib.stride_tricks.sliding_window_view(d, WINDOW)
        medians = np.median(windows, axis=1)
        jump = medians[WINDOW:] - medians[:-WINDOW]  # between the windows before and after sample k + WINDOW
        noise = 1.4826 * float(np.median(np.abs(np.diff(d))))
        over = np.abs(jump) > max(STEP, STEP_SIGMAS * noise)
        k = 0
        while k < len(over):
            if not over[k]:
                k += 1
                continue
            end = k
            while end < len(over) and over[end]:
                end += 1
            span = np.arange(k, end) + WINDOW
            at = int(span[np.argmax(np.abs(d[span] - d[span - 1]))])
            found.append(int(topic.received[at]))
            k = end
    found.sort()
    apart: list[int] = []
    for at in found:  # topics of one robot see the same step within a second
        if not apart or at - apart[-1] > 1_000_000_000:
            apart.append(at)
    return np.array(apart, np.int64)


def _segment_offsets(topic: StampedTopic, steps: Nanoseconds) -> Array:
    """Offset (m,) [s] of a clock in each segment: stamp minus reception of messages with low latency."""
    segment, d = np.searchsorted(steps, topic.received, side="right"), topic.offsets
    found = np.full(len(steps) + 1, np.nan)
    for k in np.unique(segment):
        found[k] = np.quantile(d[segment == k], QUIET)
    return np.where(np.isfinite(found), found, np.nanmedian(found))


def _jitter(topic: StampedTopic) -> float:
    """Scatter [s] of stamp minus reception from message to message."""
    return float(1.4826 * np.median(np.abs(np.diff(topic.offsets))) / np.sqrt(2))


def _majority(offsets: Sequence[float]) -> float:
    """Offset [s] that most segments share; of two equally frequent ones that nearest to the recorder's clock."""
    near = [sum(abs(other - one) < FAR for other in offsets) for one in offsets]
    among = [one for one, count in zip(offsets, near, strict=True) if count == max(near)]
    centre = min(among, key=abs)
    return float(np.median([one for one in offsets if abs(one - centre) < FAR]))


def _drift(topics: Sequence[StampedTopic], steps: Nanoseconds) -> tuple[float, float]:
    """Drift of a clock against the recorder's [s/s] with its sigma, from messages of least latency in each second."""
    times, values, sets = [], [], []
    for number, topic in enumerate(topics):
        t, d = topic.received / 1e9, topic.offsets
        segment = np.searchsorted(steps, topic.received, side="right")
        bins = np.floor((t - t[0]) / BIN).astype(int)
        for key in np.unique(bins):
            own = np.flatnonzero(bins == key)
            best = own[np.argmax(d[own])]
            times.append(t[best])
            values.append(d[best])
            sets.append((number, int(segment[best])))
    if len(times) < 10:
        return 0.0, np.inf
    x, y = np.array(times), np.array(values)
    groups = np.unique(np.array(sets), axis=0, return_inverse=True)[1].ravel()
    for group in np.unique(groups):
        x[groups == group] -= x[groups == group].mean()
        y[groups == group] -= np.median(y[groups == group])
    if not (x**2).sum() > 0:
        return 0.0, np.inf
    slope = float((x @ y) / (x @ x))
    rest = y - slope * x
    sigma = max(1.4826 * float(np.median(np.abs(rest))), 1e-6) / np.sqrt(float(x @ x))
    return slope, float(sigma)


def _disagreement(topics: Mapping[str, StampedTopic], clocks: Mapping[str, RobotClock]) -> float:
    """Standard deviation [s] of the observers' corrected offsets due to latency; 0 if none is corrected."""
    if all(clock.is_right for clock in clocks.values()):
        return 0.0
    watching = {one.robot for one in topics.values() if one.kind == "image"}
    kinds = [{one.kind for one in topics.values() if one.robot == robot} for robot in sorted(watching)]
    shared = set.intersection(*kinds) if kinds else set()
    return min((SIGMAS[kind] for kind in shared), default=max(SIGMAS.values()))
