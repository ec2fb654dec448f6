"""Detect landmarks in the images of a camera at rest, or take them from named detections, and sight them."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend.homography.plane import on_plane, plane_from_mount
from coloc_graph.frontend.images.apriltags import find_tags
from coloc_graph.frontend.images.detection import Detector, Pixels, detector_for
from coloc_graph.frontend.sighting import Marked, at_rest, sight
from coloc_graph.frontend.tracks.track import Track
from coloc_graph.frontend.tracks.tracking import UNRELIABLE
from coloc_graph.geometry.lie import se3_inverse
from coloc_graph.measurements import Sighting
from coloc_graph.run import Image, Recorded, Stance
from coloc_graph.team import Camera, Floor, Landmark, Mount, Robot, Team

Array = NDArray[np.float64]

INTERVAL = 2.0  # s between images that a camera at rest searches; more images share the same systematic error
TAG_BIAS_PX = 0.05  # px, systematic error of a tag's edges, measured on rendered tags from 1 to 2.6 m
STILL_SIGMAS = 5.0  # standard deviations within which samples of a marker at rest lie about their median
STILL_PX = 0.5  # px, the same as a distance
MIN_STILL_SHARE = 0.6  # of a marker's samples that must lie within either
SPAN_TOLERANCE = 0.35  # relative error of the distance between a landmark's two markers
MIN_ASPECT = np.deg2rad(10.0)  # rad between the line of sight and the line through two lights, to tell them apart


@dataclass(frozen=True)
class UnusedSighting:
    """Landmark, or robot that moved (`is_robot`), that an observer saw in a stance and that has no sighting."""

    landmark: str
    observer: str
    stance: int
    why: str
    is_robot: bool = False


@dataclass(frozen=True, eq=False)
class SeenLandmarks:
    """Landmarks seen by an observer: tracks with names of markers, and reasons why others are not used, by name."""

    tracks: list[Track] = field(default_factory=list)
    unused: dict[str, str] = field(default_factory=dict)


class LandmarkWatch:
    """Detector of a team's landmarks in the images of one camera at rest: AprilTags, and pairs of coloured lights.

    White lights are not searched for, since they cannot be told from lamps, nor colours that a mover or another
    landmark has.
    """

    def __init__(self, robot: Robot, team: Team, movers: Collection[str]) -> None:
        self._robot, self._floor = robot, team.floor or Floor()
        self._tags = {(one.tag.family, one.tag.id): one for one in team.landmarks if one.tag is not None}
        carried = {m.hue_deg for name in movers if (m := team[name].markers) is not None}
        lit = [(one, one.markers.hue_deg) for one in team.landmarks if one.markers is not None]
        hues = [hue for _, hue in lit]
        self._lights_of: list[tuple[Landmark, Detector]] = []
        self.unused: dict[str, str] = {}
        for one, hue in lit:
            if hue is None:
                self.unused[one.name] = (
                    "in images its white lights cannot be told from lamps; give them a colour (`hue_deg`), or use a tag"
                )
            elif hue in carried or hues.count(hue) > 1:
                self.unused[one.name] = "others have lights of the same colour; give it its own colour, or use a tag"
            else:
                self._lights_of.append((one, detector_for(one.markers, robot.camera)))
        self._next = -np.inf
        self._samples: dict[str, list[tuple[float, Array, Array]]] = {}

    def look(self, image: Image) -> None:
        """Search an image, unless the last search was a moment ago."""
        if image.time < self._next or not (self._tags or self._lights_of):
            return
        self._next = image.time + INTERVAL
        camera = self._robot.camera
        if self._tags:
            for tag in find_tags(image.pixels, camera, {family for family, _ in self._tags}):
                landmark = self._tags.get((tag.family, tag.id))
                if landmark is not None:
                    self._samples.setdefault(landmark.name, []).append((image.time, tag.uv, tag.covariance))
        for landmark, detector in self._lights_of:
            try:
                found = self._lights(landmark, detector, image.pixels)
            except DegenerateGeometry as why:
                self.unused[landmark.name] = str(why)
                continue
            if found is not None:
                self._samples.setdefault(landmark.name, []).append((image.time, *found))

    def _lights(self, landmark: Landmark, detector: Detector, pixels: Pixels) -> tuple[Array, Array] | None:
        """First and second light of a landmark, None if they are not seen; raises if they are ambiguous."""
        blobs = detector(pixels)
        blobs = blobs[(blobs.flags & UNRELIABLE) == 0]
        if len(blobs) < 2:
            return None
        if len(blobs) > 2:
            raise DegenerateGeometry(f"{len(blobs)} lights of its colour are in view, and it has two")
        T_observer_landmark = _roughly(self._robot, landmark, blobs.uv, self._floor)
        toward = se3_inverse(T_observer_landmark)[:2] @ np.array([*self._robot.mount.T_body_camera[:3, 3], 1.0])
        if abs(np.arctan2(toward[0], abs(toward[1]))) < MIN_ASPECT:
            raise DegenerateGeometry("it is seen along the line of its two lights, which cannot be told apart then")
        order = [0, 1] if toward[0] > 0 else [1, 0]  # it is seen from the side that it faces
        return blobs.uv[order], blobs.covariance[order]

    def seen(self) -> SeenLandmarks:
        """Average all samples into one for each marker."""
        tracks = []
        for name, samples in self._samples.items():
            times, uv, covariance = (np.array(values) for values in zip(*samples, strict=True))
            is_tag = any(one.name == name for one in self._tags.values())
            shared = TAG_BIAS_PX**2 * np.eye(2) if is_tag else np.zeros((2, 2))
            for n in range(2):
                track = Track(self._robot.name, f"{name}/{n}", times, uv[:, n], covariance[:, n], np.zeros(len(times)))
                try:
                    one = at_rest(still(track), float(times[0]))
                except DegenerateGeometry as why:
                    self.unused[name] = str(why)
                    break
                tracks.append(Track(one.robot, one.marker, one.times, one.uv, one.covariance + shared, one.peak))
        return SeenLandmarks(tracks, dict(self.unused))


def _roughly(observer: Robot, landmark: Landmark, uv: Array, floor: Floor) -> Array:
    """Compute T_observer_landmark (4, 4) from the pixels (2, 2) of its lights in order; raises if they are no span."""
    places = _places(observer.camera, observer.mount, landmark, uv, floor)
    markers = landmark.seen_as
    assert markers is not None
    arm, model = places[1] - places[0], markers.p_body[1, :2] - markers.p_body[0, :2]
    heading = np.arctan2(arm[1], arm[0]) - np.arctan2(model[1], model[0])
    c, s = np.cos(heading), np.sin(heading)
    T = np.eye(4)
    T[:2, :2] = [[c, -s], [s, c]]
    T[:2, 3] = places.mean(axis=0) - T[:2, :2] @ markers.p_body[:2, :2].mean(axis=0)
    return T


def _places(camera: Camera, mount: Mount, landmark: Landmark, uv: Array, floor: Floor) -> Array:
    """Project pixels (2, 2) of a landmark's markers to their plane: (2, 2) [m], observer's body; raises if no span."""
    markers = landmark.seen_as
    assert markers is not None and markers.span is not None
    T = mount.T_body_camera
    p_camera = on_plane(camera.rays(uv), plane_from_mount(mount, markers, floor))
    places = (p_camera @ T[:3, :3].T + T[:3, 3])[:, :2]
    apart = float(np.linalg.norm(places[1] - places[0]))
    if not abs(apart / markers.span - 1) < SPAN_TOLERANCE:
        far = "above the horizon" if not np.isfinite(apart) else f"{apart:.2f} m apart"
        raise DegenerateGeometry(
            f"its two markers are seen {far}, but the team states {markers.span:.2f} m, {markers.height:.2f} m above "
            "the floor: another light is taken for it, or its size or height is wrong"
        )
    return np.asarray(places)


def still(track: Track) -> Track:
    """Select the samples of a marker at rest; raises `DegenerateGeometry` if it is not at rest."""
    off = track.uv - np.median(track.uv, axis=0)
    sigmas = np.einsum("nk,nkl,nl->n", off, np.linalg.inv(track.covariance), off)
    good = (sigmas < STILL_SIGMAS**2) | (np.linalg.norm(off, axis=1) < STILL_PX)
    if good.mean() < MIN_STILL_SHARE:
        px = float(np.median(np.linalg.norm(off, axis=1)))
        raise DegenerateGeometry(f"the light taken for its marker {track.marker} is not at rest ({px:.1f} px)")
    fields = (getattr(track, name)[good] for name in ("times", "uv", "covariance", "peak"))
    return Track(track.robot, track.marker, *fields)


def sight_landmarks(
    run: Recorded,
    stance: Stance,
    seen: Iterable[tuple[str, SeenLandmarks]],
    known: Collection[tuple[str, str]] = (),
) -> tuple[list[Sighting], list[UnusedSighting]]:
    """Sight the landmarks that observers saw in a stance.

    Parameters
    ----------
    run, stance
        Run and stance.
    seen
        Landmarks seen, by observer.
    known
        Pairs (observer, landmark) that an observer at rest has sighted before, which are not repeated.

    Returns
    -------
    tuple of list
        Sightings, and landmarks that were seen and are not used; none without a floor.
    """
    if run.team.floor is None or stance.index in run.planes:
        return [], []
    landmarks = {one.name: one for one in run.team.landmarks}
    made: list[Sighting] = []
    unused: list[UnusedSighting] = []
    for observer, what in dict(seen).items():
        unused += [UnusedSighting(name, observer, stance.index, why) for name, why in what.unused.items()]
        for name in dict.fromkeys(track.marker.rpartition("/")[0] for track in what.tracks):
            if (observer, name) in known:
                continue
            own = [track for track in what.tracks if track.marker.rpartition("/")[0] == name]
            try:
                sighting = _sighting(run, stance, run.team[observer], landmarks[name], own)
            except DegenerateGeometry as why:
                unused.append(UnusedSighting(name, observer, stance.index, str(why)))
                continue
            made += [] if sighting is None else [sighting]
    return made, unused


def _sighting(
    run: Recorded, stance: Stance, observer: Robot, landmark: Landmark, tracks: Sequence[Track]
) -> Sighting | None:
    """Sight one landmark; None if one of its markers is not in view."""
    markers, named = landmark.seen_as, {track.marker: track for track in tracks}
    if markers is None:
        raise DegenerateGeometry("it has neither markers nor a tag in the team; state them")
    pair = [named.get(f"{landmark.name}/{n}") for n in range(2)]
    if pair[0] is None or pair[1] is None:
        return None
    both = [at_rest(still(track), stance.start) for track in pair if track is not None]
    plane = plane_from_mount(observer.mount, markers, run.team.floor)
    uv = np.concatenate([track.uv for track in both])
    _places(observer.camera, observer.mount, landmark, uv, run.team.floor or Floor())
    sighting = sight(stance, observer, Marked(landmark.name, markers), both, plane)
    if sighting is not None and landmark.tag is not None and not _faces(sighting.T_observer_seen, observer):
        raise DegenerateGeometry("the camera would be behind its tag: left and right edge are exchanged")
    return sighting


def _faces(T_observer_landmark: Array, observer: Robot) -> bool:
    """True if a landmark shows its front to the observer's camera."""
    p_landmark = se3_inverse(T_observer_landmark) @ observer.mount.T_body_camera[:, 3]
    return bool(p_landmark[0] > 0)


def describe_unused(unused: Iterable[UnusedSighting]) -> list[str]:
    """Describe unused landmarks and robots, one sentence for each object, observer and reason, with their number."""
    kinds: dict[tuple[str, str, str], list[UnusedSighting]] = {}
    for one in unused:
        kinds.setdefault((one.landmark, one.observer, "".join(c for c in one.why if not c.isdigit())), []).append(one)
    return [
        f"stance {all_[0].stance}{f' (and {len(all_) - 1} more)' if len(all_) > 1 else ''}: "
        + (f"{name} has no pose" if all_[0].is_robot else f"landmark {name} is not used")
        + f" as {observer} sees it: {all_[0].why}"
        for (name, observer, _), all_ in kinds.items()
    ]
