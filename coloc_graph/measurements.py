"""What passes between the front end and the back end; defined once, below both.

Frames: `T_a_b` is the pose of b in a. Covariances are in GTSAM's tangent order, rotation [rad] first, then
translation [m], in the body frame of the right-hand side: T_true = T_measured exp(xi). What is known on the floor
alone has a covariance (3, 3) of the tangent's heading, x and y.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import MeasurementError

Array = NDArray[np.float64]

#: A robot at a stance: a node of the graph.
Node = tuple[str, int]


def _as_arrays(measured: Any, *names: str) -> None:
    """Make float arrays of these fields of a measurement; a field that has a `matrix()` gives that."""
    for name in names:
        value = getattr(measured, name)
        try:
            array = np.asarray(value.matrix() if hasattr(value, "matrix") else value, float)
        except (TypeError, ValueError) as error:
            raise MeasurementError(f"{name} of the {measured} is no array of numbers: {error}") from error
        object.__setattr__(measured, name, array)


@dataclass(frozen=True, eq=False)
class Plane:
    """The plane of the markers in a camera frame: N . X = d, N a unit normal (3,) from the camera to the plane.

    `normal_sigma` [rad] and `d_sigma` [m] are what is uncertain besides the mount. Where the normal or the
    distance was computed from the mount, its error is the mount's error too: `*_from_mount` say so.
    """

    N: Array
    d: float
    normal_sigma: float = 0.0
    d_sigma: float = 0.0
    normal_from_mount: bool = False
    d_from_mount: bool = False


@dataclass(frozen=True, eq=False)
class HomographyMeasurement:
    """The homography that the marker plane induces between two observers at rest in one stance.

    `H_j_i` (3, 3) takes normalised coordinates in camera i to camera j, determinant 1. `information` (8, 8) is
    that of its sl(3) coordinates on the right: H_true = H_j_i exp(sum of h_a SL3_BASIS[a]). `chi2` has `dof`
    degrees of freedom. `overlap_px` is how many pixels of image i see what image j sees of the plane.
    `unusable` is None, or why this is not a measurement, in words; the numbers then mean nothing.

    What i's clock calls t, j's calls t + `time_offset` [s]; `time_offset_sigma` [s] is its standard deviation, which
    `information` contains (both 0 where the clocks are said to agree); `by_time_offset` (8,) is what the true
    homography is off by, in those coordinates, for each second that the true offset is larger. `warning` is None, or
    what about the measurement is weaker than it looks, in words; `doubt` is None, or a reason for which it is used by
    the paper's chain alone. Where more than two observers saw the same markers
    their homographies are not independent: `share` is the part of what the pair's points say that `information` takes.
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

    @property
    def residual(self) -> float:
        """RMS residual in units of the noise."""
        return float(np.sqrt(self.chi2 / self.dof)) if self.dof > 0 else float("nan")


@dataclass(frozen=True, eq=False)
class MarkerSpan:
    """Two markers of `mover`, a known span apart, at n instants at which both observers of a pair saw both.

    `x_i` (n, 2, 2) are the rays (x, y, 1) to both in camera i, by what both images say alike; `covariance`
    (n, 2, 2, 2) is theirs. They hold for the homography as it was measured: by `by_h` (n, 2, 2, 8) they change with
    its coordinates h, and at the true h they are independent of its error. `shared` (n, 2, 2, q) is a square root of
    the covariance of what all rays to one marker share besides.
    """

    mover: str
    x_i: Array
    covariance: Array
    by_h: Array
    shared: Array


@dataclass(frozen=True, eq=False)
class RelativePose:
    """Pose of observer j's body in observer i's body at one stance, however it was measured.

    Parameters
    ----------
    stance
        Number of the stance.
    robot_i, robot_j
        Names of the two observers.
    T_i_j
        Pose of body j in body i, (4, 4); a `gtsam.Pose3` is taken, too.
    covariance
        Covariance (6, 6): rotation [rad] first, then translation [m], in the frame of body j.
    T_ci_cj
        Pose of camera j in camera i, (4, 4), where a homography gave it.
    solution
        Number of the SVD solution whose normal is nearest to the known one.
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
        Number of the stance.
    observer, seen
        Names of the robot that sees, and of the robot or landmark that is seen.
    time
        When [UTC s, observer's clock]; the pose at this stance of a robot that moves during it is its pose then.
    T_observer_seen
        Pose of body `seen` in body `observer`, (4, 4); a `gtsam.Pose3` is taken, too.
    covariance
        Covariance (3, 3) of heading [rad], x, y [m], in the frame of `seen`: both stand on the floor.
    x_markers, x_covariance
        Rays (x, y, 1) to its first two markers, (2, 2), and their covariance (2, 2, 2). The joint estimate takes these
        instead of the pose.
    """

    stance: int
    observer: str
    seen: str
    time: float
    T_observer_seen: Array
    covariance: Array
    x_markers: Array | None = None
    x_covariance: Array | None = None

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
        Numbers of the two stances, in the order of time.
    T_before_after
        Pose of its body at `after` in its body at `before`, (4, 4); a `gtsam.Pose3` is taken, too.
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


#: What ties two nodes of the graph.
Measurement = RelativePose | Sighting | Odometry


#: Keyframes of a robot are no further apart [s]: a long step with turns in it is no arc.
LONGEST_STEP = 1.0


@dataclass(frozen=True, eq=False)
class Steps:
    """One robot's way from each of its n keyframes to the next, by its odometry.

    `twists` (delays, n - 1, 3) are the SE(2) logarithms (x [m], y [m], heading [rad]) of the steps that odometry says,
    at each of some `delays` (d,) [s] of it, ascending; `covariances` (n - 1, 3, 3) are of the second pose in the first.
    """

    delays: Array
    twists: Array
    covariances: Array


@dataclass(frozen=True, eq=False)
class RangeBearings:
    """Measurements of range and bearing as columns, in the order of time [UTC s].

    `robot` and `keyframe` say who measured where, `target` whom: a robot's number, with its keyframe in
    `target_keyframe`, or the number of robots plus a landmark's, with -1 there. `share` (n, 2) is the part of a range's
    and of a bearing's information that is new: the errors of the same target's next measurement are much alike.
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


@dataclass(frozen=True, eq=False)
class RangeBearing:
    """One measurement of range [m] and bearing [rad] at a time [UTC s], of `target` by `robot`, each at a keyframe.

    `row` is its place among the `RangeBearings` of the run; a landmark's `target_keyframe` is -1.
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
class Drive:
    """All of a team's keyframes: `times` [UTC s] of each robot's, ascending, its `steps`, and the `measured`.

    `warnings` are sentences on what was left out.
    """

    robots: tuple[str, ...]
    landmarks: tuple[str, ...]
    times: tuple[Array, ...]
    steps: tuple[Steps, ...]
    measured: RangeBearings
    warnings: tuple[str, ...] = ()

    def __repr__(self) -> str:
        counts = f"{sum(map(len, self.times))} keyframes, {len(self.measured)} measurements"
        return f"Drive({len(self.robots)} robots, {len(self.landmarks)} landmarks, {counts})"
