"""Sensor feed: the newest state and the odometry from a Create's frames; `SensorFeed`."""

import math
from collections import deque
from collections.abc import Callable, Mapping

from coloc_graph.machine import machine
from coloc_graph.robot_io.create.odometry import DeltaOdometry, EncoderOdometry, Odometer
from coloc_graph.robot_io.create.state import CreateState, read_state
from coloc_graph.run.messages import OdometrySample


class SensorFeed:
    """State and odometry, made from frames by one thread with `take` and read by others.

    Times are UTC [s], continued by the monotonic clock.
    """

    def __init__(self, model: int, robot: str, period: float, epoch: float | None = None) -> None:
        self.state: CreateState | None = None
        self.sample: OdometrySample | None = None
        #: Time of the newest frame [s, monotonic].
        self.last = machine.monotonic()
        self._epoch = 1e-9 * machine.time_ns() - self.last if epoch is None else epoch
        # a Create 1 reports its distance seldom, and then all of it
        self._odometer = Odometer(robot, period) if model == 2 else Odometer(robot, period, math.inf)
        self._way = EncoderOdometry() if model == 2 else DeltaOdometry()
        self._samples: deque[OdometrySample] = deque(maxlen=20_000)
        self._fresh = machine.new_condition()

    def take(self, values: Mapping[int, int]) -> CreateState | None:
        """Take in a frame that has just come; return its state, None if it is damaged though its checksum fits."""
        now = machine.monotonic()
        try:
            state = read_state(values, self._epoch + now)
        except ValueError:
            return None
        step = self._way.step(values, now - self.last)
        samples = self._odometer.add(state.time, *step) if step is not None else []
        with self._fresh:
            self.state, self.last = state, now
            if samples:
                self.sample = samples[-1]
                self._samples += samples
        return state

    def notify(self) -> None:
        """Wake those who wait for a frame, once all that follows from it is done."""
        with self._fresh:
            self._fresh.notify_all()

    def take_samples(self) -> list[OdometrySample]:
        """Return the samples since the last call."""
        with self._fresh:
            taken = list(self._samples)
            self._samples.clear()
        return taken

    def wait(self, met: Callable[[], bool], given_up: Callable[[], bool], timeout: float) -> bool:
        """Wait for a frame that meets a condition.

        Returns
        -------
        bool
            True if the condition is met within `timeout` [s], False if not, or if it was given up.
        """
        until = machine.monotonic() + timeout
        with self._fresh:
            while not met():
                left = until - machine.monotonic()
                if left <= 0 or given_up():
                    return False
                self._fresh.wait(min(left, 0.05))
        return True

    @property
    def age(self) -> float:
        """Age of the newest frame [s]."""
        return machine.monotonic() - self.last

    @property
    def told_to_move(self) -> bool:
        """True if the robot reports a requested speed other than 0."""
        return self.state is not None and any(self.state.requested)

    @property
    def because(self) -> str:
        """Present hazards as the end of a sentence, empty if there are none."""
        if self.state is None or self.age > 0.3:
            return " because no sensor data come"
        why = " and ".join(self.state.hazards().values())
        return f" because of {why}" if why else ""
