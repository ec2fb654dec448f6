"""The watchdog process of a simulated robot, on the timer of the real one; `SimulatedWatchdog`."""

import queue
from collections import deque
from collections.abc import Callable

from coloc_graph.missions.scheduler import Process, Scheduler
from coloc_graph.missions.system import Queue
from coloc_graph.robot_io.create import protocol as oi
from coloc_graph.robot_io.create.line import LEAVE
from coloc_graph.robot_io.create.watchdog import BEAT_PERIOD, LAST_STOPS, REPEAT_PERIOD, STANDING, StopTimer

END = -1  # the driver has closed the line and needs no watchdog


class SimulatedWatchdog:
    """A process beside the driver's; both ends of its pipe.

    Parameters
    ----------
    scheduler
        Simulated time.
    driver
        The driver's process.
    send
        Sends bytes to the robot.
    """

    def __init__(self, scheduler: Scheduler, driver: Process, send: Callable[[bytes], None]) -> None:
        self._scheduler, self._send = scheduler, send
        self.process = Process(f"watchdog of {driver.name}", driver.host)
        self._pipe, self._deadline, self._sent = Queue(scheduler, 0), STANDING, 0.0
        self._unanswered: deque[float] = deque()
        driver.at_end.append(lambda: self._pipe.put(None))
        scheduler.spawn(self._stand_by, self.process, self.process.name)

    def permit(self, until: float | None) -> None:
        """Set the time until which the wheels may turn [s, monotonic], None when they stand."""
        self._deadline = STANDING if until is None else round(1e9 * until)
        self._say()

    def beat(self) -> None:
        """Show that the driver runs."""
        if self._now() - self._sent >= BEAT_PERIOD:
            self._say()

    @property
    def silence(self) -> float:
        """Time since the earliest message that was not answered [s]."""
        return self._now() - self._unanswered[0] if self._unanswered else 0.0

    def end(self) -> None:
        """End the watchdog."""
        self._pipe.put(END)

    def _now(self) -> float:
        return 1e-9 * self.process.host.clock(self._scheduler.now)

    def _say(self) -> None:
        self._sent = self._now()
        self._unanswered.append(self._sent)
        self._pipe.put(self._deadline)

    def _stand_by(self) -> None:
        timer = StopTimer(self._now())
        while True:
            now = self._now()
            if timer.due(now):
                self._send(oi.HALT)
            try:
                word = self._pipe.get(max(timer.next(now) - now, 0.0))
            except queue.Empty:
                continue
            if word is None:
                break
            if word == END:
                return
            self._unanswered.popleft()
            timer.take(word, self._now())
        for _ in range(LAST_STOPS):
            self._send(oi.HALT)
            self._scheduler.wait(REPEAT_PERIOD)
        self._send(LEAVE)
