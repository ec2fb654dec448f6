"""Progress to stderr and tables to stdout."""

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any


@contextmanager
def progress(what: str) -> Iterator[Callable[[int, int], None]]:
    """A bar on a terminal, a line at each quarter elsewhere; call what it yields with (done, total)."""
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
            print(f"{what}: {done} of {total}", file=sys.stderr, flush=True)

    yield report


def counted(n: int, what: str) -> str:
    """`1 stance`, `2 stances`."""
    return f"{n} {what}{'' if n == 1 else 's'}"


def print_json(value: Any) -> None:
    """Figures for programs."""
    print(json.dumps(value, indent=2))


def print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """A plain table, its columns as wide as what is in them; the first is a name, the others are figures."""
    widths = [max(len(row[column]) for row in (header, *rows)) for column in range(len(header))]
    for row in (header, *rows):
        cells = [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        print("  ".join([row[0].ljust(widths[0]), *cells]).rstrip())


def warn(warnings: Sequence[str], *, kept: bool = True) -> None:
    """Warnings, one a line; of many that a result keeps, the first few and how many more there are."""
    shown = 8 if kept else len(warnings)
    for warning in warnings[:shown]:
        print(f"warning: {warning}", file=sys.stderr)
    if len(warnings) > shown:
        print(f"warning: and {len(warnings) - 8} more, see summary.json and measurements.csv", file=sys.stderr)
