"""One stance of a run: from its images or detections to the homography between two observers."""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry, InputError
from coloc_graph.frontend.correspondence import Correspondences, correspond, markers_of_movers, per_pixel, span_samples
from coloc_graph.frontend.detection import Blobs, detector_for
from coloc_graph.frontend.homography import Criterion, HomographyFit, fit_homography, shared_error
from coloc_graph.frontend.plane import distance_from_span, plane_from_mount
from coloc_graph.frontend.relative_pose import relative_pose
from coloc_graph.frontend.tracking import MarkerTracker, Track, TrackerOptions
from coloc_graph.measurements import HomographyMeasurement, Plane, RelativePose
from coloc_graph.run import Detections, Flag, Run, Stance
from coloc_graph.team import Camera, Markers

Array = NDArray[np.float64]

#: A homography that fewer of the points than this share agree on is not believed.
LEAST_AGREEMENT = 0.5


@dataclass(frozen=True)
class FrontendOptions:
    """How measurements are made. `scale` is where the plane's distance comes from: the stated heights of
    camera and markers, or the known span between two markers of one robot."""

    criterion: Criterion = "reprojection"
    scale: Literal["heights", "span"] = "heights"
    tracker: TrackerOptions = field(default_factory=TrackerOptions)


@dataclass(frozen=True, eq=False)
class PairMeasurement:
    """What one pair of observers measured in one stance, with what it was made of.

    Where `homography.unusable` says why, `relative_pose` is None; `correspondences` is None where there are
    none.
    """

    homography: HomographyMeasurement
    relative_pose: RelativePose | None
    correspondences: Correspondences | None


def measure_pair(run: Run, stance: Stance, robot_i: str, robot_j: str, options: FrontendOptions) -> PairMeasurement:
    """The homography and relative pose between two observers in one stance; degenerate geometry is an answer."""
    found: Correspondences | None = None
    try:
        plane = stance_plane(run, stance, robot_i)
        tracks_i = stance_tracks(run, stance, robot_i, options)
        tracks_j = stance_tracks(run, stance, robot_j, options)
        camera_i, camera_j = run.team[robot_i].camera, run.team[robot_j].camera
        found = correspond(tracks_i, tracks_j, camera_i, camera_j)
        fit = fit_homography(found.pairs, options.criterion)
        if fit.inliers.mean() < LEAST_AGREEMENT:
            raise DegenerateGeometry(
                f"only {fit.inliers.sum()} of {len(found)} points agree on one homography: "
                "look for wrong marker names, reflections, or clocks that differ by more than the pairing window"
            )
        measurement = _measurement(stance, robot_i, robot_j, fit, found, camera_i, camera_j)
        if options.scale == "span":
            plane = _plane_by_span(plane, tracks_i, camera_i, stance_markers(run, stance))
        pose = relative_pose(measurement, run.team[robot_i].mount, run.team[robot_j].mount, plane)
    except DegenerateGeometry as why:
        return PairMeasurement(_unusable(stance, robot_i, robot_j, found, str(why)), None, found)
    return PairMeasurement(measurement, pose, found)


def stance_markers(run: Run, stance: Stance) -> Markers | None:
    """The markers that are watched in a stance; None where no mover carries any.

    Raises `DegenerateGeometry` where the movers' markers are at different heights.
    """
    carried = [markers for name in stance.movers if (markers := run.team[name].markers) is not None]
    if len({one.height for one in carried}) > 1:
        raise DegenerateGeometry(
            "the movers' markers are at different heights, so that they share no plane: let one move at a time"
        )
    return carried[0] if carried else None


def stance_plane(run: Run, stance: Stance, robot: str) -> Plane:
    """The marker plane in a robot's camera: as stated for the stance, else from its mount and the movers.

    Raises `DegenerateGeometry` where there is no such plane below the camera.
    """
    stated = run.planes.get(stance.index)
    if stated is not None and robot in stated.planes:
        *normal, d = stated.planes[robot]
        return Plane(N=np.array(normal), d=d)
    markers = stance_markers(run, stance)
    if markers is None:
        raise DegenerateGeometry(
            "no robot with markers moves, and no plane is stated: name the movers, or state the plane"
        )
    return plane_from_mount(run.team[robot].mount, markers, run.team.floor)


def stance_tracks(run: Run, stance: Stance, robot: str, options: FrontendOptions) -> list[Track]:
    """The tracks of the movers' markers in one camera: from detections where the run has them, else from images.

    Detections that name their marker are tracks already; the others, and images, go through the tracker.
    """
    detector = detector_for(stance_markers(run, stance), run.team[robot].camera)
    count = sum(len(m.positions) for name in stance.movers if (m := run.team[name].markers))
    tracker = MarkerTracker(robot, detector, replace(options.tracker, markers=max(count, 1)))
    if run.has_detections(robot):
        seen = list(run.detections(robot, stance.start, stance.end))
        if all(marker for one in seen for marker in one.markers):
            return named_tracks(robot, seen)
        for one in seen:
            tracker.take(one.time, Blobs(one.uv, one.covariance, one.flags, one.peak, one.area))
    else:
        camera = run.team[robot].camera
        for image in run.images(robot, stance.start, stance.end):
            if image.pixels.shape[:2] != (camera.height, camera.width):
                raise InputError(
                    f"{run.path}: stance {stance.index}: the images of {robot} are {image.pixels.shape[1]} x "
                    f"{image.pixels.shape[0]} pixels and its camera is {camera.width} x {camera.height} in the team: "
                    "correct the camera, and its calibration"
                )
            tracker.step(image)
    plane = stance_plane(run, stance, robot)
    spans = {m.span for name in stance.movers if (m := run.team[name].markers) and m.span}
    return markers_of_movers(tracker.tracks(), run.team[robot].camera, plane, sorted(spans))


def named_tracks(robot: str, detections: Iterable[Detections]) -> list[Track]:
    """Tracks of detections that carry their marker's name; clipped and merged ones are left out."""
    samples: dict[str, list[tuple[float, Array, Array, float]]] = defaultdict(list)
    for one in detections:
        whole = (one.flags & (Flag.CLIPPED | Flag.MERGED)) == 0
        for index in np.flatnonzero(whole):
            sample = (one.time, one.uv[index], one.covariance[index], float(one.peak[index]))
            samples[one.markers[index]].append(sample)
    tracks = []
    for marker in sorted(samples):
        times, uv, covariance, peak = zip(*samples[marker], strict=True)
        tracks.append(Track(robot, marker, np.array(times), np.array(uv), np.array(covariance), np.array(peak)))
    return tracks


def _plane_by_span(plane: Plane, tracks: list[Track], camera: Camera, markers: Markers | None) -> Plane:
    if markers is None or markers.span is None:
        raise DegenerateGeometry("the movers carry no two markers, so that there is no span to take the scale from")
    x_a, x_b = [], []
    for a, b, shared in span_samples(tracks, camera, plane, markers.span):
        x_a.append(camera.normalise(tracks[a].uv[shared[:, 0]]))
        x_b.append(camera.normalise(tracks[b].uv[shared[:, 1]]))
    none = np.empty((0, 2))
    return distance_from_span(plane, np.concatenate([none, *x_a]), np.concatenate([none, *x_b]), markers)


def _measurement(
    stance: Stance,
    robot_i: str,
    robot_j: str,
    fit: HomographyFit,
    found: Correspondences,
    camera_i: Camera,
    camera_j: Camera,
) -> HomographyMeasurement:
    roots = _bias_root(found.uv_i, camera_i), _bias_root(found.uv_j, camera_j)
    shared = shared_error(fit, found.pairs, found.markers, roots)
    return HomographyMeasurement(
        stance=stance.index,
        robot_i=robot_i,
        robot_j=robot_j,
        H_j_i=fit.H,
        information=np.asarray(np.linalg.inv(np.linalg.inv(fit.information) + shared), float),
        points=len(fit.inliers),
        inliers=int(fit.inliers.sum()),
        chi2=fit.chi2,
        dof=fit.dof,
        overlap_px=overlap(fit.H, camera_i, camera_j),
    )


def _bias_root(uv: Array, camera: Camera) -> Array:
    """Square root (n, 2, 6) of the covariance of a camera's bias: an error that is smooth over the image.

    It has a part that is the same everywhere and one that grows across the points, each `bias_px` large.
    """
    across = (uv - uv.mean(axis=0)) / np.maximum(uv.std(axis=0), 1.0)
    root = camera.bias_px * per_pixel(uv, camera)
    return np.concatenate([root, across[:, :1, None] * root, across[:, 1:, None] * root], axis=2)


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


def overlap(H_j_i: Array, camera_i: Camera, camera_j: Camera, step: int = 4) -> float:
    """How many pixels of image i see a part of the plane that image j sees as well (sampled every `step`)."""
    u, v = np.meshgrid(np.arange(step / 2, camera_i.width, step), np.arange(step / 2, camera_i.height, step))
    x_i = camera_i.normalise(np.stack([u.ravel(), v.ravel()], axis=1))
    # beyond the plane's horizon the third coordinate changes sign, and `project` says behind
    _, inside = camera_j.project(np.concatenate([x_i, np.ones((len(x_i), 1))], axis=1) @ H_j_i.T)
    return float(inside.sum() * step**2)
