"""State of an incremental estimator: what came, what was made of it, and the poses; `EstimatorState`."""

from collections.abc import Collection, Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.calibration import Variables
from coloc_graph.backend.chain import spanning_tree
from coloc_graph.backend.checkpoint import Base, Entry, WaitingStance
from coloc_graph.backend.estimate import Rejection
from coloc_graph.backend.factors import Factors, Method, poses_in
from coloc_graph.backend.forgetting import Past, require_all
from coloc_graph.backend.graph import Link, PoseGraph, PoseKeys, instants_of, require_ends
from coloc_graph.backend.isam2_graph import Isam2Graph
from coloc_graph.backend.landmarks import OnMap, StaticPose
from coloc_graph.backend.optimize import fit_graph
from coloc_graph.backend.solver import with_stack
from coloc_graph.errors import EstimationError, MeasurementError
from coloc_graph.measurements import Measurement, Node
from coloc_graph.run import Stance
from coloc_graph.team import Floor, Landmark, Robot, Slip

Array = NDArray[np.float64]


class EstimatorState:
    """State of an `Estimator`: begun from a base, or from where it forgot something, and read by anyone."""

    reference: str
    robots: tuple[str, ...]
    floor: Floor | None
    slips: dict[str, Slip]
    robot_models: dict[str, Robot]
    landmarks: dict[str, Landmark]
    lag: int
    forgets: bool
    _on_map: tuple[OnMap, ...]
    _waiting: dict[int, WaitingStance]

    def _begin(self, base: Base | Past) -> None:
        """Hold the stances and measurements of `base`, optimised in batch, and nothing else."""
        self._past: Past | None = None  # since it forgot something, instead of the base
        if isinstance(base, Past):
            self._go_back(base)
            return
        self._base, self._journal = base, list[Entry]()  # inputs since the base, in their order
        self._pose_keys = PoseKeys(self.robots, self.slips, self.landmarks)
        self._stances: dict[int, Stance] = {}
        for before, stance in zip((None, *base.stances), base.stances, strict=False):
            self._pose_keys.accept(self._pose_keys.after(before, stance))
            self._stances[stance.index] = stance
        self._log = list(base.measurements)  # everything that ever came, the rejected too
        self._rejected = {  # by the measurement's identity
            id(self._log[number]): Rejection(self._log[number], why) for number, why in base.rejected.items()
        }
        self._newly: set[int] = set()  # those rejected since the last stance came, it included
        self._disconnected: list[Link] = []  # links that nothing ties to the reference
        self._instants: dict[Node, float] = {}
        self._instants = self._checked(self._log)  # when moving robots were sighted
        self._live = Isam2Graph(self._new_factors())
        if base.stances:
            kept = self.graph.without(one.measurement for one in self.rejected)
            self._live, links = _rebuilt(kept, self.method)
            inside = set(map(id, links))
            self._disconnected = [one for one in kept.links if id(one) not in inside and len(set(self._keys(one))) == 2]

    def _go_back(self, past: Past) -> None:
        """Return to the state in which something was forgotten last."""
        self._past, self._journal = past, []
        self._pose_keys, self._stances = past.pose_keys.kept(), dict(past.stances)
        self._log, self._rejected, self._newly = list(past.log), dict(past.rejected), set(past.newly)
        self._disconnected, self._instants = list(past.disconnected), dict(past.instants)
        factors_of = self._new_factors()
        if factors_of.variables is not None:
            factors_of.variables.anchors.update(past.anchors)
        self._live = Isam2Graph.again(factors_of, past.factors, past.values, past.tied)

    @property
    def _kept(self) -> str | None:
        """The first stance that was kept, where others were forgotten."""
        return None if self._past is None else f"stance {min(self._past.stances)}"

    @property
    def method(self) -> Method:
        """`joint` if mounts are calibrated, `smooth` if they are taken as stated."""
        return "joint" if self.robot_models else "smooth"

    def _new_factors(self) -> Factors:
        return Factors(
            self.floor, Variables(self.robots, self.robot_models, self.landmarks) if self.robot_models else None
        )

    @property
    def stances(self) -> tuple[Stance, ...]:
        """Stances of the estimate, in their order."""
        return tuple(self._stances.values())

    @property
    def measurements(self) -> tuple[Measurement, ...]:
        """All measurements, rejected ones included."""
        return tuple(self._log)

    @property
    def rejected(self) -> tuple[Rejection, ...]:
        """Measurements that were rejected as outliers."""
        return tuple(self._rejected.values())

    @property
    def waiting(self) -> tuple[int, ...]:
        """Stances that arrived before their predecessor, and wait for it."""
        return tuple(sorted(self._waiting))

    @property
    def graph(self) -> PoseGraph:
        """Graph of all inputs; `EstimationError` while there is no stance, or where some were forgotten."""
        require_all(self._kept, "return the graph of all inputs")
        return PoseGraph(
            self.reference, self.robots, self.stances, self.measurements, self.floor, self.slips, self.robot_models,
            self.landmarks, self._on_map,
        )  # fmt: skip

    def pose(self, robot: str, stance: int | None = None) -> gtsam.Pose3:
        """Return T_world_body of a robot.

        Parameters
        ----------
        robot : str
            Its name.
        stance : int or None
            Index of the stance; None: the last at which the robot is tied to the reference.

        Raises
        ------
        EstimationError
            The robot has no pose there.
        """
        return self._live.pose(self._tied_key(robot, stance))

    def covariance(self, robot: str, stance: int | None = None) -> Array:
        """Return the covariance (6, 6) of a pose: rotation [rad] first, then translation [m], body frame.

        Parameters and errors are those of `pose`.
        """
        return self._live.covariance(self._tied_key(robot, stance))

    def static_poses(self, names: Collection[str] | None = None) -> dict[str, StaticPose]:
        """Return the poses of sighted landmarks and of the map (`landmarks.MAP`), by name; all, or those of `names`."""
        return {
            name: StaticPose(self._live.pose(key), self._live.covariance(key))
            for name, key in self._pose_keys.static().items()
            if key in self._live.tied and (names is None or name in names)
        }

    def residual(self, measurement: Measurement) -> float:
        """Return the RMS residual of a measurement in units of its noise; NaN where an end of it has no pose."""
        return self._residuals([measurement])[0]

    def _residuals(self, measurements: Sequence[Measurement]) -> tuple[float, ...]:
        """Return the residual of each measurement, see `residual`."""
        ties = {n: (one, *self._keys(one)) for n, one in enumerate(measurements)}
        ties = {n: tie for n, tie in ties.items() if tie[1] != tie[2] and {*tie[1:]} <= self._live.tied}
        found = dict(zip(ties, self._live.residuals(ties.values()), strict=True))
        return tuple(found.get(n, float("nan")) for n in range(len(measurements)))

    def _checked(self, taken: Sequence[Measurement]) -> dict[Node, float]:
        """Check the ends of measurements and return the times at which moving robots were sighted."""
        for measured in taken:
            if self._past is not None:
                self._require_kept(measured)
            require_ends(measured, self._pose_keys, self._stances)
        return instants_of(taken, self._stances, self._instants)

    def _require_kept(self, measured: Measurement) -> None:
        """Raise `MeasurementError` where a measurement is of a pose that was forgotten."""
        for robot, index in measured.ends:
            if robot in self.robots and (robot, index) not in self._pose_keys and index < max(self._stances):
                raise MeasurementError(
                    f"the {measured} is of the pose of {robot} in stance {index}, which was forgotten: it left the lag "
                    f"of {self.lag} stances"
                )

    def _keys(self, link: Link) -> tuple[int, int]:
        i, j = map(self._pose_keys.key, link.ends)
        return i, j

    def _tied_key(self, robot: str, stance: int | None) -> int:
        if robot not in self.robots:
            raise EstimationError(f"robot {robot} is not in the team ({', '.join(self.robots)})")
        for index in reversed(self._stances) if stance is None else (stance,):
            if (key := self._pose_keys.find((robot, index))) is not None and key in self._live.tied:
                return key
        raise EstimationError(f"robot {robot} has no pose{'' if stance is None else f' at stance {stance}'}")


def _rebuilt(graph: PoseGraph, method: Method) -> tuple[Isam2Graph, tuple[Link, ...]]:
    """Return the ISAM2 graph of all that is tied to the reference, at its optimum, and the tied links."""
    if not spanning_tree(graph, graph.links):
        graph = graph.without(graph.measurements)  # nothing but the reference is tied yet
    fit = with_stack(len(graph.nodes), lambda: fit_graph(method, graph))
    live = Isam2Graph(fit.factors_of)
    with fit.batched:
        live.begin_with(fit.factors, fit.values)
    live.tied = set(poses_in(fit.values))
    return live, fit.links
