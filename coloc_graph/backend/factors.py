"""GTSAM's factors of what a graph holds: gauge, floor priors, links; as poses alone, or jointly with the mounts."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Literal

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.batched_factors import MAX_BATCH_SIZE, BatchedFactor, BatchedFactors
from coloc_graph.backend.calibration import Variables, is_calibration
from coloc_graph.backend.graph import Link, PoseGraph, PoseLink, StayPut, pose_of
from coloc_graph.backend.homography_factor import (
    homography_factors,
    homography_poses,
    markers_factor,
    range_factor,
    sighted_pose,
)
from coloc_graph.errors import EstimationError
from coloc_graph.measurements import Range, RelativePose, Sighting
from coloc_graph.team import Floor, Robot

Array = NDArray[np.float64]

POINT_YAW_SIGMA = 1.0  # rad: sigma of the meaningless heading of a landmark that is a point
GAUGE_SIGMA = 1e-6  # rad, m: sigma of the prior that fixes the world frame, far below any measurement's
MIN_FLOOR_SIGMA = 1e-5  # rad, m: sigma of a floor that is stated as exactly flat
BODY_LENGTH = 0.05  # m: height by which an uneven floor raises a body, per rad of tilt
_UP = np.array([0.0, 0.0, 1.0])
_ORIGIN = np.zeros(3)


#: Estimated variables: poses (`smooth`; `chain` composes the same), or calibration variables as well (`joint`).
Method = Literal["chain", "smooth", "joint"]


def factors_for(method: Method, graph: PoseGraph, known: gtsam.Values | None = None) -> "Factors":
    """Return the factory of a graph's factors; spans are linearised at the mounts in `known`, else as stated."""
    if method != "joint":
        return Factors(graph.floor)
    variables = Variables(graph.robots, graph.robot_models, graph.landmarks)
    if known is not None:
        variables.anchors |= calibrations_in(known)
    return Factors(graph.floor, variables)


def poses_in(values: gtsam.Values) -> list[int]:
    """Return the keys of poses."""
    return [key for key in map(int, values.keys()) if not is_calibration(key)]


def calibrations_in(values: gtsam.Values) -> dict[int, Array]:
    """Return the calibration variables, by key."""
    return {key: values.atVector(key) for key in map(int, values.keys()) if is_calibration(key)}


def require_robot_models(robots: Iterable[str], robot_models: Mapping[str, Robot]) -> None:
    """Raise `EstimationError` where a robot's mount is not known."""
    for robot in robots:
        if robot not in robot_models:
            raise EstimationError(
                f"the mount of robot {robot} cannot be calibrated, since it is not known: make the graph of a team "
                "(`PoseGraph.of`), or use `smooth`"
            )


def _share(link: Link) -> float:
    """Share of a link's rows that is its own: homographies of the same pixels share them."""
    return link.homography.share if isinstance(link, RelativePose) and link.homography is not None else 1.0


class Factors:
    """Factory of the factors of a team on its floor.

    With `variables` a link that holds image measurements is a factor on them and on calibration variables
    (`homography_factor`); otherwise every link is a between-factor.
    """

    def __init__(self, floor: Floor | None, variables: Variables | None = None) -> None:
        self.floor, self.variables = floor, variables
        self._ready: dict[int, gtsam.NonlinearFactor] = {}
        self._between: dict[int, tuple[Link, gtsam.NonlinearFactor]] = {}  # of links of a graph, by identity
        tilt, height = GAUGE_SIGMA, GAUGE_SIGMA
        if floor is not None:
            tilt = max(float(np.deg2rad(floor.tilt_sigma_deg)), MIN_FLOOR_SIGMA)
            height = max(floor.height_sigma, tilt * BODY_LENGTH, MIN_FLOOR_SIGMA)
        self.gauge_sigmas = np.array([tilt, tilt, GAUGE_SIGMA, GAUGE_SIGMA, GAUGE_SIGMA, height])
        # not Diagonal.Precisions: a sigma that is infinite cannot be read back from a serialised graph
        self._level = gtsam.noiseModel.Gaussian.SqrtInformation(np.diag([1 / tilt, 1 / tilt, 0.0]), False)
        self._on_floor = gtsam.noiseModel.Gaussian.SqrtInformation(np.diag([0.0, 0.0, 1 / height]), False)

    def dof(self, values: gtsam.Values, links: Iterable[tuple[Link, gtsam.NonlinearFactor]], points: int = 0) -> int:
        """Return the degrees of freedom of links and their factors: rows of weight less unknowns.

        `points` poses have a prior of their heading.

        Calibration variables have as many priors as unknowns.
        """
        poses = len(poses_in(values))
        priors = points + 6 + (0 if self.floor is None else 3) * (poses - 1)
        return priors + round(sum(_share(link) * self.rows(link, factor) for link, factor in links)) - 6 * poses

    def rows(self, link: Link, factor: gtsam.NonlinearFactor) -> int:
        """Return the number of residuals of a link, given its factor."""
        if isinstance(link, Range) or (self.variables is not None and self._as_seen(link)):
            return int(factor.dim())
        return 6 if isinstance(link, RelativePose | StayPut) else 3

    def _as_seen(self, link: Link) -> bool:
        """Return whether a link becomes a factor on image measurements."""
        if isinstance(link, Range):
            return True
        if self.variables is None:
            return False
        if isinstance(link, Sighting):
            return link.x_markers is not None and self.floor is not None
        return isinstance(link, RelativePose) and link.homography is not None and link.plane is not None

    def gauge(self, key: int) -> gtsam.NonlinearFactor:
        """Return the prior of the pose that defines the world."""
        noise = gtsam.noiseModel.Diagonal.Sigmas(self.gauge_sigmas)
        return gtsam.PriorFactorPose3(key, gtsam.Pose3(), noise)

    def of_pose(self, key: int) -> tuple[gtsam.NonlinearFactor, ...]:
        """Return the priors of any other pose: it stands on the floor, where there is one.

        The residual of a tilt is in the body frame (GTSAM's magnetometer serves for it). That of GTSAM's
        `AttitudeFactorPose3` is in the world frame and turns with the body: to Gauss-Newton a tilt then seems to tell
        the heading.
        """
        if self.floor is None:
            return ()
        return (
            gtsam.MagPoseFactorPose3(key, _UP, 1.0, _UP, _ORIGIN, self._level),
            gtsam.PoseTranslationPrior3D(key, _ORIGIN, self._on_floor),
        )

    @staticmethod
    def of_point(key: int) -> gtsam.NonlinearFactor:
        """Return the prior of the heading of a landmark that is a point."""
        R = np.zeros((6, 6))
        R[2, 2] = 1 / POINT_YAW_SIGMA
        return gtsam.PriorFactorPose3(key, gtsam.Pose3(), gtsam.noiseModel.Gaussian.SqrtInformation(R, False))

    def of_new(self, key: int, *, is_point: bool) -> tuple[gtsam.NonlinearFactor, ...]:
        """Return the priors of a new variable: calibration, or a pose other than that of the world, maybe a point's."""
        if is_calibration(key):
            return (self.calibration_prior(key),)
        return *self.of_pose(key), *((self.of_point(key),) if is_point else ())

    def leading(self, link: Link, i: int, j: int, errors: Callable[[int], Array]) -> gtsam.NonlinearFactor | None:
        """Return the between-factor by which a distant sighting is tested and led in; None of other links.

        A landmark that drift has displaced is far off in the image, or behind the camera: there its pixels give
        neither a distance nor a gradient.
        """
        if not isinstance(link, Sighting) or self.variables is None:
            return None
        return self.between(link, i, j, self.expected(link, i, j, errors))

    def of_link(self, link: Link, i: int, j: int) -> gtsam.NonlinearFactor:
        """Return the factor of a link on the keys of its two poses and of its calibration variables."""
        ready = self._ready.pop(id(link), None)
        if ready is not None and list(ready.keys()[:2]) == [i, j]:
            return ready
        if isinstance(link, Range):
            if self.variables is None:
                raise EstimationError(f"the {link} needs a joint estimate, which calibrates range sensors: use `joint`")
            return range_factor(link, i, j, self.variables)
        if self.variables is not None and self._as_seen(link):
            if isinstance(link, Sighting):
                return markers_factor(link, i, j, self.variables)
            assert isinstance(link, RelativePose)
            return homography_factors([(link, i, j)], self.variables, self.floor is not None)[0]
        return self.between(link, i, j, pose_of(link))

    def _again(self, link: Link, i: int, j: int) -> gtsam.NonlinearFactor:
        """Return the factor of a link of a graph; where poses alone are estimated, as it was made before."""
        if self.variables is not None:
            return self.of_link(link, i, j)
        before = self._between.get(id(link))
        if before is None or before[0] is not link:
            before = self._between[id(link)] = link, self.of_link(link, i, j)
        return before[1]

    @staticmethod
    def between(link: PoseLink, i: int, j: int, T_i_j: gtsam.Pose3) -> gtsam.NonlinearFactor:
        """Return a link as a between-factor of the two poses alone, with its covariance as such."""
        return gtsam.BetweenFactorPose3(i, j, T_i_j, _noise(link))

    def expected(self, link: PoseLink, i: int, j: int, errors: Callable[[int], Array]) -> gtsam.Pose3:
        """Return the pose of a link's second end in its first; see `all_expected`."""
        if self.variables is None:
            return pose_of(link)
        return self.all_expected([(link, i, j)], errors)[0]

    def all_expected(
        self, links: Sequence[tuple[PoseLink, int, int]], errors: Callable[[int], Array]
    ) -> list[gtsam.Pose3]:
        """Return the poses of links' second ends in their first, with calibration variables at `errors` of their keys.

        Links come with the keys of their ends. The factors made for this are kept for the insertion of the links.
        """
        poses = [pose_of(link) for link, _, _ in links]
        if self.variables is None or self.floor is None:
            return poses
        self._make_ready(links)
        homographies: dict[int, tuple[RelativePose, BatchedFactor]] = {}
        for n, (link, i, j) in enumerate(links):
            if not self._as_seen(link):
                continue
            if isinstance(link, Sighting):
                poses[n] = sighted_pose(link, self.variables, errors)
            elif isinstance(link, RelativePose):
                factor = self.of_link(link, i, j)
                assert isinstance(factor, BatchedFactor)
                self._ready[id(link)] = factor
                homographies[n] = link, factor
        pairs = homographies.values()
        found = homography_poses([link for link, _ in pairs], [factor for _, factor in pairs], errors)
        for n, pose in zip(homographies, found, strict=True):
            poses[n] = pose
        return poses

    def _make_ready(self, links: Sequence[tuple[Link, int, int]]) -> None:
        """Make the factors of all homographies among links, given with the keys of their ends, at once."""
        if self.variables is None:
            return
        new = [
            (link, i, j)
            for link, i, j in links
            if isinstance(link, RelativePose) and id(link) not in self._ready and self._as_seen(link)
        ]
        for first in range(0, len(new), MAX_BATCH_SIZE):
            some = new[first : first + MAX_BATCH_SIZE]
            made = homography_factors(some, self.variables, self.floor is not None)
            self._ready.update(zip((id(link) for link, _, _ in some), made, strict=True))

    def of_graph(
        self, graph: PoseGraph, keys: Iterable[int]
    ) -> tuple[gtsam.NonlinearFactorGraph, tuple[Link, ...], BatchedFactors]:
        """Return the factors on `keys`, the links among them, and the context in which they are evaluated in batches.

        The links' factors come last, in the order of the links.
        """
        wanted = set(keys)
        factors = gtsam.NonlinearFactorGraph()
        reference = graph.reference_key
        factors.add(self.gauge(reference))
        for key in sorted(wanted - {reference}):
            for factor in self.of_pose(key):
                factors.add(factor)
        for name in graph.ranged_points:
            if graph.pose_keys.static()[name] in wanted:
                factors.add(self.of_point(graph.pose_keys.static()[name]))
        ends = [(link, *graph.ends[id(link)]) for link in graph.links]
        ends = [(link, i, j) for link, i, j in ends if i in wanted and j in wanted and i != j]
        self._make_ready(ends)
        links, made = [link for link, _, _ in ends], [self._again(*one) for one in ends]
        for key in sorted({key for factor in made for key in factor.keys()[2:]}):
            factors.add(self.calibration_prior(key))
        for factor in made:
            factors.add(factor)
        return factors, tuple(links), BatchedFactors([one.evaluator for one in made if isinstance(one, BatchedFactor)])

    def nominal(self, key: int) -> Array:
        """Return the initial value of a calibration variable: as stated."""
        assert self.variables is not None
        return self.variables.start(key)

    def is_anchored(self, values: gtsam.Values) -> bool:
        """Return whether spans were linearised close enough to the estimated mounts."""
        return self.variables is None or self.variables.is_anchored(calibrations_in(values))

    def calibration_prior(self, key: int) -> gtsam.NonlinearFactor:
        """Return the prior factor of a calibration variable."""
        assert self.variables is not None
        return self.variables.prior(key)

    def start(self, pose: gtsam.Pose3) -> gtsam.Pose3:
        """Return the initial value of a pose: on the floor, where there is one.

        Bodies that start tilted couple heading and height once their linearisations differ, and ISAM2 then redoes
        the whole chain at every step (measured at stance 600: 10 ms an update against 0.16).
        """
        if self.floor is None:
            return pose
        return gtsam.Pose3(gtsam.Rot3.Yaw(pose.rotation().yaw()), np.array([pose.x(), pose.y(), 0.0]))


def link_covariance(link: PoseLink) -> Array:
    """Return the covariance of a link, (6, 6), or (3, 3) of heading, x, y."""
    if isinstance(link, StayPut):
        assert link.slip is not None
        turn = np.deg2rad(link.slip.sigma_deg)
        return np.diag(np.square([turn, turn, turn, link.slip.sigma, link.slip.sigma, link.slip.sigma]))
    return link.covariance


def _noise(link: PoseLink) -> gtsam.noiseModel.Gaussian:
    C = link_covariance(link)
    if len(C) == 6:
        return gtsam.noiseModel.Gaussian.Covariance(C)
    # heading, x and y alone are measured; the rows of roll, pitch and height are zero
    R = np.zeros((6, 6))
    R[2:5, 2:5] = gtsam.noiseModel.Gaussian.Covariance(C, False).R()
    return gtsam.noiseModel.Gaussian.SqrtInformation(R, False)  # not diagonal, which would have infinite sigmas
