"""Track any number of markers through the images of one camera (paper, section V).

Each track is a Kalman filter of nearly constant velocity. Detections are assigned to tracks globally, by the most
likely assignment, which allows for false detections and missed markers. If two assignments are about equally likely,
both tracks end and new ones begin, so that a track never mixes two markers.

In images each track searches a patch (40x40 by default) at its predicted position. The full frame is searched at the
start, after a loss, and periodically for markers that came into view.
"""

import math
from bisect import bisect_left
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from coloc_graph.frontend.images.detection import Blobs, Candidate, Detector, Pixels
from coloc_graph.frontend.images.light_kinds import forms_of_records, track_probability
from coloc_graph.frontend.tracks.blink_filter import BlinkFilter
from coloc_graph.frontend.tracks.kalman import PointFilters, Symmetric
from coloc_graph.frontend.tracks.track import (
    LiveTrack,
    NearDetection,
    Track,
    TrackerOptions,
    agreeing_pieces,
    missed_between,
    sample_key,
    spread_samples,
)
from coloc_graph.run.messages import Flag, Image

Array = NDArray[np.float64]

UNRELIABLE = np.uint8(Flag.CLIPPED | Flag.MERGED)  # flags of detections that no track takes
STILL_PX = 3.0  # px, extent of a light at rest
GATE = 25.0  # squared Mahalanobis distance of a detection from a track's prediction
JERK_PENALTY = 12.0  # reduction of that squared distance by which a sudden change of velocity must pay
CONFIRMED = 22.0  # log likelihood ratio of a light against false detections, above which a track is confirmed
AMBIGUOUS = 3.0  # log likelihood ratio of two assignments below which neither is trusted
OVERLAP_PX = 6.0  # px between two lights that may be seen as one
RIM = 3.0  # px from the border of the image, within which a missed light has left it
WIDTH = 320.0  # px, width of images that the options are of
ADAPTATION = 0.05  # of the logarithm of the acceleration, an image, by the mean normalised innovation less 1
MAX_GROWTH = math.log(100.0)  # of the logarithm of the acceleration
FASTER = 2.0  # a new light's velocity is up to this times those of the lights that are tracked
REACH_SIGMAS = 3.0  # standard deviations of a light's position that the patch holds
ROUGH_EXTENT = 2.0  # px by which an extent of approximate centres may be too small
MIN_PIECE = 4  # samples of a piece on which both directions of time agree
ROUGH_SIGMA = 0.5  # px, of a candidate's approximate centre
ROUGH: Symmetric = (ROUGH_SIGMA**2, 0.0, ROUGH_SIGMA**2)

Place = tuple[float, float]


class MarkerTracker:
    """Tracker of all blobs of one camera; `markers_of_movers` later selects the markers of robots.

    Feed it images with `step`, or detections from elsewhere with `take`, not both. Lights at rest for long are parked:
    no longer searched for, and reported as they were.

    Parameters
    ----------
    robot
        Robot that carries the camera.
    detector
        Detector of the markers.
    options
        Parameters of tracking.
    size
        Size of the images, (width, height) [px], which tells when a marker has left; with `step` it is known.
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
        self._scale = 1.0 if size is None else size[0] / WIDTH  # of the images to those that the options are of
        self._filters = PointFilters(self._options.acceleration, self._options.jerk, self._options.speed)
        self._growth = 0.0  # logarithm of the factor of the acceleration that was seen
        self._moved([], [])
        self._blink = BlinkFilter(self._options.off, self._options.off_rate)
        self._live: list[LiveTrack] = []  # in the order of the filters
        self._ended: list[LiveTrack] = []
        self._parked: list[LiveTrack] = []
        self._taken: list[tuple[Array, Array, float, bool]] = []
        self._recorded: list[tuple[Array, Array, NDArray[np.uint8]]] = []  # peaks, areas and flags, image by image
        self._searched = -math.inf  # when the full frame was searched last
        # as `_advance` took them
        self._images: list[tuple[float, list[Place], list[Symmetric], Sequence[Candidate | int]]] = []

    def step(self, image: Image) -> None:
        """Take in the next image."""
        dt = 0.0 if self._filters.time is None else image.time - self._filters.time
        self._filters.predict(image.time)
        height, width = image.pixels.shape[:2]
        self._size, self._scale = (width, height), width / WIDTH
        full = self._search_all(image.time)
        found = self._detector.find(image.pixels) if full else self._in_patches(image.pixels, dt)
        found = [one for one in found if not one.clipped]
        self._advance(image.time, [one.uv for one in found], [ROUGH] * len(found), found, births=full)

    def take(self, time: float, blobs: Blobs) -> None:
        """Take in the detections of the whole next image from a detector elsewhere."""
        self._filters.predict(time)
        whole = blobs[(blobs.flags & UNRELIABLE) == 0]
        numbers = range(len(self._taken), len(self._taken) + len(whole))
        saturated = (whole.flags & Flag.SATURATED) != 0
        self._recorded.append((whole.peak, whole.area, whole.flags))
        self._taken += zip(whole.uv, whole.covariance, whole.peak.tolist(), saturated.tolist(), strict=True)
        places: list[Place] = [(u, v) for u, v in whole.uv.tolist()]
        covariances: list[Symmetric] = [(xx, xy, yy) for (xx, xy), (_, yy) in whole.covariance.tolist()]
        self._advance(time, places, covariances, list(numbers), births=True)

    def tracks(self, least: float = 0.0) -> list[Track]:
        """Measure the samples of all tracks, ended or live, and return them, oldest first.

        Lights at rest, whose bounding box has a diagonal of less than `least` [px], are neither measured nor returned.
        """
        return self._measured([live for live in self._confirmed() if live.extent >= least - ROUGH_EXTENT])

    def checked_tracks(self) -> list[Track]:
        """Return the tracks as far as they go on alike forward and backward in time, cut where they do not.

        At a crossing, or where a light turns sharply, one direction may take the other light's detection; both seldom
        do.
        """
        back = MarkerTracker(self.robot, self._detector, self._options, self._size)
        for time, places, covariances, samples in reversed(self._images):
            back._filters.predict(-time)
            back._advance(-time, places, covariances, samples, births=True)
        number = {sample_key(sample): n for n, live in enumerate(back._confirmed()) for sample in live.samples}
        pieces = [piece for live in self._confirmed() for piece in agreeing_pieces(live, number)]
        return self._measured([piece for piece in pieces if len(piece.times) >= MIN_PIECE])

    def _confirmed(self) -> list[LiveTrack]:
        lives = [live for live in self._ended + self._parked + self._live if live.confirmed and live.times]
        return sorted(lives, key=lambda live: live.times[0])

    def _measured(self, lives: Sequence[LiveTrack]) -> list[Track]:
        candidates = [one for live in lives for one in live.samples if isinstance(one, Candidate)]
        if not candidates:
            return self._of_taken(lives)
        blobs, real = self._detector.measure(candidates)
        real &= (blobs.flags & UNRELIABLE) == 0
        looks = [spread_samples(live.samples) for live in lives]
        led = track_probability(
            self._detector.forms([one for some in looks for one in some if isinstance(one, Candidate)]),
            [len(some) for some in looks],
        )
        tracks, begin = [], 0
        for live, probability in zip(lives, led, strict=True):
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
                    missed=missed_between(live),
                    saturated=(blobs.flags[own][good] & Flag.SATURATED) != 0,
                    led=probability,
                )
            )
        return [track for track in tracks if len(track)]

    def _of_taken(self, lives: Sequence[LiveTrack]) -> list[Track]:
        """Tracks of detections that were taken from elsewhere."""
        if not lives:
            return []
        looks = [spread_samples(live.samples) for live in lives]
        rows = np.array([one for some in looks for one in some])
        peak, area, flags = (np.concatenate(one)[rows] for one in zip(*self._recorded, strict=True))
        forms = forms_of_records(peak, area, (flags & Flag.BLURRED) != 0)
        led = track_probability(forms, [len(some) for some in looks])
        tracks = []
        for live, probability in zip(lives, led, strict=True):
            uv, covariance, peak, saturated = zip(*(self._taken[one] for one in live.samples), strict=True)  # type: ignore[index]
            fields = np.array(live.times), np.array(uv), np.array(covariance), np.array(peak)
            track = Track(
                self.robot, "", *fields, missed=missed_between(live), saturated=np.array(saturated), led=probability
            )
            tracks.append(track)
        return tracks

    def _moved(self, squared: Sequence[float], speeds: Sequence[float]) -> None:
        """Adapt to the motion of confirmed tracks: squared normalised innovations, and squared speeds [px^2/s^2]."""
        options, scale, faster = self._options, self._scale, 0.0
        if squared:
            innovation = sum([min(one, GATE) for one in squared]) / (2 * len(squared))
            growth = self._growth + ADAPTATION * (innovation - 1)
            self._growth = min(max(growth, 0.0), MAX_GROWTH)
            faster = FASTER * math.sqrt(sum(speeds) / len(speeds))
        more = math.exp(self._growth / 2) * scale
        self._filters.set_motion(
            options.acceleration * more * more, options.jerk * more, max(options.speed * scale, faster)
        )

    def _search_all(self, time: float) -> bool:
        return (
            not self._searched <= time < self._searched + self._options.reacquire_every
            or len(self._live) < self._options.markers
            or any(track.misses for track in self._live)
        )

    def _in_patches(self, pixels: Pixels, dt: float) -> list[Candidate]:
        height, width = pixels.shape[:2]
        least = self._scale * self._options.patch / 2
        found: list[Candidate] = []
        for point in self._filters.points:
            half = round(max(least, REACH_SIGMAS * self._filters.reach(point, dt)))
            u, v = round(point.u), round(point.v)
            box = (max(u - half, 0), max(v - half, 0), min(u + half, width), min(v + half, height))
            if box[2] - box[0] >= 3 and box[3] - box[1] >= 3:
                more = self._detector.find(pixels, box)
                if found:  # overlapping patches see a blob twice
                    more = [one for one in more if not any(_close(one.uv, other.uv, 0.5) for other in found)]
                found += more
        return found

    def _advance(
        self,
        time: float,
        places: list[Place],
        covariances: list[Symmetric],
        samples: Sequence[Candidate | int],
        *,
        births: bool,
    ) -> None:
        self._images.append((time, places, covariances, samples))
        if self._parked:
            free = [n for n, (u, v) in enumerate(places) if not self._is_parked(u, v)]
            places, covariances = [places[n] for n in free], [covariances[n] for n in free]
            samples = [samples[n] for n in free]
        self._blink.predict(time)
        assigned, doubtful = self._assigned(places, covariances)
        self._miss(time, [row for row, _ in assigned])
        for row, column in assigned:
            self._filters.points[row].update(*places[column], covariances[column])
            self._live[row].take(time, places[column], samples[column])
        if births:
            taken = {column for _, column in assigned} | doubtful
            new = [column for column in range(len(places)) if column not in taken]
            for column in new:
                self._filters.add(*places[column], covariances[column])
                self._live.append(LiveTrack())
                self._live[-1].take(time, places[column], samples[column])
            if new:
                self._blink.add(len(new))
            self._searched = time
        self._end(time, births=births)

    def _assigned(
        self, places: Sequence[Place], covariances: Sequence[Symmetric]
    ) -> tuple[list[tuple[int, int]], set[int]]:
        """Assign detections to tracks and update the tracks' scores.

        Returns pairs of a track and its detection, and detections that may be two markers in one.
        """
        options, filters = self._options, self._filters
        seen = [options.detected * on for on in self._blink.on.tolist()]  # probability that each is seen
        missed = [math.log(1 - one) for one in seen]
        if not seen or not places:
            for track, one in zip(self._live, missed, strict=True):
                track.misses += 1
                track.score += one
            return [], set()
        near: dict[tuple[int, int], NearDetection] = {}
        jerk, false = filters.jerk, math.log(options.clutter / self._scale**2)
        for row, (point, one) in enumerate(zip(filters.points, seen, strict=True)):
            for column, ((u, v), covariance) in enumerate(zip(places, covariances, strict=True)):
                compared = point.compare(u, v, covariance, jerk, GATE)
                if compared is not None:
                    squared, density, jerked = compared
                    off = min(squared, jerked + JERK_PENALTY)
                    gain = math.log(one) - false + density + 0.5 * (squared - off)
                    near[row, column] = NearDetection(squared, off < squared, gain, missed[row])
        assigned, doubtful = self._most_likely(near, len(places))
        squares, speeds = [], []
        for row, column in assigned:
            point, taken = filters.points[row], near[row, column]
            if self._live[row].confirmed and self._live[row].score < 0:
                self._begin_anew(row)  # not seen for long enough to be anything
            track = self._live[row]
            track.score = min(track.score + taken.gain, 2 * CONFIRMED)
            track.confirmed |= track.score > CONFIRMED
            if taken.jerked:
                point.allow_jerk(jerk)
            if track.confirmed:
                squares.append(taken.squared)
                speeds.append(point.du**2 + point.dv**2)
        if len(assigned) < len(self._live):
            for row in set(range(len(self._live))).difference([row for row, _ in assigned]):
                self._live[row].misses += 1
                self._live[row].score += missed[row]
        self._moved(squares, speeds)
        return assigned, doubtful

    def _most_likely(
        self, near: dict[tuple[int, int], "NearDetection"], count: int
    ) -> tuple[list[tuple[int, int]], set[int]]:
        """Return the most likely assignment of `count` detections to tracks they are `near`, and what is doubtful."""
        if len(near) <= 1 or len({row for row, _ in near}) == len(near) == len({column for _, column in near}):
            return [pair for pair, one in near.items() if one.worth > AMBIGUOUS], set()
        # log ratio to a missed marker and a false detection
        worth, close = np.zeros((len(self._live), count)), np.zeros((len(self._live), count), bool)
        for pair, one in near.items():
            worth[pair], close[pair] = one.worth, True
        tracks, found = linear_sum_assignment(worth, maximize=True)
        good = close[tracks, found] & (worth[tracks, found] > AMBIGUOUS)
        tracks, found = tracks[good], found[good]
        doubtful: set[int] = set()
        if (close.sum(axis=0) > 1).any():
            self._cut(worth, tracks, found)
            keep = self._apart(worth, tracks, found, close)
            doubtful = set(found[~keep].tolist())
            tracks, found = tracks[keep], found[keep]
        return list(zip(tracks.tolist(), found.tolist(), strict=True)), doubtful

    def _miss(self, time: float, seen: Sequence[int]) -> None:
        """Record that all but some tracks are not seen, except those that may overlap with another."""
        self._blink.update(seen, self._options.detected)
        points = self._filters.points
        if len(seen) == len(points):
            return
        for row in set(range(len(points))).difference(seen):
            own = points[row]
            beside = (max(abs(one.u - own.u), abs(one.v - own.v)) < OVERLAP_PX for one in points)
            if sum(beside) == 1:  # itself
                self._live[row].missed.append(time)

    def _cut(self, worth: Array, tracks: NDArray[np.int64], found: NDArray[np.int64]) -> None:
        """End tracks that could as well have taken each other's detections, and begin new ones in their place."""
        own = worth[tracks, found]
        other = worth[tracks[:, None], found[None]]
        lost = own[:, None] + own[None] - other - other.T
        swapped = (other > 0) & (other.T > 0) & (lost < AMBIGUOUS)
        np.fill_diagonal(swapped, False)
        for row in tracks[swapped.any(axis=1)].tolist():
            self._begin_anew(row)

    def _begin_anew(self, row: int) -> None:
        """End a track and begin another with its filter, perhaps of another light."""
        if self._live[row].confirmed:
            self._ended.append(self._live[row])
        self._live[row] = LiveTrack()

    def _apart(
        self, worth: Array, tracks: NDArray[np.int64], found: NDArray[np.int64], near: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Mask (k,) of assignments that hold; a detection that may be two markers, or as well another's, is dropped."""
        missing = np.ones(len(self._live), bool)
        missing[tracks] = False
        keep = np.ones(len(tracks), bool)
        for row in np.flatnonzero(missing).tolist():
            if self._live[row].confirmed:
                if self._blink.on[row] > 0.5:
                    position = self._filters.position
                    touching = np.abs(position[tracks] - position[row]).max(axis=1) < OVERLAP_PX
                    keep &= ~(touching & near[row, found])
                keep &= ~(worth[tracks, found] - worth[row, found] < AMBIGUOUS)
        return keep

    def _end(self, time: float, *, births: bool) -> None:
        """End tracks that were not seen for long, and park lights that have not moved for long."""
        options, keep = self._options, [True] * len(self._live)
        for row, track in enumerate(self._live):
            unseen = time - track.times[-1] if track.times else math.inf
            lost = track.misses > options.patience and unseen > options.patience_s + options.off
            gone = lost or (track.misses and self._beyond(row))
            if gone or (not track.confirmed and (track.score < 0 or track.misses > options.patience)):
                if track.confirmed:
                    self._ended.append(track)
                keep[row] = False
            elif births and self._still(track):
                self._parked.append(track)
                keep[row] = False
        if not all(keep):
            self._filters.keep(keep)
            self._blink.keep(np.array(keep))
            self._live = [track for track, kept in zip(self._live, keep, strict=True) if kept]

    def _beyond(self, row: int) -> bool:
        """Return whether a light is near enough to the border to have left the image."""
        if self._size is None:
            return False
        point, (width, height) = self._filters.points[row], self._size
        return not (RIM - 0.5 < point.u < width - RIM - 0.5 and RIM - 0.5 < point.v < height - RIM - 0.5)

    def _still(self, track: LiveTrack) -> bool:
        """Return whether a track has not moved for long."""
        options = self._options
        if len(track.uv) < options.still_after or track.times[-1] - track.times[0] < options.still_s:
            return False
        first = min(bisect_left(track.times, track.times[-1] - options.still_s), len(track.uv) - options.still_after)
        (u, v), (u0, v0) = track.uv[-1], track.uv[first]
        if max(abs(u - u0), abs(v - v0)) >= STILL_PX:
            return False
        return bool(np.ptp(np.array(track.uv[first:]), axis=0).max() < STILL_PX)

    def _is_parked(self, u: float, v: float) -> bool:
        return any(_close((u, v), track.uv[-1], STILL_PX) for track in self._parked)


def _close(one: Place, other: Place, limit: float) -> bool:
    """Return whether two places differ by less than a limit along either axis [px]."""
    return abs(one[0] - other[0]) < limit and abs(one[1] - other[1]) < limit
