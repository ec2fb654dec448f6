"""Read text tables of numbers with comments after #, with line numbers for errors."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.input_file import quoted, read_text

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DatTable:
    """Table of numbers: `values` (n, columns), and the `lines` (n,) of the file that they are from, counted from 1."""

    path: Path
    values: Array
    lines: NDArray[np.int64]


def read_dat(path: Path, columns: int) -> DatTable:
    """Read a table with a given number of columns; `InputError` names the line of a wrong row."""
    text = read_text(path, "give the folder of a whole dataset, with the files as they were published")
    rows, lines = [], []
    for line, content in enumerate(text.split("\n"), start=1):
        words = content.split("#", 1)[0].split()
        if not words:
            continue
        if len(words) != columns:
            cut = " (the file was cut off there?)" if line >= text.count("\n") else ""
            raise InputError(f"{path}, line {line}: has {len(words)} columns and not {columns}{cut}; repair the row")
        rows.append(words)
        lines.append(line)
    if not rows:
        raise InputError(f"{path}: holds no row; give the file as it was published")
    try:
        values = np.array(rows, float)
    except ValueError:
        row, word = next((n, word) for n, words in enumerate(rows) for word in words if not _is_number(word))
        raise InputError(f"{path}, line {lines[row]}: {quoted(word)} is not a number; repair the row") from None
    bad = ~np.isfinite(values).all(axis=1)
    if bad.any():
        raise InputError(f"{path}, line {lines[int(bad.argmax())]}: holds a number that is not finite; repair the row")
    return DatTable(path, values, np.array(lines))


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
