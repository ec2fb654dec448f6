"""Lock of an output against a second writer, released by the system after a crash."""

import contextlib
import errno
import fcntl
import os
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path

from coloc_graph.errors import InputError
from coloc_graph.machine import machine

#: Errors by file systems without locks.
_WITHOUT_LOCKS = {errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS}

_held: ContextVar[frozenset[Path]] = ContextVar("outputs locked by this thread", default=frozenset())


class OutputLock:
    """Exclusive lock on the output `path`, taken when it is made and held until `release`.

    The lock is that of `flock` on `.NAME.lock` beside the output, which is removed when the lock is released. A file
    that a killed process left behind is not locked, and is reused.

    Raises
    ------
    InputError
        Another writer holds the lock.
    OSError
        The lock's file cannot be made.
    """

    def __init__(self, path: str | Path) -> None:
        output = Path(path).absolute()
        self._path = output.with_name(f".{output.name}.lock")
        self._file: int | None = None
        while self._file is None:
            flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK
            file = machine.opened(os.open(self._path, flags, 0o600))
            try:
                _lock(file, path)
                # its last holder may have removed it between the two steps
                if os.path.samestat(os.fstat(file), os.lstat(self._path)):
                    self._file = file
            except FileNotFoundError:
                continue
            finally:
                if self._file is None:
                    os.close(file)

    def release(self) -> None:
        """Release the lock; a second call does nothing."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._path.unlink()
            os.close(self._file)
            self._file = None


def _lock(file: int, path: str | Path) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise InputError(
            f"{path} is being written by another command; wait until it has ended, or give another path"
        ) from None
    except OSError as error:
        if error.errno not in _WITHOUT_LOCKS:
            raise


@contextlib.contextmanager
def locked_output(path: str | Path) -> Iterator[None]:
    """Hold the lock on an output while the block runs.

    A nested block of the same thread for the same output shares it. Folders above the output are made, and removed
    again where they stay empty.

    Raises
    ------
    InputError
        Another writer holds the lock.
    """
    output = Path(path).resolve()  # the target of a link is the same output
    if output in _held.get():
        yield
        return
    missing = [folder for folder in output.parents if not folder.exists()]
    output.parent.mkdir(parents=True, exist_ok=True)
    lock = OutputLock(output)
    token = _held.set(_held.get() | {output})
    try:
        yield
    finally:
        _held.reset(token)
        lock.release()
        for folder in missing:
            with contextlib.suppress(OSError):
                folder.rmdir()
