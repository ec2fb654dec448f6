"""Markers followed through the images of one camera (paper, section V).

Each track searches a patch (40x40 by default) centred at x_k + (x_k - x_{k-1}); the full frame is searched to
start, after a loss, and from time to time for markers that came into view.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from coloc_graph.frontend.detection import Blobs, Candidate, Detector, Pixels
from coloc_graph.run.messages import Flag, Image

Array = NDArray[np.float64]

#: Detections that no track takes.
DOUBTFUL = np.uint8(Flag.CLIPPED | Flag.MERGED)
#: A light that keeps within so many pixels stands still.
STILL_PX = 3.0


@dataclass(frozen=True, eq=False)
class Track:
    """One marker followed through time in one camera.

    `uv` (n, 2) [px] with `covariance` (n, 2, 2) [px^2] at `times` (n,) [s, the camera's clock]; `peak` (n,)
    grey levels. `marker` is its name where its identity is known ("C/0"), or "".
    """

    robot: str
    marker: str
    times: Array
    uv: Array
    covariance: Array
    peak: Array

    def __len__(self) -> int:
        return len(self.times)

    @property
    def extent(self) -> float:
        """Diagonal of the box the track stays in [px]; near 0 for a light that does not move."""
        return float(np.linalg.norm(np.ptp(self.uv, axis=0))) if len(self) else 0.0


@dataclass(frozen=True)
class TrackerOptions:
    """`patch` [px] is the side of the search patch; `patience` the frames a track survives unseen."""

    patch: int = 40
    patience: int = 3
    reacquire_every: float = 0.25  # s, at which the full frame is searched for markers that came into view
    markers: int = 2  # with fewer live tracks than this the full frame is searched
    still_after: int = 50  # frames after which a light that stands still is parked


@dataclass(slots=True)
class _Live:
    """A track that goes on: rough centres to predict with, and what each sample is measured from in the end."""

    times: list[float] = field(default_factory=list)
    uv: list[tuple[float, float]] = field(default_factory=list)
    samples: list[Candidate | int] = field(default_factory=list)
    misses: int = 0

    def predict(self, time: float) -> tuple[float, float]:
        (u, v) = self.uv[-1]
        if len(self.uv) < 2 or self.times[-1] <= self.times[-2]:
            return u, v
        ahead = (time - self.times[-1]) / (self.times[-1] - self.times[-2])
        return u + (u - self.uv[-2][0]) * ahead, v + (v - self.uv[-2][1]) * ahead


class MarkerTracker:
    """Follows every blob of one camera; which of them are markers of a mover is decided later, with all in view.

    Feed it images with `step`, or what was detected elsewhere with `take`, not both. Lights that stand still
    for long are parked: they are no longer searched for, and reported as they were.
    """

    def __init__(self, robot: str, detector: Detector, options: TrackerOptions | None = None) -> None:
        self.robot = robot
        self._detector = detector
        self._options = options or TrackerOptions()
        self._live: list[_Live] = []
        self._ended: list[_Live] = []
        self._parked: list[_Live] = []
        self._taken: list[tuple[Array, Array, float]] = []
        self._searched = -math.inf  # when the full frame was searched last

    def step(self, image: Image) -> None:
        """Take in the next image."""
        predicted = [track.predict(image.time) for track in self._live]
        full = self._search_all(image.time)
        found = self._detector.find(image.pixels) if full else self._in_patches(image.pixels, predicted)
        found = [one for one in found if not one.clipped]
        self._advance(image.time, predicted, [one.uv for one in found], found, births=full)

    def take(self, time: float, blobs: Blobs) -> None:
        """Take in what a detector elsewhere found in the whole of the next image."""
        predicted = [track.predict(time) for track in self._live]
        whole = blobs[(blobs.flags & DOUBTFUL) == 0]
        numbers = range(len(self._taken), len(self._taken) + len(whole))
        self._taken += zip(whole.uv, whole.covariance, whole.peak.tolist(), strict=True)
        self._advance(time, predicted, [(u, v) for u, v in whole.uv.tolist()], list(numbers), births=True)

    def tracks(self) -> list[Track]:
        """All tracks so far, ended or live, oldest first; their samples are measured now, all at once."""
        lives = sorted(self._ended + self._parked + self._live, key=lambda live: live.times[0])
        candidates = [one for live in lives for one in live.samples if isinstance(one, Candidate)]
        if not candidates:
            return [self._track(live, [self._taken[one] for one in live.samples]) for live in lives]  # type: ignore[index]
        blobs, real = self._detector.measure(candidates)
        real &= (blobs.flags & DOUBTFUL) == 0
        tracks, begin = [], 0
        for live in lives:
            own = slice(begin, begin + len(live.samples))
            begin = own.stop
            good = real[own]
            tracks.append(
                Track(
                    self.robot,
                    "",
                    np.array(live.times)[good],
                    blobs.uv[own][good],
                    blobs.covariance[own][good],
                    blobs.peak[own][good],
                )
            )
        return [track for track in tracks if len(track)]

    def _track(self, live: _Live, samples: list[tuple[Array, Array, float]]) -> Track:
        uv, covariance, peak = zip(*samples, strict=True)
        return Track(self.robot, "", np.array(live.times), np.array(uv), np.array(covariance), np.array(peak))

    def _search_all(self, time: float) -> bool:
        return (
            not self._searched <= time < self._searched + self._options.reacquire_every
            or len(self._live) < self._options.markers
            or any(track.misses for track in self._live)
        )

    def _in_patches(self, pixels: Pixels, predicted: list[tuple[float, float]]) -> list[Candidate]:
        height, width = pixels.shape[:2]
        half = self._options.patch // 2
        found: list[Candidate] = []
        for centre in predicted:
            u, v = round(centre[0]), round(centre[1])
            box = (max(u - half, 0), max(v - half, 0), min(u + half, width), min(v + half, height))
            if box[2] - box[0] >= 3 and box[3] - box[1] >= 3:
                # overlapping patches see a blob twice
                found += [
                    one
                    for one in self._detector.find(pixels, box)
                    if all(max(abs(one.uv[0] - o.uv[0]), abs(one.uv[1] - o.uv[1])) > 0.5 for o in found)
                ]
        return found

    def _advance(
        self,
        time: float,
        predicted: list[tuple[float, float]],
        places: list[tuple[float, float]],
        samples: Sequence[Candidate | int],
        *,
        births: bool,
    ) -> None:
        taken = set()
        for track, index in zip(self._live, self._assigned(predicted, places), strict=True):
            if index is None:
                track.misses += 1
            else:
                self._extend(track, time, places[index], samples[index])
                taken.add(index)
        if births:
            for index in sorted(set(range(len(places))) - taken):
                if not self._is_parked(places[index]):
                    self._live.append(_Live())
                    self._extend(self._live[-1], time, places[index], samples[index])
            self._park()
            self._searched = time
        if any(track.misses > self._options.patience for track in self._live):
            self._ended += [track for track in self._live if track.misses > self._options.patience]
            self._live = [track for track in self._live if track.misses <= self._options.patience]

    def _assigned(self, predicted: list[tuple[float, float]], places: list[tuple[float, float]]) -> list[int | None]:
        """For each track the blob it goes on to: the least total distance, none farther than half a patch."""
        if not predicted or not places:
            return [None] * len(predicted)
        gate = self._options.patch / 2
        near = [[math.dist(one, place) < gate for place in places] for one in predicted]
        if all(sum(row) <= 1 for row in near) and all(sum(column) <= 1 for column in zip(*near, strict=True)):
            return [row.index(True) if any(row) else None for row in near]  # nothing to decide
        distance = np.hypot(*(np.array(predicted)[:, None] - np.array(places)[None]).transpose(2, 0, 1))
        rows, columns = linear_sum_assignment(np.minimum(distance, gate))
        chosen = {int(r): int(c) for r, c in zip(rows, columns, strict=True) if near[r][c]}
        return [chosen.get(row) for row in range(len(predicted))]

    def _park(self) -> None:
        """Set aside the lights that have not moved for `still_after` frames."""
        going: list[_Live] = []
        for track in self._live:
            still = len(track.uv) >= self._options.still_after
            if still:
                recent = np.array(track.uv[-self._options.still_after :])
                still = bool(np.ptp(recent, axis=0).max() < STILL_PX)
            (self._parked if still else going).append(track)
        self._live = going

    def _is_parked(self, place: tuple[float, float]) -> bool:
        return any(
            max(abs(place[0] - track.uv[-1][0]), abs(place[1] - track.uv[-1][1])) < STILL_PX for track in self._parked
        )

    @staticmethod
    def _extend(track: _Live, time: float, place: tuple[float, float], sample: Candidate | int) -> None:
        track.times.append(time)
        track.uv.append(place)
        track.samples.append(sample)
        track.misses = 0
