"""Many runs, each solved by itself: in any process, resumed where it stopped, and a bad one ends none of the others."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, as_completed
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from coloc_graph._version import __version__
from coloc_graph.errors import ColocError, InputError
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.results.folder import SUMMARY, holds_result, read_config, read_summary, require_place
from coloc_graph.results.writer import write_result
from coloc_graph.run import open_run, run_id

#: A run whose process dies is tried so often: whose fault it was is not known when several are under way.
TRIES = 2


@dataclass(frozen=True)
class Outcome:
    """What became of a run: its result is in `out`, unless `failed` says why there is none.

    `resumed` where it was there already. `summary` is that of the result ({}: none).
    """

    run: Path
    out: Path
    summary: dict[str, Any]
    failed: str = ""
    resumed: bool = False


def runs_in(folder: str | Path) -> list[Path]:
    """The runs (.mcap) in a folder and the folders in it, by name; `InputError` where there are none."""
    folder = Path(folder)
    found = sorted(path for path in folder.rglob("*.mcap") if path.is_file())
    if not found:
        raise InputError(f"{folder}: holds no run (.mcap); give a run, or a folder of runs")
    return found


def places_of(runs: Sequence[Path], folder: str | Path, out: str | Path) -> list[Path]:
    """Where the result of each run in a folder goes: as it is called there, without its ending.

    `InputError` where one result would lie in another, which is replaced as a whole when its run is solved again.
    """
    places = [Path(out) / path.relative_to(folder).with_suffix("") for path in runs]
    run_at = dict(zip(places, runs, strict=True))
    for run, place in zip(runs, places, strict=True):
        for above in place.parents:
            if above in run_at:
                raise InputError(
                    f"{run}: its result would lie in that of {run_at[above]}; give the run or its folder another name"
                )
    return places


def solve_runs(
    runs: Sequence[Path],
    places: Sequence[Path],
    options: SolveOptions | None = None,
    *,
    executors: Callable[[], AbstractContextManager[Executor]],
    told: Callable[[Outcome], None] | None = None,
) -> list[Outcome]:
    """Solve each run, and write its result to its place; what became of them comes back in their order.

    A result that is there already, of the same run, options and version, is left as it is. `executors` makes one
    more executor where one broke. `told` hears of each run as soon as it is over.
    """
    options = options or SolveOptions()
    outcomes: dict[int, Outcome] = {}

    def take(number: int, outcome: Outcome) -> None:
        outcomes[number] = outcome
        if told is not None:
            told(outcome)

    for number, (run, out) in enumerate(zip(runs, places, strict=True)):
        if (summary := _earlier(run, out, options)) is not None:
            take(number, Outcome(run, out, summary, resumed=True))
    for tries in reversed(range(TRIES)):
        left = [number for number in range(len(runs)) if number not in outcomes]
        if not left:
            break
        with executors() as executor:
            futures: dict[Future[Outcome], int] = {
                executor.submit(solve_one, runs[number], places[number], options): number for number in left
            }
            for future in as_completed(futures):
                number = futures[future]
                try:
                    take(number, future.result())
                except Exception as error:  # `solve_one` raises none: its process is gone, and what waited for it
                    if not tries:
                        said = f"{runs[number]}: the process that solved it ended ({type(error).__name__}: {error})"
                        take(number, Outcome(runs[number], places[number], {}, failed=said))
    return [outcomes[number] for number in range(len(runs))]


def solve_one(run: Path, out: Path, options: SolveOptions) -> Outcome:
    """Solve a run and write its result; what is wrong with it is said in the outcome, whatever it is."""
    try:
        require_place(out)
        write_result(solve(open_run(run), options), out)
        return Outcome(run, out, read_summary(out))
    except ColocError as error:
        earlier = f"; {out} still holds an earlier result" if holds_result(out) else ""
        return Outcome(run, out, {}, failed=f"{error}{earlier}")
    except OSError as error:
        return Outcome(run, out, {}, failed=f"the system says: {error.strerror} {error.filename or ''}".strip())
    except Exception as error:
        return Outcome(run, out, {}, failed=f"{run}: cannot be solved ({type(error).__name__}: {error})")


def _earlier(run: Path, out: Path, options: SolveOptions) -> dict[str, Any] | None:
    """The summary of a result that is of this run as it is now, by these options and this version; else None."""
    if not holds_result(out):
        return None
    try:
        summary, config = read_summary(out), read_config(out)
        same = (
            config.version == __version__
            and config.options in (options, options.resolved())
            and (out / SUMMARY).stat().st_mtime >= run.stat().st_mtime
            and summary.get("run_id") == run_id(run)
        )
    except (OSError, ValueError, ColocError):
        return None
    return summary if same else None
