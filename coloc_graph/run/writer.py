"""Writing of runs: `RunWriter` records a run as it happens, `atomic_run` writes one atomically."""

import os
import stat
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import ArrayLike

from coloc_graph.errors import RunError
from coloc_graph.machine import machine
from coloc_graph.run import schemas
from coloc_graph.run.atomic_file import open_part
from coloc_graph.run.encode import (
    ImageFormat,
    Record,
    check_robots,
    check_targets,
    encode_pose,
    encode_record,
    encode_team,
)
from coloc_graph.run.messages import Clocks, Planes, Ranges, Stance
from coloc_graph.run.output_lock import OutputLock, locked_output
from coloc_graph.team import Team

CHUNK_SIZE = 128 * 1024  # bytes without compression


class RunWriter:
    """Writer of a run while it happens; a context manager, which replaces an existing file.

    `write` may be called from several threads.

    Parameters
    ----------
    path
        File to write. It is not touched while another writer writes it, and a link is not followed.
    team
        Robots of the run.
    image_format
        `jpeg` (quality 95, lossy), `png` or `raw`.
    flush_every
        Longest time between the return of `write` and the moment when the message is in the operating system's hands
        [s]; a killed process loses no more than that. None writes a chunk only when it is full, and then the same input
        gives the same bytes.

    Raises
    ------
    RunError
        A record is invalid, or the disk refuses.
    InputError
        Another writer writes the file.
    """

    def __init__(
        self,
        path: str | Path,
        team: Team,
        *,
        image_format: ImageFormat = "jpeg",
        flush_every: float | None = 0.5,
    ) -> None:
        if image_format not in ("jpeg", "png", "raw"):
            raise RunError(f"the image format `{image_format}` is unknown; use jpeg, png or raw")
        if flush_every is not None and not flush_every > 0:
            raise RunError(f"`flush_every` is {flush_every}; give seconds above 0, or None")
        self.path = Path(path)
        self.team = team
        self._image_format = image_format
        self._true_team: Team | None = None
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._last: dict[str, int] = {}
        self._counts: dict[int, int] = {}
        self._started = False
        self._closed = False
        self._failure: OSError | None = None
        self._lock = machine.new_lock()
        self._stop = machine.new_event()
        self._output: OutputLock | None = None
        try:
            self._file = self._open()
        except OSError as error:
            self._release()
            raise self._refused(error) from error
        except BaseException:
            self._release()
            raise
        self._mcap = Writer(self._file, chunk_size=CHUNK_SIZE, compression=CompressionType.LZ4)
        try:
            self._on_disk(self._begin)
        except RunError:
            self._close_file()
            raise
        self._flusher: threading.Thread | None = None
        if flush_every is not None:
            # at twice the rate, so that a flush that comes late is still in time
            self._flusher = machine.new_thread(target=self._flush_regularly, args=(flush_every / 2,), name="run-flush")
            self._flusher.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # records before an error are worth keeping: the file is finished either way
        if error is None:
            self.close()
        else:
            with suppress(RunError):
                self.close()

    def write(self, record: Record) -> None:
        """Add a record; its time must not be before the last one of its topic."""
        match record:
            case Stance():
                where = f"stance {record.index}"
                check_robots(self.team, (*record.observers, *record.movers, *record.anchors), where)
            case Planes():
                check_robots(self.team, tuple(record.planes), f"the planes of stance {record.stance}")
            case Clocks():
                check_robots(self.team, tuple(clock.robot for clock in record.clocks), "the record of clocks")
            case _:
                check_robots(self.team, (record.robot,), f"the {type(record).__name__}")
        if isinstance(record, Ranges):
            check_targets(self.team, record, f"the ranges of {record.robot} at {record.time} s")
        topic, schema, time, data = encode_record(record, self._image_format)
        self._add(topic, schema, time, data)

    def write_truth(self, robot: str, time: float, T_world_body: ArrayLike) -> None:
        """Add the true pose of a robot's body in the world, (4, 4) [m]; only evaluations see it."""
        check_robots(self.team, (robot,), "the truth")
        data = encode_pose(time, np.asarray(T_world_body, float))
        self._add(schemas.topic_of(robot, "truth"), schemas.POSE_IN_FRAME, time, data)

    def write_true_team(self, team: Team) -> None:
        """Add, once, the true team (true mounts, spans); only evaluations see it."""
        with self._lock:
            self._check_open()
            if self._true_team is not None:
                raise RunError(f"{self.path}: the true team was written twice; write it once")
            self._true_team = team
            if self._started:
                self._on_disk(lambda: self._message(*self._of_team(schemas.TRUE_TEAM_TOPIC, team), self._start_ns))

    def flush(self, begun: float = 0.0) -> None:
        """Hand all that was written to the operating system now; `begun` [s] is the team's time if nothing was."""
        with self._lock:
            self._check_open()
            self._on_disk(lambda: self._start(schemas.to_ns(begun)))
            self._on_disk(self._flush)

    def close(self) -> None:
        """Finish the file; afterwards nothing can be written. Closing twice does nothing."""
        self._stop.set()
        if self._flusher is not None:
            self._flusher.join()
        with self._lock:
            if self._closed:
                return
            self._closed = True
            if self._failure is None:
                self._on_disk(self._finish)
            self._close_file()
            if self._failure is not None:
                raise self._refused(self._failure) from self._failure

    def _open(self) -> BinaryIO:
        """Lock the output, then open it: an existing file is truncated only after that."""
        if not self.path.exists() or self.path.is_file():  # a device is not locked
            self._output = OutputLock(self.path)
        if self.path.is_symlink():
            raise RunError(f"{self.path}: is a link; give the path of the file itself")
        file = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        if stat.S_ISREG(os.fstat(file).st_mode):
            os.ftruncate(file, 0)
        opened: BinaryIO = os.fdopen(file, "wb")
        return machine.opened(opened)

    def _release(self) -> None:
        if self._output is not None:
            self._output.release()

    def _add(self, topic: str, schema: str, time: float, data: bytes) -> None:
        ns = schemas.to_ns(time)
        with self._lock:
            self._check_open()
            last = self._last.get(topic, 0)
            if ns < last:
                raise RunError(
                    f"{self.path}: time runs backwards in {topic}, from {schemas.to_seconds(last)} s "
                    f"to {time} s; write each topic in the order of time"
                )
            if not self._started:
                self._on_disk(lambda: self._start(ns))
            self._on_disk(lambda: self._message(topic, schema, data, ns))
            self._last[topic] = ns

    def _check_open(self) -> None:
        if self._closed:
            raise RunError(f"{self.path}: the run is closed; write before closing it")
        if self._failure is not None:
            raise self._refused(self._failure) from self._failure

    def _begin(self) -> None:
        self._mcap.start(profile=f"{schemas.PROFILE_PREFIX}{schemas.FORMAT}", library=schemas.LIBRARY)
        self._file.flush()

    def _start(self, ns: int) -> None:
        # the team gets the time of the first message, which keeps Foxglove's time line short
        if self._started:
            return
        self._started = True
        self._start_ns = ns
        self._message(*self._of_team(schemas.TEAM_TOPIC, self.team), ns)
        if self._true_team is not None:
            self._message(*self._of_team(schemas.TRUE_TEAM_TOPIC, self._true_team), ns)
        self._flush()

    def _of_team(self, topic: str, team: Team) -> tuple[str, str, bytes]:
        return topic, schemas.schemas_of(topic)[0], encode_team(team)

    def _message(self, topic: str, schema: str, data: bytes, ns: int) -> None:
        channel = self._channel(topic, schema)
        sequence = self._counts.get(channel, 0)
        self._counts[channel] = sequence + 1
        self._mcap.add_message(channel, log_time=ns, publish_time=ns, data=data, sequence=sequence)

    def _channel(self, topic: str, schema: str) -> int:
        if (topic, schema) not in self._channels:
            encoding, message_encoding, data = schemas.schema_of(schema)
            if schema not in self._schemas:
                self._schemas[schema] = self._mcap.register_schema(schema, encoding, data)
            self._channels[topic, schema] = self._mcap.register_channel(topic, message_encoding, self._schemas[schema])
        return self._channels[topic, schema]

    def _finish(self) -> None:
        self._start(0)
        self._mcap.finish()  # type: ignore[no-untyped-call]
        self._file.flush()

    def _flush(self) -> None:
        self._mcap.flush()  # type: ignore[no-untyped-call]

    def _flush_regularly(self, period: float) -> None:
        while not self._stop.wait(period):
            with self._lock, suppress(RunError):  # kept in `_failure`, and raised by the next `write`
                if self._failure is None:
                    self._on_disk(self._flush)

    def _close_file(self) -> None:
        with suppress(OSError):  # it flushes once more; a full disk was reported before
            self._file.close()
        self._release()

    def _on_disk(self, action: Callable[[], None]) -> None:
        try:
            machine.use_disk()
            action()
        except OSError as error:
            self._failure = error
            raise self._refused(error) from error

    def _refused(self, error: OSError) -> RunError:
        return RunError(
            f"{self.path}: cannot be written ({error.strerror}); check the folder and the space on the disk"
        )


class _PartWriter(RunWriter):
    """Writer of the temporary file of a run, which is open as `file`."""

    def __init__(self, file: int, path: Path, team: Team, *, image_format: ImageFormat, flush_every: float | None):
        self._descriptor = file
        super().__init__(path, team, image_format=image_format, flush_every=flush_every)

    def _open(self) -> BinaryIO:
        return os.fdopen(self._descriptor, "wb")


@contextmanager
def atomic_run(
    path: str | Path, team: Team, *, image_format: ImageFormat = "jpeg", flush_every: float | None = None
) -> Iterator[RunWriter]:
    """Yield a `RunWriter` whose file appears at `path` when it is whole, and not at all after an exception.

    Until then it is beside it, as `NAME.<random>.part`. The same input gives the same bytes.

    Raises
    ------
    RunError
        `path` is a folder, or its folder does not exist.
    InputError
        Another command writes `path`.
    """
    path = Path(path)
    if path.is_dir():
        raise RunError(f"{path}: is a folder; give the path of a file")
    if not path.parent.is_dir():
        what = "is not a folder" if path.parent.exists() else "does not exist"
        raise RunError(f"{path}: cannot be written, since {path.parent} {what}; make the folder, or give another")
    with locked_output(path):
        file, part = open_part(path)
        writer = None
        try:
            writer = _PartWriter(file, path, team, image_format=image_format, flush_every=flush_every)
            yield writer
            writer.close()
            part.replace(path)
        except BaseException:
            if writer is not None:
                with suppress(RunError):
                    writer.close()
            part.unlink(missing_ok=True)
            raise
