"""Tracks of markers through the images of one camera, finished and live; `Track`, `LiveTrack`."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coloc_graph.frontend.images.detection import Candidate

Array = NDArray[np.float64]

LOOKED_AT = 12  # samples of a track by whose looks it is called an LED or not


@dataclass(frozen=True, eq=False)
class Track:
    """One marker through time in one camera.

    Attributes
    ----------
    robot
        Robot that carries the camera.
    marker
        Name of the marker, such as "C/0", or "" if it is unknown.
    times
        Times of the samples by the camera's clock, (n,) [s].
    uv, covariance
        Positions, (n, 2) [px], and their covariances, (n, 2, 2) [px^2].
    peak
        Peak brightness, (n,) [grey levels].
    body
        Number shared by the tracks of one robot in this camera, -1 if it is unknown.
    mover
        Name of that robot, if its colour or its blink code tells it, or "".
    missed
        Times of images in which the marker was expected and not detected, (k,) [s].
    saturated
        True for samples whose core is at the sensor's limit, (n,); None if it is unknown.
    led
        Probability that it is an LED, and no reflection or lamp, by its looks; NaN if it is unknown.
    """

    robot: str
    marker: str
    times: Array
    uv: Array
    covariance: Array
    peak: Array
    body: int = -1
    mover: str = ""
    missed: Array = field(default_factory=lambda: np.zeros(0))
    saturated: NDArray[np.bool_] | None = None
    led: float = math.nan

    def __len__(self) -> int:
        return len(self.times)

    @property
    def loads(self) -> Array:
        """Parts of the white floors, of other and of saturated spots, in each sample (n, 2): `team.CentreNoise`."""
        saturated = np.zeros(len(self), bool) if self.saturated is None else self.saturated
        return np.stack([~saturated, saturated], axis=1).astype(float)

    @property
    def extent(self) -> float:
        """Diagonal of the track's bounding box [px], near 0 for a light at rest."""
        return float(np.linalg.norm(np.ptp(self.uv, axis=0))) if len(self) else 0.0


@dataclass(frozen=True)
class TrackerOptions:
    """Parameters of `MarkerTracker`.

    Those in pixels are of images 320 px wide, and grow with the width. `acceleration` and `speed` are where the tracker
    begins: it takes what the lights do for more, and the patch is as large as the time between images asks for.
    """

    patch: int = 40  # px, side of the search patch, at least
    patience: int = 3  # frames; a track ends that is not seen for longer, and for `patience_s`
    reacquire_every: float = 0.25  # s between searches of the full frame for markers that came into view
    markers: int = 2  # expected number of markers; with fewer live tracks the full frame is searched
    still_after: int = 50  # frames, and `still_s`, after which a light at rest is parked
    still_s: float = 4.5  # s
    patience_s: float = 0.3  # s
    detected: float = 0.95  # probability of detection of a marker in an image
    clutter: float = 5e-5  # 1/px^2, density of false detections in an image
    acceleration: float = 3e3  # px^2/s^3, spectral density of the markers' acceleration
    jerk: float = 60.0  # px/s, standard deviation of occasional sudden changes of velocity
    speed: float = 200.0  # px/s, standard deviation of a new track's velocity
    off: float = 0.0  # s, for which blinking markers go off each time
    off_rate: float = 0.0  # 1/s, at which a blinking marker that is on goes off


@dataclass(slots=True)
class LiveTrack:
    """Live track: approximate centres, and the candidates or taken blobs that its samples are measured from.

    `score` is the log likelihood ratio of a light against false detections.
    """

    times: list[float] = field(default_factory=list)
    uv: list[tuple[float, float]] = field(default_factory=list)
    samples: list[Candidate | int] = field(default_factory=list)
    missed: list[float] = field(default_factory=list)
    misses: int = 0
    score: float = 0.0
    confirmed: bool = False

    @property
    def extent(self) -> float:
        """Diagonal of the bounding box of the approximate centres [px]."""
        u, v = zip(*self.uv, strict=True)
        return math.hypot(max(u) - min(u), max(v) - min(v))

    def take(self, time: float, place: tuple[float, float], sample: Candidate | int) -> None:
        """Add a sample at a time [s] and an approximate place [px]."""
        self.times.append(time)
        self.uv.append(place)
        self.samples.append(sample)
        self.misses = 0


class NearDetection(NamedTuple):
    """Detection near a track's prediction: squared distance, whether it jerked, and log likelihoods."""

    squared: float
    jerked: bool
    gain: float
    missed: float

    @property
    def worth(self) -> float:
        """Log likelihood ratio to a missed marker and a false detection."""
        return self.gain - self.missed


def spread_samples(samples: Sequence[Candidate | int]) -> list[Candidate | int]:
    """Up to `LOOKED_AT` samples, evenly spread."""
    step = max(len(samples) // LOOKED_AT, 1)
    return list(samples[::step][:LOOKED_AT])


def missed_between(live: LiveTrack) -> Array:
    """Times of images in which a track was missed between its first and its last sample, (k,) [s]."""
    missed = np.array(live.missed)
    return missed[(missed > live.times[0]) & (missed < live.times[-1])]


def sample_key(sample: Candidate | int) -> int:
    """Identity of a sample among all of its tracker."""
    return sample if isinstance(sample, int) else id(sample)


def agreeing_pieces(live: LiveTrack, number: Mapping[int, int]) -> list[LiveTrack]:
    """The pieces of a track whose samples have one `number` each; samples without one are left out."""
    pieces: list[LiveTrack] = []
    last = -1
    for time, place, sample in zip(live.times, live.uv, live.samples, strict=True):
        now = number.get(sample_key(sample), -1)
        if now >= 0 and now != last:
            pieces.append(LiveTrack(confirmed=True, missed=live.missed))
        if now >= 0:
            pieces[-1].take(time, place, sample)
        last = now if now >= 0 else last
    return pieces
