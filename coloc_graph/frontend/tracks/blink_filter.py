"""Whether lights that blink are on: what the images say of many at once, as it goes on."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: In so many steps a bit passes.
STEPS = 16


class Lit:
    """Of n lights the chance that each is on, `on` (n,), at the last prediction.

    They go off for a `bit` [s], and then on for one at least: `rate` times a second of the time after that. Where `bit`
    is 0 they never go off.
    """

    def __init__(self, bit: float, rate: float) -> None:
        self._bit, self._rate = bit, rate
        self._time: float | None = None
        self.on = np.zeros(0)
        # how likely each is off, or on again, and so much of the bit has passed; and on for longer
        self._stage = np.zeros((0, 2 * STEPS + 1))

    def predict(self, time: float) -> None:
        """Go on to a later time [s]."""
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

    def see(self, seen: NDArray[np.bool_], detected: float) -> None:
        """Which lights (n,) were seen, where one that is on is `detected` with that chance."""
        if not self._bit:
            return
        self._stage[:, STEPS:] *= np.where(seen, 1.0, 1 - detected)[:, None]
        self._stage[:, :STEPS] *= ~seen[:, None]
        whole = self._stage.sum(axis=1)
        self._stage[whole < 1e-12, -1] = 1.0  # on against all odds
        self._stage /= self._stage.sum(axis=1)[:, None]

    def add(self, n: int) -> None:
        """So many more, which are on."""
        self.on = np.append(self.on, np.ones(n))
        self._stage = np.concatenate([self._stage, np.eye(1, 2 * STEPS + 1, 2 * STEPS).repeat(n, axis=0)])

    def keep(self, which: NDArray[np.bool_]) -> None:
        """Forget all others."""
        self.on, self._stage = self.on[which], self._stage[which]
