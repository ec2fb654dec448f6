"""Reading of runs: `open_run`; `read_truth` and `read_true_team`, which are for evaluation alone."""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from coloc_graph.errors import RunError
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.run import decode, schemas
from coloc_graph.run.encode import check_robots, check_targets
from coloc_graph.run.index import Index, build_index
from coloc_graph.run.messages import Detections, Image, Motion, OdometrySample, Planes, Ranges, RobotClock, Stance
from coloc_graph.run.topics import Item, decoded, read_near, read_topic, time_span
from coloc_graph.team import Team

SAME_TIME = 1_000  # ns: difference of equal times by rounding
MAX_IDENTIFYING = 1 << 20  # bytes that a run's id is computed from, at most


@dataclass(frozen=True, eq=False, repr=False)
class Run:
    """Recording of a team, read on demand; it holds no open file and gives no access to truth.

    Parameters
    ----------
    path : Path
        The file.
    team : Team
        The team as stated.
    warnings : tuple of str
        Sentences on what could not be read.
    stances : tuple of Stance
        In the order of their indices.
    planes : dict of int to Planes
        Stated planes by stance.
    topics : dict of str to int
        Number of messages by topic.
    start, end : float or None
        Time of the first and the last message [UTC s]; None where there is none but the team.

    Notes
    -----
    The methods that iterate yield the messages of one robot in the order of time, from `start` to `end`, both included
    [UTC s]; only a few chunks are in memory at any time. They raise `RunError` where the file is damaged. Of images and
    detections of one robot with the same stamp the first is yielded, and the others are counted in `repeated`.
    """

    path: Path
    team: Team
    warnings: tuple[str, ...]
    stances: tuple[Stance, ...]
    planes: dict[int, Planes]
    topics: dict[str, int]
    start: float | None
    end: float | None
    _index: Index = field(repr=False)
    _repeated: dict[str, set[tuple[int, int]]] = field(default_factory=dict, repr=False, compare=False)

    def __repr__(self) -> str:
        seconds = 0.0 if self.start is None or self.end is None else self.end - self.start
        robots, stances = ", ".join(self.team.names), len(self.stances)
        return f"Run({str(self.path)!r}, robots {robots}, {stances} stance{'s' * (stances != 1)} in {seconds:.1f} s)"

    def images(self, robot: str, start: float | None = None, end: float | None = None) -> Iterator[Image]:
        """Yield the images of a robot's camera."""
        items = self._once(*self._items(robot, "image", start, end))
        return decoded(self._index, items, lambda item: decode.decode_image(robot, item.ns, item.schema, item.data))

    def detections(self, robot: str, start: float | None = None, end: float | None = None) -> Iterator[Detections]:
        """Yield the detections in the images of a robot's camera, one record per image."""
        items = self._once(*self._items(robot, "detections", start, end))
        return decoded(self._index, items, lambda item: decode.decode_detections(robot, item.ns, item.data))

    def odometry(self, robot: str, start: float | None = None, end: float | None = None) -> Iterator[OdometrySample]:
        """Yield a robot's odometry."""
        items = self._items(robot, "odometry", start, end)
        return decoded(self._index, items, lambda item: decode.decode_odometry(robot, item.ns, item.data))

    def motions(self, robot: str, start: float | None = None, end: float | None = None) -> Iterator[Motion]:
        """Yield the begins and ends of a robot's movements."""
        items = self._items(robot, "motion", start, end)
        return decoded(self._index, items, lambda item: decode.decode_motion(robot, item.ns, item.data))

    def ranges(self, robot: str, start: float | None = None, end: float | None = None) -> Iterator[Ranges]:
        """Yield the measurements of a robot's range and bearing sensor, one record per time."""
        items = self._items(robot, "ranges", start, end)
        known = {*self.team.names, *(landmark.name for landmark in self.team.landmarks)} - {robot}
        for one in decoded(self._index, items, lambda item: decode.decode_ranges(robot, item.ns, item.data)):
            if not known.issuperset(one.targets):
                check_targets(self.team, one, f"{self.path}: the ranges of {robot} at {one.time} s")
            yield one

    def clocks(self) -> tuple[RobotClock, ...]:
        """Errors of the robots' clocks by which the stamps were corrected when the run was made."""
        items = schemas.CLOCKS_TOPIC, read_topic(self._index, schemas.CLOCKS_TOPIC)
        found = decoded(self._index, items, lambda item: decode.decode_clocks(item.ns, item.data))
        clocks = tuple(clock for one in found for clock in one.clocks)
        check_robots(self.team, tuple(clock.robot for clock in clocks), f"{self.path}: the record of clocks")
        return clocks

    @property
    def repeated(self) -> dict[str, int]:
        """Number of messages by topic that were left out as they were read: they repeat the stamp of one before."""
        return {topic: len(which) for topic, which in self._repeated.items()}

    @property
    def has_ranges(self) -> bool:
        """True if any robot has range and bearing measurements."""
        return any(self._count(robot, "ranges") for robot in self.team.names)

    def has_images(self, robot: str) -> bool:
        """Return whether there is an image of this robot's camera."""
        return self._count(robot, "image") > 0

    def has_detections(self, robot: str) -> bool:
        """Return whether there are detections of this robot's camera."""
        return self._count(robot, "detections") > 0

    def _count(self, robot: str, kind: str) -> int:
        check_robots(self.team, (robot,), f"{self.path}: the query")
        return self.topics.get(schemas.topic_of(robot, kind), 0)

    def _items(self, robot: str, kind: str, start: float | None, end: float | None) -> tuple[str, Iterator[Item]]:
        self._count(robot, kind)
        topic = schemas.topic_of(robot, kind)
        first = 0 if start is None else _clamped_ns(start)
        last = None if end is None else _clamped_ns(end)
        return topic, read_topic(self._index, topic, first, last)

    def _once(self, topic: str, items: Iterator[Item]) -> tuple[str, Iterator[Item]]:
        """Leave out messages with the stamp of the one before."""

        def once() -> Iterator[Item]:
            before, repeats = -1, 0
            for item in items:
                repeats = repeats + 1 if item.ns == before else 0
                if repeats:
                    self._repeated.setdefault(topic, set()).add((item.ns, repeats))
                else:
                    yield item
                before = item.ns

        return topic, once()


def open_run(path: str | Path) -> Run:
    """Open a run: its team, stances and index are read now, everything else on demand.

    Parameters
    ----------
    path : str or Path
        An MCAP file. A file that was cut off opens up to its last whole chunk, with a warning.

    Returns
    -------
    Run
        The recording.

    Raises
    ------
    RunError
        The file is damaged, is no run, or contradicts itself.
    """
    index = build_index(Path(path))
    _check_format(index)
    topics = _counts(index)
    team = _read_team(index, schemas.TEAM_TOPIC)
    if team is None:
        what = "is an MCAP file without a /team, so not a run; import it, or record it with RunWriter"
        if index.lost is not None:
            what = "was cut off before its /team, so nothing usable was recorded; record it again"
        raise RunError(f"{index.path}: {what}")
    if topics[schemas.TEAM_TOPIC] > 1:
        raise RunError(f"{index.path}: has {topics[schemas.TEAM_TOPIC]} messages of /team; record one run a file")
    unknown = _check_topics(index, team)
    spans = [time_span(index, topic) for topic in topics if topic != schemas.TEAM_TOPIC and topic not in unknown]
    return Run(
        path=index.path,
        team=team,
        warnings=(
            *_cut_off(index),
            *(f"{index.path}: {topic} is no topic of a run and is ignored" for topic in unknown),
        ),
        stances=_stances(index, team),
        planes=_planes(index, team),
        topics=topics,
        start=min((schemas.to_seconds(first) for first, _ in spans), default=None),
        end=max((schemas.to_seconds(last) for _, last in spans), default=None),
        # without truth, so that no user of a run can read it
        _index=replace(index, channels={c: i for c, i in index.channels.items() if not schemas.is_truth(i.topic)}),
    )


def read_truth(path: str | Path, near: Mapping[str, Trajectory] | None = None) -> dict[str, Trajectory]:
    """Read the true trajectories T_world_body of a run. For evaluation: no estimator may call it.

    Parameters
    ----------
    path : str or Path
        The run.
    near : mapping of str to Trajectory, optional
        Estimated trajectories: of these robots, only the true poses right before and right after each estimated one
        are read, and the first and the last.

    Returns
    -------
    dict of str to Trajectory
        By robot; {} of a run without truth.
    """
    index = build_index(Path(path))
    truth = {}
    for topic in dict.fromkeys(info.topic for info in index.channels.values()):
        split = schemas.robot_and_kind(topic)
        if split and split[1] == "truth":
            estimated = None if near is None else near.get(split[0])
            if estimated is None:
                items = read_topic(index, topic)
            else:
                items = iter(read_near(index, topic, [schemas.to_ns(time) + SAME_TIME for time in estimated.times]))
            poses = list(decoded(index, (topic, items), lambda item: (item.ns, decode.decode_pose(item.ns, item.data))))
            times = np.array([schemas.to_seconds(ns) for ns, _ in poses])
            truth[split[0]] = Trajectory(split[0], times, np.array([T for _, T in poses]).reshape(-1, 4, 4))
    return truth


def truth_counts(path: str | Path) -> dict[str, int]:
    """Return the number of true poses of a run by robot, without reading them."""
    index = build_index(Path(path))
    counts: dict[str, int] = {}
    for chunk in index.chunks:
        for channel, count in chunk.counts.items():
            split = schemas.robot_and_kind(index.channels[channel].topic)
            if split and split[1] == "truth":
                counts[split[0]] = counts.get(split[0], 0) + count
    return counts


def read_true_team(path: str | Path) -> Team | None:
    """Read the true mounts and markers of the team, None if they are not recorded. For evaluation alone."""
    return _read_team(build_index(Path(path)), schemas.TRUE_TEAM_TOPIC)


def run_id(path: str | Path) -> str:
    """Return the identifier of a run, the same for its file moved, copied, renamed or cut off.

    The SHA-256 of the file up to the end of its second chunk, of 1 MiB at most: the team, and the first data.
    """
    index = build_index(Path(path))
    last = index.chunks[min(1, len(index.chunks) - 1)] if index.chunks else None
    size = MAX_IDENTIFYING if last is None else min(last.offset + last.length, MAX_IDENTIFYING)
    with index.path.open("rb") as file:
        return hashlib.sha256(file.read(size)).hexdigest()


def _clamped_ns(seconds: float) -> int:
    """Return a bound in nanoseconds, within the range of a file's times."""
    if np.isnan(seconds):
        raise RunError("a time range cannot begin or end at NaN; give UTC seconds")
    return schemas.to_ns(min(max(seconds, 0.0), 9e9))


def _check_format(index: Index) -> None:
    number = index.profile.removeprefix(schemas.PROFILE_PREFIX)
    if number != index.profile and number != str(schemas.FORMAT):
        raise RunError(
            f"{index.path}: has format {number} and this version reads format {schemas.FORMAT}; "
            "use the version of coloc-graph that wrote it, or a newer one"
        )


def _read_team(index: Index, topic: str) -> Team | None:
    return next(decoded(index, (topic, read_topic(index, topic)), lambda item: decode.decode_team(item.data)), None)


def _check_topics(index: Index, team: Team) -> list[str]:
    """Return the topics that no run has; RunError for a run's topic with another schema."""
    unknown = []
    for info in index.channels.values():
        split = schemas.robot_and_kind(info.topic)
        wanted = schemas.schemas_of(info.topic)
        if split:
            check_robots(team, split[:1], f"{index.path}: the topic {info.topic}")
        if not wanted and not schemas.is_truth(info.topic):
            unknown.append(info.topic)
        elif info.schema not in wanted or info.encoding != ("protobuf" if info.schema.startswith("fox") else "json"):
            raise RunError(
                f"{index.path}: the messages of {info.topic} are `{info.schema}` in `{info.encoding}`, not "
                f"{' or '.join(wanted)}; see docs/run-format.md"
            )
    return unknown


def _counts(index: Index) -> dict[str, int]:
    counts = {info.topic: 0 for info in index.channels.values() if not schemas.is_truth(info.topic)}
    for chunk in index.chunks:
        for channel, count in chunk.counts.items():
            if index.channels[channel].topic in counts:
                counts[index.channels[channel].topic] += count
    return counts


def _cut_off(index: Index) -> list[str]:
    if index.lost is None:
        return []
    reach = max(chunk.end for chunk in index.chunks)
    after = schemas.to_seconds(reach - min(chunk.start for chunk in index.chunks))
    what = "was cut off or is still being written, and all that is in it could be read"
    if index.lost:
        what = f"was cut off, the last {index.lost} byte{'s' * (index.lost != 1)} could not be read"
    return [
        f"{index.path}: {what}; the data reach {schemas.to_seconds(reach):.3f} s (UTC), {after:.3f} s after they begin"
    ]


def _stances(index: Index, team: Team) -> tuple[Stance, ...]:
    stances: dict[int, Stance] = {}
    items = schemas.STANCE_TOPIC, read_topic(index, schemas.STANCE_TOPIC)
    for stance in decoded(index, items, lambda item: decode.decode_stance(item.ns, item.data)):
        where = f"{index.path}: stance {stance.index}"
        check_robots(team, (*stance.observers, *stance.movers, *stance.anchors), where)
        if stance.index in stances:
            raise RunError(f"{where} is recorded twice; number each stance once")
        stances[stance.index] = stance
    return tuple(stances[k] for k in sorted(stances))


def _planes(index: Index, team: Team) -> dict[int, Planes]:
    planes: dict[int, Planes] = {}
    items = schemas.PLANES_TOPIC, read_topic(index, schemas.PLANES_TOPIC)
    for plane in decoded(index, items, lambda item: decode.decode_planes(item.ns, item.data)):
        where = f"{index.path}: the planes of stance {plane.stance}"
        check_robots(team, tuple(plane.planes), where)
        if plane.stance in planes:
            raise RunError(f"{where} are recorded twice; state them once a stance")
        planes[plane.stance] = plane
    return planes
