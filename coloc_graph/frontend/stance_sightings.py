"""Sight the robots that move and those that stand in a stance."""

from collections.abc import Iterable, Mapping

import numpy as np

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend.homography.plane import plane_from_mount
from coloc_graph.frontend.landmarks import UnusedSighting
from coloc_graph.frontend.odometry import WheelTrack
from coloc_graph.frontend.pairing.clock_offset import ClockOffset
from coloc_graph.frontend.sighting import at_rest, sight
from coloc_graph.frontend.stance import PairMeasurement
from coloc_graph.frontend.stance_tracks import stance_plane
from coloc_graph.frontend.tracks.track import Track
from coloc_graph.measurements import Sighting
from coloc_graph.run import Recorded, Stance


def sight_movers(
    run: Recorded, stance: Stance, measured: Iterable[PairMeasurement], wheels: Mapping[str, WheelTrack]
) -> list[Sighting]:
    """Sight the moving robots of a stance, each by the observer that saw it best.

    Parameters
    ----------
    run, stance
        Run and stance.
    measured
        Measurements of all pairs of the stance.
    wheels
        Wheel odometry by robot, which tells the two markers of a robot apart if they have no names.

    Returns
    -------
    list of Sighting
        Sightings; none without a floor, and none of a robot whose markers cannot be told apart or are never seen at
        once (`unsighted_movers` gives the reason).
    """
    if run.team.floor is None or stance.index in run.planes:
        return []
    tracks: dict[str, list[Track]] = {}
    measured = list(measured)
    for one in measured:
        if one.tracks is not None:
            for observer, seen in zip((one.homography.robot_i, one.homography.robot_j), one.tracks, strict=True):
                tracks.setdefault(observer, seen)
    best: dict[str, Sighting] = {}
    for observer, seen in tracks.items():
        try:
            plane = stance_plane(run, stance, observer)
        except DegenerateGeometry:  # a camera below the markers, which the homography reports
            continue
        for mover in stance.movers:
            named = len(stance.movers) == 1 or any(track.marker for track in seen)
            own = seen if named else [track for track in seen if track.mover == mover]
            clock = _clock(run, observer, measured)
            sighting = sight(stance, run.team[observer], run.team[mover], own, plane, wheels.get(mover), clock=clock)
            before = best.get(mover)
            if sighting is not None and (before is None or np.trace(sighting.covariance) < np.trace(before.covariance)):
                best[mover] = sighting
    return list(best.values())


def _clock(run: Recorded, observer: str, measured: Iterable[PairMeasurement]) -> ClockOffset:
    """Clock of an observer minus the reference robot's, by the homography of both or as the team states it."""
    if observer == run.team.reference:
        return ClockOffset(0.0, 0.0)
    for h in (one.homography for one in measured):
        if {h.robot_i, h.robot_j} == {observer, run.team.reference} and h.time_offset_sigma:
            found = ClockOffset(h.time_offset, h.time_offset_sigma)
            return found if h.robot_j == observer else found.reversed()
    return ClockOffset(0.0, run.team.clock_sigma)


def unsighted_movers(
    run: Recorded,
    stance: Stance,
    measured: Iterable[PairMeasurement],
    wheels: Mapping[str, WheelTrack],
    sightings: Iterable[Sighting],
) -> list[UnusedSighting]:
    """Movers that were seen in a stance and have no sighting in it, with the reason."""
    sighted = {one.seen for one in sightings}
    if run.team.floor is None or stance.index in run.planes:
        return []
    unused: dict[str, UnusedSighting] = {}
    for one in measured:
        if one.tracks is None:
            continue
        for mover in stance.movers:
            markers = run.team[mover].markers
            if markers is None or mover in sighted or mover in unused:
                continue
            track = wheels.get(mover)
            if any(seen.marker for side in one.tracks for seen in side):
                why = (
                    f"the names of its markers do not identify them; call them `{mover}/0` and `{mover}/1` in the "
                    "order of the team, and see both at once"
                )
            elif len(markers.positions) < 2:
                why = "it carries one marker, which does not tell its heading; give it two"
            elif len(stance.movers) > 1 and not any(t.marker or t.mover == mover for t in one.tracks[0]):
                why = "its lights cannot be told from those of other movers; give each a colour, a blink code, or names"
            elif track is None or not len(track):
                why = (
                    "its two equal lights cannot be told apart; record its wheel odometry, or name its markers "
                    f"`{mover}/0` and `{mover}/1`"
                )
            else:
                why = "its two lights are never seen at once, or its odometry does not tell them apart; drive further"
            observer = one.homography.robot_i
            unused[mover] = UnusedSighting(mover, observer, stance.index, why, is_robot=True)
    return list(unused.values())


def sight_standing(
    run: Recorded, stance: Stance, measured: Iterable[PairMeasurement], before: Stance | None
) -> list[Sighting]:
    """Sight robots at rest by others at rest, from named markers.

    Parameters
    ----------
    run, stance
        Run and stance.
    measured
        Measurements of all pairs of the stance.
    before
        Previous stance. Two robots that have both stood since then are not sighted again.

    Returns
    -------
    list of Sighting
        Sightings; none without a floor.
    """
    if run.team.floor is None or stance.index in run.planes:
        return []
    stayed = {name for name in stance.anchors if before is not None and name in before.observers}
    tracks: dict[str, list[Track]] = {}
    for one in measured:
        for observer, seen in zip((one.homography.robot_i, one.homography.robot_j), one.standing, strict=True):
            tracks.setdefault(observer, seen)
    made = []
    for observer, standing in tracks.items():
        still = [at_rest(track, stance.start) for track in standing]
        for name in dict.fromkeys(track.marker[: track.marker.rfind("/")] for track in standing):
            markers = run.team[name].markers
            if markers is None or (observer in stayed and name in stayed):
                continue
            try:
                plane = plane_from_mount(run.team[observer].mount, markers, run.team.floor)
            except DegenerateGeometry:  # a camera below these markers
                continue
            sighting = sight(stance, run.team[observer], run.team[name], still, plane)
            made += [] if sighting is None else [sighting]
    return made
