"""GTSAM's factors of what a graph holds: gauge, floor priors, between-factors."""

from collections.abc import Iterable

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.graph import Link, PoseGraph, StayPut
from coloc_graph.measurements import RelativePose
from coloc_graph.team import Floor

Array = NDArray[np.float64]

#: The world frame is fixed this firmly [rad, m]; far below anything that is measured.
GAUGE_SIGMA = 1e-6
#: A floor that is called exactly flat is taken as flat to this much [rad, m].
LEAST_FLOOR_SIGMA = 1e-5
#: A floor that tilts a body raises it, too: by the tilt times this [m].
BODY_LENGTH = 0.25
_UP = gtsam.Unit3(np.array([0.0, 0.0, 1.0]))
_ORIGIN = np.zeros(3)


class Factors:
    """Makes the factors of a team on its floor; noise models that many share are made once."""

    def __init__(self, floor: Floor | None) -> None:
        self.floor = floor
        tilt, height = GAUGE_SIGMA, GAUGE_SIGMA
        if floor is not None:
            tilt = max(float(np.deg2rad(floor.tilt_sigma_deg)), LEAST_FLOOR_SIGMA)
            # tighter than that, far poses' heights bend the search: 100 iterations instead of 15 at 1,000 stances
            height = max(floor.height_sigma, tilt * BODY_LENGTH, LEAST_FLOOR_SIGMA)
        self.gauge_sigmas = np.array([tilt, tilt, GAUGE_SIGMA, GAUGE_SIGMA, GAUGE_SIGMA, height])
        self._level = gtsam.noiseModel.Isotropic.Sigma(2, tilt)
        self._on_floor = gtsam.noiseModel.Diagonal.Precisions(np.array([0.0, 0.0, height**-2]))

    @property
    def pose_rows(self) -> int:
        """How many rows the priors of one pose weigh."""
        return 0 if self.floor is None else 3

    def gauge(self, key: int) -> gtsam.NonlinearFactor:
        """The prior of the pose that defines the world."""
        noise = gtsam.noiseModel.Diagonal.Sigmas(self.gauge_sigmas)
        return gtsam.PriorFactorPose3(key, gtsam.Pose3(), noise)

    def of_pose(self, key: int) -> tuple[gtsam.NonlinearFactor, ...]:
        """The priors of any other pose: it stands on the floor, where there is one."""
        if self.floor is None:
            return ()
        return (
            gtsam.AttitudeFactorPose3(key, _UP, self._level),
            gtsam.PoseTranslationPrior3D(key, _ORIGIN, self._on_floor),
        )

    def of_link(self, link: Link, i: int, j: int) -> gtsam.NonlinearFactor:
        """The between-factor of two keys."""
        return gtsam.BetweenFactorPose3(i, j, link.T_i_j, _noise(link))

    def of_graph(self, graph: PoseGraph, keys: Iterable[int]) -> tuple[gtsam.NonlinearFactorGraph, tuple[Link, ...]]:
        """The factors over these keys, and the links among them; the links' factors come last, in that order."""
        wanted = set(keys)
        factors = gtsam.NonlinearFactorGraph()
        reference = graph.reference_key
        factors.add(self.gauge(reference))
        for key in sorted(wanted - {reference}):
            for factor in self.of_pose(key):
                factors.add(factor)
        links = []
        key_of = graph.places.key
        for link in graph.links:
            i, j = map(key_of, link.ends)
            if i in wanted and j in wanted and i != j:
                factors.add(self.of_link(link, i, j))
                links.append(link)
        return factors, tuple(links)

    def start(self, pose: gtsam.Pose3) -> gtsam.Pose3:
        """Where to start the search for a pose: on the floor, where there is one.

        Bodies that start tilted couple heading and height once their linearisations differ, and ISAM2 then redoes
        the whole chain at every step (measured at stance 600: 10 ms an update against 0.16).
        """
        if self.floor is None:
            return pose
        return gtsam.Pose3(gtsam.Rot3.Yaw(pose.rotation().yaw()), np.array([pose.x(), pose.y(), 0.0]))


def link_covariance(link: Link) -> Array:
    """The covariance of a link, (6, 6), or (3, 3) of heading, x, y."""
    if isinstance(link, StayPut):
        assert link.slip is not None
        turn = np.deg2rad(link.slip.sigma_deg)
        return np.diag(np.square([turn, turn, turn, link.slip.sigma, link.slip.sigma, link.slip.sigma]))
    return link.covariance


def rows(link: Link) -> int:
    """How many numbers a link measures."""
    return 6 if isinstance(link, RelativePose | StayPut) else 3


def _noise(link: Link) -> gtsam.noiseModel.Gaussian:
    C = link_covariance(link)
    if len(C) == 6:
        return gtsam.noiseModel.Gaussian.Covariance(C)
    # heading, x and y alone weigh; the rows of roll, pitch and height are zero
    R = np.zeros((6, 6))
    R[2:5, 2:5] = np.linalg.cholesky(np.linalg.inv(C)).T
    return gtsam.noiseModel.Gaussian.SqrtInformation(R)
