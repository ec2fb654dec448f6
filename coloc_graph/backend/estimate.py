"""Result of an estimation: poses of all robots at all stances, covariances, outliers and bumps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.calibration import Calibration, Variables, size_of
from coloc_graph.backend.cause import Cause, or_else, to_check
from coloc_graph.backend.chi2_test import UNCHECKED, Agreement
from coloc_graph.backend.factors import Factors, Method, calibrations_in, poses_in
from coloc_graph.backend.graph import PoseGraph, StayPut
from coloc_graph.backend.landmarks import MAP, OnMap, StaticPose
from coloc_graph.backend.marginals import Marginals
from coloc_graph.backend.ranging import RangingProblem
from coloc_graph.errors import EstimationError
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.measurements import Measurement, Node, Range, RangeBearing

Array = NDArray[np.float64]

NO_LINE_OF_SIGHT = "; was something in the line of sight?"  # continues the reason of a range that is an outlier


@dataclass(frozen=True, eq=False)
class Rejection:
    """A measurement, or a landmark's position on the map, that was rejected as an outlier.

    Parameters
    ----------
    measurement : Measurement, RangeBearing or OnMap
        The outlier itself.
    reason : str
        Reason in words.
    sigmas : float
        Distance from all other measurements in standard deviations.
    alternative : tuple of Cause
        Other causes that would explain the measurements as well.
    """

    measurement: Measurement | RangeBearing | OnMap
    reason: str
    sigmas: float = float("nan")
    alternative: tuple[Cause, ...] = ()


def rejection_of(measurement: Measurement | RangeBearing | OnMap, off: Agreement) -> Rejection:
    """Return the rejection of an outlier, by its test statistic."""
    cause = NO_LINE_OF_SIGHT if isinstance(measurement, Range) else ""
    return Rejection(measurement, f"{off.reason}{cause}", off.sigmas)


@dataclass(frozen=True, eq=False)
class Bump:
    """An anchor that did not stay put.

    Parameters
    ----------
    stay_put : StayPut
        The constraint that it violates.
    T_before_after : gtsam.Pose3
        Its body after the bump in its body before, by the other measurements.
    sigmas : float
        Distance from the stay-put constraint in standard deviations.
    alternative : tuple of Cause
        Other causes that would explain the measurements as well; what they say is wrong is taken to be as uncertain as
        it then is off.
    """

    stay_put: StayPut
    T_before_after: gtsam.Pose3
    sigmas: float
    alternative: tuple[Cause, ...] = ()

    @property
    def description(self) -> str:
        """The event in one sentence."""
        stay, moved = self.stay_put, self.T_before_after
        far, turned = float(np.linalg.norm(moved.translation())), abs(np.rad2deg(moved.rotation().yaw()))
        return (
            f"robot {stay.robot} was bumped between stances {stay.before} and {stay.after}, where it should have "
            f"stayed put: it moved by {100 * far:.1f} cm and turned by {turned:.1f} deg ({self.sigmas:.0f} sigmas)"
        )

    def __str__(self) -> str:
        if self.alternative:
            return (
                f"{self.description}{or_else(self.alternative)}: both explain the measurements equally well and the "
                f"estimate is as uncertain as either; check {to_check(Cause((self.stay_put,)), *self.alternative)}"
            )
        return f"{self.description}; do not name it as an anchor of stance {self.stay_put.after}"


@dataclass(frozen=True, eq=False)
class Estimate:
    """Poses of all robots that are tied to the world frame, with covariances, outliers and calibration.

    A node is (robot, index): the index of a stance, or, of a ranging run, the number of a robot's keyframe.

    Parameters
    ----------
    method : {"chain", "smooth", "joint", "ranging"}
        Method of estimation.
    source : PoseGraph or RangingProblem
        The estimated problem; `graph` and `ranging` give one or the other.
    trajectories : mapping of str to Trajectory
        By robot, one pose a node that has one.
    disconnected : tuple of Node
        Nodes that no measurement ties to the world frame; they have no pose.
    chi2, dof : float
        Squared error of all measurements used, and its degrees of freedom (0: nothing could contradict).
    iterations : int
        Iterations of the optimiser.
    rejected : tuple of Rejection
        Outliers, each with its reason.
    bumped : tuple of Bump
        Anchors that moved.
    calibration : Calibration
        Estimates of mounts, markers and clocks, or of wheels and range sensors.
    landmarks : mapping of str to StaticPose
        By name, those that were measured, or that the team states.
    map : StaticPose or None
        Pose of the map that landmarks are on, where it was estimated.
    """

    method: Method | Literal["ranging"]
    source: PoseGraph | RangingProblem
    trajectories: Mapping[str, Trajectory]
    disconnected: tuple[Node, ...] = ()
    chi2: float = 0.0
    dof: float = 0
    iterations: int = 0
    rejected: tuple[Rejection, ...] = ()
    bumped: tuple[Bump, ...] = ()
    calibration: Calibration = field(default_factory=Calibration)
    landmarks: Mapping[str, StaticPose] = field(default_factory=dict)
    map: StaticPose | None = None

    @property
    def graph(self) -> PoseGraph:
        """The pose graph; `EstimationError` of a ranging run, which has none."""
        if isinstance(self.source, PoseGraph):
            return self.source
        raise EstimationError("an estimate of a ranging run has no pose graph: its measurements are in `ranging`")

    @property
    def ranging(self) -> RangingProblem:
        """The measurements of a ranging run; `EstimationError` of a run with stances, which has none."""
        if isinstance(self.source, RangingProblem):
            return self.source
        raise EstimationError("an estimate of a run with stances holds no ranges: its measurements are in `graph`")

    @property
    def is_ranging(self) -> bool:
        """True if this is the estimate of a ranging run."""
        return isinstance(self.source, RangingProblem)

    def __repr__(self) -> str:
        agreement = f", chi2/dof {self.chi2 / self.dof:.2f}" if self.dof > 0 else ""
        return (
            f"Estimate({self.method}, {len(self.trajectories)} robots, {sum(map(len, self.trajectories.values()))} "
            f"poses, {len(self.landmarks)} landmarks, {len(self.rejected)} measurements rejected{agreement})"
        )

    def pose(self, robot: str, index: int) -> gtsam.Pose3:
        """Return a pose T_world_body.

        Parameters
        ----------
        robot : str
            Its name.
        index : int
            The stance, or the robot's keyframe.

        Raises
        ------
        EstimationError
            It has no pose there.
        """
        T, _ = self._at(robot, index)
        return gtsam.Pose3(T)

    def covariance(self, robot: str, index: int) -> Array:
        """Return the covariance (6, 6) of a pose: rotation [rad] first, then translation [m], body frame.

        Parameters and errors are those of `pose`.
        """
        return self._at(robot, index)[1]

    def joint_covariance(self, nodes: Sequence[Node]) -> Array:
        """Return the joint covariance (6 n, 6 n) of n nodes, each in its own body's tangent, in the order given.

        Nodes that share a pose have the same rows.

        Raises
        ------
        EstimationError
            A node has no pose, or the estimate has no joint covariances (`chain`, and ranging runs incrementally).
        """
        if not nodes:
            raise EstimationError("name at least one robot and stance to have a covariance")
        if self.method == "chain":
            raise EstimationError("a chain has no joint covariances: it uses some measurements only; use `smooth`")
        T = {node: self._at(*node)[0] for node in nodes}
        if isinstance(self.source, RangingProblem):
            keys: list[Any] = list(nodes)
            joint = self.source.joint(list(T), np.array(list(T.values())))
        else:
            keys = [self.source.key(*node) for node in nodes]
            joint = self._marginals.joint(list(dict.fromkeys(keys)))
        different = list(dict.fromkeys(keys))
        index = np.concatenate([6 * different.index(key) + np.arange(6) for key in keys])
        return np.asarray(joint[np.ix_(index, index)])

    def residual(self, measurement: Measurement | RangeBearing) -> float:
        """Return the RMS residual of a measurement in units of its noise; NaN where an end of it has no pose."""
        if isinstance(measurement, RangeBearing):
            return self.ranging.residual(measurement)
        values, graph = self.values, self.graph
        i, j = (graph.key(*end) for end in measurement.ends)
        if not (values.exists(i) and values.exists(j)) or i == j:
            return float("nan")
        factors = Factors(graph.floor, self.calibration.variables)
        factor = factors.of_link(measurement, i, j)
        if not all(map(values.exists, factor.keys())):
            return float("nan")
        return float(np.sqrt(2 * factor.error(values) / factors.rows(measurement, factor)))

    @cached_property
    def values(self) -> gtsam.Values:
        """Poses and calibration variables as GTSAM has them."""
        values = gtsam.Values()
        for robot, trajectory in self.trajectories.items():
            assert trajectory.stances is not None
            for stance, T in zip(trajectory.stances.tolist(), trajectory.T_world_body, strict=True):
                key = self.graph.key(robot, stance)
                if not values.exists(key):
                    values.insert(key, gtsam.Pose3(T))
        for name, placed in {**self.landmarks, **({} if self.map is None else {MAP: self.map})}.items():
            values.insert(self.graph.pose_keys.static()[name], placed.T_world_body)
        for key, errors in self.calibration.values.items():
            values.insert(key, errors)
        return values

    @cached_property
    def _marginals(self) -> Marginals:
        used = self.graph.without(one.measurement for one in self.rejected)
        factors_of = Factors(self.graph.floor, self.calibration.variables)
        factors, _, batched = factors_of.of_graph(used, poses_in(self.values))
        with batched:
            return Marginals(factors.linearize(self.values), size_of)

    @cached_property
    def _index(self) -> dict[Node, int]:
        """Row of each node in its robot's trajectory."""
        if isinstance(self.source, RangingProblem):
            numbers = self.source.numbers
        else:
            numbers = {name: one.stances for name, one in self.trajectories.items() if one.stances is not None}
        return {
            (robot, index): row for robot, of_robot in numbers.items() for row, index in enumerate(of_robot.tolist())
        }

    def _at(self, robot: str, index: int) -> tuple[Array, Array]:
        at, trajectory = self._index.get((robot, index)), self.trajectories.get(robot)
        if at is None or trajectory is None or trajectory.covariances is None:
            what = "keyframe" if self.is_ranging else "stance"
            raise EstimationError(f"robot {robot} has no pose at {what} {index}")
        return trajectory.T_world_body[at], trajectory.covariances[at]


@dataclass(frozen=True, eq=False)
class StanceEstimate:
    """Poses of the robots of one stance, and how its measurements agree with everything before.

    Parameters
    ----------
    stance : int
        Its index.
    poses : mapping of str to gtsam.Pose3
        T_world_body by robot.
    covariances : mapping of str to (6, 6) float
        In GTSAM's tangent, by robot.
    disconnected : tuple of str
        Robots that nothing ties to the reference.
    rejected : tuple of Rejection
        Measurements that were rejected in this call.
    agreement : Agreement
        Agreement of everything that this call took in with everything before.
    residuals : tuple of float
        Of the stance's measurements, in their order: RMS in units of their noise, NaN where an end has no pose.
    landmarks : mapping of str to StaticPose
        Landmarks that were sighted in the stance.
    """

    stance: int
    poses: Mapping[str, gtsam.Pose3]
    covariances: Mapping[str, Array]
    disconnected: tuple[str, ...] = ()
    rejected: tuple[Rejection, ...] = ()
    agreement: Agreement = UNCHECKED
    residuals: tuple[float, ...] = ()
    landmarks: Mapping[str, StaticPose] = field(default_factory=dict)


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
    rejected: tuple[Rejection, ...] = (),
    bumped: tuple[Bump, ...] = (),
) -> Estimate:
    """Return the estimate of a graph from its values, and their covariances by key."""
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
    disconnected = graph.disconnected(poses)
    calibration = Calibration(variables, errors, {key: covariances[key] for key in errors})
    still = {
        name: StaticPose(poses[key], covariances[key], has_heading=name not in graph.ranged_points)
        for name, key in graph.pose_keys.static().items()
        if key in poses
    }
    here = still.pop(MAP, None)
    return Estimate(
        method, graph, trajectories, disconnected, chi2, dof, iterations, rejected, bumped, calibration, still, here
    )
