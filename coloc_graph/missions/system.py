"""Clocks, threads, locks and queues of a simulated computer, as `machine.System` has them; `SimulatedSystem`."""

import errno
import queue
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import IO, Any, Self

from coloc_graph.missions.scheduler import OpenFile, Scheduler, Task

MIN_WORK = 0.3  # least time that a worker takes for a job [s]
MEAN_WORK = 0.4  # mean of the time that it takes longer [s]


class SimulatedSystem:
    """The system of whichever simulated process runs."""

    def __init__(self, scheduler: Scheduler) -> None:
        self._scheduler = scheduler

    def monotonic_ns(self) -> int:
        """Return the monotonic clock of the host [ns]."""
        return self._scheduler.clock()

    def time_ns(self) -> int:
        """Return the time of day of the host [ns]."""
        return self._scheduler.clock() + self._scheduler.host.utc

    def sleep(self, seconds: float) -> None:
        """Wait [s]."""
        self._scheduler.wait(seconds)

    def unique(self) -> str:
        """Return 32 hexadecimal digits."""
        return f"{self._scheduler.random.getrandbits(128):032x}"

    def event(self) -> "Event":
        """Return an event."""
        return Event(self._scheduler)

    def lock(self) -> "Lock":
        """Return a lock."""
        return Lock(self._scheduler)

    def condition(self) -> "Condition":
        """Return a condition."""
        return Condition(self._scheduler)

    def queue(self, size: int) -> "Queue":
        """Return a queue."""
        return Queue(self._scheduler, size)

    def thread(self, target: Callable[..., object], name: str, args: tuple[Any, ...]) -> "Thread":
        """Return a thread."""
        return Thread(self._scheduler, target, name, args)

    def current_thread(self) -> "Thread | None":
        """Return the thread that runs; None for the main one."""
        return None if self._scheduler.current is None else self._scheduler.current.thread

    def worker(self, name: str) -> "Worker":
        """Return an executor of one thread."""
        return Worker(self._scheduler, name)

    def use_disk(self) -> None:
        """Wait for a slow disk; raise `OSError` if it is full."""
        host = self._scheduler.host
        if host.disk_delay:
            self._scheduler.wait(host.disk_delay)
        if host.disk_full:
            raise OSError(errno.ENOSPC, "No space left on device")

    def opened(self, file: "int | IO[Any]") -> None:
        """Note an open file of the process."""
        assert self._scheduler.current is not None
        self._scheduler.current.process.files.append(OpenFile(file))


class _Waiters:
    """Tasks that wait for something."""

    def __init__(self, scheduler: Scheduler) -> None:
        self.scheduler = scheduler
        self._tasks: deque[Task] = deque()

    def wait(self, seconds: float | None) -> None:
        task = self.scheduler.current
        assert task is not None
        self._tasks.append(task)
        self.scheduler.wait(seconds)
        if task in self._tasks:
            self._tasks.remove(task)

    def wake(self) -> None:
        """Wake the task that has waited longest."""
        if self._tasks:
            self.scheduler.wake(self._tasks.popleft())

    def wake_all(self) -> None:
        """Wake all tasks."""
        while self._tasks:
            self.scheduler.wake(self._tasks.popleft())

    def until(self, met: Callable[[], bool], timeout: float | None) -> bool:
        """Wait until a condition is met, for `timeout` [s] at most; return whether it is."""
        if met():
            return True
        limit = None if timeout is None else self.scheduler.now + round(1e9 * timeout)
        while not met():
            left = None if limit is None else 1e-9 * (limit - self.scheduler.now)
            if left is not None and left <= 0:
                return False
            self.wait(left)
        return True


class Event:
    """As `threading.Event`."""

    def __init__(self, scheduler: Scheduler) -> None:
        self._set, self._waiters = False, _Waiters(scheduler)

    def is_set(self) -> bool:
        """Return whether it is set."""
        return self._set

    def set(self) -> None:
        """Set it."""
        self._set = True
        self._waiters.wake_all()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it is set."""
        return self._set or self._waiters.until(self.is_set, timeout)


class Lock:
    """As `threading.RLock`."""

    def __init__(self, scheduler: Scheduler) -> None:
        self._owner: Task | None = None
        self._count, self._waiters = 0, _Waiters(scheduler)

    def acquire(self, blocking: bool = True, timeout: float = -1) -> bool:
        """Take it."""
        scheduler = self._waiters.scheduler
        task = scheduler.current
        if self._owner is not task:
            scheduler.interrupt()
            if self._owner is not None:
                limit = None if timeout < 0 else timeout
                if not self._waiters.until(lambda: self._owner is None, limit if blocking else 0.0):
                    return False
            self._owner = task
        self._count += 1
        return True

    def release(self) -> None:
        """Let it go."""
        assert self._owner is self._waiters.scheduler.current
        self._count -= 1
        if not self._count:
            self._owner = None
            self._waiters.wake()

    def __enter__(self) -> Self:
        self.acquire()
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


class Condition(Lock):
    """As `threading.Condition`."""

    def __init__(self, scheduler: Scheduler) -> None:
        super().__init__(scheduler)
        self._notified = _Waiters(scheduler)

    def wait(self, timeout: float | None = None) -> None:
        """Wait for a notification."""
        count, self._count = self._count, 1
        self.release()
        self._notified.wait(timeout)
        self.acquire()
        self._count = count

    def wait_for(self, met: Callable[[], Any], timeout: float | None = None) -> bool:
        """Wait until a condition is met."""
        scheduler = self._waiters.scheduler
        limit = None if timeout is None else scheduler.now + round(1e9 * timeout)
        while not met():
            left = None if limit is None else 1e-9 * (limit - scheduler.now)
            if left is not None and left <= 0:
                return False
            self.wait(left)
        return True

    def notify_all(self) -> None:
        """Wake all that wait."""
        self._notified.wake_all()


class Queue:
    """As `queue.Queue`."""

    def __init__(self, scheduler: Scheduler, size: int) -> None:
        self._items: deque[Any] = deque()
        self._size, self._waiters, self._full = size, _Waiters(scheduler), _Waiters(scheduler)

    def put(self, item: Any, timeout: float | None = None) -> None:
        """Add an item."""
        if self._size and not self._full.until(lambda: len(self._items) < self._size, timeout):
            raise queue.Full
        self._items.append(item)
        self._waiters.wake()

    def put_nowait(self, item: Any) -> None:
        """Add an item, or raise `queue.Full`."""
        self.put(item, 0.0)

    def get(self, timeout: float | None = None) -> Any:
        """Take the first item, or raise `queue.Empty`."""
        if not (self._items or self._waiters.until(lambda: bool(self._items), timeout)):
            raise queue.Empty
        self._full.wake()
        return self._items.popleft()


class Thread:
    """As `threading.Thread`."""

    def __init__(self, scheduler: Scheduler, target: Callable[..., object], name: str, args: tuple[Any, ...]) -> None:
        self._scheduler, self.name, self._work = scheduler, name, lambda: target(*args)
        self._task: Task | None = None

    def start(self) -> None:
        """Start it in the present process."""
        assert self._scheduler.current is not None
        self._task = self._scheduler.spawn(self._work, self._scheduler.current.process, self.name)
        self._task.thread = self

    def is_alive(self) -> bool:
        """Return whether it runs."""
        return self._task is not None and not self._task.ended

    def join(self, timeout: float | None = None) -> None:
        """Wait for its end."""
        task, current = self._task, self._scheduler.current
        if task is not None and not task.ended and current is not None:
            task.joined.append(current)
            self._scheduler.wait(timeout)
            if current in task.joined:
                task.joined.remove(current)


class Worker(Executor):
    """As a `ThreadPoolExecutor` of one thread, which takes a random time for each job."""

    def __init__(self, scheduler: Scheduler, name: str) -> None:
        self._scheduler, self._jobs, self._ended = scheduler, Queue(scheduler, 0), False
        self._thread = Thread(scheduler, self._run, name, ())
        self._thread.start()

    def submit(self, work: Callable[..., Any], /, *args: Any, **kwargs: Any) -> "Future[Any]":
        """Have something done."""
        done: Future[Any] = Future()
        self._jobs.put((done, lambda: work(*args, **kwargs)))
        return done

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End after the present job."""
        self._ended = True
        self._jobs.put(None)
        if wait:
            self._thread.join()

    def _run(self) -> None:
        while not self._ended and (job := self._jobs.get()) is not None:
            done, work = job
            self._scheduler.wait(MIN_WORK + self._scheduler.random.expovariate(1 / MEAN_WORK))
            try:
                done.set_result(work())
            except BaseException as error:
                done.set_exception(error)
