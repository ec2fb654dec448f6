"""Files that are there whole or not at all."""

import os
import tempfile
from contextlib import suppress
from pathlib import Path

from coloc_graph.errors import InputError


def require_writable(path: str | Path, *, force: bool = False, what: str = "a file") -> None:
    """Raise `InputError` where a file cannot be written at `path`, or is there already, unless with `force`."""
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path} is a folder; give the path of {what}")
    if path.exists() and not force:
        raise InputError(f"{path} exists; replace it with --force, or give another path")
    if not path.absolute().parent.is_dir():
        raise InputError(f"{path} cannot be written, since its folder does not exist; make it, or give another path")


def write_whole(path: Path, data: str | bytes) -> None:
    """Write a file that is there whole or not at all; where there was one, it keeps its rights. A link stays one."""
    path = path.resolve()
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}-", delete=False) as part:
        try:
            part.write(data.encode() if isinstance(data, str) else data)
            part.close()
            # such a file is its owner's alone, where others are as the system has it
            mask = os.umask(0)
            os.umask(mask)
            Path(part.name).chmod(path.stat().st_mode & 0o777 if path.exists() else 0o666 & ~mask)
            Path(part.name).replace(path)
        except BaseException:
            with suppress(FileNotFoundError):
                Path(part.name).unlink()
            raise
