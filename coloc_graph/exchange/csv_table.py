"""Read CSV files into columns of text with line numbers, so that errors name file and line."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import TracksError
from coloc_graph.input_file import decode_text, read_bytes
from coloc_graph.team import Team

Array = NDArray[np.float64]

MAX_STANCE = 10**9  # larger numbers are of another column


@dataclass(frozen=True)
class Table:
    """Rows of a CSV file: `columns` by name, and the `lines` of the file that they are from, counted from 1.

    Methods that convert a column raise `TracksError` at the first wrong row.
    """

    path: Path
    columns: dict[str, list[str]]
    lines: list[int]

    def __len__(self) -> int:
        return len(self.lines)

    def error(self, row: int, what: str) -> TracksError:
        """Return the error for a wrong row."""
        return TracksError(f"{self.path}, line {self.lines[row]}: {what}")

    def numbers(self, name: str) -> Array:
        """Convert a column to finite numbers, (n,)."""
        texts = self.columns[name]
        values = np.empty(len(texts))
        for row, text in enumerate(texts):
            try:
                values[row] = float(text)
            except ValueError:
                raise self.error(row, f"`{name}` is {_quoted(text)}, not a number; {_remedy(text)}") from None
        unbounded = first(~np.isfinite(values))
        if unbounded is not None:
            raise self.error(unbounded, f"`{name}` is `{texts[unbounded]}`; remove rows that were not measured")
        return values

    def stances(self) -> NDArray[np.int64]:
        """Convert the column `stance` to whole numbers from 0 on, (n,)."""
        texts = self.columns["stance"]
        values = []
        for row, text in enumerate(texts):
            try:
                values.append(int(text))
            except ValueError:
                what = f"`stance` is {_quoted(text)}, not a whole number; number the stances 0, 1, 2, ..."
                raise self.error(row, what) from None
            if not 0 <= values[-1] <= MAX_STANCE:
                raise self.error(row, f"`stance` is {text}; number the stances 0, 1, 2, ...")
        return np.array(values, np.int64)

    def robots(self, team: Team) -> NDArray[np.int64]:
        """Convert the column `robot` to indices in the team, (n,)."""
        place = {name: index for index, name in enumerate(team.names)}
        names = self.columns["robot"]
        row = next((row for row, name in enumerate(names) if name not in place), None)
        if row is not None:
            raise self.error(
                row,
                f"robot {_quoted(names[row])} is not in the team ({', '.join(team.names)}); "
                "correct the name or add the robot to the team",
            )
        return np.array([place[name] for name in names], np.int64)


def first(wrong: NDArray[np.bool_]) -> int | None:
    """Index of the first True, None if there is none."""
    return int(wrong.argmax()) if wrong.any() else None


def read_table(path: Path, what: str, header: Sequence[str], *, optional: Sequence[str] = ()) -> Table:
    """Read a UTF-8 CSV file with a given header.

    Blank lines, spaces around cells, a byte order mark and Windows line ends are accepted.

    Parameters
    ----------
    path
        File.
    what
        Kind of file, for messages.
    header
        Names of the columns.
    optional
        Names of columns that may follow.

    Raises
    ------
    TracksError
        The file cannot be read or decoded, is empty, or its header or a row has other columns.
    """
    expected = ",".join(header) + (f"[,{','.join(optional)}]" if optional else "")
    rows, lines = _rows(path, _text(path, what))
    if not rows:
        raise TracksError(f"{path}: is empty; begin it with the header {expected}")
    found = rows.pop(0)
    line = lines.pop(0)
    if found not in ([*header], [*header, *optional]):
        raise TracksError(f"{path}, line {line}: the header is {_quoted(','.join(found))}; it must be `{expected}`")
    for row, at in zip(rows, lines, strict=True):
        if len(row) != len(found):
            raise TracksError(
                f"{path}, line {at}: {len(row)} columns, where the header has {len(found)} ({','.join(found)}); "
                f"{'complete the row' if len(row) < len(found) else 'remove the surplus (decimals take a point)'}"
            )
    columns = zip(*rows, strict=True) if rows else ((),) * len(found)
    return Table(path, {name: list(column) for name, column in zip(found, columns, strict=True)}, lines)


def require_other_file(out: Path, *inputs: str | Path | None) -> None:
    """Raise `TracksError` where the run to write is one of the files to read."""
    for path in inputs:
        if path is not None and out.resolve() == Path(path).resolve():
            raise TracksError(f"{out}: is an input and the run to write; give the run a name of its own")


def _text(path: Path, what: str) -> str:
    data = read_bytes(path, f"give the path of a CSV with {what}", error=TracksError)
    return decode_text(path, data, f"save the {what} as CSV in UTF-8", error=TracksError)


def _rows(path: Path, text: str) -> tuple[list[list[str]], list[int]]:
    """Non-blank rows, and their line numbers."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows, lines = [], []
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            if any(cells):
                rows.append(cells)
                lines.append(reader.line_num)
    except csv.Error as error:
        raise TracksError(f"{path}, line {reader.line_num}: is not CSV ({error}); correct the line") from error
    return rows, lines


def _quoted(text: str) -> str:
    """Quote a text for a message, shortened if it is long."""
    return f"`{text}`" if len(text) <= 80 else f"`{text[:80]}...`"


def _remedy(text: str) -> str:
    return "write it like 12.5" if text else "remove rows that were not measured"
