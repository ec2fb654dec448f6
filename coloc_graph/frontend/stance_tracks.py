"""Track the markers of one stance in the observers' cameras, and provide the marker plane of each."""

import heapq
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry, InputError
from coloc_graph.frontend.homography.plane import plane_from_mount
from coloc_graph.frontend.homography.plane_tilts import plausible_planes
from coloc_graph.frontend.images.detection import Blobs, detector_for
from coloc_graph.frontend.landmarks import LandmarkWatch, SeenLandmarks
from coloc_graph.frontend.pairing.correspondence import STILL
from coloc_graph.frontend.tracks.blink_codes import BlinkCodes
from coloc_graph.frontend.tracks.marker_pairs import markers_of_movers, merge_named
from coloc_graph.frontend.tracks.rigid_path import RigidPath
from coloc_graph.frontend.tracks.track import Track, TrackerOptions
from coloc_graph.frontend.tracks.tracking import MarkerTracker
from coloc_graph.measurements import Plane
from coloc_graph.run import Detections, Flag, Recorded, Stance
from coloc_graph.team import Markers, Tracking

Array = NDArray[np.float64]


def stance_markers(run: Recorded, stance: Stance) -> Markers | None:
    """Return markers of the movers of a stance, whose height defines the marker plane; None if no mover has any.

    Parameters
    ----------
    run, stance
        Run and stance.

    Raises
    ------
    DegenerateGeometry
        The movers' markers are at different heights.
    """
    carried = [markers for name in stance.movers if (markers := run.team[name].markers) is not None]
    if len({one.height for one in carried}) > 1:
        raise DegenerateGeometry(
            "the movers' markers are at different heights and share no plane: let one robot move at a time"
        )
    return carried[0] if carried else None


def stance_plane(run: Recorded, stance: Stance, robot: str) -> Plane:
    """Return the marker plane in a robot's camera frame: as stated for the stance, or from its mount and the movers.

    Parameters
    ----------
    run, stance
        Run and stance.
    robot
        Name of the observer.

    Raises
    ------
    DegenerateGeometry
        There is no such plane below the camera.
    """
    stated = run.planes.get(stance.index)
    if stated is not None and robot in stated.planes:
        *normal, d = stated.planes[robot]
        normal_sigma, d_sigma = stated.sigmas.get(robot, (0.0, 0.0))
        return Plane(N=np.array(normal), d=d, normal_sigma=normal_sigma, d_sigma=d_sigma)
    markers = stance_markers(run, stance)
    if markers is None:
        raise DegenerateGeometry(
            "no robot with markers moves, and no marker plane is stated: name the movers, or state the plane"
        )
    return plane_from_mount(run.team[robot].mount, markers, run.team.floor)


class StanceTracks:
    """Tracks of the movers' markers in the observers' cameras, from detections if the run has them, else from images.

    Tracks are made once for each camera, and continued while a live stance continues. Detections with marker names are
    tracks already. Others, and images, pass through a tracker for each colour of the movers' markers. A mover is
    identified by a colour of its own, or by its blink code.

    Parameters
    ----------
    run, stance
        Run and stance.
    options
        Parameters of tracking.
    """

    def __init__(self, run: Recorded, stance: Stance, options: TrackerOptions | None = None) -> None:
        self.run, self.stance = run, stance
        stance_markers(run, stance)  # refuses movers whose markers share no plane
        self._options = _with_stated(options or TrackerOptions(), run.team.tracking)
        self._by_hue: dict[float | None, list[str]] = {}  # movers by the colour of their markers
        for name in stance.movers:
            markers = run.team[name].markers
            if markers is not None:
                self._by_hue.setdefault(markers.hue_deg, []).append(name)
        self._trackers: dict[str, dict[float | None, MarkerTracker]] = {}
        self._taken: dict[str, int] = defaultdict(int)
        self._followed: dict[str, float] = {}  # up to when the images of a robot were followed [UTC s]
        self._made: dict[str, tuple[float, list[Track]]] = {}
        self._standing: dict[str, list[Track]] = {}
        self._landmarks = {landmark.name for landmark in run.team.landmarks}
        self._named_landmarks: dict[str, list[Track]] = {}
        self._watches: dict[str, LandmarkWatch] = {}
        #: Paths of a lone mover by observer, each with the instant up to which it goes [UTC s]; see `stance_hindsight`.
        self.paths: dict[str, tuple[float, RigidPath]] = {}

    def of(self, robot: str, end: float | None = None) -> list[Track]:
        """Tracks of an observer up to a time [UTC s].

        Parameters
        ----------
        robot
            Name of the observer.
        end
            End time, not before that of an earlier call; by default the stance's end.

        Raises
        ------
        DegenerateGeometry
            The movers' markers share no plane below the camera.
        """
        end = self.stance.end if end is None else end
        made = self._made.get(robot)
        if made is None or made[0] != end:
            self._made[robot] = made = end, self._of(robot, end)
        return made[1]

    def checked(self, robot: str) -> list[Track]:
        """Tracks of an observer up to where `of` was last asked for, cut where both directions of time disagree."""
        trackers = self._trackers.get(robot, {})
        return self._bound(robot, {hue: tracker.checked_tracks() for hue, tracker in trackers.items()})

    def detections(self, robot: str, end: float) -> Iterator[Detections]:
        """Detections of the movers' markers, of one colour, in an observer's whole images up to an instant [UTC s]."""
        run, stance = self.run, self.stance
        if run.has_detections(robot):
            yield from run.detections(robot, stance.start, end)
            return
        detector = detector_for(stance_markers(run, stance), run.team[robot].camera)
        for image in run.images(robot, stance.start, end):
            blobs = detector(image.pixels)
            names = ("",) * len(blobs)
            yield Detections(robot, image.time, blobs.uv, blobs.covariance, names, blobs.flags, blobs.peak, blobs.area)

    def all(self, end: float) -> dict[str, list[Track]]:
        """Tracks of all observers up to a time [UTC s]; none for a camera that is not above the marker plane."""
        found: dict[str, list[Track]] = {}
        self._follow([robot for robot in self.stance.observers if not self.run.has_detections(robot)], end)
        for robot in self.stance.observers:
            try:
                found[robot] = self.of(robot, end)
            except DegenerateGeometry:
                found[robot] = []
        return found

    def standing(self, robot: str) -> list[Track]:
        """Tracks of named markers of robots at rest, after a call of `of`."""
        return self._standing.get(robot, [])

    def landmarks(self, robot: str) -> SeenLandmarks:
        """Landmarks seen by an observer up to the end of the last call of `of`, by default in the whole stance."""
        if not self._landmarks:
            return SeenLandmarks()
        if robot not in self._made:
            with suppress(DegenerateGeometry):  # of the movers' plane, which landmarks do not need
                self.of(robot)
        if robot in self._watches:
            return self._watches[robot].seen()
        return SeenLandmarks(self._named_landmarks.get(robot, []))

    def _of(self, robot: str, end: float) -> list[Track]:
        run, stance = self.run, self.stance
        if run.has_detections(robot):
            seen = list(run.detections(robot, stance.start, end))
            if all(marker for one in seen for marker in one.markers):
                tracks = named_tracks(robot, seen)
                self._require_known(robot, tracks)
                self._named_landmarks[robot] = [t for t in tracks if _name(t) in self._landmarks]
                tracks = [t for t in tracks if _name(t) not in self._landmarks]
                stand = {f"{name}/" for name in stance.observers}
                standing = [track for track in tracks if track.marker[: track.marker.rfind("/") + 1] in stand]
                self._standing[robot] = standing
                return [track for track in tracks if track not in standing]
            # detections have no colour
            trackers = self._trackers.setdefault(robot, {None: self._tracker(robot, stance.movers)})
            for one in seen[self._taken[robot] :]:
                trackers[None].take(one.time, Blobs(one.uv, one.covariance, one.flags, one.peak, one.area))
            self._taken[robot] = len(seen)
        else:
            self._follow([robot], end)
            trackers = self._trackers[robot]
        # blink codes are read from pieces of tracks, too
        least = STILL if self._codes(self.stance.movers) is None else 0.0
        return self._bound(robot, {hue: tracker.tracks(least) for hue, tracker in trackers.items()})

    def _follow(self, robots: Sequence[str], end: float) -> None:
        """Follow lights through the images of robots up to a time [UTC s], in one pass through their file."""
        run, stance = self.run, self.stance
        for robot in robots:
            by_hue = self._by_hue or {None: []}
            self._trackers.setdefault(robot, {hue: self._tracker(robot, own) for hue, own in by_hue.items()})
            if robot not in self._watches and self._landmarks:
                self._watches[robot] = LandmarkWatch(run.team[robot], run.team, stance.movers)
        number = dict.fromkeys(robots, 0)
        streams = [run.images(robot, stance.start, end) for robot in robots if self._followed.get(robot) != end]
        for image in heapq.merge(*streams, key=lambda one: one.time):
            robot, camera = image.robot, run.team[image.robot].camera
            if image.pixels.shape[:2] != (camera.height, camera.width):
                raise InputError(
                    f"{run.path}: stance {stance.index}: the images of {robot} are {image.pixels.shape[1]} x "
                    f"{image.pixels.shape[0]} pixels and its camera is {camera.width} x {camera.height} in the "
                    "team: correct the camera, and its calibration"
                )
            number[robot] += 1
            if number[robot] > self._taken[robot]:
                for tracker in self._trackers[robot].values():
                    tracker.step(image)
                if robot in self._watches:
                    self._watches[robot].look(image)
                self._taken[robot] = number[robot]
        self._followed.update(dict.fromkeys(robots, end))

    def _bound(self, robot: str, by_hue: Mapping[float | None, list[Track]]) -> list[Track]:
        """Return the tracks of movers' markers of an observer, by colour, with the robot or body of each."""
        run, stance, camera = self.run, self.stance, self.run.team[robot].camera
        planes = plausible_planes(stance_plane(run, stance, robot), run.team[robot].mount)
        tracks: list[Track] = []
        for hue, own in by_hue.items():
            names = self._by_hue.get(hue, []) if len(by_hue) > 1 else list(stance.movers)
            spans = {m.span for name in names if (m := run.team[name].markers) and m.span}
            codes = self._codes(names)
            if len(names) > 1 and codes is not None:
                own = codes.name_tracks(own)
            own = markers_of_movers(own, camera, planes, sorted(spans), len(names))
            if len(names) == 1:
                own = [replace(track, mover=names[0]) for track in own]
            elif codes is not None:
                own = merge_named(codes.name_bodies(own))
            bodies = max((track.body for track in tracks), default=-1) + 1
            tracks += [replace(t, body=t.body + bodies * (t.body >= 0)) for t in own]
        return tracks

    def _require_known(self, robot: str, tracks: Iterable[Track]) -> None:
        if not self._landmarks:
            return  # without landmarks, names of markers are free
        known = {"", *self.run.team.names, *self._landmarks}
        for track in tracks:
            if _name(track) not in known:
                raise InputError(
                    f"{self.run.path}: stance {self.stance.index}: the detections of {robot} name `{track.marker}`, "
                    f"but the team has no robot or landmark `{_name(track)}`: correct the name, or add it under "
                    "[[landmarks]]"
                )

    def _codes(self, names: Iterable[str]) -> BlinkCodes | None:
        """Blink codes of robots, None if none of them blinks."""
        blinks = {name: blink for name in names if (blink := self.run.team[name].blink) is not None}
        if not blinks:
            return None
        return BlinkCodes({name: blink.code for name, blink in blinks.items()}, next(iter(blinks.values())).bit)

    def _tracker(self, robot: str, names: Sequence[str]) -> MarkerTracker:
        """Tracker of the markers of movers of one colour."""
        camera = self.run.team[robot].camera
        markers = [one for name in names if (one := self.run.team[name].markers) is not None]
        options = replace(self._options, markers=max(sum(len(one.positions) for one in markers), 1))
        if (codes := self._codes(names)) is not None:
            options = replace(options, off=codes.bit, off_rate=codes.rate)
        return MarkerTracker(
            robot, detector_for(markers[0] if markers else None, camera), options, (camera.width, camera.height)
        )


def _with_stated(options: TrackerOptions, stated: Tracking | None) -> TrackerOptions:
    """Options with those that a team states, but for those that are chosen already."""
    if stated is None:
        return options
    usual = TrackerOptions()
    fields = {
        name: value
        for name, value in msgspec.structs.asdict(stated).items()
        if value is not None and getattr(options, name) == getattr(usual, name)
    }
    return replace(options, **fields)


def _name(track: Track) -> str:
    """Robot or landmark in the name of a track's marker."""
    return track.marker.rpartition("/")[0]


def named_tracks(robot: str, detections: Iterable[Detections]) -> list[Track]:
    """Make tracks of detections with marker names, except clipped and merged ones."""
    every = [one for one in detections if len(one.uv)]
    if not every:
        return []
    times = np.repeat([one.time for one in every], [len(one.uv) for one in every])
    uv, covariance, peak, flags = (
        np.concatenate([getattr(one, name) for one in every]) for name in ("uv", "covariance", "peak", "flags")
    )
    names = [marker for one in every for marker in one.markers]
    number = {name: n for n, name in enumerate(sorted(set(names)))}
    markers = np.array([number[name] for name in names])
    whole = (flags & (Flag.CLIPPED | Flag.MERGED)) == 0
    markers[~whole] = -1
    saturated = (flags & Flag.SATURATED) != 0
    tracks = []
    for marker, n in number.items():
        own = np.flatnonzero(markers == n)
        if len(own):
            columns = times[own], uv[own], covariance[own], peak[own].astype(float)
            tracks.append(Track(robot, marker, *columns, saturated=saturated[own]))
    return tracks
