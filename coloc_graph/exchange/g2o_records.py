"""Records of a g2o file as arrays, a block for each tag, with the line of each record.

Lines of one tag are parsed together as JSON, at a tenth of the time that one by one takes; only where that fails are
they read one by one, which tells the line that is wrong.

Source: g2o's file format, https://github.com/RainerKuemmerle/g2o/wiki/File-Format
"""

import re
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.input_file import quoted

MAX_ID = 2**64 - 1
MAX_NUMBER = 1e100  # largest absolute value of a number
#: Number of ids and of numbers after them, by tag.
TAGS = {"VERTEX_SE2": (1, 3), "VERTEX_SE3:QUAT": (1, 7), "EDGE_SE2": (2, 9), "EDGE_SE3:QUAT": (2, 28)}
_ID = re.compile(r"[0-9]{1,20}")


@dataclass(frozen=True, eq=False)
class Block:
    """All n records of one tag.

    Attributes
    ----------
    ids
        Ids of each record's vertices, n tuples of 1 or 2.
    numbers
        Numbers after the ids, (n, k).
    lines
        Number of each record's line in the file, from 1.
    """

    ids: list[tuple[int, ...]]
    numbers: NDArray[np.float64]
    lines: list[int]


@dataclass(frozen=True, eq=False)
class G2oText:
    """Records of a file.

    Attributes
    ----------
    blocks
        Records by tag, of all `TAGS`.
    fixed
        Ids after FIX, each with its line.
    comments
        Comments in lines of their own, beginning with #.
    """

    blocks: dict[str, Block]
    fixed: list[tuple[int, int]]
    comments: list[str]


def bad_line(path: Path, line: int, what: str) -> InputError:
    """Return the error for a line of a file."""
    return InputError(f"{path}, line {line}: {what}")


def parse_g2o(path: Path, text: str) -> G2oText:
    """Parse the text of a g2o file.

    Raises `InputError`, which names the line, at unknown tags, wrong counts, ids or numbers.
    """
    found: dict[str, tuple[list[str], list[int]]] = {tag: ([], []) for tag in TAGS}
    fixed: list[tuple[int, int]] = []
    comments: list[str] = []
    for line, content in enumerate(text.split("\n"), start=1):
        if "#" in content:
            if content.lstrip().startswith("#"):
                comments.append(content.strip())
            content = content.split("#", 1)[0]
        tag, *rest = content.split(None, 1)[:2] or ("",)
        if tag in found:
            records, lines = found[tag]
            records.append(rest[0].rstrip() if rest else "")
            lines.append(line)
        elif tag == "FIX":
            if not rest:
                raise bad_line(path, line, "`FIX` has no id; give the vertices that do not move")
            fixed += [(_id(path, line, word), line) for word in rest[0].split()]
        elif tag:
            known = ", ".join((*TAGS, "FIX"))
            raise bad_line(path, line, f"{quoted(tag)} is not read; a graph of poses has {known}")
    return G2oText({tag: _block(path, tag, *those) for tag, those in found.items()}, fixed, comments)


def _block(path: Path, tag: str, records: list[str], lines: list[int]) -> Block:
    ids, count = TAGS[tag]
    if not records:
        return Block([], np.empty((0, count)), [])
    width, text = ids + count, ",".join(records)
    if "  " in text or "\t" in text:
        records = [" ".join(record.split()) for record in records]
        text = ",".join(records)
    if all(record.count(" ") == width - 1 for record in records):
        try:
            flat = msgspec.json.decode(f"[{text.replace(' ', ',')}]", type=list[int | float])
        except ValueError:  # JSON's numbers are not all that g2o's may be
            return _line_by_line(path, tag, records, lines)
        columns = [flat[column::width] for column in range(ids)]
        numbers = np.array(flat, np.float64).reshape(-1, width)[:, ids:]
        sound = all(type(one) is int and 0 <= one <= MAX_ID for column in columns for one in column)
        if sound and (np.abs(numbers) < MAX_NUMBER).all():
            return Block(list(zip(*columns, strict=True)), numbers, lines)
    return _line_by_line(path, tag, records, lines)


def _line_by_line(path: Path, tag: str, records: list[str], lines: list[int]) -> Block:
    ids, count = TAGS[tag]
    vertices, numbers = [], []
    for record, line in zip(records, lines, strict=True):
        words = record.split()
        try:
            row = [float(word) for word in words]
        except ValueError:
            raise bad_line(path, line, f"`{tag}` holds what is no number") from None
        if len(row) != ids + count or not all(abs(number) < MAX_NUMBER for number in row[ids:]):
            expected = f"{ids + count}, all finite, are expected"
            raise bad_line(path, line, f"`{tag}` has {len(row)} numbers; {expected}")
        vertices.append(tuple(_id(path, line, word) for word in words[:ids]))
        numbers.append(row[ids:])
    return Block(vertices, np.array(numbers, np.float64).reshape(-1, count), lines)


def _id(path: Path, line: int, word: str) -> int:
    if not _ID.fullmatch(word) or int(word) > MAX_ID:
        raise bad_line(path, line, f"{quoted(word)} is no id; ids are whole numbers from 0 to {MAX_ID}")
    return int(word)
