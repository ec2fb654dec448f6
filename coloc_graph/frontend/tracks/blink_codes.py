"""Whose lights some tracks are, by how they blink: the likelihood of all that was seen and missed, under each code.

When a code began, and how fast the robot's clock goes, is not known: both are summed over. So is that the lights are
nobody's, whose bits are any: a code that does no better than this is not believed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from coloc_graph.frontend.tracks.tracking import Track

Array = NDArray[np.float64]

#: A robot that is less likely than this is not named.
SURE = 0.999
#: Of a light that is on, the chance that it is missed; of one that is off, that something else is taken for it.
MISSED = 0.05
FALSE = 0.02
#: The chance that a whole bit is not what it seems: hidden, or another light's.
WRONG_BIT = 0.02
#: A robot's clock may go wrong by this share, and images so near to the ends of a bit [bits] may be of the next one.
CLOCK = 5e-3
EDGE = 0.125
#: Longer than that nothing is looked back at [s].
LONGEST = 60.0
#: A code may begin at so many instants in a bit.
PHASES = 8
#: What share of its bits a light is on that blinks as none of the robots does, the last one all the time.
DUTIES = np.array([0.5, 0.7, 0.85, 0.95, 1.0])
#: The chance that a light blinks by a code, of up to so many bits, that no robot is said to have.
STRANGER = 1e-4
STRANGERS_BITS = 16


@dataclass(frozen=True, eq=False)
class BlinkCodes:
    """The codes of robots by their names; a bit lasts `bit` [s]."""

    codes: Mapping[str, str]
    bit: float

    @property
    def rate(self) -> float:
        """How often a light that is on goes off [1/s]."""
        return max(code.count("0") / code.count("1") for code in self.codes.values()) / self.bit

    def each(self, tracks: Sequence[Track]) -> list[Track]:
        """Tracks with the names of their robots (`Track.mover`), each by itself; "" where it is not sure."""
        return [replace(track, mover=self.whose([track])) for track in tracks]

    def bodies(self, tracks: Sequence[Track]) -> list[Track]:
        """The same for those that have no name yet, by all tracks of their body together."""
        unsure = {track.body for track in tracks if not track.mover and track.body >= 0}
        together = {body: self.whose([track for track in tracks if track.body == body]) for body in unsure}
        return [replace(track, mover=track.mover or together.get(track.body, "")) for track in tracks]

    def whose(self, tracks: Sequence[Track]) -> str:
        """The robot that blinks as tracks do, which are one's; "" where it is not sure."""
        chances = self.chances(tracks)
        best = int(np.argmax(chances))
        return tuple(self.codes)[best] if chances[best] >= SURE else ""

    def chances(self, tracks: Sequence[Track]) -> Array:
        """How likely each robot is the one whose tracks these are, (n,); what is left is the chance that none is."""
        on, off = self._bits(tracks)
        with np.errstate(divide="ignore"):
            log_on, log_off = np.log(DUTIES)[:, None, None], np.log1p(-DUTIES)[:, None, None]
        of_none = _mean(np.logaddexp(log_on + on, log_off + off).sum(axis=2))
        strangers = [
            _mean(np.logaddexp(np.log(0.75) + _folded(on, n), np.log(0.25) + _folded(off, n)).sum(axis=1))
            for n in range(2, STRANGERS_BITS + 1)
        ]
        of_codes = (self._evidence(code, on, off) for code in self.codes.values())
        evidence = np.array([*of_codes, of_none, _mean(np.array(strangers)) + np.log(STRANGER)])
        return np.asarray(np.exp(evidence - logsumexp(evidence)))[:-2]

    def _bits(self, tracks: Sequence[Track]) -> tuple[Array, Array]:
        """The logarithms of the likelihood of each bit, were it on and were it off, (k, b): at each of k rates and
        phases of the robot's clock."""
        end = max(track.times[-1] for track in tracks)
        length = min(end - min(track.times[0] for track in tracks), LONGEST)
        # a step of the rate is less than the edge of a bit at either end of it all
        rates = np.linspace(-CLOCK, CLOCK, 2 * int(np.ceil(4 * CLOCK * length / self.bit)) + 1)
        first = (1 + CLOCK) * length / 2 / self.bit + np.arange(PHASES)[:, None] / PHASES
        bits = int(np.ceil(2 * first.max()))
        on, off = np.zeros((2, len(rates) * PHASES, bits))
        row = np.arange(len(on)).reshape(len(rates), PHASES, 1) * bits
        for track in tracks:
            count = []
            for times in (track.times, track.missed):
                ago = end - times[(times >= end - length) & (times <= end)]
                at = first + (1 + rates[:, None, None]) * (length / 2 - ago) / self.bit
                number = np.floor(at)
                sharp = np.abs(at - number - 0.5) < 0.5 - EDGE
                flat = (row + number.astype(np.int64))[sharp]
                count.append(np.bincount(flat, minlength=on.size).reshape(on.shape))
            seen, missed = count
            as_on = seen * np.log(1 - MISSED) + missed * np.log(MISSED)
            as_off = seen * np.log(FALSE) + missed * np.log(1 - FALSE)
            on += np.logaddexp(np.log(1 - WRONG_BIT) + as_on, np.log(WRONG_BIT) + as_off)
            off += np.logaddexp(np.log(1 - WRONG_BIT) + as_off, np.log(WRONG_BIT) + as_on)
        return on, off

    def _evidence(self, code: str, on: Array, off: Array) -> float:
        n = len(code)
        lit = np.array([bit == "1" for bit in code])
        shifts = lit[(np.arange(n)[:, None] + np.arange(n)) % n]
        return _mean(_folded(on, n) @ shifts.T + _folded(off, n) @ ~shifts.T)


def _folded(bits: Array, n: int) -> Array:
    """What is known of the same bits of a code of length n, together: (k, n) of (k, b)."""
    padded = np.pad(bits, ((0, 0), (0, -bits.shape[1] % n)))
    return np.asarray(padded.reshape(len(bits), -1, n).sum(axis=1))


def _mean(logarithms: Array) -> float:
    """The logarithm of the mean of what some are the logarithms of."""
    return float(logsumexp(logarithms)) - float(np.log(logarithms.size))
