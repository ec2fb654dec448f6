"""Markers followed through the images of one camera (paper, section V), however many there are.

Each track is a Kalman filter of nearly constant speed. The detections of an image go to the tracks by the most likely
assignment of all at once, where a detection may be false and a marker missed. Where two assignments are about as
likely, both tracks end there, and others begin: what passes for one marker is one.

In images each track searches a patch (40x40 by default) centred where its marker should be; the full frame is searched
to start, after a loss, and from time to time for markers that came into view.
"""

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from coloc_graph.frontend.images.detection import Blobs, Candidate, Detector, Pixels
from coloc_graph.frontend.tracks.blink_filter import Lit
from coloc_graph.frontend.tracks.kalman import PointFilters
from coloc_graph.run.messages import Flag, Image

Array = NDArray[np.float64]

#: Detections that no track takes.
DOUBTFUL = np.uint8(Flag.CLIPPED | Flag.MERGED)
#: A light that keeps within so many pixels stands still.
STILL_PX = 3.0
#: Squared distance, in units of what is uncertain, beyond which a detection is not a track's.
GATE = 25.0
#: By how much a detection must be nearer, so measured, had the speed changed at once, to be taken for that.
JERKS = 12.0
#: Logarithms of likelihood ratios: above, a track is of a light and of no false detections; below, two assignments are
#: about as likely as each other.
CONFIRMED = 22.0
AMBIGUOUS = 3.0
#: Two lights this near to each other may be seen as one [px].
TOUCHING = 6.0
#: A light that is missed so near to the border of the image has left it [px].
RIM = 3.0
#: How well a candidate's place is known before it is measured [px].
ROUGHLY = 0.5


@dataclass(frozen=True, eq=False)
class Track:
    """One marker followed through time in one camera.

    `uv` (n, 2) [px] with `covariance` (n, 2, 2) [px^2] at `times` (n,) [s, the camera's clock]; `peak` (n,)
    grey levels. `marker` is its name where its identity is known ("C/0"), or "". Tracks of one camera with the same
    `body` are markers of one robot; -1 where that is not known. `mover` is that robot's name where its colour, or how
    it blinks, tells it. `missed` (k,) [s] are the images in between in which it should have been, and was not.
    `saturated` (n,) marks samples whose core is at the sensor's limit; None where that is not known.
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

    def __len__(self) -> int:
        return len(self.times)

    @property
    def loads(self) -> Array:
        """How much of the variances beyond the stated one each sample has: of the white floor, of saturation (n, 2)."""
        saturated = np.zeros(len(self)) if self.saturated is None else self.saturated
        return np.stack([np.ones(len(self)), saturated], axis=1)

    @property
    def extent(self) -> float:
        """Diagonal of the box the track stays in [px]; near 0 for a light that does not move."""
        return float(np.linalg.norm(np.ptp(self.uv, axis=0))) if len(self) else 0.0


@dataclass(frozen=True)
class TrackerOptions:
    """`patch` [px] is the side of the search patch; a track ends that is unseen for more than `patience` frames and
    `patience_s`.

    Of a marker's image `detected` is the chance that it is found; false detections come `clutter` [1/px^2] an image.
    `acceleration` [px^2/s^3] is the spectral density of how markers change their speed, `jerk` [px/s] how they do at
    once, now and then, `speed` [px/s] what is usual. Markers that blink go off for `off` [s] each time, `off_rate`
    times a second that they are on.
    """

    patch: int = 40
    patience: int = 3
    reacquire_every: float = 0.25  # s, at which the full frame is searched for markers that came into view
    markers: int = 2  # with fewer live tracks than this the full frame is searched
    still_after: int = 50  # frames, and `still_s`, after which a light that stands still is parked
    still_s: float = 4.5
    patience_s: float = 0.3
    detected: float = 0.95
    clutter: float = 5e-5
    acceleration: float = 3e3
    jerk: float = 60.0
    speed: float = 200.0
    off: float = 0.0
    off_rate: float = 0.0


@dataclass(slots=True)
class _Live:
    """A track that goes on: rough centres, and what each sample is measured from in the end.

    `score` is the logarithm of how much more likely it is of a light than of false detections.
    """

    times: list[float] = field(default_factory=list)
    uv: list[tuple[float, float]] = field(default_factory=list)
    samples: list[Candidate | int] = field(default_factory=list)
    missed: list[float] = field(default_factory=list)
    misses: int = 0
    score: float = 0.0
    confirmed: bool = False

    def take(self, time: float, place: tuple[float, float], sample: Candidate | int) -> None:
        self.times.append(time)
        self.uv.append(place)
        self.samples.append(sample)
        self.misses = 0


class MarkerTracker:
    """Follows every blob of one camera; which of them are markers of a mover is decided later, with all in view.

    Feed it images with `step`, or what was detected elsewhere with `take`, not both; then the `size` of the images
    (width, height) [px] tells when a marker has left. Lights that stand still for long are parked: they are no longer
    searched for, and reported as they were.
    """

    def __init__(
        self,
        robot: str,
        detector: Detector,
        options: TrackerOptions | None = None,
        size: tuple[int, int] | None = None,
    ) -> None:
        self.robot, self._size = robot, size
        self._detector = detector
        self._options = options or TrackerOptions()
        self._filters = PointFilters(self._options.acceleration, self._options.jerk, self._options.speed)
        self._lit = Lit(self._options.off, self._options.off_rate)
        self._live: list[_Live] = []  # in the order of the filters
        self._ended: list[_Live] = []
        self._parked: list[_Live] = []
        self._taken: list[tuple[Array, Array, float, bool]] = []
        self._searched = -math.inf  # when the full frame was searched last

    def step(self, image: Image) -> None:
        """Take in the next image."""
        self._filters.predict(image.time)
        self._size = image.pixels.shape[1], image.pixels.shape[0]
        full = self._search_all(image.time)
        found = self._detector.find(image.pixels) if full else self._in_patches(image.pixels)
        found = [one for one in found if not one.clipped]
        uv = np.array([one.uv for one in found]).reshape(-1, 2)
        self._advance(image.time, uv, np.broadcast_to(ROUGHLY**2 * np.eye(2), (len(uv), 2, 2)), found, births=full)

    def take(self, time: float, blobs: Blobs) -> None:
        """Take in what a detector elsewhere found in the whole of the next image."""
        self._filters.predict(time)
        whole = blobs[(blobs.flags & DOUBTFUL) == 0]
        numbers = range(len(self._taken), len(self._taken) + len(whole))
        saturated = (whole.flags & Flag.SATURATED) != 0
        self._taken += zip(whole.uv, whole.covariance, whole.peak.tolist(), saturated.tolist(), strict=True)
        self._advance(time, whole.uv, whole.covariance, list(numbers), births=True)

    def tracks(self) -> list[Track]:
        """All tracks so far, ended or live, oldest first; their samples are measured now, all at once."""
        lives = [live for live in self._ended + self._parked + self._live if live.confirmed and live.times]
        lives.sort(key=lambda live: live.times[0])
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
                    missed=_between(live),
                    saturated=(blobs.flags[own][good] & Flag.SATURATED) != 0,
                )
            )
        return [track for track in tracks if len(track)]

    def _track(self, live: _Live, samples: list[tuple[Array, Array, float, bool]]) -> Track:
        uv, covariance, peak, saturated = zip(*samples, strict=True)
        fields = np.array(live.times), np.array(uv), np.array(covariance), np.array(peak)
        return Track(self.robot, "", *fields, missed=_between(live), saturated=np.array(saturated))

    def _search_all(self, time: float) -> bool:
        return (
            not self._searched <= time < self._searched + self._options.reacquire_every
            or len(self._live) < self._options.markers
            or any(track.misses for track in self._live)
        )

    def _in_patches(self, pixels: Pixels) -> list[Candidate]:
        height, width = pixels.shape[:2]
        half = self._options.patch // 2
        found: list[Candidate] = []
        for centre in self._filters.place.tolist():
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
        self, time: float, uv: Array, covariance: Array, samples: Sequence[Candidate | int], *, births: bool
    ) -> None:
        places: list[tuple[float, float]] = [(u, v) for u, v in uv.tolist()]
        free = [index for index, place in enumerate(places) if not self._is_parked(place)]
        if len(free) < len(places):
            uv, covariance = uv[free], covariance[free]
        self._lit.predict(time)
        tracks, found, doubtful = self._assigned(uv, covariance)
        self._miss(time, tracks)
        if len(tracks):
            self._filters.update(tracks, uv[found], covariance[found])
        for track, index in zip(tracks.tolist(), found.tolist(), strict=True):
            self._live[track].take(time, places[free[index]], samples[free[index]])
        if births:
            taken = {*found.tolist(), *doubtful.tolist()}
            new = [index for index in range(len(free)) if index not in taken]
            if new:
                self._filters.add(uv[new], covariance[new])
                self._lit.add(len(new))
                for index in new:
                    self._live.append(_Live())
                    self._live[-1].take(time, places[free[index]], samples[free[index]])
            self._searched = time
        self._end(time, births=births)

    def _assigned(self, uv: Array, covariance: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Tracks (k,) and the detections (k,) that they go on with; what that means for their scores; and detections
        (l,) that may be two tracks' in one."""
        options, n = self._options, len(self._live)
        seen = options.detected * self._lit.on  # how likely each is
        missed = np.log(1 - seen)
        none = np.zeros(0, np.int64)
        if not n or not len(uv):
            for track, one in zip(self._live, missed.tolist(), strict=True):
                track.misses += 1
                track.score += one
            return none, none, none
        squared, density, jerked = self._filters.against(uv, covariance)
        off = np.minimum(squared, jerked + JERKS)
        near = jerked < GATE
        gain = np.log(seen / options.clutter)[:, None] + density + 0.5 * (squared - off)
        worth = np.where(near, gain - missed[:, None], 0.0)  # against a missed marker and a false detection
        tracks, found = linear_sum_assignment(worth, maximize=True)
        good = near[tracks, found] & (worth[tracks, found] > AMBIGUOUS)
        tracks, found, doubtful = tracks[good], found[good], none
        if (near.sum(axis=0) > 1).any():
            self._cut(worth, tracks, found)
            keep = self._apart(worth, tracks, found, near)
            tracks, found, doubtful = tracks[keep], found[keep], found[~keep]
        there = np.zeros(n, bool)
        there[tracks] = True
        gained = missed
        gained[tracks] = gain[tracks, found]
        for row, (one, is_seen) in enumerate(zip(gained.tolist(), there.tolist(), strict=True)):
            if is_seen and self._live[row].confirmed and self._live[row].score < 0:
                self._begin_anew(row)  # unseen for so long that it may be anything
            track = self._live[row]
            track.misses += not is_seen
            track.score = min(track.score + one, 2 * CONFIRMED)
            track.confirmed |= track.score > CONFIRMED
        self._filters.jerk(tracks[off[tracks, found] < squared[tracks, found]])
        return tracks, found, doubtful

    def _miss(self, time: float, tracks: NDArray[np.int64]) -> None:
        """All but some tracks are not seen now; where one might be another's blob that says nothing of it."""
        seen = np.zeros(len(self._live), bool)
        seen[tracks] = True
        self._lit.see(seen, self._options.detected)
        for row in np.flatnonzero(~seen).tolist():
            apart = np.abs(self._filters.place - self._filters.place[row]).max(axis=1)
            if (apart < TOUCHING).sum() == 1:  # itself
                self._live[row].missed.append(time)

    def _cut(self, worth: Array, tracks: NDArray[np.int64], found: NDArray[np.int64]) -> None:
        """End the tracks that could as well have gone on with each other's detections; others go on in their place."""
        own = worth[tracks, found]
        other = worth[tracks[:, None], found[None]]
        lost = own[:, None] + own[None] - other - other.T
        swapped = (other > 0) & (other.T > 0) & (lost < AMBIGUOUS)
        np.fill_diagonal(swapped, False)
        for row in tracks[swapped.any(axis=1)].tolist():
            self._begin_anew(row)

    def _begin_anew(self, row: int) -> None:
        """End a track where its filter goes on, perhaps with another light."""
        if self._live[row].confirmed:
            self._ended.append(self._live[row])
        self._live[row] = _Live()

    def _apart(
        self, worth: Array, tracks: NDArray[np.int64], found: NDArray[np.int64], near: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Which assignments hold: a detection that may be two markers in one, or as well another's, is neither's."""
        missing = np.ones(len(self._live), bool)
        missing[tracks] = False
        keep = np.ones(len(tracks), bool)
        for row in np.flatnonzero(missing).tolist():
            if self._live[row].confirmed:
                if self._lit.on[row] > 0.5:
                    touching = np.abs(self._filters.place[tracks] - self._filters.place[row]).max(axis=1) < TOUCHING
                    keep &= ~(touching & near[row, found])
                keep &= ~(worth[tracks, found] - worth[row, found] < AMBIGUOUS)
        return keep

    def _end(self, time: float, *, births: bool) -> None:
        """End the tracks that have not been seen for long, and park the lights that have not moved for long."""
        options, keep = self._options, np.ones(len(self._live), bool)
        left = self._beyond()
        for row, track in enumerate(self._live):
            unseen = time - track.times[-1] if track.times else math.inf
            lost = track.misses > options.patience and unseen > options.patience_s + options.off
            gone = lost or (track.misses and left[row])
            if gone or (not track.confirmed and (track.score < 0 or track.misses > options.patience)):
                if track.confirmed:
                    self._ended.append(track)
                keep[row] = False
            elif births and self._still(track):
                self._parked.append(track)
                keep[row] = False
        if not keep.all():
            self._filters.keep(keep)
            self._lit.keep(keep)
            self._live = [track for track, kept in zip(self._live, keep.tolist(), strict=True) if kept]

    def _beyond(self) -> list[bool]:
        """Whether each light is so near to the border that it may have left the image, and another may come."""
        if self._size is None:
            return [False] * len(self._live)
        place, size = self._filters.place, np.array(self._size)
        out = np.any((place <= RIM - 0.5) | (place >= size - RIM - 0.5), axis=1)
        return [bool(one) for one in out]

    def _still(self, track: _Live) -> bool:
        """Whether a track has not moved for long."""
        options = self._options
        if len(track.uv) < options.still_after or track.times[-1] - track.times[0] < options.still_s:
            return False
        first = min(bisect_left(track.times, track.times[-1] - options.still_s), len(track.uv) - options.still_after)
        (u, v), (u0, v0) = track.uv[-1], track.uv[first]
        if max(abs(u - u0), abs(v - v0)) >= STILL_PX:
            return False
        return bool(np.ptp(np.array(track.uv[first:]), axis=0).max() < STILL_PX)

    def _is_parked(self, place: tuple[float, float]) -> bool:
        return any(
            max(abs(place[0] - track.uv[-1][0]), abs(place[1] - track.uv[-1][1])) < STILL_PX for track in self._parked
        )


def _between(live: _Live) -> Array:
    """The images [s] in which a track was missed before it was seen for the last time."""
    missed = np.array(live.missed)
    return missed[(missed > live.times[0]) & (missed < live.times[-1])]
