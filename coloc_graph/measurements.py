"""Measurements that the front end passes to the back end; defined once, below both.

Frames: `T_a_b` is the pose of b in a. Covariances are in GTSAM's tangent order, rotation [rad] first, then
translation [m], in the body frame of the right-hand side: T_true = T_measured exp(xi). Measurements on the floor have a
covariance (3, 3) of the tangent's heading, x and y.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import MeasurementError

Array = NDArray[np.float64]

#: Node of the graph: a robot and the index of a stance (or keyframe).
Node = tuple[str, int]


def _as_arrays(measured: Any, *names: str) -> None:
    """Convert fields of a measurement to float arrays; a field with a `matrix()` gives that."""
    for name in names:
        value = getattr(measured, name)
        try:
            array = np.asarray(value.matrix() if hasattr(value, "matrix") else value, float)
        except (TypeError, ValueError) as error:
            raise MeasurementError(f"{name} of the {measured} is no array of numbers: {error}") from error
        object.__setattr__(measured, name, array)


@dataclass(frozen=True, eq=False)
class Plane:
    """Plane of the markers in a camera frame: N . X = d.

    Parameters
    ----------
    N : (3,) float
        Unit normal from the camera to the plane.
    d : float
        Distance from the camera [m].
    normal_sigma, d_sigma : float
        Standard deviations of the normal [rad] and the distance [m] besides those of the mount.
    normal_from_mount, d_from_mount : bool
        They were computed from the mount, and share its error.
    """

    N: Array
    d: float
    normal_sigma: float = 0.0
    d_sigma: float = 0.0
    normal_from_mount: bool = False
    d_from_mount: bool = False


@dataclass(frozen=True, eq=False)
class HomographyMeasurement:
    """Homography that the marker plane induces between two observers at rest in one stance.

    Parameters
    ----------
    stance : int
        Index of the stance.
    robot_i, robot_j : str
        The two observers.
    H_j_i : (3, 3) float
        Takes normalised coordinates in camera i to camera j; determinant 1.
    information : (8, 8) float
        Of its sl(3) coordinates h on the right: H_true = H_j_i exp(sum of h_a SL3_BASIS[a]).
    points, inliers : int
        Number of corresponding points, and of those that the fit kept.
    chi2, dof : float
        Squared residuals of the points in units of their noise, and degrees of freedom.
    overlap_px : float
        Pixels of image i that see the part of the plane that image j sees.
    time_offset, time_offset_sigma : float
        Clock j minus clock i [s] and its standard deviation, which `information` contains; 0 of agreeing clocks.
    unusable : str or None
        Reason for which this is not a measurement; its numbers are then meaningless.
    by_time_offset : (8,) float or None
        Derivative of h by the clock offset [1/s].
    warning : str or None
        Reason for which the measurement is weaker than it looks.
    share : float
        Share of the points' information that `information` holds: homographies of more than two observers of the same
        markers are not independent.
    doubt : str or None
        Reason for which only the paper's chain uses it.
    shared : (8, 8) float or None
        Part of the covariance of h by errors that all samples of a marker share.
    by_lenses : (2, 8, q) float or None
        Derivatives of h by the terms that the lens models of cameras i and j leave (`Camera.lens_terms`); of a stated
        plane.
    """

    stance: int
    robot_i: str
    robot_j: str
    H_j_i: Array
    information: Array
    points: int
    inliers: int
    chi2: float
    dof: int
    overlap_px: float
    time_offset: float = 0.0
    unusable: str | None = None
    time_offset_sigma: float = 0.0
    by_time_offset: Array | None = None
    warning: str | None = None
    share: float = 1.0
    doubt: str | None = None
    shared: Array | None = None
    by_lenses: Array | None = None

    def at_shared(self, size: float) -> "HomographyMeasurement":
        """Return the measurement with shared errors `size` times as large."""
        if self.shared is None:
            return self
        covariance = np.linalg.inv(self.information) + (size**2 - 1) * self.shared
        information = np.linalg.inv((covariance + covariance.T) / 2)
        return replace(self, information=(information + information.T) / 2, shared=size**2 * self.shared)

    @property
    def residual(self) -> float:
        """RMS residual in units of the noise."""
        return float(np.sqrt(self.chi2 / self.dof)) if self.dof > 0 else float("nan")


@dataclass(frozen=True, eq=False)
class MarkerSpan:
    """Two markers of a mover, a known span apart, at n instants at which both observers of a pair saw both.

    Parameters
    ----------
    mover : str
        Robot that carries the markers.
    x_i : (n, 2, 2) float
        Rays (x, y, 1) to both markers in a view of camera i, estimated from both images and the measured homography.
    covariance : (n, 2, 2, 2) float
        Covariances of the rays; at the true homography they are independent of its error.
    by_h : (n, 2, 2, 8) float
        Derivatives of the rays by the homography's coordinates h.
    shared : (n, 2, 2, q) float
        Square root of the covariance of errors that all rays to one marker share.
    R_camera_view : (3, 3) float or None
        Rotation of the frame of the rays; None: the camera's own.
    uneven : (n, 2, 2) float or None
        Displacement of both rays of an instant by one standard deviation of the floor's slope, which tilts the mover;
        as if slopes of instants were independent of each other. None of a level floor.
    """

    mover: str
    x_i: Array
    covariance: Array
    by_h: Array
    shared: Array
    R_camera_view: Array | None = None
    uneven: Array | None = None


@dataclass(frozen=True, eq=False)
class RelativePose:
    """Pose of observer j's body in observer i's body at one stance, however it was measured.

    Parameters
    ----------
    stance
        Index of the stance.
    robot_i, robot_j
        Names of the two observers.
    T_i_j
        Pose of body j in body i, (4, 4), or a `gtsam.Pose3`.
    covariance
        Covariance (6, 6): rotation [rad] first, then translation [m], in the frame of body j.
    T_ci_cj
        Pose of camera j in camera i, (4, 4), where a homography gave it.
    solution
        Number of the SVD solution with the normal nearest to the known one.
    normal_error
        Angle [rad] between these two normals.
    homography, plane, spans, movers
        The homography it was made of, the marker plane in camera i as stated, the spans between two markers that were
        seen, and the robots whose markers they were. The joint estimate calibrates the mounts from these.
    """

    stance: int
    robot_i: str
    robot_j: str
    T_i_j: Array
    covariance: Array
    T_ci_cj: Array | None = None
    solution: int | None = None
    normal_error: float | None = None
    homography: HomographyMeasurement | None = None
    plane: Plane | None = None
    spans: tuple[MarkerSpan, ...] = ()
    movers: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _as_arrays(self, "T_i_j", "covariance")

    def at_shared(self, size: float) -> "RelativePose":
        """Return the measurement with shared errors of pixels `size` times as large; its own covariance stays."""
        if self.homography is None:
            return self
        spans = tuple(replace(one, shared=size * one.shared) for one in self.spans)
        return replace(self, homography=self.homography.at_shared(size), spans=spans)

    @property
    def ends(self) -> tuple[Node, Node]:
        """The two nodes that it relates, i then j."""
        return (self.robot_i, self.stance), (self.robot_j, self.stance)

    def __str__(self) -> str:
        return f"relative pose of {self.robot_i} and {self.robot_j} at stance {self.stance}"


@dataclass(frozen=True, eq=False)
class Sighting:
    """Pose of a robot, or a landmark, whose markers an observer at rest sees.

    Parameters
    ----------
    stance
        Index of the stance.
    observer, seen
        Names of the observing robot, and of the robot or landmark that it sees.
    time
        Time of the image [UTC s, the reference robot's clock]; a moving robot's pose of this stance is that at it.
    T_observer_seen
        Pose of body `seen` in body `observer`, (4, 4), or a `gtsam.Pose3`.
    covariance
        Covariance (3, 3) of heading [rad], x, y [m], in the frame of `seen`: both stand on the floor.
    x_markers, x_covariance
        Rays (x, y, 1) to its first two markers, (2, 2), and their covariance (4, 4). The joint estimate takes these
        instead of the pose.
    R_camera_view
        Rotation (3, 3) of the frame of these rays; None: the camera's own.
    """

    stance: int
    observer: str
    seen: str
    time: float
    T_observer_seen: Array
    covariance: Array
    x_markers: Array | None = None
    x_covariance: Array | None = None
    R_camera_view: Array | None = None

    def __post_init__(self) -> None:
        _as_arrays(self, "T_observer_seen", "covariance")

    @property
    def ends(self) -> tuple[Node, Node]:
        """The two nodes that it relates, observer first."""
        return (self.observer, self.stance), (self.seen, self.stance)

    @property
    def T_i_j(self) -> Array:
        """Pose (4, 4) of the second end in the first."""
        return self.T_observer_seen

    def __str__(self) -> str:
        return f"sighting of {self.seen} by {self.observer} at stance {self.stance}"


@dataclass(frozen=True, eq=False)
class Odometry:
    """Motion of a robot between two stances by its wheels.

    Parameters
    ----------
    robot
        Name of the robot.
    before, after
        Indices of the two stances, in the order of time.
    T_before_after
        Pose of its body at `after` in its body at `before`, (4, 4), or a `gtsam.Pose3`.
    covariance
        Covariance (3, 3) of heading [rad], x, y [m], in the frame of the body at `after`.
    """

    robot: str
    before: int
    after: int
    T_before_after: Array
    covariance: Array

    def __post_init__(self) -> None:
        _as_arrays(self, "T_before_after", "covariance")

    @property
    def ends(self) -> tuple[Node, Node]:
        """The two nodes that it relates, in the order of time."""
        return (self.robot, self.before), (self.robot, self.after)

    @property
    def T_i_j(self) -> Array:
        """Pose (4, 4) of the second end in the first."""
        return self.T_before_after

    def __str__(self) -> str:
        return f"odometry of {self.robot} from stance {self.before} to {self.after}"


@dataclass(frozen=True, eq=False)
class Range:
    """Ranges of a robot or a landmark by a robot at n instants, at known places in the robots' poses of stances.

    Parameters
    ----------
    robot, target : str
        Names of the robot that measured, and of the robot or landmark that it measured.
    stance, target_stance : int
        Stances whose poses of the two robots they refer to; -1 of a landmark.
    time : float
        Mean time [UTC s].
    range : (n,) float
        Ranges as read [m], each the mean of some samples.
    moved, target_moved : (n, 3) float
        x [m], y [m], yaw [rad] of the two bodies at each instant, in their bodies at their stances: 0 where they stand.
    covariance : (n, n) float
        Covariance of the ranges [m^2], with that of the odometry that gave the places.
    samples : int
        Number of the averaged samples.
    place : (2,) float or None
        Of a landmark, where it is about in the robot's pose [m]: an initial value where no other measurement gives one.
    bearing, bearing_sigma : float or None
        Mean bearing [rad] of the target from the robot while both stand, and its standard deviation [rad].
    bearings : int
        Number of the averaged bearings.
    """

    robot: str
    target: str
    stance: int
    target_stance: int
    time: float
    range: Array
    moved: Array
    target_moved: Array
    covariance: Array
    samples: int
    place: Array | None = None
    bearing: float | None = None
    bearing_sigma: float | None = None
    bearings: int = 0

    def __post_init__(self) -> None:
        _as_arrays(self, "range", "moved", "target_moved", "covariance")

    @property
    def ends(self) -> tuple[Node, Node]:
        """The two nodes that it relates, the measuring robot first."""
        return (self.robot, self.stance), (self.target, self.target_stance)

    def __str__(self) -> str:
        return f"range of {self.target} by {self.robot} at {self.time:.3f} s"


#: Measurement that gives the pose of one node in another.
PoseMeasurement = RelativePose | Sighting | Odometry

#: Measurement between two nodes of the graph.
Measurement = PoseMeasurement | Range


MAX_KEYFRAME_INTERVAL = 1.0  # s, between keyframes of a robot: a long step with turns in it is no arc


@dataclass(frozen=True, eq=False)
class Steps:
    """Odometry of one robot between its n keyframes.

    Parameters
    ----------
    delays : (d,) float
        Delays of the odometry [s], ascending, at which the steps were evaluated.
    twists : (d, n - 1, 3) float
        SE(2) logarithms of the steps at each delay: x [m], y [m], heading [rad].
    covariances : (n - 1, 3, 3) float
        Covariances of each step's second pose in the first.
    """

    delays: Array
    twists: Array
    covariances: Array

    def part(self, first: int, until: int) -> "Steps":
        """Return the steps between some keyframes: from `first` to the one before `until`."""
        some = slice(first, max(until - 1, first))
        return Steps(self.delays, self.twists[:, some], self.covariances[some])


@dataclass(frozen=True, eq=False)
class RangeBearings:
    """Columns of n measurements of range and bearing, in the order of time.

    Parameters
    ----------
    time : (n,) float
        Time [UTC s].
    robot, keyframe : (n,) int
        Number of the observer and of its keyframe.
    target, target_keyframe : (n,) int
        Number of the measured robot and of its keyframe; of a landmark the number of robots plus its own, and -1.
    range, bearing : (n,) float
        Range [m] and bearing [rad]; a bearing of NaN was not measured.
    share : (n, 2) float
        Share of the information of range and bearing that is new: successive errors of a target are correlated. 0 of
        a bearing that was not measured.
    """

    time: Array
    robot: NDArray[np.int64]
    keyframe: NDArray[np.int64]
    target: NDArray[np.int64]
    target_keyframe: NDArray[np.int64]
    range: Array
    bearing: Array
    share: Array

    def __len__(self) -> int:
        return len(self.time)

    def of(self, rows: NDArray[np.bool_] | slice) -> "RangeBearings":
        """Return some of the measurements."""
        return RangeBearings(*(getattr(self, one.name)[rows] for one in fields(self)))


@dataclass(frozen=True, eq=False)
class RangeBearing:
    """One measurement of range [m] and bearing [rad], NaN if there is none, of `target` by `robot`, each at a keyframe.

    `time` is in UTC seconds, `row` its index in the `RangeBearings` of the run; a landmark's `target_keyframe` is -1.
    """

    row: int
    time: float
    robot: str
    keyframe: int
    target: str
    target_keyframe: int
    range: float
    bearing: float

    @property
    def ends(self) -> tuple[Node, Node]:
        """The two nodes that it relates, observer first."""
        return (self.robot, self.keyframe), (self.target, self.target_keyframe)

    def __str__(self) -> str:
        return f"range of {self.target} by {self.robot} at {self.time:.3f} s"


@dataclass(frozen=True, eq=False)
class Keyframes:
    """Keyframes of a team with their odometry and measurements: those of a whole run, or a part of them.

    Parameters
    ----------
    robots, landmarks : tuple of str
        Names by number.
    times : tuple of (n,) float
        Times of each robot's keyframes [UTC s], ascending.
    steps : tuple of Steps
        Odometry between each robot's keyframes.
    measured : RangeBearings
        Ranges and bearings.
    warnings : tuple of str
        Sentences on recorded data that was left out.
    begins : tuple of int
        Number of each robot's first keyframe; () if these are all from 0 on.
    """

    robots: tuple[str, ...]
    landmarks: tuple[str, ...]
    times: tuple[Array, ...]
    steps: tuple[Steps, ...]
    measured: RangeBearings
    warnings: tuple[str, ...] = ()
    begins: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "begins", self.begins or (0,) * len(self.robots))

    def __repr__(self) -> str:
        counts = f"{sum(map(len, self.times))} keyframes, {len(self.measured)} measurements"
        return f"Keyframes({len(self.robots)} robots, {len(self.landmarks)} landmarks, {counts})"

    @property
    def ends(self) -> tuple[int, ...]:
        """Number of the keyframe that comes after each robot's last one."""
        return tuple(begin + len(times) for begin, times in zip(self.begins, self.times, strict=True))

    def between(self, after: float, until: float) -> "Keyframes":
        """Return what came from one time to before another [UTC s], as `KeyframeEstimator` takes it.

        Each robot's last keyframe before it comes first, for the step to the next one.
        """
        found = [np.searchsorted(times, (after, until)).tolist() for times in self.times]
        first = [max(one - 1, 0) for one, _ in found]
        begin, end = np.searchsorted(self.measured.time, (after, until)).tolist()
        return self._part(first, [last for _, last in found], slice(begin, end))

    def since(self, begins: Sequence[int]) -> "Keyframes":
        """Return the keyframes from these numbers on, with the measurements between them and of landmarks."""
        m, first = self.measured, np.array(begins)
        of_landmark, target = m.target >= len(first), np.minimum(m.target, len(first) - 1)
        there = (m.keyframe >= first[m.robot]) & (of_landmark | (m.target_keyframe >= first[target]))
        return self._part((first - self.begins).tolist(), [len(times) for times in self.times], there)

    def followed_by(self, *later: "Keyframes") -> "Keyframes":
        """Return these keyframes and those after them, which begin with each robot's last one before, if it has any."""
        parts, times, steps, begins = (self, *later), [], [], []
        for robot in range(len(self.robots)):
            first, *more = [one for one in parts if len(one.times[robot])] or [self]
            begins.append(first.begins[robot])
            times.append(np.concatenate([first.times[robot], *(one.times[robot][1:] for one in more)]))
            of = [one.steps[robot] for one in (first, *more)]
            twists, C = np.concatenate([one.twists for one in of], axis=1), [one.covariances for one in of]
            steps.append(Steps(of[0].delays, twists, np.concatenate(C)))
        columns = (np.concatenate([getattr(one.measured, of.name) for one in parts]) for of in fields(RangeBearings))
        said = tuple(one for part in parts for one in part.warnings)
        measured = RangeBearings(*columns)
        return Keyframes(self.robots, self.landmarks, tuple(times), tuple(steps), measured, said, tuple(begins))

    def _part(self, first: list[int], last: list[int], rows: NDArray[np.bool_] | slice) -> "Keyframes":
        """Return keyframes from `first` to before `last` of each robot, counted from those here, and measurements."""
        spans = list(zip(first, last, strict=True))
        times = tuple(one[a:b] for one, (a, b) in zip(self.times, spans, strict=True))
        steps = tuple(one.part(a, b) for one, (a, b) in zip(self.steps, spans, strict=True))
        begins = tuple(a + begin for a, begin in zip(first, self.begins, strict=True))
        return Keyframes(self.robots, self.landmarks, times, steps, self.measured.of(rows), begins=begins)
