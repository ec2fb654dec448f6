"""Identify the robot of a track by its blink code, from the likelihood of every detection and miss under each code.

The phase of a code and the drift of the robot's clock are unknown and marginalised. Lights of no robot, with arbitrary
bits or an unknown code, are alternatives that a code must beat.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from coloc_graph.frontend.tracks.track import Track

Array = NDArray[np.float64]

MIN_POSTERIOR = 0.999  # probability below which no robot is named
MISS_RATE = 0.05  # probability that a light that is on is not detected
FALSE_RATE = 0.02  # probability that something else is taken for a light that is off
BIT_ERROR_RATE = 0.02  # probability that a whole bit is wrong, since the light is hidden or another's
MAX_DRIFT = 5e-3  # relative error of a robot's clock
BIT_EDGE = 0.125  # bits; images nearer to a transition are not used
MAX_DURATION = 60.0  # s, of a track's most recent part that is evaluated
PHASES = 8  # phases of a code that are tried in each bit
DUTY_CYCLES = np.array([0.5, 0.7, 0.85, 0.95, 1.0])  # of lights with random bits; the last one is always on
UNKNOWN_CODE_PRIOR = 1e-4  # probability of a code that no robot of the team has
MAX_UNKNOWN_CODE_BITS = 16  # length of such a code


@dataclass(frozen=True, eq=False)
class BlinkCodes:
    """Blink codes of robots by name; a bit lasts `bit` [s]."""

    codes: Mapping[str, str]
    bit: float

    @property
    def rate(self) -> float:
        """Largest rate at which a light that is on goes off [1/s]."""
        return max(code.count("0") / code.count("1") for code in self.codes.values()) / self.bit

    def name_tracks(self, tracks: Sequence[Track]) -> list[Track]:
        """Name the robot of each track (`Track.mover`) by its own blinking; "" if it is uncertain."""
        return [replace(track, mover=self.robot_of([track])) for track in tracks]

    def name_bodies(self, tracks: Sequence[Track]) -> list[Track]:
        """Name the robots of tracks without one by all tracks of the same body (`Track.body`)."""
        unsure = {track.body for track in tracks if not track.mover and track.body >= 0}
        together = {body: self.robot_of([track for track in tracks if track.body == body]) for body in unsure}
        return [replace(track, mover=track.mover or together.get(track.body, "")) for track in tracks]

    def robot_of(self, tracks: Sequence[Track]) -> str:
        """Name of the robot whose code tracks of one body show; "" if it is uncertain."""
        posteriors = self.posteriors(tracks)
        best = int(np.argmax(posteriors))
        return tuple(self.codes)[best] if posteriors[best] >= MIN_POSTERIOR else ""

    def posteriors(self, tracks: Sequence[Track]) -> Array:
        """Posterior probability (n,) of each robot, given tracks of one body; the rest to 1 is that of none."""
        on, off = self._bits(tracks)
        with np.errstate(divide="ignore"):
            log_on, log_off = np.log(DUTY_CYCLES)[:, None, None], np.log1p(-DUTY_CYCLES)[:, None, None]
        of_none = _mean(np.logaddexp(log_on + on, log_off + off).sum(axis=2))
        unknown = [
            _mean(np.logaddexp(np.log(0.75) + _folded(on, n), np.log(0.25) + _folded(off, n)).sum(axis=1))
            for n in range(2, MAX_UNKNOWN_CODE_BITS + 1)
        ]
        of_codes = (self._evidence(code, on, off) for code in self.codes.values())
        evidence = np.array([*of_codes, of_none, _mean(np.array(unknown)) + np.log(UNKNOWN_CODE_PRIOR)])
        return np.asarray(np.exp(evidence - logsumexp(evidence)))[:-2]

    def _bits(self, tracks: Sequence[Track]) -> tuple[Array, Array]:
        """Log likelihoods (k, b) of each of b bits being on and being off, for k drifts and phases of the clock."""
        end = max(track.times[-1] for track in tracks)
        length = min(end - min(track.times[0] for track in tracks), MAX_DURATION)
        # steps of the drift move either end by less than the edge of a bit
        rates = np.linspace(-MAX_DRIFT, MAX_DRIFT, 2 * int(np.ceil(4 * MAX_DRIFT * length / self.bit)) + 1)
        first = (1 + MAX_DRIFT) * length / 2 / self.bit + np.arange(PHASES)[:, None] / PHASES
        bits = int(np.ceil(2 * first.max()))
        on, off = np.zeros((2, len(rates) * PHASES, bits))
        row = np.arange(len(on)).reshape(len(rates), PHASES, 1) * bits
        for track in tracks:
            count = []
            for times in (track.times, track.missed):
                ago = end - times[(times >= end - length) & (times <= end)]
                at = first + (1 + rates[:, None, None]) * (length / 2 - ago) / self.bit
                number = np.floor(at)
                sharp = np.abs(at - number - 0.5) < 0.5 - BIT_EDGE
                flat = (row + number.astype(np.int64))[sharp]
                count.append(np.bincount(flat, minlength=on.size).reshape(on.shape))
            seen, missed = count
            as_on = seen * np.log(1 - MISS_RATE) + missed * np.log(MISS_RATE)
            as_off = seen * np.log(FALSE_RATE) + missed * np.log(1 - FALSE_RATE)
            on += np.logaddexp(np.log(1 - BIT_ERROR_RATE) + as_on, np.log(BIT_ERROR_RATE) + as_off)
            off += np.logaddexp(np.log(1 - BIT_ERROR_RATE) + as_off, np.log(BIT_ERROR_RATE) + as_on)
        return on, off

    def _evidence(self, code: str, on: Array, off: Array) -> float:
        n = len(code)
        lit = np.array([bit == "1" for bit in code])
        shifts = lit[(np.arange(n)[:, None] + np.arange(n)) % n]
        return _mean(_folded(on, n) @ shifts.T + _folded(off, n) @ ~shifts.T)


def _folded(bits: Array, n: int) -> Array:
    """Sum log likelihoods (k, b) over repetitions of a code of n bits: (k, n)."""
    padded = np.pad(bits, ((0, 0), (0, -bits.shape[1] % n)))
    return np.asarray(padded.reshape(len(bits), -1, n).sum(axis=1))


def _mean(logarithms: Array) -> float:
    """Logarithm of the mean of exponentials."""
    return float(logsumexp(logarithms)) - float(np.log(logarithms.size))
