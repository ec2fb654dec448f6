"""Files from outside, read within bounds: size, depth and numbers are checked before anything is built of them."""

import datetime
import json
import re
import tomllib
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from coloc_graph.errors import InputError

T = TypeVar("T")

#: Largest table or graph [bytes]; the largest public ones are a tenth of it.
MAX_TABLE_SIZE = 256 * 1024 * 1024
#: Largest description: team, map, summary of a result [bytes].
MAX_DESCRIPTION_SIZE = 8 * 1024 * 1024
#: Parts of a dotted key of TOML (`a.b.c` has three); reading one takes time with their square.
MAX_KEY_PARTS = 32  # as in _LONG_KEY
#: Integers of TOML are of 64 bits.
MAX_INTEGER = 2**63
#: Characters of a value that are quoted in a sentence.
MAX_QUOTED = 60
#: Characters of another library's reason in a sentence.
MAX_REASON = 400
_BYTE_ORDER_MARKS = {b"\xff\xfe": "UTF-16", b"\xfe\xff": "UTF-16"}
_LONG_KEY = re.compile(r"""[\w"'-](?:[ \t]*\.[ \t]*[\w"'-]+){32}""")


def quoted(value: object) -> str:
    """A value as it is shown in a sentence, cut where it is long; nothing is written out in full that is large."""
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, list | tuple | set):
        return f"a list of {len(value)}"
    if isinstance(value, int) and not -(10**20) < value < 10**20:
        return f"a number of {value.bit_length()} bits"
    if isinstance(value, int | float):
        return str(value)
    text = str(value)
    return f"`{text}`" if len(text) <= MAX_QUOTED else f"`{text[:MAX_QUOTED]}...`"


def read_bytes(path: Path, remedy: str, *, limit: int = MAX_TABLE_SIZE, error: type[InputError] = InputError) -> bytes:
    """Content of a file, of at most `limit` bytes.

    Parameters
    ----------
    path
        File; of a pipe that does not end no more than the limit is read.
    remedy
        End of the sentence if it cannot be read, as "give the path of a team.toml".
    limit
        Largest size [bytes].
    error
        Kind of the error that is raised.

    Raises
    ------
    InputError
        If it cannot be read, or is larger.
    """
    try:
        with path.open("rb") as file:
            data = file.read(limit + 1)
    except OSError as why:
        raise error(f"{path}: cannot be read ({why.strerror}); {remedy}") from why
    except ValueError as why:  # a zero byte in its name
        raise error(f"{path}: cannot be read ({why}); {remedy}") from why
    if len(data) > limit:
        raise error(f"{path}: is larger than {limit / 2**20:g} MiB; {remedy}")
    return data


def decode_text(path: Path, data: bytes, remedy: str, *, error: type[InputError] = InputError) -> str:
    """Text of UTF-8 bytes, without the byte order mark that they may begin with.

    Raises
    ------
    InputError
        If they are not UTF-8; it names the line, or UTF-16.
    """
    for mark, name in _BYTE_ORDER_MARKS.items():
        if data.startswith(mark):
            raise error(f"{path}: is text in {name}; save it as UTF-8")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as why:
        line = data.count(b"\n", 0, why.start) + 1
        raise error(f"{path}, line {line}: is not UTF-8 text; {remedy}") from why


def read_text(path: Path, remedy: str, *, limit: int = MAX_TABLE_SIZE, error: type[InputError] = InputError) -> str:
    """Text of a UTF-8 file, with or without a byte order mark; see `read_bytes`."""
    return decode_text(path, read_bytes(path, remedy, limit=limit, error=error), remedy, error=error)


def read_toml(path: Path, remedy: str, *, error: type[InputError] = InputError) -> dict[str, Any]:
    """Content of a TOML file; see `parse_toml`."""
    return parse_toml(path, read_text(path, remedy, limit=MAX_DESCRIPTION_SIZE, error=error), error=error)


def parse_toml(path: Path, text: str, *, error: type[InputError] = InputError) -> dict[str, Any]:
    """Content of a TOML text, read in bounded time.

    Raises
    ------
    InputError
        If it is not TOML, is nested too deep, or holds an integer of more than 64 bits.
    """
    if long := _LONG_KEY.search(text):
        line = text.count("\n", 0, long.start()) + 1
        raise error(f"{path}, line {line}: a key has more than {MAX_KEY_PARTS} parts; shorten it")
    try:
        found = tomllib.loads(text)
    except RecursionError as why:
        raise error(f"{path}: is nested too deep; write tables and lists of a few levels") from why
    except ValueError as why:  # that of TOML, of a date that is none, of a number with too many digits
        raise error(f"{path}: is not TOML: {shortened(why)}") from why
    _require_numbers(path, found, error)
    return found


def convert(path: Path, fields: Any, kind: type[T], remedy: str, *, error: type[InputError] = InputError) -> T:
    """Fields of a TOML or JSON file as a typed record.

    Raises
    ------
    InputError
        If a field is missing, unknown or wrong; it names the path in the file.
    """
    dates = (datetime.datetime, datetime.date, datetime.time)
    try:
        return msgspec.convert(fields, kind, builtin_types=dates, str_keys=True)
    except (msgspec.ValidationError, RecursionError, OverflowError) as why:
        raise error(f"{path}: {shortened(why)}; {remedy}") from why


def _require_numbers(path: Path, found: dict[str, Any], error: type[InputError]) -> None:
    left: list[tuple[str, Any]] = list(found.items())
    while left:
        name, value = left.pop()
        if isinstance(value, dict):
            left += value.items()
        elif isinstance(value, list):
            left += ((name, one) for one in value)
        elif isinstance(value, int) and not -MAX_INTEGER <= value < MAX_INTEGER:
            raise error(f"{path}: `{name[:MAX_QUOTED]}` is {quoted(value)}; give an integer of 64 bits at most")


def read_json(path: Path, remedy: str, *, error: type[InputError] = InputError) -> Any:
    """Content of a JSON file.

    Raises
    ------
    InputError
        If it cannot be read, is not JSON, or is nested too deep.
    """
    text = read_text(path, remedy, limit=MAX_DESCRIPTION_SIZE, error=error)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as why:
        raise error(f"{path}: is damaged ({shortened(why)}); {remedy}") from why


def shortened(why: Exception) -> str:
    """Reason that another library gives, on one line, cut where it is long."""
    text = " ".join(str(why).split())
    return text if len(text) <= MAX_REASON else f"{text[: MAX_REASON // 2]} ... {text[-MAX_REASON // 2 :]}"
