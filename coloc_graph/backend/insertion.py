"""Order in which links enter an existing graph, and initial values of the poses that they bring."""

from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.factors import Factors
from coloc_graph.backend.graph import Link, point_of, pose_of
from coloc_graph.measurements import Odometry, Range, RelativePose, Sighting

Array = NDArray[np.float64]

# a measurement within either of these of its expected value enters at once and is tested afterwards
INNOVATION_GATE = 0.05  # m, rad
INNOVATION_GATE_SIGMAS = 6.0  # standard deviations of the odometry that predicts it

# tested; odometry is seldom wrong by much, so that its prediction can reject a wrong homography
_IMAGES = (RelativePose, Sighting)

#: A link and the keys of its ends.
Tie = tuple[Link, int, int]


@dataclass(frozen=True, eq=False)
class InsertionPlan:
    """Plan of the links that one call puts into the graph.

    Parameters
    ----------
    start : dict of int to gtsam.Pose3
        Initial values of new poses.
    ties : list of Tie
        Links that determine them, and odometry.
    near : list of Tie
        Measurements within the innovation gate: tested after insertion.
    far : list of Tie
        Measurements outside it: tested before insertion.
    disconnected : list of Link
        Links that nothing ties to the reference yet.
    points : set of int
        New poses of landmarks that have no heading.
    """

    start: dict[int, gtsam.Pose3]
    ties: list[Tie]
    near: list[Tie]
    far: list[Tie]
    disconnected: list[Link]
    points: set[int]

    @property
    def links(self) -> list[Link]:
        """All links of the plan."""
        return [*(link for link, _, _ in (*self.ties, *self.near, *self.far)), *self.disconnected]


class InsertionPlanner:
    """Planner of the insertion of links.

    `tied` are the keys that are tied to the reference; `ends` gives the keys of a link, `known` the poses of tied keys,
    and `errors` the estimates of calibration variables.
    """

    def __init__(
        self,
        factors: Factors,
        ends: Callable[[Link], tuple[int, int]],
        tied: Set[int],
        reference: int,
        known: Callable[[int], gtsam.Pose3],
        errors: Callable[[int], Array],
    ) -> None:
        self._factors, self._ends, self._tied, self._reference, self._known = factors, ends, tied, reference, known
        self._errors = errors

    def sort(self, links: list[Link]) -> InsertionPlan:
        """Plan the insertion of links, wheel odometry first."""
        start: dict[int, gtsam.Pose3] = {}
        if not self._tied:
            start[self._reference] = gtsam.Pose3()
        ties: list[Tie] = []
        points: set[int] = set()
        near: list[Tie] = []
        far: list[Tie] = []
        rough: dict[int, float] = {}  # keys with initial values by odometry alone, with its sigma
        left = sorted(links, key=lambda link: isinstance(link, (*_IMAGES, Range)))
        while left:
            still: list[Link] = []
            for link in left:
                i, j = self._ends(link)
                has_i, has_j = (key in self._tied or key in start for key in (i, j))
                if isinstance(link, Range):
                    if has_i and has_j:
                        # one range leaves a new landmark open: only all of them together can be tested
                        (near if j in points else far).append((link, i, j))
                    elif has_i and link.place is not None:
                        start[j] = point_of(link, self._pose_of(i, start))
                        points.add(j)
                        ties.append((link, i, j))
                    else:
                        still.append(link)
                    continue
                is_new = i not in self._tied or j not in self._tied
                T_i_j = self._factors.expected(link, i, j, self._errors) if is_new else pose_of(link)
                tested = isinstance(link, _IMAGES)
                if i == j:
                    continue
                if not has_i and not has_j:
                    still.append(link)
                elif has_i and has_j and tested:
                    # a pose that starts where a homography says is not moved by it, nor linearised anew
                    is_near = self._refine(T_i_j, i, j, start, rough)
                    (near if is_near else far).append((link, i, j))
                else:
                    if not has_j:
                        start[j] = self._factors.start(self._pose_of(i, start).compose(T_i_j))
                    elif not has_i:
                        start[i] = self._factors.start(self._pose_of(j, start).compose(T_i_j.inverse()))
                    if isinstance(link, Odometry):
                        sigma = float(np.sqrt(np.diagonal(link.covariance).max()))
                        rough |= {key: sigma for key, had in ((i, has_i), (j, has_j)) if not had}
                    ties.append((link, i, j))
            if len(still) == len(left):
                break
            left = still
        return InsertionPlan(start, ties, near, far, left, points)

    def _refine(
        self, T_i_j: gtsam.Pose3, i: int, j: int, start: dict[int, gtsam.Pose3], rough: dict[int, float]
    ) -> bool:
        """Return whether a measurement is within the innovation gate.

        Then a key with an initial pose by odometry alone gets one by the measurement.
        """
        T_world_i, T_world_j = self._pose_of(i, start), self._pose_of(j, start)
        off = T_world_i.between(T_world_j).between(T_i_j)
        near = max(INNOVATION_GATE, INNOVATION_GATE_SIGMAS * max(rough.get(i, 0.0), rough.get(j, 0.0)))
        if np.abs(off.translation()).max() > near or abs(off.rotation().yaw()) > near:
            return False
        if j in rough:
            start[j] = self._factors.start(T_world_i.compose(T_i_j))
        elif i in rough:
            start[i] = self._factors.start(T_world_j.compose(T_i_j.inverse()))
        for key in (i, j):
            rough.pop(key, None)
        return True

    def _pose_of(self, key: int, start: Mapping[int, gtsam.Pose3]) -> gtsam.Pose3:
        pose = start.get(key)
        return self._known(key) if pose is None else pose
