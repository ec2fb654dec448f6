"""Atomic writes of files."""

import os
import secrets
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

from coloc_graph.errors import InputError

_RANDOM_BYTES = 8  # bytes of the random part of a temporary name


def require_writable(path: str | Path, *, force: bool = False, what: str = "a file") -> None:
    """Raise `InputError` if no file can be written at `path`, or if one is there and `force` is not given."""
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path} is a folder; give the path of {what}")
    if os.path.lexists(path) and not force:
        raise InputError(f"{path} exists; replace it with --force, or give another path")
    if not path.absolute().parent.is_dir():
        raise InputError(f"{path} cannot be written: its folder does not exist; create it, or give another path")


def require_replaceable_folder(path: str | Path, names: Collection[str], *, force: bool = False) -> None:
    """Raise `InputError` if no folder can be written at `path`, or if one is there and may not be replaced.

    Parameters
    ----------
    path
        Folder to write.
    names
        Names, or endings of names (".tum"), of the files that it would hold. A folder with any other is never replaced.
    force
        Replace a folder of such files.
    """
    path = Path(path)
    if not os.path.lexists(path):
        return
    if not force:
        raise InputError(f"{path} exists; replace it with --force, or give another path")
    if path.is_symlink() or not path.is_dir():
        raise InputError(f"{path} is not a folder; give another path")
    other = [one.name for one in path.iterdir() if not any(one.is_file() and one.name.endswith(name) for name in names)]
    if other:
        raise InputError(f"{path} holds {min(other)}, which this command does not write; give another path")


def open_part(path: Path) -> tuple[int, Path]:
    """Create the temporary file of an output, beside it, under an unpredictable name.

    The file is new (`O_EXCL`) and no link is followed (`O_NOFOLLOW`); its permissions are those of new files. Its name
    is `NAME.<random>.part`, so that files of killed processes can be found.

    Parameters
    ----------
    path
        The output.

    Returns
    -------
    tuple
        File descriptor, open for writing, and path of the temporary file.
    """
    part = path.with_name(f"{path.name}.{secrets.token_hex(_RANDOM_BYTES)}.part")
    return os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666), part


def parts_left(path: Path) -> list[Path]:
    """Return the temporary files of an output (see `open_part`) that killed processes left beside it, by name."""
    return sorted(one for one in path.parent.glob("*.part") if _is_part(one.name, path.name) and one.is_file())


def _is_part(name: str, of: str) -> bool:
    random = name.removeprefix(f"{of}.").removesuffix(".part")
    return len(random) == 2 * _RANDOM_BYTES and f"{of}.{random}.part" == name and set(random) <= set("0123456789abcdef")


def write_atomically(path: Path, data: str | bytes, *, synchronise: bool = False) -> None:
    """Write a file atomically; a replaced file keeps its permissions, and a link stays a link.

    Parameters
    ----------
    path
        Output.
    data
        Content; text is written as UTF-8.
    synchronise
        Synchronise the content to the disk before the file gets its name.
    """
    if path.is_symlink():
        path = path.resolve()
    file, part = open_part(path)
    try:
        with os.fdopen(file, "wb") as stream:
            stream.write(data.encode() if isinstance(data, str) else data)
            if synchronise:
                stream.flush()
                os.fsync(stream.fileno())
        if path.exists():
            part.chmod(path.stat().st_mode & 0o777)
        part.replace(path)
    except BaseException:
        with suppress(FileNotFoundError):
            part.unlink()
        raise
