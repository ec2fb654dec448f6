"""The folder of a mission, of one coordinator at a time; `MissionFolder`."""

from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

from coloc_graph.errors import InputError
from coloc_graph.online.record import Record, begun, continued
from coloc_graph.run import Run
from coloc_graph.run.output_lock import OutputLock
from coloc_graph.team import Team


class MissionFolder:
    """A mission's folder, locked until the context manager ends; nothing in it is touched before `open_record`.

    Parameters
    ----------
    folder
        Path of the folder, which `open_record` makes if there is none.
    resume
        Continue the record that is in it. Without, a folder that holds one is refused.

    Raises
    ------
    InputError
        If another coordinator holds the folder, or it holds a record and `resume` is not set.
    """

    def __init__(self, folder: str | Path, *, resume: bool) -> None:
        self.path = Path(folder).resolve()  # one lock, whatever the folder is called
        self.record_path = Path(folder) / "run.mcap"
        self.log_path = Path(folder) / "mission.jsonl"
        if self.record_path.exists() and not resume:
            raise InputError(f"{self.record_path} exists: continue it with --resume, or give another folder with --out")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with ExitStack() as undo:
            undo.callback(OutputLock(self.path).release)
            if self.record_path.exists():  # other commands write runs too
                undo.callback(OutputLock(self.record_path).release)
            self._locks = undo.pop_all()

    def open_record(self, team: Team) -> tuple[Record, Run | None]:
        """Begin the mission's record, or continue the one that is there and return it as the second value.

        Raises
        ------
        RunError
            If the record that is there is of another team, or cannot be read.
        """
        self.path.mkdir(exist_ok=True)
        if self.record_path.exists():
            return continued(self.record_path, team)
        self._locks.callback(OutputLock(self.record_path).release)
        return begun(self.record_path, team), None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._locks.close()
