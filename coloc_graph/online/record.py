"""Record of a mission: the newest minutes in memory, everything in a run on disk; `Record`."""

import contextlib
from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self, TypeVar

from coloc_graph.errors import RunError
from coloc_graph.machine import machine
from coloc_graph.run import Detections, Image, Motion, OdometrySample, Planes, Run, RunWriter, Stance, open_run
from coloc_graph.run.schemas import to_ns, to_seconds
from coloc_graph.team import Team

T = TypeVar("T", Detections, OdometrySample)

LATER = 1e-6  # time by which a late image is put after the last one [s]
MEMORY = 600.0  # newest part of the run that is kept in memory too [s]


class _InMemory:
    """Records in memory, read as `run.Recorded`."""

    _detections: Mapping[str, list[Detections]]
    _odometry: Mapping[str, list[OdometrySample]]

    def has_detections(self, robot: str) -> bool:
        """Return True: robots send detections."""
        return True

    def detections(self, robot: str, start: float, end: float) -> Iterator[Detections]:
        """Return the detections of a robot's camera in a time span [UTC s]."""
        return iter(_between(self._detections.get(robot, ()), start, end))

    def images(self, robot: str, start: float, end: float) -> Iterator[Image]:
        """Return no images: they stay on the robot."""
        return iter(())

    def odometry(self, robot: str, start: float | None = None, end: float | None = None) -> Iterator[OdometrySample]:
        """Return a robot's odometry in a time span [UTC s]."""
        return iter(_between(self._odometry.get(robot, ()), start, end))


class Excerpt(_InMemory):
    """Records of a mission as they were at an instant."""

    def __init__(
        self,
        path: Path,
        team: Team,
        detections: Mapping[str, list[Detections]],
        odometry: Mapping[str, list[OdometrySample]],
    ) -> None:
        self.path, self.team, self._detections, self._odometry = path, team, detections, odometry
        self.planes: dict[int, Planes] = {}


class Record(_InMemory):
    """A run that is written while it is measured, and read as `run.Recorded`; a context manager.

    A late sample of odometry gets the time of the last one, and a late image a time right after the last one: time does
    not run backwards in a run, and images of one robot with the same stamp count once.
    """

    def __init__(self, path: str | Path, team: Team) -> None:
        self.path, self.team = Path(path), team
        self.planes: dict[int, Planes] = {}
        self._writer = RunWriter(path, team)
        self._detections: dict[str, list[Detections]] = defaultdict(list)
        self._odometry: dict[str, list[OdometrySample]] = defaultdict(list)
        self._moving: dict[str, tuple[bool, float]] = {}
        self._counts = {name: [0, 0] for name in team.names}
        self._lock = machine.new_lock()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.__exit__(kind, error, trace)

    def take(self, one: Detections | OdometrySample) -> Detections | OdometrySample:
        """Add a record; return it as it will be read from the run."""
        with self._lock:
            self._counts[one.robot][isinstance(one, OdometrySample)] += 1
            if isinstance(one, Detections):
                return self._into(self._detections[one.robot], one, LATER)
            return self._into(self._odometry[one.robot], one, 0.0)

    def moves(self, robot: str, time: float, moving: bool) -> None:
        """Record whether a robot moves, if that has changed."""
        with self._lock:
            before = self._moving.get(robot)
            if before is None or before[0] != moving:
                time = time if before is None else max(time, before[1])
                self._moving[robot] = moving, time
                self._writer.write(Motion(robot, time, moving))

    def complete(self, stance: Stance) -> None:
        """Add a stance that has entered the estimate; a killed process does not lose it."""
        self._writer.write(stance)
        self._writer.flush()

    def hand_over(self) -> None:
        """Hand all that was taken to the operating system: a killed process does not lose it."""
        self._writer.flush(to_seconds(machine.time_ns()))

    @property
    def counts(self) -> dict[str, tuple[int, int]]:
        """Number of detections and of odometry samples of each robot, of the whole run."""
        with self._lock:
            return {name: tuple(self._counts[name]) for name in self.team.names}  # type: ignore[misc]

    def now(self) -> "Excerpt":
        """Return all that is in memory, as it is now."""
        with self._lock:
            detections = {name: list(kept) for name, kept in self._detections.items()}
            odometry = {name: list(kept) for name, kept in self._odometry.items()}
        return Excerpt(self.path, self.team, detections, odometry)

    def rounded(self, time: float) -> float:
        """Round a time [UTC s] as it will be read from the run."""
        return to_seconds(to_ns(time))

    def last_odometry(self, robot: str) -> OdometrySample | None:
        """Return the newest odometry sample of a robot; None if there is none."""
        return self._odometry[robot][-1] if self._odometry[robot] else None

    def newest(self) -> float:
        """Return the time of the newest record [UTC s]; 0 if there is none."""
        seen = [kept[-1].time for kept in self._detections.values() if kept]
        rolled = [kept[-1].time for kept in self._odometry.values() if kept]
        return max([*seen, *rolled], default=0.0)

    def _into(self, kept: list[T], one: T, later: float) -> T:
        time = max(self.rounded(one.time), self.rounded(kept[-1].time + later) if kept else 0.0)
        one = replace(one, time=time)
        self._writer.write(one)
        kept.append(one)
        if kept[-1].time - kept[0].time > 1.2 * MEMORY:
            del kept[: bisect_left(kept, kept[-1].time - MEMORY, key=lambda old: old.time)]
        return one


def _between(kept: Sequence[T], start: float | None, end: float | None) -> Sequence[T]:
    first = 0 if start is None else bisect_left(kept, start, key=lambda one: one.time)
    last = len(kept) if end is None else bisect_right(kept, end, key=lambda one: one.time)
    return kept[first:last]


@contextlib.contextmanager
def _taking_place(path: Path, team: Team) -> Iterator[Record]:
    """Fill a record that takes its place at `path` once it is whole and handed over; if that fails it is removed."""
    new = path.with_suffix(".new.mcap")
    record = Record(new, team)
    try:
        yield record
        new.rename(path)
    except BaseException:
        record.__exit__(None, None, None)
        new.unlink(missing_ok=True)
        raise
    record.path = path


def begun(path: str | Path, team: Team) -> Record:
    """Begin a record that is at `path` as soon as it has its team: a coordinator killed before leaves none there."""
    with _taking_place(Path(path), team) as record:
        record.hand_over()
    return record


def continued(path: str | Path, team: Team) -> tuple[Record, Run]:
    """Begin a record with all that can be read of an earlier one, which may have been cut off, and return both.

    The earlier run is kept beside it with a number. At every moment `path` is a complete copy of what was there before.

    Raises
    ------
    RunError
        If the earlier run is of another team, or cannot be read; nothing is changed then.
    """
    path = Path(path)
    before = open_run(path)
    if before.team != team:
        raise RunError(f"{path}: is of another team, or of another description of it: begin in a new folder")
    number = next(n for n in range(1, 10_000) if not path.with_suffix(f".{n}.mcap").exists())
    kept = path.with_suffix(f".{number}.mcap")
    with _taking_place(path, team) as record:
        for robot in team.names:
            for detections in before.detections(robot):
                record.take(detections)
            for sample in before.odometry(robot):
                record.take(sample)
            for motion in before.motions(robot):
                record.moves(robot, motion.time, motion.moving)
        for stance in before.stances:
            record.complete(stance)
        record.hand_over()
        try:
            kept.hardlink_to(path)
        except OSError:  # a file system without hard links
            path.rename(kept)
    return record, open_run(kept)
