"""Solving of many runs in parallel, each by itself, with resuming; a bad run ends none of the others."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, as_completed
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from coloc_graph.errors import ColocError, InputError
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.results.earlier import require_replaceable, same_result
from coloc_graph.results.folder import SUMMARY, holds_result, read_summary, require_output_folder
from coloc_graph.results.writer import write_result
from coloc_graph.run import open_run

MAX_TRIES = 2  # of a run whose process died: with several under way it is not known whose fault it was


@dataclass(frozen=True)
class Outcome:
    """Outcome of one run.

    Parameters
    ----------
    run, out : Path
        The run, and the folder of its result.
    summary : dict
        summary.json of the result; {} where there is none.
    failed : str
        Reason for which there is no result; "" where there is one.
    resumed : bool
        The result existed before.
    """

    run: Path
    out: Path
    summary: dict[str, Any]
    failed: str = ""
    resumed: bool = False


def runs_in(folder: str | Path) -> list[Path]:
    """Return the runs (.mcap) in a folder and the folders in it, by name; `InputError` where there are none."""
    folder = Path(folder)
    found = sorted(path for path in folder.rglob("*.mcap") if path.is_file())
    if not found:
        raise InputError(f"{folder}: holds no run (.mcap); give a run, or a folder of runs")
    return found


def result_folders(runs: Sequence[Path], folder: str | Path, out: str | Path) -> list[Path]:
    """Return the folder of each run's result in `out`: the run's path in `folder` without its ending.

    `InputError` where one result would lie in another, which is replaced as a whole when its run is solved again.
    """
    folders = [Path(out) / path.relative_to(folder).with_suffix("") for path in runs]
    run_at = dict(zip(folders, runs, strict=True))
    for run, result in zip(runs, folders, strict=True):
        for above in result.parents:
            if above in run_at:
                raise InputError(
                    f"{run}: its result would lie in that of {run_at[above]}: give the run or its folder another name"
                )
    return folders


def solve_runs(
    runs: Sequence[Path],
    folders: Sequence[Path],
    options: SolveOptions | None = None,
    *,
    executors: Callable[[], AbstractContextManager[Executor]],
    force: bool = True,
    on_outcome: Callable[[Outcome], None] | None = None,
) -> list[Outcome]:
    """Solve each run, and write its result to its folder.

    Parameters
    ----------
    runs, folders : sequence of Path
        The runs, and the folder of each result. An existing result of the same run, options and version is kept.
    options : SolveOptions, optional
        As of `solve`.
    executors : callable
        Makes an executor, and one more where it broke.
    force : bool
        Replace existing results of other runs, options or versions; otherwise their runs count as failed.
    on_outcome : callable, optional
        Called with each outcome as soon as it is known.

    Returns
    -------
    list of Outcome
        In the order of the runs.
    """
    options = options or SolveOptions()
    outcomes: dict[int, Outcome] = {}

    def take(number: int, outcome: Outcome) -> None:
        outcomes[number] = outcome
        if on_outcome is not None:
            on_outcome(outcome)

    for number, (run, out) in enumerate(zip(runs, folders, strict=True)):
        if (summary := _earlier(run, out, options)) is not None:
            take(number, Outcome(run, out, summary, resumed=True))
        elif (failed := _replacing(run, out, options, force=force)) != "":
            take(number, Outcome(run, out, {}, failed=failed))
    for tries in reversed(range(MAX_TRIES)):
        left = [number for number in range(len(runs)) if number not in outcomes]
        if not left:
            break
        with executors() as executor:
            futures: dict[Future[Outcome], int] = {
                executor.submit(solve_one, runs[number], folders[number], options): number for number in left
            }
            for future in as_completed(futures):
                number = futures[future]
                try:
                    take(number, future.result())
                except Exception as error:  # `solve_one` raises none: its process died, or another one's did
                    if not tries:
                        failed = f"{runs[number]}: the process that solved it ended ({type(error).__name__}: {error})"
                        take(number, Outcome(runs[number], folders[number], {}, failed=failed))
    return [outcomes[number] for number in range(len(runs))]


def solve_one(run: Path, out: Path, options: SolveOptions) -> Outcome:
    """Solve a run and write its result; any failure is described in the outcome."""
    try:
        require_output_folder(out)
        write_result(solve(open_run(run), options), out)
        return Outcome(run, out, read_summary(out))
    except ColocError as error:
        earlier = f"; {out} still holds an earlier result" if holds_result(out) else ""
        return Outcome(run, out, {}, failed=f"{error}{earlier}")
    except OSError as error:
        return Outcome(run, out, {}, failed=f"the system says: {error.strerror} {error.filename or ''}".strip())
    except Exception as error:
        return Outcome(run, out, {}, failed=f"{run}: cannot be solved ({type(error).__name__}: {error})")


def _replacing(run: Path, out: Path, options: SolveOptions, *, force: bool) -> str:
    """Reason for which the result of a run must not be written; "" where it may be."""
    try:
        require_replaceable(run, out, options, force=force)
    except (OSError, ColocError) as error:
        return str(error)
    return ""


def _earlier(run: Path, out: Path, options: SolveOptions) -> dict[str, Any] | None:
    """Return the summary of the same result, if it was written after the run; None where there is none."""
    try:
        if holds_result(out) and (out / SUMMARY).stat().st_mtime >= run.stat().st_mtime:
            return same_result(run, out, options)
    except (OSError, ColocError):
        return None
    return None
