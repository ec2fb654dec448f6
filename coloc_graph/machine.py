"""The machine on which a program of the online system runs: clocks, threads and their waiting, unique names; `machine`.

The online system uses it instead of `time`, `threading`, `queue` and `uuid`. It is the operating system's, unless a
simulation takes its place (`missions`), in which shipped code then runs on simulated time.
"""

import queue
import threading
import time
import uuid
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import IO, Any, BinaryIO, Protocol, TextIO, TypeVar

F = TypeVar("F", int, IO[str], IO[bytes], BinaryIO, TextIO)


class System(Protocol):
    """Parts of a machine, as in `time`, `threading` and `queue`."""

    def monotonic_ns(self) -> int:
        """Return the monotonic clock [ns]."""

    def time_ns(self) -> int:
        """Return the time of day [UTC ns]."""

    def sleep(self, seconds: float) -> None:
        """Wait [s]."""

    def unique(self) -> str:
        """Return a name that nobody else has."""

    def event(self) -> Any:
        """Return an event."""

    def lock(self) -> Any:
        """Return a lock, which the same thread may take again."""

    def condition(self) -> Any:
        """Return a condition with a lock of its own."""

    def queue(self, size: int) -> Any:
        """Return a queue of at most `size` items; 0 for no limit."""

    def thread(self, target: Callable[..., object], name: str, args: tuple[Any, ...]) -> Any:
        """Return a daemon thread."""

    def current_thread(self) -> Any:
        """Return the thread that runs."""

    def worker(self, name: str) -> Executor:
        """Return an executor of one thread."""

    def use_disk(self) -> None:
        """Wait, or raise `OSError`, before a file is written, where the disk is slow or full."""

    def opened(self, file: "int | IO[Any]") -> None:
        """Take note of an open file of this process."""


class OperatingSystem:
    """The operating system's clocks and threads."""

    monotonic_ns = staticmethod(time.monotonic_ns)
    time_ns = staticmethod(time.time_ns)
    sleep = staticmethod(time.sleep)
    event = threading.Event
    lock = staticmethod(threading.RLock)
    condition = threading.Condition
    current_thread = staticmethod(threading.current_thread)

    def unique(self) -> str:
        """Return 32 hexadecimal digits."""
        return uuid.uuid4().hex

    def queue(self, size: int) -> Any:
        """Return a queue of at most `size` items; 0 for no limit, which is faster."""
        return queue.Queue(size) if size else queue.SimpleQueue()

    def thread(self, target: Callable[..., object], name: str, args: tuple[Any, ...]) -> threading.Thread:
        """Return a daemon thread."""
        return threading.Thread(target=target, name=name, args=args, daemon=True)

    def worker(self, name: str) -> Executor:
        """Return an executor of one thread."""
        return ThreadPoolExecutor(1, thread_name_prefix=name)

    def use_disk(self) -> None:
        """Do nothing: the real disk refuses by itself."""

    def opened(self, file: "int | IO[Any]") -> None:
        """Do nothing: the operating system closes the files of a process that ends."""


class Machine:
    """The system's clocks and threads; those of a simulation while it is in `use`."""

    def __init__(self) -> None:
        self._system: System = OperatingSystem()

    def use(self, system: System) -> System:
        """Let another system take the place of the present one, which is returned."""
        before, self._system = self._system, system
        return before

    def monotonic(self) -> float:
        """Return CLOCK_MONOTONIC [s]."""
        return 1e-9 * self._system.monotonic_ns()

    def monotonic_ns(self) -> int:
        """Return CLOCK_MONOTONIC [ns]."""
        return self._system.monotonic_ns()

    def time_ns(self) -> int:
        """Return the time of day [UTC ns]."""
        return self._system.time_ns()

    def sleep(self, seconds: float) -> None:
        """Wait for `seconds` [s]."""
        self._system.sleep(seconds)

    def unique(self) -> str:
        """Return a name that nobody else has: 32 hexadecimal digits."""
        return self._system.unique()

    def new_event(self) -> threading.Event:
        """Return an event."""
        return self._system.event()  # type: ignore[no-any-return]

    def new_lock(self) -> "threading.RLock":
        """Return a lock, which the same thread may take again."""
        return self._system.lock()  # type: ignore[no-any-return]

    def new_condition(self) -> threading.Condition:
        """Return a condition with a lock of its own."""
        return self._system.condition()  # type: ignore[no-any-return]

    def new_queue(self, size: int = 0) -> "queue.Queue[Any]":
        """Return a queue of at most `size` items; 0 for any number."""
        return self._system.queue(size)  # type: ignore[no-any-return]

    def new_thread(self, target: Callable[..., object], name: str, args: tuple[Any, ...] = ()) -> threading.Thread:
        """Return a daemon thread, which is not started yet."""
        return self._system.thread(target, name, args)  # type: ignore[no-any-return]

    def current_thread(self) -> threading.Thread:
        """Return the thread that runs."""
        return self._system.current_thread()  # type: ignore[no-any-return]

    def new_worker(self, name: str) -> Executor:
        """Return an executor of one thread."""
        return self._system.worker(name)

    def use_disk(self) -> None:
        """Say that a file is about to be written. Raises `OSError` if a simulated disk refuses."""
        self._system.use_disk()

    def opened(self, file: F) -> F:
        """Say that a file was opened; return it. A simulated process that is killed loses it."""
        self._system.opened(file)
        return file


machine = Machine()
