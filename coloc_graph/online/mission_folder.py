"""The folder of a mission, of one coordinator at a time: its record and its log; `MissionFolder`."""

import contextlib
import fcntl
import os
from pathlib import Path
from types import TracebackType
from typing import Self

from coloc_graph.errors import InputError
from coloc_graph.online.record import Record, continued
from coloc_graph.run import Run
from coloc_graph.team import Team

LOCK = ".lock"
RECORD = "run.mcap"


class MissionFolder:
    """A mission's folder, locked until the context manager ends; nothing else in it is touched before `open_record`.

    The lock ends with the process that holds it, however that ends.

    Parameters
    ----------
    folder
        Path of the folder, which is made where there is none.
    resume
        Go on with the record that is in it. Without, a folder that holds one is refused.

    Raises
    ------
    InputError
        If another coordinator holds the folder, or it holds a record and `resume` is not set.
    """

    def __init__(self, folder: str | Path, *, resume: bool) -> None:
        self.path = Path(folder)
        self._made = not self.path.exists()
        self.path.mkdir(parents=True, exist_ok=True)
        self._lock = os.open(self.path / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._lock)
            raise InputError(
                f"another coordinator is at work in {self.path}: end it first, or give another folder with --out"
            ) from None
        if self.record_path.exists() and not resume:
            os.close(self._lock)
            raise InputError(f"{self.record_path} exists: continue it with --resume, or give another folder with --out")

    @property
    def record_path(self) -> Path:
        """Path of the mission's run."""
        return self.path / RECORD

    @property
    def log_path(self) -> Path:
        """Path of the log of states and events, one JSON object a line."""
        return self.path / "mission.jsonl"

    def open_record(self, team: Team) -> tuple[Record, Run | None]:
        """Begin the mission's record, or continue the one that is there and return it as the second value.

        Raises
        ------
        RunError
            If the record that is there is of another team, or cannot be read.
        """
        self._made = False
        if self.record_path.exists():
            return continued(self.record_path, team)
        return Record(self.record_path, team), None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._made:  # nothing came to be in it
            with contextlib.suppress(OSError):
                (self.path / LOCK).unlink()
                self.path.rmdir()
        os.close(self._lock)
