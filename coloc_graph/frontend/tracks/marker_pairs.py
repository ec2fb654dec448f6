"""Which tracks of one camera are markers of one robot: by the distance between them on the marker plane."""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from coloc_graph.frontend.homography.plane import on_plane
from coloc_graph.frontend.pairing.correspondence import STILL, pair_by_time
from coloc_graph.frontend.tracks.tracking import Track
from coloc_graph.measurements import Plane
from coloc_graph.team import Camera

#: Two markers of a robot are seen together for this share of the shorter track.
TOGETHER = 0.5
CLEARLY_MORE = 1.05  # times the samples that a plane explains by which another explains more
#: Samples that two tracks must share to be bound where there is a choice.
LEAST_SHARED = 8


#: Two tracks of one camera that may be two markers of one robot, by their numbers, with sample indices (n, 2).
Bound = tuple[int, int, NDArray[np.int64]]


def plane_of_spans(tracks: Sequence[Track], camera: Camera, planes: Sequence[Plane], spans: Sequence[float]) -> Plane:
    """The plane of some, the first of which is as stated, on which most samples are of two markers of one robot.

    Of a camera that is tilted otherwise than stated the markers may not be their span apart on the plane as stated, and
    their reflections may be.
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
    """Pairs of tracks of one camera that are two markers of one robot: (a, b, sample indices (n, 2)).

    They are where their distance on the marker plane is the robot's `span` [m] for most of the time. The
    tolerance is wide because a tilt that is wrong by a degree is 15 % of the distance at 2 m; a reflection in
    the floor, seen as if on the marker plane, is off by more than half.
    """
    on_floor = [on_plane(camera.normalise(track.uv), plane) for track in tracks]
    found = []
    for a in range(len(tracks)):
        for b in range(a + 1, len(tracks)):
            shared = pair_by_time(tracks[a].times, tracks[b].times)
            if len(shared) >= max(2, TOGETHER * min(len(tracks[a]), len(tracks[b]))):
                distance = np.linalg.norm(on_floor[a][shared[:, 0]] - on_floor[b][shared[:, 1]], axis=1)
                if (np.abs(distance / span - 1) < tolerance).mean() > 0.8:  # NaN, above the horizon, is not close
                    found.append((a, b, shared))
    return found


def couple_of(tracks: Sequence[Track], camera: Camera, planes: Sequence[Plane], span: float) -> tuple[int, int] | None:
    """Of one robot's tracks, which may be in pieces, the two of its two markers that share most samples."""
    bound = span_samples(tracks, camera, plane_of_spans(tracks, camera, planes, [span]), span)
    return max(bound, key=lambda one: len(one[2]))[:2] if bound else None


def named_pair(tracks: Sequence[Track], robot: str, *, alone: bool) -> tuple[int, int] | None:
    """Numbers of the tracks of a robot's first and second marker by their names; None where they do not tell.

    Two names that end in numbers do, as `ROBOT/0` and `ROBOT/1`: the smaller number is the first marker.
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
    """Numbers of the named tracks of a robot: those called `ROBOT/...`, or all where it moves `alone`."""
    named = [n for n, track in enumerate(tracks) if track.marker]
    own = [n for n in named if tracks[n].marker.startswith(f"{robot}/")]
    return own or (named if alone else [])


def markers_of_movers(
    tracks: Sequence[Track], camera: Camera, planes: Sequence[Plane], spans: Sequence[float], movers: int | None = None
) -> list[Track]:
    """Of all tracks of a camera those that are markers of a moving robot, with a number for each robot (`Track.body`).

    Lights that do not move are not. Where robots carry two markers, the tracks that are bound by a span are;
    tracks with no partner are kept only if no track has one. The pieces of a track that was lost belong to one robot
    with whatever they are bound to, as long as no more than two lights of it are seen at once; all do where it is
    known that one robot moves. Tracks that are known to be different robots' (`Track.mover`) are not bound. Of `planes`
    the first is as stated; see `plane_of_spans`.
    """
    moving = [track for track in tracks if len(track) >= 4 and track.extent > STILL]
    plane = plane_of_spans(moving, camera, planes, spans)
    bound = [one for span in spans for one in span_samples(moving, camera, plane, span)]
    if not bound:
        alone = movers == 1 and spans and _two_at_once(moving, set(range(len(moving))))
        return [replace(track, body=0) for track in moving] if alone else moving
    bodies = [{index} for index in range(len(moving))]
    of = list(range(len(moving)))
    for a, b, shared in sorted(bound, key=lambda one: -len(one[2])):
        joined = bodies[of[a]] | bodies[of[b]]
        if len({moving[n].mover for n in joined} - {""}) > 1:
            continue
        if of[a] == of[b] or (len(joined) > 2 and (len(shared) < LEAST_SHARED or not _two_at_once(moving, joined))):
            continue
        bodies[of[a]], bodies[of[b]] = joined, set()
        for index in joined:
            of[index] = of[a]
    every = {n for n, body in enumerate(of) if len(bodies[body]) > 1}
    if movers == 1 and _two_at_once(moving, every):
        return [replace(moving[n], body=0) for n in sorted(every)]
    robots = sorted({body for body in of if len(bodies[body]) > 1}, key=lambda body: min(bodies[body]))
    return [replace(track, body=robots.index(of[n])) for n, track in enumerate(moving) if of[n] in robots]


def of_named(tracks: Sequence[Track]) -> list[Track]:
    """Tracks that are known to be one robot's (`Track.mover`), in pieces or not bound, are one body, if no more than
    two are seen at once."""
    out = list(tracks)
    free = max((track.body for track in tracks), default=-1) + 1
    for name in dict.fromkeys(track.mover for track in tracks if track.mover):
        own = {n for n, track in enumerate(tracks) if track.mover == name}
        if _two_at_once(tracks, own):
            out = [replace(track, body=free) if n in own else track for n, track in enumerate(out)]
            free += 1
    return out


def _two_at_once(tracks: Sequence[Track], which: set[int]) -> bool:
    """Whether never more than two of some tracks go on at the same time, a moment apart."""
    moment = 0.02
    steps = sorted(
        step for n in which for step in ((tracks[n].times[0] + moment, 1), (tracks[n].times[-1] - moment, -1))
    )
    going = 0
    for _, step in steps:
        going += step
        if going > 2:
            return False
    return True
