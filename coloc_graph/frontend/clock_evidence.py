"""Offsets between the clocks of cameras and wheels, from motion that two of them saw in one stance."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend.odometry import WheelTrack
from coloc_graph.frontend.pairing.clock_offset import ClockOffset, find_offset
from coloc_graph.frontend.pairing.correspondence import Correspondences
from coloc_graph.frontend.pairing.offset_search import REACH, TimedPath, search_offset
from coloc_graph.frontend.tracks.interpolation import MAX_GAP
from coloc_graph.frontend.tracks.paired_tracks import PairedTracks
from coloc_graph.frontend.tracks.track import Track
from coloc_graph.frontend.wheel_offset import refine_wheel_offset
from coloc_graph.run import OdometrySample, Recorded, Stance
from coloc_graph.team import Camera, Team

Array = NDArray[np.float64]

#: A clock: whose, and of what.
Sensor = tuple[str, Literal["camera", "wheels"]]

#: Tracks in both cameras of a pair.
Seen = tuple[list[Track], list[Track]]

MAX_UNNAMED_TRACKS = 2  # tracks without names that are tried in each camera, the longest
MOVED_PX = 20.0  # a track that keeps within this tells nothing [px]
SYNCHRONOUS = 2e-3  # samples of two cameras that are taken at once lie this close [s]
MIN_AT_ONCE = 10  # samples that tell that two cameras take them at once
MAX_WHEEL_ERROR = 0.03  # robust deviation of a path by wheels from the seen one that an offset explains [m]
ROUGH_SIGMA = 20e-3  # standard deviation of a searched offset before it is refined [s]
SIGMA_FLOORS = {"camera": 5e-3, "wheels": 20e-3}  # a searched offset is known no better: samples are few, wheels slip


@dataclass(frozen=True)
class ClockEvidence:
    """Offset clock of `second` minus clock of `first` at a time [UTC s], from the motion of one stance.

    `synchronous` says that two cameras took images rarely and at the same instants, to which the offset is fitted.
    """

    stance: int
    time: float
    first: Sensor
    second: Sensor
    offset: ClockOffset
    synchronous: bool = False


def clock_evidence(
    run: Recorded, stance: Stance, seen: Mapping[tuple[str, str], Seen], *, rough: bool = False
) -> Iterator[ClockEvidence]:
    """Yield offsets between clocks of a stance: of each pair of cameras, and of each camera and the movers' wheels.

    Parameters
    ----------
    run : Recorded
        The run, for the movers' odometry.
    stance : Stance
        The stance.
    seen : mapping of (str, str) to (list of Track, list of Track)
        Tracks of the movers' markers in both cameras, by pair of observers.
    rough : bool
        Compare wheels and cameras only, by a search without the refinement: to see whether any may differ.
    """
    middle, tracks = (stance.start + stance.end) / 2, dict[str, list[Track]]()
    for (i, j), both in seen.items():
        tracks.setdefault(i, both[0])
        tracks.setdefault(j, both[1])
        between = _between_cameras(*both, run.team[i].camera, run.team[j].camera) if not rough else None
        if between is not None:
            yield ClockEvidence(stance.index, middle, (i, "camera"), (j, "camera"), *between)
    for mover in stance.movers:
        samples = list(run.odometry(mover, stance.start - REACH, stance.end + REACH))
        found: dict[str, ClockOffset] = {}
        for observer, own in tracks.items():
            camera, alone = run.team[observer].camera, len(stance.movers) == 1
            offset = _camera_to_wheels(own, samples, run.team, mover, camera, alone=alone, rough=rough)
            if offset is not None:
                found[observer] = offset
        for observer, offset in found.items():
            # the observers share the errors of the wheels, so that they know no more than one of them
            shared = replace(offset, sigma=offset.sigma * np.sqrt(len(found)))
            yield ClockEvidence(stance.index, middle, (observer, "camera"), (mover, "wheels"), shared)


def _between_cameras(
    seen_i: list[Track], seen_j: list[Track], camera_i: Camera, camera_j: Camera
) -> tuple[ClockOffset, bool] | None:
    """Offset of two cameras' clocks, and True if they take images rarely and at once."""
    best: tuple[ClockOffset, list[tuple[int, int]]] | None = None
    for choices in _pairings(seen_i, seen_j):
        for chosen in choices:
            found = search_offset([(_path(seen_i[a], camera_i), _path(seen_j[b], camera_j)) for a, b in chosen])
            if found is not None and (best is None or found.sigma < best[0].sigma):
                best = found, chosen
        if best is not None:
            break
    if best is None:
        return None
    rough, chosen = best
    floored = ClockOffset(rough.value, float(np.hypot(rough.sigma, SIGMA_FLOORS["camera"])))
    if (at_once := _at_once(seen_i, seen_j, chosen, floored)) is not None:
        return at_once, True
    tracks = PairedTracks(seen_i, seen_j, chosen, camera_i, camera_j)
    at = tracks.at(rough.value)
    valid = np.flatnonzero(at.interpolated.valid)
    try:
        start = _rough(tracks.correspondences(at, valid), at.slope[valid])
        _, evidence = find_offset(tracks, start, ClockOffset(rough.value, ROUGH_SIGMA))
    except DegenerateGeometry:
        return floored, False
    return (floored if evidence is None or evidence.sigma > floored.sigma else evidence), False


def _at_once(
    seen_i: list[Track], seen_j: list[Track], chosen: Sequence[tuple[int, int]], rough: ClockOffset
) -> ClockOffset | None:
    """Offset at which samples that are too rare to interpolate coincide; None where they do not."""
    times_i = np.unique(np.concatenate([seen_i[a].times for a, _ in chosen]))
    times_j = np.unique(np.concatenate([seen_j[b].times for _, b in chosen]))
    if np.median(np.diff(times_i)) <= MAX_GAP:
        return None
    apart = times_j[None] - times_i[:, None] - rough.value
    nearest = apart[np.arange(len(apart)), np.abs(apart).argmin(axis=1)]
    nearest = nearest[np.abs(nearest) < 4 * rough.sigma]
    if len(nearest) < MIN_AT_ONCE:
        return None
    lag = float(np.median(nearest))
    spread = 1.4826 * float(np.median(np.abs(nearest - lag)))
    return ClockOffset(rough.value + lag, max(spread, 1e-4)) if spread < SYNCHRONOUS else None


def _rough(found: Correspondences, slope: Array) -> Correspondences:
    """The same correspondences, with what the offset's uncertainty adds to camera j's covariances."""
    pairs = found.pairs
    wider = pairs.covariance_j + ROUGH_SIGMA**2 * slope[:, :, None] * slope[:, None, :]
    return replace(found, pairs=replace(pairs, covariance_j=wider))


def _pairings(seen_i: list[Track], seen_j: list[Track]) -> Iterator[list[list[tuple[int, int]]]]:
    """Choices of tracks (a, b) that may be the same markers, those first that tell most.

    All those of the same names at once; or both long ones, since the path of one marker alone is also like that of the
    other at another time; or one long one.
    """
    moving = [[n for n, one in enumerate(seen) if _moves(one)] for seen in (seen_i, seen_j)]
    named = [(a, b) for a in moving[0] for b in moving[1] if seen_i[a].marker and seen_i[a].marker == seen_j[b].marker]
    if named:
        yield [named]
        return
    long_i, long_j = (
        sorted(numbers, key=lambda n: -len(seen[n].times))[:MAX_UNNAMED_TRACKS]
        for seen, numbers in zip((seen_i, seen_j), moving, strict=True)
    )
    if any(seen_i[a].marker for a in long_i) or any(seen_j[b].marker for b in long_j):
        return
    if len(long_i) == len(long_j) == MAX_UNNAMED_TRACKS:
        yield [list(zip(long_i, order, strict=True)) for order in (long_j, long_j[::-1])]
    yield [[(a, b)] for a in long_i for b in long_j]


def _moves(track: Track) -> bool:
    return len(track.times) >= 4 and float(np.ptp(track.uv, axis=0).max()) > MOVED_PX


def _path(track: Track, camera: Camera) -> TimedPath:
    """Path of a marker without the distortion of the lens, which is no homography; of a fisheye as it is."""
    return TimedPath(track.times, camera.normalise(track.uv) if camera.model == "pinhole" else track.uv)


def _camera_to_wheels(
    seen: list[Track],
    samples: Sequence[OdometrySample],
    team: Team,
    mover: str,
    camera: Camera,
    *,
    alone: bool,
    rough: bool,
) -> ClockOffset | None:
    """Offset of the wheels' clock from the camera's; refined unless it may be `rough`."""
    markers = team[mover].markers
    if markers is None or len(samples) < 4:
        return None
    new = np.append(True, np.diff([one.time for one in samples]) > 1e-4)
    wheels = WheelTrack(mover, [one for one, kept in zip(samples, new, strict=True) if kept])
    x, y, yaw = wheels.pose_at(wheels.times).T
    c, s = np.cos(yaw), np.sin(yaw)
    points = [np.array(one) for one in markers.positions]
    paths = [TimedPath(wheels.times, np.stack([x + c * a - s * b, y + s * a + c * b], axis=1)) for a, b in points]
    named = [
        (one, int(number))
        for one in seen
        for body, _, number in [one.marker.rpartition("/")]
        if body == mover and number.isdecimal() and int(number) < len(paths) and _moves(one)
    ]
    choices = [named] if named else []
    if not named and alone:
        long = sorted((one for one in seen if _moves(one) and not one.marker), key=lambda one: -len(one.times))
        choices = [[(one, number)] for one in long[:1] for number in range(len(paths))]
    found = [
        (offset, chosen)
        for chosen in choices
        if (
            offset := search_offset([(_path(one, camera), paths[n]) for one, n in chosen], max_residual=MAX_WHEEL_ERROR)
        )
    ]
    if not found:
        return None
    best, chosen = min(found, key=lambda one: one[0].sigma)
    if not rough and camera.model == "pinhole":
        refined = refine_wheel_offset([(one, points[n]) for one, n in chosen], wheels, camera, best.value)
        if refined is not None:
            return refined
    return ClockOffset(best.value, float(np.hypot(best.sigma, SIGMA_FLOORS["wheels"])))
