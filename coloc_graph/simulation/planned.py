"""A simulated team that follows a plan: `PlannedScenario`."""

import math
from dataclasses import dataclass

import numpy as np

from coloc_graph.errors import InputError
from coloc_graph.planning.clearance import conflicts
from coloc_graph.planning.drive import drive_through, there_and_back
from coloc_graph.planning.floor_map import FloorMap
from coloc_graph.planning.plan import Plan
from coloc_graph.planning.slip import HEADING_SIGMA, stop_sigma
from coloc_graph.simulation.floor_plans import FloorPlan
from coloc_graph.simulation.paths import Array, Leg
from coloc_graph.simulation.scenarios import Box, Pose, Scenario
from coloc_graph.simulation.tours import Tour, no_common_view, sees
from coloc_graph.team.shared_view import View, hidden

MIN_POINTS = 6  # correspondences without which a stance has no homography


@dataclass(frozen=True)
class PlannedScenario(Scenario):
    """A leap-frog that follows `plan`: robots stop where it says but for their slip, and hide what is behind them.

    `at[k]` is the robot -> number of its standing pose in stance k.
    """

    plan: Plan | None = None
    walls: FloorPlan | FloorMap | None = None
    at: tuple[dict[str, int], ...] = ()

    @property
    def stances(self) -> int:
        """The number of stances."""
        return len(self.at)

    def observers(self, k: int) -> tuple[str, ...]:
        """The robots of stance k, anchors first."""
        anchors = self.anchors(k)
        return (*anchors, *(name for name in self.at[k] if name not in anchors))

    def anchors(self, k: int) -> tuple[str, ...]:
        """The robots that have stayed put since stance k-1."""
        return tuple(name for name, n in self.at[k].items() if k and self.at[k - 1].get(name) == n)

    def standing(self, k: int) -> dict[str, int]:
        """Robot -> number of its standing pose, in stance k, anchors first."""
        return {name: self.at[k][name] for name in self.observers(k)}

    def leaps(self, k: int) -> dict[str, int]:
        """Observer -> number of the standing pose to which it drives between stances k-1 and k."""
        return {name: n for name, n in self.at[k].items() if self.at[k - 1].get(name) != n}

    def middle(self, k: int) -> tuple[float, float]:
        """The middle of the pair in stance k [m]."""
        x, y, _ = np.mean([self.poses[n] for n in self.at[k].values()], axis=0)
        return float(x), float(y)

    def tour(self, k: int, views: tuple[View, ...], markers: Array, fps: float, start: float, where: str) -> Tour:
        """Drive through the plan's waypoints for as long as it says, with captures at `fps` [1/s].

        Raises
        ------
        InputError
            If no two cameras see enough of the mover on the way.
        """
        assert self.plan is not None
        stance = self.plan.stances[k]
        drive = drive_through(there_and_back(stance.waypoints, stance.duration))
        frames = max(math.floor(stance.duration * fps), 1)
        instants = np.asarray((np.arange(frames) + 0.5) / fps, float)
        x, y, yaw = drive.at(instants).T
        c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        mx, my = markers[:, 0], markers[:, 1]
        places = np.stack([x[:, None] + c * mx - s * my, y[:, None] + s * mx + c * my], axis=-1)
        points = np.concatenate([places, np.full((*places.shape[:2], 1), markers[0, 2])], axis=-1)
        by_view = np.empty((len(views), *points.shape[:2]), bool)
        for n, view in enumerate(views):
            by_view[n] = sees(view, points)
            others = [other.T_world_camera[:2, 3] for other in views if other is not view]
            by_view[n] &= ~hidden(view.T_world_camera[:3, 3], points, np.array(others))
            if self.walls is not None:
                by_view[n] &= ~self.walls.blocked(view.T_world_camera[:2, 3], points)
        # what one camera alone sees is seen with no other
        recorded = by_view.sum(axis=0) >= 2
        by_view &= recorded
        if recorded.sum() < MIN_POINTS:
            raise no_common_view(where)
        leg = Leg(start + np.append(drive.times, stance.duration), np.vstack([drive.knots, drive.knots[-1:]]))
        if drive.times[-1] > stance.duration:
            leg = Leg(start + drive.times, drive.knots).cut(stance.duration)
        return Tour(leg, start + instants, recorded, by_view)


def require_clear(plan: Plan, floor_map: FloorMap) -> None:
    """Require that robots that follow a plan keep off the walls of a map, and off each other.

    Raises
    ------
    InputError
        If they do not.
    """
    if found := conflicts(plan, floor_map.clear):
        k, sentence = found[0]
        raise InputError(f"stance {k} of the plan: {sentence}; plan it with this map")


def planned(
    plan: Plan,
    rng: np.random.Generator | None = None,
    walls: FloorPlan | FloorMap | None = None,
    landmarks: tuple[Pose, ...] = (),
) -> PlannedScenario:
    """Make the scenario that follows a plan; each stop is off by some centimetres and a degree.

    `walls` hide what is behind them; `landmarks` are the poses of landmarks.

    Raises
    ------
    InputError
        If the mover of the plan changes.
    """
    movers = {stance.mover for stance in plan.stances}
    if len(movers) > 1:
        raise InputError(f"a simulated plan has one mover, not {', '.join(sorted(movers))}: give such a plan")
    rng = np.random.default_rng(0) if rng is None else rng
    poses: list[Pose] = []
    at: list[dict[str, int]] = []
    last: dict[str, Pose] = {}
    for stance in plan.stances:
        numbers = {}
        for name, target in stance.standing.items():
            if name in stance.anchors:
                numbers[name] = at[-1][name]
                continue
            leapt = math.dist(last[name][:2], target[:2]) if name in last else 0.0
            sigma = float(stop_sigma(leapt))
            off = rng.standard_normal(3) * (sigma, sigma, HEADING_SIGMA)
            numbers[name], last[name] = len(poses), target
            x, y, yaw = np.add(target, off).tolist()
            poses.append((x, y, yaw))
        at.append(numbers)
    (mover,) = movers
    first, second = plan.observers[:2]
    return PlannedScenario(
        "plan",
        tuple(poses),
        Box((0.0, 3.0), (-2.0, 2.0)),
        (first, second),
        mover,
        plan=plan,
        walls=walls,
        landmarks=landmarks,
        at=tuple(at),
    )
