"""Group the tracks of one camera into robots, by the distance between two markers on the marker plane."""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from coloc_graph.frontend.homography.plane import on_plane
from coloc_graph.frontend.pairing.correspondence import STILL, pair_by_time
from coloc_graph.frontend.tracks.track import Track
from coloc_graph.measurements import Plane
from coloc_graph.team import Camera

MIN_SHARED_PART = 0.5  # of the shorter track, during which two markers of a robot are both seen
CLEARLY_MORE = 1.05  # ratio of the samples that two planes explain above which the second is preferred
MIN_SHARED_SAMPLES = 8  # of two tracks, to be grouped if there is a choice
MOMENT = 0.02  # s, overlap of two tracks that does not count as being seen at the same time
PAIR_ODDS = 20.0  # factor of the odds that two lights are LEDs which move a span apart on the marker plane


#: Indices of two tracks of one camera that may be two markers of one robot, and indices (n, 2) of shared samples.
Bound = tuple[int, int, NDArray[np.int64]]


def plane_of_spans(tracks: Sequence[Track], camera: Camera, planes: Sequence[Plane], spans: Sequence[float]) -> Plane:
    """Select the plane on which most samples show two markers at a span's distance; the first is the stated one.

    If a camera is tilted otherwise than stated, the markers may not be their span apart on the stated plane, and their
    reflections may be.
    """
    best, most = planes[0], 0
    for plane in planes:
        bound = [one for span in spans for one in span_samples(tracks, camera, plane, span)]
        samples, free = 0, set(range(len(tracks)))
        for a, b, shared in sorted(bound, key=lambda one: -len(one[2])):
            if {a, b} <= free:
                samples, free = samples + len(shared), free - {a, b}
        if samples > CLEARLY_MORE * most:
            best, most = plane, samples
    return best


def span_samples(
    tracks: Sequence[Track], camera: Camera, plane: Plane, span: float, tolerance: float = 0.35
) -> list[Bound]:
    """Find pairs of tracks of one camera that are the two markers of one robot.

    Their distance on the marker plane is the robot's span most of the time.

    Parameters
    ----------
    tracks, camera, plane
        Tracks, the camera, and the marker plane in its frame.
    span
        Distance between the two markers [m].
    tolerance
        Relative error of that distance. It is wide, since a tilt that is wrong by 1 deg makes 15 % at 2 m; a
        reflection in the floor is off by more than half.

    Returns
    -------
    list of tuple
        Indices of both tracks, and the indices (n, 2) of samples taken at the same time.
    """
    on_floor = [on_plane(camera.rays(track.uv), plane) for track in tracks]
    found = []
    for a in range(len(tracks)):
        for b in range(a + 1, len(tracks)):
            shared = pair_by_time(tracks[a].times, tracks[b].times)
            if len(shared) >= max(2, MIN_SHARED_PART * min(len(tracks[a]), len(tracks[b]))):
                distance = np.linalg.norm(on_floor[a][shared[:, 0]] - on_floor[b][shared[:, 1]], axis=1)
                if (np.abs(distance / span - 1) < tolerance).mean() > 0.8:  # NaN, above the horizon, is not close
                    found.append((a, b, shared))
    return found


def longest_pair(
    tracks: Sequence[Track], camera: Camera, planes: Sequence[Plane], span: float
) -> tuple[int, int] | None:
    """Indices of the tracks of a robot's two markers that share most samples, if tracks are in pieces."""
    bound = span_samples(tracks, camera, plane_of_spans(tracks, camera, planes, [span]), span)
    return max(bound, key=lambda one: len(one[2]))[:2] if bound else None


def named_pair(tracks: Sequence[Track], robot: str, *, alone: bool) -> tuple[int, int] | None:
    """Indices of the tracks of a robot's first and second marker by their names; None if names do not tell.

    Names that end in numbers tell, such as `ROBOT/0` and `ROBOT/1`: the smaller number is the first marker.
    """
    own = tracks_of(tracks, robot, alone=alone)
    names = {track.marker: number for number, track in enumerate(tracks) if track.marker}
    first, second = (names.get(f"{robot}/{n}") for n in range(2))
    if first is not None and second is not None:
        return first, second
    ends = {n: int(end[0]) for n in own if (end := re.search(r"[0-9]+$", tracks[n].marker))}
    if len(own) != 2 or len(set(ends.values())) != 2:
        return None
    a, b = sorted(own, key=ends.__getitem__)
    return a, b


def tracks_of(tracks: Sequence[Track], robot: str, *, alone: bool) -> list[int]:
    """Indices of the named tracks of a robot: those called `ROBOT/...`, or all if it moves `alone`."""
    named = [n for n, track in enumerate(tracks) if track.marker]
    own = [n for n in named if tracks[n].marker.startswith(f"{robot}/")]
    return own or (named if alone else [])


def markers_of_movers(
    tracks: Sequence[Track], camera: Camera, planes: Sequence[Plane], spans: Sequence[float], movers: int | None = None
) -> list[Track]:
    """Select the tracks that are markers of moving robots and number the robots (`Track.body`).

    Lights at rest are dropped. Tracks at the distance of a marker span are grouped; tracks without a partner are kept
    only if no track has one. Pieces of an interrupted track are grouped with the same robot as long as no more than two
    of its lights are seen at once. Tracks of different named robots (`Track.mover`) are never grouped.

    Parameters
    ----------
    tracks, camera
        Tracks of one camera, and the camera.
    planes
        Possible marker planes in its frame, the stated one first (`plane_of_spans`).
    spans
        Distances between the two markers of the robots that move [m].
    movers
        Number of robots that move, if it is known.

    Returns
    -------
    list of Track
        Tracks of movers.
    """
    moving = [track for track in tracks if len(track) >= 4 and track.extent > STILL]
    plane = plane_of_spans(moving, camera, planes, spans)
    bound = [one for span in spans for one in span_samples(moving, camera, plane, span)]
    if not bound:
        alone = movers == 1 and spans and _two_at_once(moving, set(range(len(moving))))
        return [replace(track, body=0) for track in moving] if alone else moving
    bodies = [{index} for index in range(len(moving))]
    of = list(range(len(moving)))
    for a, b, shared in sorted(bound, key=lambda one: -len(one[2]) * _likely(moving[one[0]]) * _likely(moving[one[1]])):
        joined = bodies[of[a]] | bodies[of[b]]
        if len({moving[n].mover for n in joined} - {""}) > 1:
            continue
        too_many = len(joined) > 2 and (len(shared) < MIN_SHARED_SAMPLES or not _two_at_once(moving, joined))
        if of[a] == of[b] or too_many:
            continue
        bodies[of[a]], bodies[of[b]] = joined, set()
        for index in joined:
            of[index] = of[a]
    every = {n for n, body in enumerate(of) if len(bodies[body]) > 1}
    if movers == 1 and _two_at_once(moving, every):
        return [_marker(moving[n], 0) for n in sorted(every)]
    robots = sorted({body for body in of if len(bodies[body]) > 1}, key=lambda body: min(bodies[body]))
    return [_marker(track, robots.index(of[n])) for n, track in enumerate(moving) if of[n] in robots]


def _likely(track: Track) -> float:
    """Weight of a track where pairs are formed: a track that looks like no LED has half of another's."""
    return 1.0 if np.isnan(track.led) else (1 + track.led) / 2


def _marker(track: Track, body: int) -> Track:
    """The track as a marker of a robot: that it moves as one makes an LED likelier than its looks."""
    odds = PAIR_ODDS * track.led / max(1 - track.led, 1e-9)
    return replace(track, body=body, led=odds / (1 + odds))


def merge_named(tracks: Sequence[Track]) -> list[Track]:
    """Make one body of all tracks that are known to be one robot's (`Track.mover`), if at most two are seen at once."""
    out = list(tracks)
    free = max((track.body for track in tracks), default=-1) + 1
    for name in dict.fromkeys(track.mover for track in tracks if track.mover):
        own = {n for n, track in enumerate(tracks) if track.mover == name}
        if _two_at_once(tracks, own):
            out = [replace(track, body=free) if n in own else track for n, track in enumerate(out)]
            free += 1
    return out


def _two_at_once(tracks: Sequence[Track], which: set[int]) -> bool:
    """Return whether no more than two tracks overlap in time, but for a moment."""
    steps = sorted(
        step for n in which for step in ((tracks[n].times[0] + MOMENT, 1), (tracks[n].times[-1] - MOMENT, -1))
    )
    going = 0
    for _, step in steps:
        going += step
        if going > 2:
            return False
    return True
