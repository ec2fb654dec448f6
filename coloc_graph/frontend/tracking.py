"""Markers followed through the images of one camera (paper, section V).

Each track searches a patch (40x40 by default) centred at x_k + (x_k - x_{k-1}); the full frame is searched to
start, after a loss, and from time to time for markers that came into view.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from coloc_graph.frontend.detection import Blobs, Detector
from coloc_graph.run.messages import Flag, Image

Array = NDArray[np.float64]


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
    reacquire_every: int = 10
    markers: int = 2  # with fewer live tracks than this the full frame is searched


@dataclass
class _Live:
    times: list[float]
    uv: list[Array]
    covariance: list[Array]
    peak: list[float]
    misses: int = 0

    def predict(self, time: float) -> Array:
        if len(self.uv) < 2 or self.times[-1] <= self.times[-2]:
            return self.uv[-1]
        return self.uv[-1] + (self.uv[-1] - self.uv[-2]) * (time - self.times[-1]) / (self.times[-1] - self.times[-2])


@dataclass
class MarkerTracker:
    """Follows every blob of one camera; which of them are markers of a mover is decided later, with all in view."""

    robot: str
    detector: Detector
    options: TrackerOptions = field(default_factory=TrackerOptions)
    _live: list[_Live] = field(default_factory=list)
    _ended: list[_Live] = field(default_factory=list)
    _frame: int = 0

    def step(self, image: Image) -> Blobs:
        """Take in the next image; returns the blobs found in it."""
        predicted = [track.predict(image.time) for track in self._live]
        full = (
            self._frame % self.options.reacquire_every == 0
            or len(self._live) < self.options.markers
            or any(track.misses for track in self._live)
        )
        blobs = self.detector(image.pixels, None) if full else self._in_patches(image, predicted)
        self._take(image.time, predicted, blobs, births=full)
        return blobs

    def take(self, time: float, blobs: Blobs) -> None:
        """Take in what a detector elsewhere found in the whole of the next image."""
        self._take(time, [track.predict(time) for track in self._live], blobs, births=True)

    def _take(self, time: float, predicted: list[Array], blobs: Blobs, *, births: bool) -> None:
        blobs = blobs[(blobs.flags & (Flag.CLIPPED | Flag.MERGED)) == 0]
        taken = self._assign(time, predicted, blobs)
        if births:
            for index in sorted(set(range(len(blobs))) - taken):
                self._live.append(_Live([], [], [], []))
                self._extend(self._live[-1], time, blobs, index)
        self._ended += [track for track in self._live if track.misses > self.options.patience]
        self._live = [track for track in self._live if track.misses <= self.options.patience]
        self._frame += 1

    def tracks(self) -> list[Track]:
        """All tracks so far, ended or live, oldest first."""
        return [
            Track(self.robot, "", np.array(t.times), np.array(t.uv), np.array(t.covariance), np.array(t.peak))
            for t in sorted(self._ended + self._live, key=lambda t: t.times[0])
        ]

    def _in_patches(self, image: Image, predicted: list[Array]) -> Blobs:
        height, width = image.pixels.shape[:2]
        half = self.options.patch // 2
        found: list[Blobs] = []
        for centre in predicted:
            u, v = np.rint(centre).astype(int)
            box = (max(u - half, 0), max(v - half, 0), min(u + half, width), min(v + half, height))
            if box[2] - box[0] >= 3 and box[3] - box[1] >= 3:
                found.append(self.detector(image.pixels, box))
        if not found:
            return self.detector(image.pixels, None)
        blobs = Blobs(
            *(np.concatenate([getattr(b, n) for b in found]) for n in ("uv", "covariance", "flags", "peak", "area"))
        )
        # overlapping patches see a blob twice
        apart = np.linalg.norm(blobs.uv[:, None] - blobs.uv[None], axis=2) if len(blobs) else np.empty((0, 0))
        again = np.tril(apart < 2.0, k=-1).any(axis=1)
        return blobs[np.asarray(~again)]

    def _assign(self, time: float, predicted: list[Array], blobs: Blobs) -> set[int]:
        taken: set[int] = set()
        gate = self.options.patch / 2
        if predicted and len(blobs):
            distance = np.linalg.norm(np.array(predicted)[:, None] - blobs.uv[None], axis=2)
            rows, columns = linear_sum_assignment(np.minimum(distance, gate))
            for row, column in zip(rows, columns, strict=True):
                if distance[row, column] < gate:
                    self._extend(self._live[row], time, blobs, int(column))
                    taken.add(int(column))
        for track in self._live:
            if track.times[-1] != time:
                track.misses += 1
        return taken

    @staticmethod
    def _extend(track: _Live, time: float, blobs: Blobs, index: int) -> None:
        track.times.append(time)
        track.uv.append(blobs.uv[index])
        track.covariance.append(blobs.covariance[index])
        track.peak.append(float(blobs.peak[index]))
        track.misses = 0
