"""Threads of several simulated computers in one real thread, one at a time, on simulated time; `Scheduler`.

A task is a greenlet. It runs until it waits; then simulated time goes on to the next task that is due. A generator of
one seed draws how late each task wakes and where it is interrupted, so that one seed is one interleaving.
"""

import contextlib
import heapq
import math
import os
import random
from collections.abc import Callable
from typing import IO, Any

from greenlet import GreenletExit, getcurrent, greenlet

from coloc_graph.errors import ColocError

LATENESS = 60e-6  # mean time by which a task wakes late [s]
INTERRUPTED = 0.02  # share of the times at which a task takes a lock where others run first
MAX_READINGS = 200_000  # readings of clocks after which time should have gone on


class Stuck(ColocError):
    """Simulated time does not go on: a task runs in a loop without waiting."""


class Host:
    """A simulated computer: its clocks and its disk.

    Attributes
    ----------
    ahead
        Monotonic clock minus simulated time [ns].
    drift
        Rate of the clock, less 1.
    utc
        Time of day minus monotonic clock [ns].
    disk_full
        True if nothing can be written.
    disk_delay
        Time that each write takes [s].
    """

    def __init__(self, name: str, ahead: int, drift: float, utc: int) -> None:
        self.name, self.ahead, self.drift, self.utc = name, ahead, drift, utc
        self.disk_full, self.disk_delay = False, 0.0

    def clock(self, now: int) -> int:
        """Return the monotonic clock at a simulated time [ns]."""
        return now + self.ahead + int(self.drift * now)


class OpenFile:
    """A file that a process has opened, by its descriptor or as Python has it."""

    def __init__(self, file: "int | IO[Any]") -> None:
        self._file, self._descriptor = file, file if isinstance(file, int) else file.fileno()
        self._identity = self._found()

    def _found(self) -> tuple[int, int] | None:
        with contextlib.suppress(OSError):
            found = os.fstat(self._descriptor)
            return found.st_dev, found.st_ino
        return None

    def lose(self) -> None:
        """Close it as the system does when a process is killed: what Python holds back goes nowhere, locks go."""
        if self._found() == self._identity is not None:  # the descriptor is not of another file by now
            nowhere = os.open(os.devnull, os.O_WRONLY | os.O_CLOEXEC)
            os.dup2(nowhere, self._descriptor, inheritable=False)
            os.close(nowhere)
            self._identity = self._found()

    def close(self) -> None:
        """Close it, if it is open."""
        if not isinstance(self._file, int):
            with contextlib.suppress(OSError, ValueError):
                self._file.close()
        elif self._found() == self._identity is not None:
            os.close(self._descriptor)


class Process:
    """A simulated process of a host: tasks that are stopped, continued and killed together."""

    def __init__(self, name: str, host: Host) -> None:
        self.name, self.host = name, host
        self.alive, self.stopped = True, False
        self.held_up: list[Task] = []
        self.files: list[OpenFile] = []
        self.at_end: list[Callable[[], None]] = []


class Task:
    """A thread of a process."""

    def __init__(self, work: Callable[[], object], process: Process, name: str, parent: greenlet) -> None:
        self.process, self.name = process, name
        self.thread: Any = None  # the `Thread` of this task, if it has one
        self.ended = self.hung = self.waits_hung = False
        self.turn = 0  # number of the wake-up that counts; earlier ones are void
        self.error: BaseException | None = None
        self.joined: list[Task] = []
        self.greenlet = greenlet(lambda: self._run(work), parent)

    def _run(self, work: Callable[[], object]) -> None:
        try:
            work()
        except BaseException as error:
            self.error = error
        self.ended = True


class Scheduler:
    """Runs tasks in the order of simulated time; `seed` draws what is left open."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.now = 0
        self.hub = getcurrent()
        self.current: Task | None = None
        self.tasks: list[Task] = []  # all, so that those that never end are not ended by the garbage collector
        self.faults: list[tuple[str, BaseException]] = []
        self._due: list[tuple[int, int, Any, int]] = []
        self._number = 0
        self._readings = 0
        self._calm = 0  # locks that are taken until others run first
        self._closed = False

    def close(self) -> None:
        """End all tasks: from now on whoever waits is ended."""
        self._closed = True
        for process in {id(task.process): task.process for task in self.tasks}.values():
            self.kill(process)
        for task in self.tasks:
            self.current = task
            if task.greenlet and not task.ended:
                task.greenlet.throw(GreenletExit)
        self.current = None
        for task in self.tasks:
            for file in task.process.files:
                file.close()
            task.process.files.clear()

    def spawn(self, work: Callable[[], object], process: Process, name: str) -> Task:
        """Start a task."""
        task = Task(work, process, name, self.hub)
        self.tasks.append(task)
        self._push(self.now, task, task.turn)
        return task

    def call_at(self, time: int, call: Callable[[], None]) -> None:
        """Call something, which must not wait, at a simulated time [ns]."""
        self._push(max(time, self.now), call, 0)

    def call_in(self, seconds: float, call: Callable[[], None]) -> None:
        """Call something after a time [s]."""
        self._push(self.now + int(1e9 * seconds) if seconds > 0 else self.now, call, 0)

    def wait(self, seconds: float | None = None) -> None:
        """Let the present task wait for `seconds` [s], None for ever, unless it is woken before."""
        if self._closed:
            raise GreenletExit
        task = self.current
        assert task is not None and getcurrent() is task.greenlet, "only a task can wait"
        task.turn += 1
        if seconds is not None:
            late = self.exponential(LATENESS)
            self._push(self.now + int(1e9 * (late + seconds if seconds > 0 else late)), task, task.turn)
        self.hub.switch()

    def exponential(self, mean: float) -> float:
        """Draw from an exponential distribution."""
        return -math.log(1.0 - self.random.random()) * mean

    def wake(self, task: Task) -> None:
        """Let a waiting task run now."""
        task.turn += 1
        self._push(self.now, task, task.turn)

    def interrupt(self) -> None:
        """Let others run first, now and then."""
        self._calm -= 1
        if self._calm < 0 and self.current is not None:
            self._calm = int(self.exponential(1 / INTERRUPTED))
            self.wait(self.random.random() * 1e-3)

    def clock(self) -> int:
        """Return the monotonic clock of the present host [ns]."""
        self._readings += 1
        if self._readings > MAX_READINGS:
            raise Stuck(f"{self.current and self.current.name} reads the clock for ever at {self.now} ns")
        assert self.current is not None
        return self.current.process.host.clock(self.now)

    @property
    def host(self) -> Host:
        """Host of the present task."""
        assert self.current is not None
        return self.current.process.host

    def run(self, ended: Callable[[], bool], until: float) -> bool:
        """Run until something has ended, or until a simulated time [s]; return whether it has ended."""
        limit, due = round(1e9 * until), self._due
        while not ended():
            if not due or due[0][0] > limit:
                self.now = limit
                return False
            time, _, task, turn = heapq.heappop(due)
            if time > self.now:
                self.now, self._readings = time, 0
            if not isinstance(task, Task):
                task()
            elif task.turn == turn and not task.ended and task.process.alive:
                if task.process.stopped:
                    task.process.held_up.append(task)
                elif task.hung:
                    task.waits_hung = True
                else:
                    self._switch_to(task)
        return True

    def kill(self, process: Process) -> None:
        """End a process without a word: its tasks never run again, its files are closed as they are."""
        if not process.alive:
            return
        process.alive = False
        for file in process.files:
            file.lose()
        for call in process.at_end:
            call()

    def stop(self, process: Process) -> None:
        """Stop a process (SIGSTOP)."""
        process.stopped = True

    def go_on(self, process: Process) -> None:
        """Continue a process (SIGCONT)."""
        process.stopped = False
        held_up, process.held_up = process.held_up, []
        for task in held_up:
            self._push(self.now, task, task.turn)

    def unhang(self, task: Task) -> None:
        """Let a task go on that was hung."""
        task.hung = False
        if task.waits_hung:
            task.waits_hung = False
            self._push(self.now, task, task.turn)

    def _switch_to(self, task: Task) -> None:
        self.current = task
        task.greenlet.switch()
        self.current = None
        if task.ended:
            for other in task.joined:
                self.wake(other)
            if task.error is not None:
                self.faults.append((task.name, task.error))

    def _push(self, time: int, what: Any, turn: int) -> None:
        self._number += 1
        heapq.heappush(self._due, (time, self._number, what, turn))
