"""Find the time offset of recordings that did not begin together, by homographies between their cameras.

Offsets are tried over the whole of both recordings, a fraction of a second apart; the front end refines each
(`find_offset`), and the one at which most points agree on one homography is chosen. The rest is estimated with poses
(`Team.clock_sigma`).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry, InputError
from coloc_graph.frontend import ClockOffset, MarkerTracker, Track
from coloc_graph.frontend.homography.plane import plane_from_mount
from coloc_graph.frontend.homography.plane_tilts import plausible_planes
from coloc_graph.frontend.images.detection import detector_for
from coloc_graph.frontend.pairing.clock_offset import find_offset, fit_at_offset
from coloc_graph.frontend.pairing.correspondence import correspond_roughly
from coloc_graph.frontend.pairing.floor_checks import on_one_floor
from coloc_graph.frontend.tracks.marker_pairs import markers_of_movers
from coloc_graph.frontend.tracks.paired_tracks import PairedTracks
from coloc_graph.run import Image
from coloc_graph.team import Markers, Team

Array = NDArray[np.float64]
Span = tuple[float, float]

OFFSET_SIGMA = 0.05  # s, standard deviation of the result
SEARCH_SIGMA = 0.12  # s, standard deviation with which each offset is tried
STEP = 0.3  # s between offsets that are tried
STRETCHES = 2  # number of intervals, longest first, in which the first camera stands, that are used
MAX_STRETCH = 15.0  # s of such an interval
MIN_OVERLAP = 5.0  # s that both cameras stand
MIN_POINTS = 40  # that agree on one homography
MIN_SHARE = 0.75  # of the points
CANDIDATES = 4  # offsets that are tested in all intervals
MIN_CONTRAST = 1.3  # of the points that agree, to any other offset
MIN_SHARED = 0.6  # of the time for which the camera stands that stands less, in which both stand at the offset
APART = 1.0  # s


@dataclass(frozen=True, eq=False)
class RecordedTracks:
    """Tracks of lights in a robot's recording, and the intervals in which its camera stood, by its own clock."""

    robot: str
    tracks: list[Track]
    standing: tuple[Span, ...]


def recorded_tracks(
    team: Team, robot: str, times: Array, images: Iterable[NDArray[np.uint8]], standing: Sequence[Span]
) -> RecordedTracks:
    """Track the lights in a recording."""
    tracker = MarkerTracker(robot, detector_for(_markers(team), team[robot].camera))
    for time, pixels in zip(times.tolist(), images, strict=False):
        tracker.step(Image(robot, time, pixels))
    return RecordedTracks(robot, tracker.tracks(), tuple(standing))


def recording_offset(team: Team, first: RecordedTracks, other: RecordedTracks) -> float:
    """Find by how much another recording's times are to be moved so that both saw the same at the same time [s].

    Raises
    ------
    InputError
        At no offset, or at several, do the recordings show the same.
    """
    tried: dict[float, int] = {}
    longest = sorted(first.standing, key=lambda one: one[0] - one[1])[:STRETCHES]
    for begin, end in longest:
        span = begin, min(end, begin + MAX_STRETCH)
        for b, e in other.standing:
            # offsets, as clock of the other less that of the first, at which both stand for long enough
            for lag in np.arange(b - span[1] + MIN_OVERLAP, e - span[0] - MIN_OVERLAP, STEP).tolist():
                at, points = _tried(team, first, other, _shared(span, (b, e), lag), ClockOffset(lag, SEARCH_SIGMA))
                if points:
                    tried[at] = max(points, tried.get(at, 0))
    # the likeliest few by all that both saw: what looks alike in one stretch does not in others
    found: dict[float, int] = {}
    while tried and len(found) < CANDIDATES:
        at = max(tried, key=lambda one: tried[one])
        tried = {one: points for one, points in tried.items() if abs(one - at) > APART}
        shared = [
            span
            for one in first.standing
            for two in other.standing
            if (span := _shared(one, two, at))[1] - span[0] >= MIN_OVERLAP
        ]
        stood = min(sum(end - begin for begin, end in one.standing) for one in (first, other))
        if sum(end - begin for begin, end in shared) < MIN_SHARED * stood:
            found[at] = 0  # short stretches look alike by chance
            continue
        again = [_tried(team, first, other, span, ClockOffset(at, OFFSET_SIGMA)) for span in shared]
        refined, _ = max(again, key=lambda one: one[1], default=(at, 0))
        found[refined] = sum(points for _, points in again)
    who = f"{first.robot} and {other.robot}"
    if not any(found.values()):
        raise InputError(
            f"when the recordings of {who} began is not said, and they show the same at no offset: let the mover turn "
            "and cross both views, or state it with --offset"
        )
    best = max(found, key=lambda at: found[at])
    rest = [points for at, points in found.items() if at != best]
    if rest and found[best] < MIN_CONTRAST * max(rest):
        raise InputError(
            f"when the recordings of {who} began is not said, and they look alike at several offsets: let the mover "
            "stop and turn at odd times, or state it with --offset"
        )
    return -best


def _shared(one: Span, two: Span, lag: float) -> Span:
    """Interval, by the first clock, in which both cameras stand at an offset."""
    return max(one[0], two[0] - lag), min(one[1], two[1] - lag)


def _tried(
    team: Team, first: RecordedTracks, other: RecordedTracks, span: Span, prior: ClockOffset
) -> tuple[float, int]:
    """Refine an offset (other clock minus first) [s], and return it with the number of points that agree."""
    cameras, lag = (team[first.robot].camera, team[other.robot].camera), prior.value
    i = _within(team, first, span)
    j = _within(team, other, (span[0] + lag, span[1] + lag))
    try:
        chosen, rough = correspond_roughly(i, j, *cameras, prior.value, prior.sigma, alone=True)
        tracks = PairedTracks(i, j, chosen, *cameras)
        offset, evidence = find_offset(tracks, rough, prior)
        if evidence is None:
            return lag, 0
        fit = fit_at_offset(tracks, offset).fit
        plane = plane_from_mount(team[first.robot].mount, _markers(team))
        if not on_one_floor(fit.H, team[first.robot], team[other.robot], plane):
            return lag, 0
    except DegenerateGeometry:
        return lag, 0
    points = int(fit.inliers.sum())
    return offset.value, points if points >= MIN_POINTS and points >= MIN_SHARE * len(fit.inliers) else 0


def _within(team: Team, one: RecordedTracks, span: Span) -> list[Track]:
    """Tracks of moving markers in a stretch of time."""
    kept = []
    for track in one.tracks:
        own = (track.times >= span[0]) & (track.times <= span[1])
        saturated = None if track.saturated is None else track.saturated[own]
        kept.append(
            replace(
                track, times=track.times[own], uv=track.uv[own], covariance=track.covariance[own], peak=track.peak[own],
                missed=np.zeros(0), saturated=saturated,
            )
        )  # fmt: skip
    robot, markers = team[one.robot], _markers(team)
    planes = plausible_planes(plane_from_mount(robot.mount, markers), robot.mount)
    return markers_of_movers(kept, robot.camera, planes, [markers.span] if markers.span else [], 1)


def _markers(team: Team) -> Markers:
    """The markers of the first robot that has any."""
    found = next((one.markers for one in team.robots if one.markers is not None), None)
    if found is None:
        raise InputError("no robot of the team has markers; state them under [robots.markers]")
    return found
