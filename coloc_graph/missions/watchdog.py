"""The watchdog process of a simulated robot, on the timer of the real one; `SimulatedWatchdog`."""

from collections.abc import Callable

from coloc_graph.missions.scheduler import LATENESS, Process, Scheduler
from coloc_graph.robot_io.create import protocol as oi
from coloc_graph.robot_io.create.line import LEAVE
from coloc_graph.robot_io.create.watchdog import BEAT_PERIOD, LAST_STOPS, REPEAT_PERIOD, STANDING, StopTimer


class SimulatedWatchdog:
    """A process beside the driver's, which is never held up; both ends of its pipe.

    Parameters
    ----------
    scheduler
        Simulated time.
    driver
        The driver's process.
    send
        Sends bytes to the robot.
    """

    silence = 0.0  # time since the earliest message that was not answered [s]

    def __init__(self, scheduler: Scheduler, driver: Process, send: Callable[[bytes], None]) -> None:
        self._scheduler, self._host, self._send = scheduler, driver.host, send
        self._deadline, self._sent, self._ended = STANDING, 0.0, False
        self._timer, self._waits_until = StopTimer(self._now()), 0.0
        driver.at_end.append(self._take_over)
        self._wait()

    def permit(self, until: float | None) -> None:
        """Set the time until which the wheels may turn [s, monotonic], None when they stand."""
        self._deadline = STANDING if until is None else round(1e9 * until)
        self._say(self._now())

    def beat(self) -> None:
        """Show that the driver runs."""
        now = self._now()
        if now - self._sent >= BEAT_PERIOD:
            self._say(now)

    def end(self) -> None:
        """End the watchdog: the driver has closed the line and needs it no longer."""
        self._ended = True

    def _now(self) -> float:
        return 1e-9 * self._host.clock(self._scheduler.now)

    def _say(self, now: float) -> None:
        self._sent = now
        self._timer.take(self._deadline, now)
        if self._timer.next(now) < self._waits_until:
            self._wait()

    def _wait(self) -> None:
        """Look again when a stop command is due next."""
        now = self._now()
        self._waits_until = until = self._timer.next(now)
        late = self._scheduler.exponential(LATENESS)
        self._scheduler.call_in(max(until - now, 0.0) + late, lambda: self._look(until))

    def _look(self, until: float) -> None:
        """Stop the wheels if that is due, unless the wait `until` now was replaced by a shorter one."""
        if self._ended or until != self._waits_until:
            return
        if self._timer.due(self._now()):
            self._send(oi.HALT)
        self._wait()

    def _take_over(self) -> None:
        """Stop the wheels: the driver has ended without a word."""
        if not self._ended:
            self._ended = True
            for n in range(LAST_STOPS):
                self._scheduler.call_in(n * REPEAT_PERIOD, lambda: self._send(oi.HALT))
            self._scheduler.call_in(LAST_STOPS * REPEAT_PERIOD, lambda: self._send(LEAVE))
