"""What a method makes of a graph: the poses of all robots at all stances, and what is needed to doubt them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.calibration import Calibration, Variables
from coloc_graph.backend.chi2_test import UNCHECKED, Agreement
from coloc_graph.backend.factors import Factors, Method, calibrations_in, poses_in
from coloc_graph.backend.graph import PoseGraph, StayPut
from coloc_graph.backend.landmarks import MAP, OnMap, Placed
from coloc_graph.backend.marginals import Posterior
from coloc_graph.errors import EstimationError
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.measurements import Measurement, Node

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Rejection:
    """A measurement, or a place on the map, that was left out, and why, in words."""

    measurement: Measurement | OnMap
    reason: str


@dataclass(frozen=True, eq=False)
class Bump:
    """An anchor that did not stay put: what the others say it did, and how many sigmas that is off its stay-put.

    `T_before_after` is its body after in its body before.
    """

    stay_put: StayPut
    T_before_after: gtsam.Pose3
    sigmas: float

    @property
    def what(self) -> str:
        """What happened, in words."""
        stay, moved = self.stay_put, self.T_before_after
        far, turned = float(np.linalg.norm(moved.translation())), abs(np.rad2deg(moved.rotation().yaw()))
        return (
            f"robot {stay.robot} was bumped between stances {stay.before} and {stay.after}, where it should have "
            f"stayed put: it moved by {100 * far:.1f} cm and turned by {turned:.1f} deg ({self.sigmas:.0f} sigmas)"
        )

    def __str__(self) -> str:
        return f"{self.what}; do not name it as an anchor of stance {self.stay_put.after}"


@dataclass(frozen=True, eq=False)
class Estimate:
    """Poses of all robots at all stances that are tied to the reference.

    `trajectories` by robot, one pose a stance at which it is a node. `chi2` with `dof` degrees of freedom says how
    well the measurements agree (dof 0: nothing could contradict). `untied` are the (robot, stance) that no
    measurement ties to the reference; they have no pose. `refused` are the measurements that all others contradict,
    and `bumped` the anchors that did. `calibration` is what a joint estimate found of mounts, markers and clocks.
    `landmarks` are those that were sighted, by name, and `map` is where the map of those that are on one is.
    """

    method: Method
    graph: PoseGraph
    trajectories: Mapping[str, Trajectory]
    untied: tuple[Node, ...] = ()
    chi2: float = 0.0
    dof: int = 0
    iterations: int = 0
    refused: tuple[Rejection, ...] = ()
    bumped: tuple[Bump, ...] = ()
    calibration: Calibration = field(default_factory=Calibration)
    landmarks: Mapping[str, Placed] = field(default_factory=dict)
    map: Placed | None = None

    def pose(self, robot: str, stance: int) -> gtsam.Pose3:
        """T_world_body of a robot at a stance; `EstimationError` where it has none."""
        T, _ = self._at(robot, stance)
        return gtsam.Pose3(T)

    def covariance(self, robot: str, stance: int) -> Array:
        """Covariance (6, 6) of that pose: GTSAM's tangent, rotation [rad] first, then translation [m], body frame."""
        return self._at(robot, stance)[1]

    def joint_covariance(self, nodes: Sequence[Node]) -> Array:
        """Joint covariance (6 n, 6 n) of n (robot, stance), each in its own body's tangent, in the order given.

        Poses that are one place have the same rows. Raises `EstimationError` where one has no pose.
        """
        if not nodes:
            raise EstimationError("name at least one robot and stance to have a covariance")
        if self.method == "chain":
            raise EstimationError("a chain has no joint covariances: it uses some measurements only; use `smooth`")
        for node in nodes:
            self._at(*node)
        keys = [self.graph.key(*node) for node in nodes]
        different = list(dict.fromkeys(keys))
        joint = self._posterior.joint(different)
        index = np.concatenate([6 * different.index(key) + np.arange(6) for key in keys])
        return np.asarray(joint[np.ix_(index, index)])

    def residual(self, measurement: Measurement) -> float:
        """How far a measurement is from the estimate, RMS in units of its noise; NaN where an end of it has no pose."""
        values, graph = self._values, self.graph
        i, j = (graph.key(*end) for end in measurement.ends)
        if not (values.exists(i) and values.exists(j)) or i == j:
            return float("nan")
        factors = Factors(graph.floor, self.calibration.variables)
        factor = factors.of_link(measurement, i, j)
        if not all(map(values.exists, factor.keys())):
            return float("nan")
        return float(np.sqrt(2 * factor.error(values) / factors.rows(measurement, factor)))

    @cached_property
    def _values(self) -> gtsam.Values:
        values = gtsam.Values()
        for robot, trajectory in self.trajectories.items():
            assert trajectory.stances is not None
            for stance, T in zip(trajectory.stances.tolist(), trajectory.T_world_body, strict=True):
                key = self.graph.key(robot, stance)
                if not values.exists(key):
                    values.insert(key, gtsam.Pose3(T))
        for name, placed in {**self.landmarks, **({} if self.map is None else {MAP: self.map})}.items():
            values.insert(self.graph.places.still()[name], placed.T_world_body)
        for key, errors in self.calibration.values.items():
            values.insert(key, errors)
        return values

    @cached_property
    def _posterior(self) -> Posterior:
        used = self.graph.without(one.measurement for one in self.refused)
        factors_of = Factors(self.graph.floor, self.calibration.variables)
        factors, _, at_once = factors_of.of_graph(used, poses_in(self._values))
        with at_once:
            return Posterior(factors, self._values)

    @cached_property
    def _index(self) -> dict[Node, int]:
        return {
            (robot, stance): at
            for robot, trajectory in self.trajectories.items()
            if trajectory.stances is not None
            for at, stance in enumerate(trajectory.stances.tolist())
        }

    def _at(self, robot: str, stance: int) -> tuple[Array, Array]:
        at, trajectory = self._index.get((robot, stance)), self.trajectories.get(robot)
        if at is None or trajectory is None or trajectory.covariances is None:
            raise EstimationError(f"robot {robot} has no pose at stance {stance}")
        return trajectory.T_world_body[at], trajectory.covariances[at]


@dataclass(frozen=True, eq=False)
class StanceEstimate:
    """Where the robots of one stance stand: `poses` T_world_body, and `covariances` (6, 6) in GTSAM's tangent.

    Robots that nothing ties to the reference are `untied`. `refused` is what was refused in this call, and `agreement`
    says how all that it took in, together, agrees with what was in before; `residuals` are of the measurements that
    came with the stance, in their order: RMS in units of their noise, NaN where an end of it has no pose. `landmarks`
    are those that were sighted in it, where they are now.
    """

    stance: int
    poses: Mapping[str, gtsam.Pose3]
    covariances: Mapping[str, Array]
    untied: tuple[str, ...] = ()
    refused: tuple[Rejection, ...] = ()
    agreement: Agreement = UNCHECKED
    residuals: tuple[float, ...] = ()
    landmarks: Mapping[str, Placed] = field(default_factory=dict)


def make_estimate(
    method: Method,
    graph: PoseGraph,
    values: gtsam.Values,
    covariances: Mapping[int, Array],
    *,
    variables: Variables | None = None,
    chi2: float = 0.0,
    dof: int = 0,
    iterations: int = 0,
    refused: tuple[Rejection, ...] = (),
    bumped: tuple[Bump, ...] = (),
) -> Estimate:
    """An estimate of values, and of their covariances by key."""
    poses, errors = {key: values.atPose3(key) for key in poses_in(values)}, calibrations_in(values)
    nodes: dict[str, list[int]] = {robot: [] for robot in graph.robots}
    for robot, stance in graph.nodes:
        if graph.key(robot, stance) in poses:
            nodes[robot].append(stance)
    trajectories = {}
    for robot, stances in nodes.items():
        if stances:
            keys = [graph.key(robot, stance) for stance in stances]
            trajectories[robot] = Trajectory(
                robot=robot,
                times=np.array([graph.times[robot, stance] for stance in stances]),
                T_world_body=np.array([poses[key].matrix() for key in keys]),
                stances=np.array(stances),
                covariances=np.array([covariances[key] for key in keys]),
            )
    untied = graph.untied(poses)
    calibration = Calibration(variables, errors, {key: covariances[key] for key in errors})
    still = {name: Placed(poses[key], covariances[key]) for name, key in graph.places.still().items() if key in poses}
    here = still.pop(MAP, None)
    return Estimate(
        method, graph, trajectories, untied, chi2, dof, iterations, refused, bumped, calibration, still, here
    )
