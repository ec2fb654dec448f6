"""The log of a mission: its states and events, one JSON object a line; `MissionLog`."""

import contextlib
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType
from typing import Self

from coloc_graph.errors import RunError
from coloc_graph.machine import machine


class MissionLog:
    """Appends to `path`; a context manager.

    Parameters
    ----------
    path
        File of JSON lines. Each has `time` [UTC s], `what` happened, and more.
    now
        Returns the time [UTC s].
    """

    def __init__(self, path: Path, now: Callable[[], float]) -> None:
        self._path, self._now = path, now
        self._warned: set[str] = set()
        self._file = machine.opened(path.open("a", encoding="utf-8"))

    def note(self, what: str, **more: object) -> None:
        """Add a line, which a killed coordinator leaves behind complete.

        Raises
        ------
        RunError
            If the disk refuses.
        """
        try:
            machine.use_disk()
            self._file.write(json.dumps({"time": self._now(), "what": what, **more}) + "\n")
            self._file.flush()
        except OSError as error:
            raise RunError(
                f"{self._path}: cannot be written ({error.strerror}); check the folder and the space on the disk"
            ) from error

    def warn(self, texts: Iterable[str]) -> None:
        """Add a line for each warning that was not in the log yet."""
        for text in texts:
            if text not in self._warned:
                self._warned.add(text)
                self.note("warning", text=text)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with contextlib.suppress(OSError):  # a full disk was reported by `note`
            self._file.close()
