"""Ranges of a run with stances: means of samples, each at a place that wheel odometry gives in a pose of a stance."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coloc_graph.frontend.odometry import WheelTrack
from coloc_graph.frontend.ranged_landmarks import Located, locate
from coloc_graph.geometry.lie import floor_pose, se3_inverse
from coloc_graph.geometry.se2 import wrap
from coloc_graph.measurements import Range
from coloc_graph.run import Ranges
from coloc_graph.team import Ranging, Team

Array = NDArray[np.float64]
Index = NDArray[np.int64]

WINDOW = 2.0  # s of samples that are averaged while a robot drives; at 0.2 m/s the geometry hardly changes in them
OUTLIER_SIGMAS = 3.0  # standard deviations from the median of its window above which a sample is left out
MIN_SAMPLES = 4  # samples of a window, of fewer an outlier cannot be told
NO_ODOMETRY = "{} drives and has no odometry then"
MIN_NOISE_SAMPLES = 50  # samples from which on their own scatter says how noisy they are


@dataclass(frozen=True, eq=False)
class Standing:
    """Interval [UTC s] in which a robot has its pose of a stance; an instant, of a robot that was sighted as it drove.

    Parameters
    ----------
    stance : int
        Index of the stance.
    start, end : float
        The interval.
    T_world_body : (4, 4) float
        An estimate of the pose, at which samples are averaged.
    """

    stance: int
    start: float
    end: float
    T_world_body: Array


@dataclass(frozen=True, eq=False)
class StanceRanges:
    """Ranges for the graph, and the numbers of samples and of bearings that are in none of them.

    `unused` are ranges by reason.
    """

    ranges: tuple[Range, ...]
    unused: Mapping[str, int]
    unused_bearings: int = 0

    @property
    def samples(self) -> int:
        """Number of samples that are used."""
        return sum(one.samples for one in self.ranges)


@dataclass(frozen=True, eq=False)
class _Places:
    """Places of a robot's body at n instants: row of the standing interval, pose (n, 3) in its body there.

    `known` and `stands` (n,) say whether it has a place then, and whether that is the standing one.
    """

    row: Index
    moved: Array
    known: NDArray[np.bool_]
    stands: NDArray[np.bool_]

    def of(self, index: Index) -> "_Places":
        return _Places(self.row[index], self.moved[index], self.known[index], self.stands[index])


def ranges_of_stances(
    team: Team,
    standing: Mapping[str, Sequence[Standing]],
    wheels: Mapping[str, WheelTrack],
    recorded: Mapping[str, Sequence[Ranges]],
) -> StanceRanges:
    """Average the ranges of pairs of robots.

    Parameters
    ----------
    team
        The team; robots that measure have a `Ranging`.
    standing
        By robot, the intervals in which it has a pose, in the order of time; by landmark, one without end.
    wheels
        By robot, its wheel odometry from one to the next; robots without any are used while they stand.
    recorded
        By robot, what it measured.

    Returns
    -------
    StanceRanges
        One `Range` for each pair of robots and poses. The error of the odometry that several of them share counts as
        many times in each, so that together they do not know it better than it is.

    Notes
    -----
    Samples of a window are averaged as differences from the range that `T_world_body` predict, without those far from
    their median: something in the line of sight makes a range too long. Means of n independent samples have 1/n of
    their variance; `range_memory` leaves less. The sensors' offsets need not be known.
    """
    unused: Counter[str] = Counter()
    made: list[_Link] = []
    for robot, records in recorded.items():
        by_target: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
        for one in records:
            bearings = [np.nan] * len(one.targets) if one.bearing is None else one.bearing.tolist()
            for target, distance, bearing in zip(one.targets, one.range.tolist(), bearings, strict=True):
                by_target[target].append((one.time, distance, bearing))
        for target, samples in by_target.items():
            made += _links_of_pair(team, (robot, target), standing, wheels, np.array(samples), unused)
    noise = _noise_factors(made)
    shares = Counter(node for one in made for node in one.driven)
    return StanceRanges(tuple(one.measured(noise[one.robot], shares, wheels) for one in made), unused)


@dataclass(frozen=True, eq=False)
class _Link:
    """Averaged ranges of a pair of robots at a pair of poses: of n windows.

    `residuals` are the samples' differences from their window's mean in stated sigmas; `directions` (n, 2, 2) are those
    of the range in the bodies of both robots, and `points` (n, 2, 2) the antennas on these. `bearing` is a mean [rad],
    its standard deviation, and the number of samples.
    """

    robot: str
    target: str
    standing: tuple[Standing, Standing]
    times: Array
    range: Array
    sigmas: Array
    moved: tuple[Array, Array]
    stands: tuple[NDArray[np.bool_], NDArray[np.bool_]]
    directions: Array
    points: Array
    residuals: Array
    bearing: tuple[float, float, int] | None

    @property
    def driven(self) -> tuple[tuple[str, int], ...]:
        """Robots, with their stances, whose odometry it uses."""
        ends = zip((self.robot, self.target), self.standing, self.stands, strict=True)
        return tuple((name, standing.stance) for name, standing, stands in ends if not stands.all())

    def measured(self, noise: float, shares: Mapping[tuple[str, int], int], wheels: Mapping[str, WheelTrack]) -> Range:
        """Return the measurement, with its samples `noise` times as noisy as stated."""
        C = np.diag((noise * self.sigmas) ** 2)
        for end, name in enumerate((self.robot, self.target)):
            standing, driven = self.standing[end], np.flatnonzero(~self.stands[end])
            if len(driven):
                times = self.times[driven]
                begin = np.clip(times, standing.start, standing.end)
                root = wheels[name].place_errors(begin, times, self.points[driven, end])
                along = (self.directions[driven, end, :, None] * root).sum(axis=1)
                # odometry between the stances is in the graph, too
                C[np.ix_(driven, driven)] += (1 + shares[name, standing.stance]) * along @ along.T
        i, j = self.standing
        place = None if j.stance >= 0 else (se3_inverse(i.T_world_body) @ j.T_world_body)[:2, 3]
        return Range(
            self.robot, self.target, i.stance, j.stance, float(self.times.mean()), self.range, *self.moved, C,
            len(self.residuals), place, *(self.bearing or ()),
        )  # fmt: skip


def _links_of_pair(
    team: Team,
    pair: tuple[str, str],
    standing: Mapping[str, Sequence[Standing]],
    wheels: Mapping[str, WheelTrack],
    samples: Array,
    unused: Counter[str],
) -> list[_Link]:
    times, ranges, bearings = samples.T
    ends = []
    known = np.ones(len(times), bool)
    for name in pair:
        if not standing.get(name):
            unused[f"{name} has no pose"] += len(times)
            return []
        places = _places(standing[name], wheels.get(name), times)
        missing = known & ~places.known
        if missing.any():
            unused[NO_ODOMETRY.format(name)] += int(missing.sum())
        known &= places.known
        ends.append(places)
    kept = np.flatnonzero(known)
    if not len(kept):
        return []
    at = [one.of(kept) for one in ends]
    return list(_windows(team, pair, standing, at, times[kept], ranges[kept], bearings[kept], unused))


def _places(standing: Sequence[Standing], track: WheelTrack | None, times: Array) -> _Places:
    """Place a robot at instants by the nearest interval in which it stands, and its odometry from there."""
    starts, ends = np.array([(one.start, one.end) for one in standing]).T
    far = np.maximum(np.maximum(starts - times[:, None], times[:, None] - ends), 0.0)
    row = np.argmin(far, axis=1)
    stands = far[np.arange(len(times)), row] == 0
    moved = np.zeros((len(times), 3))
    if track is None or not len(track):
        return _Places(row, moved, stands, stands)
    begin = np.clip(times, starts[row], ends[row])
    moved[~stands] = track.moved(begin[~stands], times[~stands])
    return _Places(row, moved, stands | track.covers(times), stands)


def _windows(
    team: Team,
    pair: tuple[str, str],
    standing: Mapping[str, Sequence[Standing]],
    ends: Sequence[_Places],
    times: Array,
    ranges: Array,
    bearings: Array,
    unused: Counter[str],
) -> Iterable[_Link]:
    sensor = team[pair[0]].ranging
    other = team[pair[1]].ranging if pair[1] in team.names else None
    assert sensor is not None
    antennas = [(sensor.x, sensor.y), (other.x, other.y) if sensor.two_way and other is not None else (0.0, 0.0)]
    at, turned = [], []
    for name, places, antenna in zip(pair, ends, antennas, strict=True):
        T_world_stance = np.array([one.T_world_body for one in standing[name]])[places.row]
        T_world_body = T_world_stance @ floor_pose(*places.moved.T)
        at.append((T_world_body @ np.array([*antenna, 0.0, 1.0]))[:, :2])
        turned.append(T_world_stance[:, :2, :2].mT)
    apart = at[1] - at[0]
    predicted = np.maximum(np.hypot(*apart.T), 1e-6)
    along = (apart / predicted[:, None])[:, :, None]
    directions = np.stack([(one @ along)[..., 0] for one in turned], axis=1)
    stated = sensor.scale * predicted
    off, sigmas = ranges - stated, sensor.range_sigma + sensor.range_sigma_per_m2 * ranges**2
    resting = ends[0].stands & ends[1].stands
    window = np.where(resting, -1, np.floor((times - times[0]) / WINDOW))
    keys = np.stack([ends[0].row, ends[1].row, window], axis=1)
    order = np.lexsort((times, *keys.T[::-1]))
    first = np.flatnonzero(np.r_[True, np.any(np.diff(keys[order], axis=0), axis=1)])
    rows: dict[tuple[int, int], list[tuple[int, float, float, Array]]] = defaultdict(list)
    seen: dict[tuple[int, int], tuple[float, float, int] | None] = {}
    for index in np.split(order, first[1:]):
        median = float(np.median(off[index]))
        kept = index[np.abs(off[index] - median) < OUTLIER_SIGMAS * sigmas[index]]
        if len(index) < MIN_SAMPLES:
            unused["they are too few at a time to tell which have no line of sight"] += len(index)
            continue
        if len(kept) * 2 < len(index):
            unused["they scatter more than the stated noise explains"] += len(index)
            continue
        if len(kept) < len(index):
            unused["they are outliers among those next to them"] += len(index) - len(kept)
        mean = float(off[kept].mean())
        sigma = float(np.sqrt((sigmas[kept] ** 2).mean() / _independent(times[kept], sensor.range_memory)))
        middle = int(kept[np.argmin(np.abs(times[kept] - times[kept].mean()))])
        scatter = (off[kept] - mean) / sigmas[kept] * np.sqrt(len(kept) / max(len(kept) - 1, 1))
        where = int(ends[0].row[middle]), int(ends[1].row[middle])
        rows[where].append((middle, mean, sigma, scatter))
        if resting[middle]:
            seen[where] = _bearing(sensor, times[kept], ranges[kept], bearings[kept])
    for (row_i, row_j), each in rows.items():
        middles = np.array([one[0] for one in each])
        points = np.broadcast_to(np.array(antennas), (len(each), 2, 2))
        yield _Link(
            robot=pair[0],
            target=pair[1],
            standing=(standing[pair[0]][row_i], standing[pair[1]][row_j]),
            times=times[middles],
            range=stated[middles] + np.array([one[1] for one in each]),
            sigmas=np.array([one[2] for one in each]),
            moved=(ends[0].moved[middles], ends[1].moved[middles]),
            stands=(ends[0].stands[middles], ends[1].stands[middles]),
            directions=directions[middles],
            points=points,
            residuals=np.concatenate([one[3] for one in each]),
            bearing=seen.get((row_i, row_j)),
        )


def _bearing(sensor: Ranging, times: Array, ranges: Array, bearings: Array) -> tuple[float, float, int] | None:
    """Mean bearing while both ends stand, its standard deviation [rad], and the number of samples; None of none."""
    there = np.isfinite(bearings)
    sigmas = np.hypot(np.deg2rad(sensor.bearing_sigma_deg), sensor.across_sigma / ranges)
    if not there.any() or not sigmas.min() > 0:
        return None
    first = bearings[there][0]
    off = wrap(bearings - first)
    kept = there & (np.abs(off - np.median(off[there])) < OUTLIER_SIGMAS * sigmas)
    if kept.sum() * 2 < there.sum():
        return None
    variance = (sigmas[kept] ** 2).mean() / _independent(times[kept], sensor.bearing_memory)
    return float(wrap(first + off[kept].mean())), float(np.sqrt(variance)), int(kept.sum())


def _independent(times: Array, memory: float) -> float:
    """Number of independent samples that determine their mean as well; see `keyframes._shares`."""
    if len(times) < 2 or memory <= 0:
        return float(len(times))
    return float(1 + np.tanh(np.diff(times) / (2 * memory)).sum())


def _noise_factors(links: Iterable[_Link]) -> dict[str, float]:
    """Factor on the stated noise of each robot's ranges, by how samples of one window differ."""
    found: dict[str, list[Array]] = defaultdict(list)
    for one in links:
        found[one.robot].append(one.residuals)
    factors = {}
    for robot, parts in found.items():
        scatter = np.concatenate(parts)
        # not by the median: it would not see ranges without line of sight that are too short to be told
        factors[robot] = float(np.sqrt((scatter**2).mean())) if len(scatter) >= MIN_NOISE_SAMPLES else 1.0
    return factors


def merged(parts: Sequence[StanceRanges]) -> StanceRanges:
    """Return the ranges of several intervals together."""
    unused: Counter[str] = Counter()
    ranges: list[Range] = []
    for one in parts:
        ranges += one.ranges
        unused.update(one.unused)
    return StanceRanges(tuple(ranges), unused, sum(one.unused_bearings for one in parts))


def locate_landmarks(
    team: Team,
    standing: Mapping[str, Sequence[Standing]],
    wheels: Mapping[str, WheelTrack],
    recorded: Mapping[str, Sequence[Ranges]],
) -> dict[str, Located]:
    """Locate the landmarks that were ranged, from the places of robots; arguments as of `ranges_of_stances`."""
    found: dict[str, list[Array]] = defaultdict(list)
    for number, (robot, records) in enumerate(recorded.items()):
        sensor = team[robot].ranging
        times = np.array([one.time for one in records])
        if sensor is None or not len(times) or not standing.get(robot):
            continue
        places = _places(standing[robot], wheels.get(robot), times)
        T = np.array([one.T_world_body for one in standing[robot]])[places.row] @ floor_pose(*places.moved.T)
        antennas = (T @ np.array([sensor.x, sensor.y, 0.0, 1.0]))[:, :2]
        landmarks = {one.name for one in team.landmarks}
        for n, one in enumerate(records):
            for target, distance in zip(one.targets, one.range.tolist(), strict=True):
                if places.known[n] and target in landmarks:
                    reading = (distance - sensor.offset) / sensor.scale
                    row = (*antennas[n], reading, number, sensor.range_sigma, sensor.offset_sigma)
                    found[target].append(np.array(row))
    located = {}
    for name, rows in found.items():
        x, y, distance, who, sigma, offset_sigma = np.array(rows).T
        places_of = np.stack([x, y], axis=1)
        located[name] = locate(places_of, distance, who.astype(int).tolist(), sigma.max(), offset_sigma.max())
    return located
