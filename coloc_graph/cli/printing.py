"""Print progress to stderr and tables to stdout."""

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

_quiet: ContextVar[bool] = ContextVar("quiet", default=False)  # set by -q


def set_quiet(*, quiet: bool) -> None:
    """Print neither progress nor warnings from here on, or print them again."""
    _quiet.set(quiet)


def note(text: str) -> None:
    """Print a line about the work to stderr, unless -q is given."""
    if not _quiet.get():
        print(text, file=sys.stderr, flush=True)


@contextmanager
def progress(what: str) -> Iterator[Callable[[int, int], None]]:
    """Yield a callback (done, total) that shows a bar on a terminal, and a line at each quarter elsewhere."""
    if _quiet.get():
        yield lambda _done, _total: None
        return
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, console=Console(stderr=True)) as bar:
            task = bar.add_task(what, total=None)
            yield lambda done, total: bar.update(task, completed=done, total=total)
        return

    quarter = -1

    def report(done: int, total: int) -> None:
        nonlocal quarter
        if 4 * done // total != quarter:
            quarter = 4 * done // total
            note(f"{what}: {done} of {total}")

    yield report


def counted(n: int, what: str) -> str:
    """Format a number with its noun: `1 stance`, `2 stances`."""
    return f"{n} {what}{'' if n == 1 else 's'}"


def print_json(value: Any) -> None:
    """Print a value as JSON."""
    print(json.dumps(value, indent=2))


def print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a plain table with a left-aligned column of names and right-aligned columns of figures."""
    widths = [max(len(row[column]) for row in (header, *rows)) for column in range(len(header))]
    for row in (header, *rows):
        cells = [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        print("  ".join([row[0].ljust(widths[0]), *cells]).rstrip())


def warn(warnings: Sequence[str], *, kept: bool = True) -> None:
    """Print warnings to stderr, one a line; of many that are `kept` in a result, the first and the number of others."""
    shown = 8 if kept else len(warnings)
    for warning in warnings[:shown]:
        note(f"warning: {warning}")
    if len(warnings) > shown:
        note(f"warning: and {len(warnings) - shown} more, see summary.json and measurements.csv")
