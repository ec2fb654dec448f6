"""Measure the homography and the relative pose between two observers in one stance, from images or detections."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend.homography.eq2_pose import relative_pose
from coloc_graph.frontend.homography.fit import HomographyFit, fit_homography, persisting
from coloc_graph.frontend.homography.fit_checks import require_agreement, require_determined
from coloc_graph.frontend.homography.floor_tilt import FloorTilt
from coloc_graph.frontend.homography.marker_span import marker_spans
from coloc_graph.frontend.homography.ml_pose import most_likely_pose
from coloc_graph.frontend.homography.overlap import overlap
from coloc_graph.frontend.homography.plane import distance_from_span
from coloc_graph.frontend.homography.plane_tilts import plausible_planes
from coloc_graph.frontend.homography.plane_view import (
    between_cameras,
    measured_between_cameras,
    span_in_view,
    view_of_plane,
)
from coloc_graph.frontend.homography.refinement import Criterion
from coloc_graph.frontend.homography.scatter import spread_of
from coloc_graph.frontend.homography.smooth_errors import bias_root, by_lenses, shared_error
from coloc_graph.frontend.landmarks import SeenLandmarks
from coloc_graph.frontend.pairing.clock_offset import (
    NOT_OBSERVABLE,
    ClockOffset,
    find_offset,
    fit_at_offset,
    require_searchable,
)
from coloc_graph.frontend.pairing.correspondence import (
    PAIRING_WINDOW,
    Correspondences,
    UnpairedTracks,
    correspond,
    correspond_roughly,
    with_noise,
)
from coloc_graph.frontend.pairing.floor_checks import of_some_span, on_one_floor, require_on_floor
from coloc_graph.frontend.pairing.observer_pairs import Pair, information_weight, pairs_of
from coloc_graph.frontend.stance_hindsight import track_choices, why_broken
from coloc_graph.frontend.stance_tracks import StanceTracks, stance_markers, stance_plane
from coloc_graph.frontend.tracks.interpolation import MAX_GAP
from coloc_graph.frontend.tracks.marker_pairs import longest_pair, named_pair, span_samples
from coloc_graph.frontend.tracks.paired_tracks import PairedTracks
from coloc_graph.frontend.tracks.track import Track, TrackerOptions
from coloc_graph.measurements import HomographyMeasurement, MarkerSpan, Plane, RelativePose
from coloc_graph.run import Recorded, Stance
from coloc_graph.team import Camera, Markers, Team

Array = NDArray[np.float64]

LITTLE_IN_COMMON = 30  # points below which two of many observers may be left unmeasured without a warning
WELL_EXPLAINED = 0.8  # share of inliers from which on no other tracks are tried

#: Source of the marker plane's distance.
Scale = Literal["heights", "span"]


@dataclass(frozen=True)
class FrontendOptions:
    """Options of the front end.

    Attributes
    ----------
    criterion
        "reprojection" (maximum likelihood) or "transfer" (the paper's).
    pose
        Relative pose by "eq2" (the paper's) or "ml" (maximum likelihood).
    scale
        Source of the marker plane's distance: the stated "heights" of camera and markers, or the known "span" between
        two markers of one robot.
    tracker
        Parameters of tracking.
    """

    criterion: Criterion = "reprojection"
    pose: Literal["eq2", "ml"] = "ml"
    scale: Scale = "heights"
    tracker: TrackerOptions = field(default_factory=TrackerOptions)


@dataclass(frozen=True, eq=False)
class PairMeasurement:
    """Measurement of one pair of observers in one stance.

    Attributes
    ----------
    homography
        Homography; `homography.unusable` is the reason if there is none.
    relative_pose
        Relative pose, None if the homography is unusable.
    correspondences
        Correspondences, None if there are none.
    offset_evidence
        Clock offset by this stance alone, None if it is not observed.
    at_offset
        Function that repeats the measurement at a known clock offset, if clocks may differ.
    tracks
        Tracks of the movers' markers in both cameras, None if the measurement ended before.
    seen
        The same tracks, also if the pair is unusable; None if there are none.
    standing
        Tracks of the markers of robots at rest in both cameras.
    landmarks
        Landmarks seen by both cameras.
    """

    homography: HomographyMeasurement
    relative_pose: RelativePose | None
    correspondences: Correspondences | None
    offset_evidence: ClockOffset | None = None
    at_offset: "Callable[[ClockOffset], PairMeasurement] | None" = None
    tracks: tuple[list[Track], list[Track]] | None = None
    seen: tuple[list[Track], list[Track]] | None = None
    standing: tuple[list[Track], list[Track]] = ([], [])
    landmarks: tuple[SeenLandmarks, SeenLandmarks] = (SeenLandmarks(), SeenLandmarks())
    fit: HomographyFit | None = None
    cameras: tuple[Camera, Camera] | None = None
    with_team: "Callable[[Team], PairMeasurement] | None" = None


@dataclass(frozen=True, eq=False)
class _Seen:
    """Tracks of a pair of observers in one stance."""

    run: Recorded
    team: Team
    stance: Stance
    robot_i: str
    robot_j: str
    options: FrontendOptions
    plane: Plane
    tracks_i: list[Track]
    tracks_j: list[Track]
    pairs: Sequence[Pair]  # all that are measured in the stance
    tracks: dict[str, list[Track]]  # of all observers of the stance

    @property
    def alone(self) -> bool:
        """True if only one robot moves."""
        return len(self.stance.movers) == 1

    def plausible(self, H_j_i: Array, tracks: Sequence[Track]) -> bool:
        """Return whether a homography has both observers on one floor and pairs tracks of one robot's markers."""
        team, plane = self.team, self.plane
        if not (plane.normal_from_mount and plane.d_from_mount):
            return True
        spans = [m.span for name in self.stance.movers if (m := team[name].markers) and m.span]
        return of_some_span(tracks, team[self.robot_i], plane, spans) and (
            team.floor is None
            or on_one_floor(between_cameras(H_j_i, *self.cameras), team[self.robot_i], team[self.robot_j], plane)
        )

    @property
    def cameras(self) -> tuple[Camera, Camera]:
        """Cameras of both observers, fisheyes as views of the marker plane."""
        one, other = self.team[self.robot_i], self.team[self.robot_j]
        if one.camera.model == other.camera.model == "pinhole":
            return one.camera, other.camera
        down = other.mount.R_body_camera.T @ np.array([0.0, 0.0, -1.0])
        return view_of_plane(one.camera, self.plane.N), view_of_plane(other.camera, down)


def little_in_common(measured: HomographyMeasurement, stance: Stance) -> bool:
    """Return whether two of many observers share too few points to be worth a warning."""
    return len(stance.observers) > 2 and measured.points < LITTLE_IN_COMMON


def measured_pairs(tracks: StanceTracks, end: float) -> list[Pair]:
    """Select the pairs of a stance's observers to measure; of many observers, those that share most samples.

    Parameters
    ----------
    tracks
        Tracks of the stance.
    end
        Time up to which they are considered [UTC s].

    Returns
    -------
    list of tuple
        Names of the observers of each pair.
    """
    return pairs_of(tracks.stance.observers, tracks.all(end), _window(tracks.run))


def _window(run: Recorded) -> float:
    return PAIRING_WINDOW if run.team.clock_sigma == 0 else MAX_GAP / 2


def measure_pair(
    run: Recorded,
    stance: Stance,
    robot_i: str,
    robot_j: str,
    options: FrontendOptions,
    tracks: StanceTracks | None = None,
    pairs: Sequence[Pair] | None = None,
    *,
    alone: bool = True,
) -> PairMeasurement:
    """Measure the homography and relative pose between two observers in one stance.

    Degenerate geometry is a result (`homography.unusable`), not an exception. If the team's clocks may differ
    (`Team.clock_sigma`), their offset is estimated too.

    Parameters
    ----------
    run, stance
        Run and stance.
    robot_i, robot_j
        Names of the observers.
    options
        Options of the front end.
    tracks
        Tracks of the stance, if they exist already.
    pairs
        All pairs that are measured in the stance, which share information; by default `measured_pairs`.
    alone
        False if the clock offset is fused over all stances first: the measurement is then completed by
        `PairMeasurement.at_offset`.

    Returns
    -------
    PairMeasurement
        The measurement.
    """
    tracks = tracks or StanceTracks(run, stance, options.tracker)
    made: list[PairMeasurement] = []
    try:
        plane = stance_plane(run, stance, robot_i)
        pairs = pairs or measured_pairs(tracks, stance.end)
        for tracks_i, tracks_j in track_choices(tracks, robot_i, robot_j, stance.end, _window(run)):
            every = tracks.all(stance.end) | {robot_i: tracks_i, robot_j: tracks_j}
            seen = _Seen(run, run.team, stance, robot_i, robot_j, options, plane, tracks_i, tracks_j, pairs, every)
            one = _measure(seen, tracks, alone)
            made.append(replace(one, seen=(tracks_i, tracks_j)))
            if _inliers(one) >= WELL_EXPLAINED * max(one.homography.points, 1):
                break
    except DegenerateGeometry as why:
        made.append(PairMeasurement(_unusable(stance, robot_i, robot_j, None, str(why)), None, None))
    return replace(
        max(made, key=_inliers),
        standing=(tracks.standing(robot_i), tracks.standing(robot_j)),
        landmarks=(tracks.landmarks(robot_i), tracks.landmarks(robot_j)),
    )


def _measure(seen: _Seen, tracks: StanceTracks, alone: bool) -> PairMeasurement:
    """Measure a pair of observers from one choice of tracks."""
    stance, robot_i, robot_j = seen.stance, seen.robot_i, seen.robot_j
    found: Correspondences | None = None
    try:
        if seen.team.clock_sigma > 0:
            return _measure_with_clocks(seen, alone)
        found = correspond(seen.tracks_i, seen.tracks_j, *seen.cameras, alone=seen.alone, plausible=seen.plausible)
        return _measured_from(seen, found, seen.team)
    except UnpairedTracks as why:
        seen_instead = why_broken(tracks, robot_i, robot_j, stance.end)
        reason = f"{why.what}; {seen_instead}" if seen_instead else str(why)
        return PairMeasurement(_unusable(stance, robot_i, robot_j, found, reason), None, found)
    except DegenerateGeometry as why:
        return PairMeasurement(_unusable(stance, robot_i, robot_j, found, str(why)), None, found)


def _inliers(made: PairMeasurement) -> int:
    """Number of a measurement's points that are inliers; all where it is left to `at_offset`, -1 where unusable."""
    if made.homography.unusable is None:
        return made.homography.inliers
    return made.homography.points if made.offset_evidence is not None else -1


def _measure_with_clocks(seen: _Seen, alone: bool) -> PairMeasurement:
    prior = ClockOffset(0.0, seen.team.clock_sigma)
    require_searchable(prior)
    chosen, rough = correspond_roughly(
        seen.tracks_i,
        seen.tracks_j,
        *seen.cameras,
        prior.value,
        prior.sigma,
        alone=seen.alone,
        plausible=seen.plausible,
    )
    tracks = PairedTracks(seen.tracks_i, seen.tracks_j, chosen, *seen.cameras)
    again = partial(_measure_at_offset, seen, chosen, rough)
    try:
        offset, evidence = find_offset(tracks, rough, prior)
    except DegenerateGeometry as why:
        return PairMeasurement(
            _unusable(seen.stance, seen.robot_i, seen.robot_j, rough, str(why)), None, rough, None, again
        )
    if alone:
        return replace(again(offset), offset_evidence=evidence, at_offset=again)
    open_yet = _unusable(seen.stance, seen.robot_i, seen.robot_j, rough, "the clock offset is not estimated yet")
    return PairMeasurement(open_yet, None, rough, evidence, again)


def _measured_from(seen: _Seen, found: Correspondences, team: Team) -> PairMeasurement:
    """Measure from correspondences with the cameras of another team, which may have other noise."""
    now = replace(seen, team=team)
    again = partial(_measured_from, seen, found)
    found = with_noise(found, seen.cameras, now.cameras)
    try:
        made = _measured(now, found, fit_homography(found.pairs, seen.options.criterion, spread_of(*now.cameras)))
    except DegenerateGeometry as why:
        made = PairMeasurement(_unusable(seen.stance, seen.robot_i, seen.robot_j, found, str(why)), None, found)
    return replace(made, with_team=again)


def _measure_at_offset(
    seen: _Seen,
    chosen: list[tuple[int, int]],
    rough: Correspondences,
    offset: ClockOffset,
    team: Team | None = None,
) -> PairMeasurement:
    again = partial(_measure_at_offset, seen, chosen, rough, offset)
    seen, found = replace(seen, team=team or seen.team), rough
    try:
        tracks = PairedTracks(seen.tracks_i, seen.tracks_j, chosen, *seen.cameras)
        clock = fit_at_offset(tracks, offset, seen.options.criterion, spread_of(*seen.cameras))
        found = clock.found
        made = _measured(seen, found, clock.fit, clock.offset, clock.by_offset)
    except DegenerateGeometry as why:
        made = PairMeasurement(_unusable(seen.stance, seen.robot_i, seen.robot_j, found, str(why)), None, found)
    return replace(made, with_team=again)


def _measured(
    seen: _Seen,
    found: Correspondences,
    fit: HomographyFit,
    offset: ClockOffset | None = None,
    by_offset: Array | None = None,
) -> PairMeasurement:
    """Make the measurement from a fit; raises `DegenerateGeometry` if the fit is rejected."""
    robot_i, robot_j, plane = seen.team[seen.robot_i], seen.team[seen.robot_j], seen.plane
    pairing = "the pairing window" if offset is None else "`clock_sigma` says"
    doubt = None
    try:
        require_agreement(fit, found, f"{seen.robot_i} or {seen.robot_j}", pairing)
    except DegenerateGeometry as why:
        if seen.options.criterion != "transfer":
            raise
        doubt = str(why)  # the paper's chain composes every homography that it can fit
    tilt = _floor_tilt(seen, fit, found)
    fit = persisting(fit, found.pairs, found.markers, found.times)
    fit = fit if tilt is None else tilt.widened(fit, found)
    require_determined(fit)
    own = information_weight(found, (seen.robot_i, seen.robot_j), seen.pairs, seen.tracks, _window(seen.run))
    fit = replace(fit, information=own * fit.information)
    measurement = _measurement(seen.stance, seen.robot_i, seen.robot_j, fit, found, *seen.cameras)
    lenses = None if plane.normal_from_mount else by_lenses(fit, found, *seen.cameras)
    measurement = replace(measurement, share=own, doubt=doubt, by_lenses=lenses)
    if offset is not None:
        measurement = replace(
            measurement,
            time_offset=offset.value,
            time_offset_sigma=offset.sigma,
            by_time_offset=by_offset,
            warning=None if offset.is_observed(seen.team.clock_sigma) else NOT_OBSERVABLE,
        )
    measurement = measured_between_cameras(measurement, *seen.cameras)
    if seen.options.scale == "span":
        plane = _plane_by_span(plane, seen.tracks_i, robot_i.camera, stance_markers(seen.run, seen.stance))
    # without the floor: the graph knows it, and must not count it twice
    make_pose = relative_pose if seen.options.pose == "eq2" else most_likely_pose
    pose = make_pose(measurement, robot_i.mount, robot_j.mount, plane)
    if seen.team.floor is not None and seen.plane.normal_from_mount:
        require_on_floor(pose, seen.team.floor)
    marked = tuple(name for name in seen.stance.movers if seen.team[name].markers is not None)
    pose = replace(pose, homography=measurement, plane=seen.plane, movers=marked, spans=_spans(seen, found, fit, tilt))
    return PairMeasurement(
        measurement, pose, found, tracks=(seen.tracks_i, seen.tracks_j), fit=fit, cameras=seen.cameras
    )


def _floor_tilt(seen: _Seen, fit: HomographyFit, found: Correspondences) -> FloorTilt | None:
    """Effect of the floor's slope under a lone mover; None where the floor, its markers or the planes are not known."""
    floor, carried = seen.team.floor, stance_markers(seen.run, seen.stance) is not None
    by_mount = seen.plane.normal_from_mount and seen.plane.d_from_mount
    if floor is None or not floor.tilt_sigma_deg or not (carried and by_mount and seen.alone):
        return None
    planes = (seen.plane, stance_plane(seen.run, seen.stance, seen.robot_j))
    return FloorTilt.of(fit, found, planes, seen.cameras, math.radians(floor.tilt_sigma_deg))


def _spans(seen: _Seen, found: Correspondences, fit: HomographyFit, tilt: FloorTilt | None) -> tuple[MarkerSpan, ...]:
    """Marker spans of the movers whose two markers are identified; () if the plane is stated."""
    if not (seen.plane.normal_from_mount and seen.plane.d_from_mount):
        return ()
    robot, movers = seen.team[seen.robot_i], seen.stance.movers
    view = seen.cameras[0]
    bias = bias_root(found.uv_i, found.pairs.x_i, view)
    named = any(track.marker for track in seen.tracks_i)
    couples: dict[str, tuple[int, int]] = {}
    for mover in movers:
        markers = seen.team[mover].markers
        if markers is None or markers.span is None:
            continue
        pair = named_pair(seen.tracks_i, mover, alone=len(movers) == 1)
        if pair is not None:
            couples[mover] = pair
        own = [n for n, track in enumerate(seen.tracks_i) if not named and (len(movers) == 1 or track.mover == mover)]
        if own:
            planes = plausible_planes(seen.plane, robot.mount)
            couple = longest_pair([seen.tracks_i[n] for n in own], robot.camera, planes, markers.span)
            if couple is not None:
                couples[mover] = own[couple[0]], own[couple[1]]
    return tuple(span_in_view(one, view) for one in marker_spans(couples, found, fit, bias, tilt)) if couples else ()


def _plane_by_span(plane: Plane, tracks: list[Track], camera: Camera, markers: Markers | None) -> Plane:
    if markers is None or markers.span is None:
        raise DegenerateGeometry("no mover carries two markers: there is no span to take the scale from")
    rays_a, rays_b = [np.empty((0, 3))], [np.empty((0, 3))]
    for a, b, shared in span_samples(tracks, camera, plane, markers.span):
        rays_a.append(camera.rays(tracks[a].uv[shared[:, 0]]))
        rays_b.append(camera.rays(tracks[b].uv[shared[:, 1]]))
    return distance_from_span(plane, np.concatenate(rays_a), np.concatenate(rays_b), markers)


def _measurement(
    stance: Stance,
    robot_i: str,
    robot_j: str,
    fit: HomographyFit,
    found: Correspondences,
    camera_i: Camera,
    camera_j: Camera,
) -> HomographyMeasurement:
    pairs = found.pairs
    roots = bias_root(found.uv_i, pairs.x_i, camera_i), bias_root(found.uv_j, pairs.x_j, camera_j)
    shared = shared_error(fit, pairs, found.markers, roots)
    information = np.linalg.inv(np.linalg.inv(fit.information) + shared)
    return HomographyMeasurement(
        stance=stance.index,
        robot_i=robot_i,
        robot_j=robot_j,
        H_j_i=fit.H,
        information=np.asarray((information + information.T) / 2, float),
        points=len(fit.inliers),
        inliers=int(fit.inliers.sum()),
        chi2=fit.chi2,
        dof=fit.dof,
        overlap_px=overlap(fit.H, camera_i, camera_j),
        shared=shared if shared.any() else None,
    )


def _unusable(
    stance: Stance, robot_i: str, robot_j: str, found: Correspondences | None, why: str
) -> HomographyMeasurement:
    nan = float("nan")
    return HomographyMeasurement(
        stance=stance.index,
        robot_i=robot_i,
        robot_j=robot_j,
        H_j_i=np.full((3, 3), nan),
        information=np.full((8, 8), nan),
        points=len(found) if found else 0,
        inliers=0,
        chi2=nan,
        dof=0,
        overlap_px=nan,
        unusable=why,
    )
