"""A scene that grows by the estimates after each stance."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from coloc_graph.backend import StanceEstimate
from coloc_graph.backend.landmarks import StaticPose
from coloc_graph.exchange.landmarks import row_of
from coloc_graph.frontend import PairMeasurement
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.measurements import Measurement, RelativePose, Sighting
from coloc_graph.run import Stance
from coloc_graph.viewer.landmarks import landmarks_in, sighted_in
from coloc_graph.viewer.scene import Array, Scene, ShownPlan, layer_of
from coloc_graph.viewer.sources import as_edges, stayed

LIVE = "live"  # name of the layer if the first scene has none
RESIDUAL_AT_INSERTION = "of the measurement in the estimate at its insertion"


@dataclass(frozen=True, eq=False)
class LiveStance:
    """A new stance, to be published to a viewer.

    Parameters
    ----------
    stance : Stance
        The stance.
    estimate : StanceEstimate
        Poses of its robots.
    measurements : sequence of Measurement
        Its measurements.
    pairs : sequence of PairMeasurement
        Measurements of all pairs, unusable ones included, which are then shown too.
    """

    stance: Stance
    estimate: StanceEstimate
    measurements: Sequence[Measurement] = ()
    pairs: Sequence[PairMeasurement] = ()


@dataclass(frozen=True, eq=False)
class LivePoses:
    """Poses of robots at any time, to be published to a viewer.

    Parameters
    ----------
    time : float
        Their time [s].
    T_world_body : mapping of str to (4, 4) float
        Poses by robot [m]; other robots stay at the pose of their last stance.
    note : str
        Sentence that is shown with them.
    """

    time: float
    T_world_body: Mapping[str, Array]
    note: str = ""

    def over(self, robots: Sequence[str], poses: Array) -> Array:
        """Return `poses` (r, 4) of x, y, z, heading of `robots`, with the live ones replaced."""
        out = poses.copy()
        for number, robot in enumerate(robots):
            T = self.T_world_body.get(robot)
            if T is not None and _is_transform(T):
                out[number, :3], out[number, 3] = T[:3, 3], np.arctan2(T[1, 0], T[0, 0])
        return out

    def problems(self, robots: Sequence[str]) -> str:
        """Return a sentence on poses that cannot be shown; "" if all can."""
        strangers = sorted(set(self.T_world_body) - set(robots))
        broken = [robot for robot, T in self.T_world_body.items() if not _is_transform(T)]
        return "; ".join(
            [*(f"there is no robot {robot} in this team" for robot in strangers),
             *(f"the live pose of robot {robot} is not a finite 4x4 transform" for robot in broken)]
        )  # fmt: skip


def _is_transform(T: Array) -> bool:
    return np.shape(T) == (4, 4) and bool(np.isfinite(T).all())


class LiveScene:
    """Scene that grows by `LiveStance`s; the scene itself is made on demand."""

    def __init__(self, start: Scene) -> None:
        self._start = start
        self._name = start.layers[0].name if start.layers else LIVE
        self._stances: dict[int, Stance] = {}
        self._poses: dict[str, dict[int, tuple[float, Array, Array]]] = {robot: {} for robot in start.robots}
        self._found: dict[int, list[tuple[int, str, str, float, str]]] = {}
        self._landmarks: dict[str, StaticPose] = {}
        self._sighted: dict[int, list[tuple[str, int, str]]] = {}
        self._plans: dict[int, ShownPlan] = {}

    def add_plan(self, plan: ShownPlan) -> None:
        """Take in the plan of a stance; a later one of the same stance replaces it."""
        self._plans[plan.stance] = plan

    def add(self, one: LiveStance) -> None:
        """Take in a stance; one that is in already is brought up to date."""
        stance, said = one.stance, one.estimate
        self._stances[stance.index] = stance
        rejected = {id(r.measurement): r.reason for r in said.rejected}
        times = {m.seen: m.time for m in one.measurements if isinstance(m, Sighting)}
        for robot, pose in said.poses.items():
            if robot in stance.observers or robot in times:
                time = times.get(robot, stance.start)
                self._poses[robot][stance.index] = (time, pose.matrix(), said.covariances[robot])
        self._landmarks |= said.landmarks
        used = [m for m in one.measurements if id(m) not in rejected]
        self._sighted[stance.index] = sighted_in(used, self._landmarks)
        # an estimate of a later stance, which had waited for this one, has no residuals of this one
        told = said.residuals if said.stance == stance.index else ()
        residuals = {id(m): off for m, off in zip(one.measurements, told, strict=False)}
        self._found[stance.index] = [
            (m.stance, m.robot_i, m.robot_j, residuals.get(id(m), np.nan), rejected.get(id(m), ""))
            for m in one.measurements
            if isinstance(m, RelativePose)
        ] + [
            (h.stance, h.robot_i, h.robot_j, np.nan, h.unusable)
            for h in (pair.homography for pair in one.pairs)
            if h.unusable
        ]

    def scene(self) -> Scene:
        """Make the scene of all stances that were added."""
        robots = self._start.robots
        stances = tuple(self._stances[index] for index in sorted(self._stances))
        trajectories = {}
        for robot, poses in self._poses.items():
            if poses:
                indices = sorted(poses)
                times, T, covariances = zip(*(poses[index] for index in indices), strict=True)
                trajectories[robot] = Trajectory(
                    robot, np.array(times), np.array(T), np.array(indices), np.array(covariances)
                )
        found = [edge for every in self._found.values() for edge in every]
        sighted = [one for every in self._sighted.values() for one in every]
        rows = [
            row_of(name, placed, False, sum(seen == name for *_, seen in sighted))
            for name, placed in self._landmarks.items()
        ]
        held = [(robot, stance.index) for stance in stances for robot in stance.anchors]
        return replace(
            self._start,
            stances=stances,
            layers=(layer_of(self._name, robots, stances, trajectories),) if stances else (),
            edges=as_edges(found, robots, stances, RESIDUAL_AT_INSERTION),
            stayed=stayed(robots, stances, held),
            landmarks=landmarks_in(rows, sighted, robots, stances),
            plans=tuple(self._plans[index] for index in sorted(self._plans)),
        )
