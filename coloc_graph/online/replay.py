"""Replay of a mission's record through the code that estimated online; `replay`."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from coloc_graph.errors import InputError, RunError
from coloc_graph.online.journal import Journal, digest_of, read_attempts
from coloc_graph.pipeline.incremental import EnteredStance, IncrementalSolver
from coloc_graph.pipeline.options import SolveOptions
from coloc_graph.run import open_run


@dataclass(frozen=True, eq=False)
class ReplayedStance:
    """A stance as it was estimated again.

    Attributes
    ----------
    entered
        The stance and its estimate.
    same
        True if the estimate is that of online, bit for bit; None if the log does not have that.
    """

    entered: EnteredStance
    same: bool | None


def replay(folder: str | Path, options: SolveOptions | None = None) -> Iterator[ReplayedStance]:
    """Give the estimator what entered it online, in the same order and to the same extent; yield each stance.

    Parameters
    ----------
    folder
        Folder of a mission: run.mcap and mission.jsonl.
    options
        Options of the estimator, as in the mission.

    Raises
    ------
    InputError
        If it is not the folder of a mission.
    RunError
        If its record cannot be read, or has no stance.
    """
    record, log = Path(folder) / "run.mcap", Path(folder) / "mission.jsonl"
    if not record.exists() or not log.exists():
        raise InputError(f"{folder} is not the folder of a mission: it needs run.mcap and mission.jsonl")
    run = open_run(record)
    if not run.stances:
        raise RunError(f"{record}: no stance has entered the estimate: there is nothing to replay")
    for attempt, one in Journal(run, read_attempts(log)).enter(IncrementalSolver(run.team, options)):
        yield ReplayedStance(one, attempt.digest == digest_of(one.estimate) if attempt.digest else None)
