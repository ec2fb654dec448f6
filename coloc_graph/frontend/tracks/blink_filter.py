"""Filter the blink states of many lights, on or off, from image to image."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STEPS = 16  # time steps in a bit


class BlinkFilter:
    """Bayes filter of the blink states of n lights; `on` (n,) are the probabilities that they are on.

    A light goes off for one bit and is then on for at least one.

    Parameters
    ----------
    bit
        Duration of a bit [s]; 0 for lights that never go off.
    rate
        Rate at which a light goes off after that [1/s].
    """

    def __init__(self, bit: float, rate: float) -> None:
        self._bit, self._rate = bit, rate
        self._time: float | None = None
        self.on = np.zeros(0)
        # probabilities by the elapsed steps of the bit: off, on again; and last, on for longer than a bit
        self._stage = np.zeros((0, 2 * STEPS + 1))

    def predict(self, time: float) -> None:
        """Predict to a later time [s]."""
        dt = 0.0 if self._time is None else time - self._time
        self._time = time if self._time is None else max(time, self._time)
        if not self._bit or dt <= 0 or not len(self.on):
            return
        steps = min(STEPS * dt / self._bit, 2.0 * STEPS)
        whole = int(steps)
        share, long = steps - whole, self._stage[:, -1].copy()
        padded = np.concatenate([np.zeros((len(self.on), whole + 1)), self._stage[:, :-1]], axis=1)
        passing = (1 - share) * padded[:, 1 : 2 * STEPS + 1] + share * padded[:, : 2 * STEPS]
        goes = long * -np.expm1(-self._rate * dt)
        long += self._stage[:, :-1].sum(axis=1) - passing.sum(axis=1) - goes
        passing[:, min(int(steps / 2), STEPS - 1)] += goes
        self._stage = np.concatenate([passing, np.maximum(long, 0.0)[:, None]], axis=1)
        self.on = np.clip(self._stage[:, STEPS:].sum(axis=1), 1e-9, 1.0)

    def update(self, rows: Sequence[int], detected: float) -> None:
        """Update by the lights that were seen, `rows`; `detected` is the detection probability of one that is on."""
        if not self._bit:
            return
        seen = np.zeros(len(self.on), bool)
        seen[list(rows)] = True
        self._stage[:, STEPS:] *= np.where(seen, 1.0, 1 - detected)[:, None]
        self._stage[:, :STEPS] *= ~seen[:, None]
        whole = self._stage.sum(axis=1)
        self._stage[whole < 1e-12, -1] = 1.0  # impossible by the model, and seen: on
        self._stage /= self._stage.sum(axis=1)[:, None]

    def add(self, n: int) -> None:
        """Add n lights that are on."""
        self.on = np.append(self.on, np.ones(n))
        self._stage = np.concatenate([self._stage, np.eye(1, 2 * STEPS + 1, 2 * STEPS).repeat(n, axis=0)])

    def keep(self, which: NDArray[np.bool_]) -> None:
        """Remove all lights but those of a mask (n,)."""
        self.on, self._stage = self.on[which], self._stage[which]
