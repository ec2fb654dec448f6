"""Plans that are compared: fixed gaits along a course of any number of robots, greedy ones, and the planner's own.

Of fixed gaits, observer n of m stands at stop n, and leaps over the others to stop n + m, in one of two lanes. A gait
follows a corner with the direction between the points of the course a `window` behind and ahead of a stop. Its mover
patrols near, far left, far right and middle of the common view. b2 is the gait of a grid of leaps, distances abreast,
toe-ins and windows that promises the least sigma of the last positions, and that touches nothing.
"""

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from coloc_graph.errors import InputError
from coloc_graph.geometry.se2 import Planar
from coloc_graph.planning.belief import POSE, Belief
from coloc_graph.planning.clearance import ROOM, conflicts
from coloc_graph.planning.course import Course
from coloc_graph.planning.formation import PAPER, Gait
from coloc_graph.planning.gaits import ABREAST, LEAPS, TOE_INS, GaitSearch
from coloc_graph.planning.horizon import ARRIVED, Horizon, Objective
from coloc_graph.planning.leaps import TO_WALL
from coloc_graph.planning.least_time import least_time
from coloc_graph.planning.mission import Mission, best_stance, stances_of
from coloc_graph.planning.mover_path import cells, patrol
from coloc_graph.planning.plan import Plan, PlannedStance
from coloc_graph.planning.prediction import MIN_POINTS, Predictor
from coloc_graph.planning.room import TO_ROBOT
from coloc_graph.planning.route import clear_way
from coloc_graph.simulation.floor_plans import FloorPlan
from coloc_graph.team import Team

FIG_4 = Gait.of_paper(0.6, 40.0)  # best distance and angle of the paper's Fig. 4
WINDOWS = (0.0, 0.5, 1.0)  # of the direction at a corner, in leaps
SCREENED = 40  # gaits of two observers on a straight way, the best by evenly spread images, whose patrols are planned
REFINED = 5  # gaits, the best with their patrols, whose drives are designed
MOUNT_SIGMA_DEG = 0.05  # sigma of tilts and rolls with which mounts count as known
MOVER_START = (1.5, 0.0, 0.0)
NAMES = ("b0", "b1", "b2", "b3", "b4", "b5", "gait", "horizon", "from b0", "short")


@dataclass(frozen=True)
class Scene:
    """A team, its way, and the seconds of images of the whole mission."""

    team: Team
    course: Course
    floor_plan: FloorPlan | None
    fps: float
    capture: float

    @classmethod
    def of(cls, team: Team, fps: float, seconds: float, length: float, floor_plan: FloorPlan | None) -> "Scene":
        """Scene with as many images as the paper's formation takes in stances of these `seconds`."""
        goals = ((length, 0.0),) if floor_plan is None else floor_plan.goals
        course = Course(((0.0, 0.0), *goals))
        return cls(team, course, floor_plan, fps, seconds * stances_of(PAPER, course.length))

    @property
    def observers(self) -> tuple[str, ...]:
        """Names of the robots that stand and leap."""
        return self.team.names[:-1]

    @property
    def mover(self) -> str:
        """Name of the robot that drives."""
        return self.team.names[-1]

    @property
    def predictor(self) -> Predictor:
        """Predictor that knows the walls."""
        return Predictor(self.team, self.fps, floor_map=self.floor_plan and self.floor_plan.floor_map())


class FixedGaits:
    """Missions of fixed gaits in a scene."""

    def __init__(self, scene: Scene) -> None:
        self._scene, self._predictor = scene, scene.predictor
        self._bends = len(scene.course.points) > 2

    def stop(self, gait: Gait, window: float, k: int) -> Planar:
        """Pose number k of a gait along the course; the middle of the first ones is at its start."""
        way = gait.leap * (k - (len(self._scene.observers) - 1) / 2)
        (x, y, heading), (a, b) = self._scene.course.at(way), (way - window * gait.leap, way + window * gait.leap)
        if window:
            (x0, y0, _), (x1, y1, _) = self._scene.course.at(a), self._scene.course.at(b)
            heading = math.atan2(y1 - y0, x1 - x0)
        side = -1.0 if k % 2 else 1.0
        lateral, yaw = side * gait.abreast / 2, heading - side * math.radians(gait.toe_in_deg)
        return x - lateral * math.sin(heading), y + lateral * math.cos(heading), yaw

    def mission(self, gait: Gait, window: float = 0.0, *, designed: bool = False) -> Mission:
        """Plan the mission of a gait; its mover patrols unless its drives are `designed`.

        Raises
        ------
        InputError
            If the gait meets walls or robots, or the observers share no view.
        """
        names, mover, predictor = self._scene.observers, self._scene.mover, self._predictor
        many = len(names)
        number = max(math.ceil((self._scene.course.length - ARRIVED) / gait.leap), 0) + 1
        stops = [self.stop(gait, window, k) for k in range(number + many - 1)]
        self._require_room(stops, many)
        seconds = self._scene.capture / number
        start = belief = Belief.start(self._scene.team, {**dict(zip(names, stops, strict=False)), mover: MOVER_START})
        stances, promises, times = [], [], []
        for k in range(number):
            order = [n % many for n in range(k, k + many)]
            leaper = names[order[-1]]
            times.append(predictor.leap_time(belief.poses[leaper], stops[k + many - 1]) if k else 0.0)
            if k:
                belief = belief.after_leap(leaper, stops[k + many - 1], predictor.wheels)
            standing = {names[n]: belief.poses[names[n]] for n in order}
            anchors = tuple(names[n] for n in order[:-1]) if k else ()
            if designed:
                goal = self._scene.course.points[-1]
                stance, promise = best_stance(predictor, belief, standing, anchors, mover, seconds, goal)
            else:
                stance = PlannedStance(standing, anchors, mover, self._patrol(belief, standing, stops[k][2]), seconds)
                promise = predictor.of_stance(belief, stance)
            if promise.points < MIN_POINTS:
                raise InputError(f"stance {k} is void")
            stances.append(stance)
            promises.append(promise)
            belief = promise.belief
        plan = Plan(tuple(stances))
        if found := conflicts(plan, predictor.free):
            raise InputError(f"stance {found[0][0]}: {found[0][1]}")
        return Mission(plan, tuple(promises), tuple(times), start)

    def best(self, *, designed: bool = False) -> Mission:
        """Best mission of the grid.

        Raises
        ------
        InputError
            If no gait of the grid is possible.
        """
        scene = self._scene
        length = scene.course.length
        leaps = sorted({length / math.ceil(length / leap) for leap in LEAPS if leap <= length})
        gaits = [Gait(*one) for one in product(leaps, ABREAST, TOE_INS)]
        search = GaitSearch(Predictor(scene.team, scene.fps), length, scene.observers[:2], scene.mover, gaits)
        ranked = [one.gait for one, _ in search.ranked(capture=scene.capture)]
        ways = list(product(ranked, WINDOWS if self._bends else (0.0,)))
        # the rank is that of two observers: it says little about corners, and about more observers
        screened = not self._bends and len(scene.observers) == 2
        patrols = self._possible(ways[:SCREENED] if screened else ways)
        if not patrols:
            raise InputError("no fixed gait of the grid can go this way")
        if not designed:
            return patrols[0][1]
        made = self._possible([way for way, _ in patrols[:REFINED]], designed=True)
        return (made or patrols)[0][1]

    def _possible(
        self, ways: Sequence[tuple[Gait, float]], *, designed: bool = False
    ) -> list[tuple[tuple[Gait, float], Mission]]:
        """Missions of gaits with windows that can go this way, the best first."""
        found = []
        for gait, window in ways:
            with contextlib.suppress(InputError):
                found.append(((gait, window), self.mission(gait, window, designed=designed)))
        return sorted(found, key=lambda each: each[1].end_sigma)

    def _require_room(self, stops: Sequence[Planar], many: int) -> None:
        at = np.array(stops)[:, :2]
        free = self._predictor.free
        if free is not None and not free(at, TO_WALL).all():
            raise InputError("a robot stands in a wall")
        for ahead in range(1, many):
            if (np.hypot(*(at[ahead:] - at[:-ahead]).T) < TO_ROBOT).any():
                raise InputError("robots stand too near to each other")

    def _patrol(self, belief: Belief, standing: dict[str, Planar], heading: float) -> tuple[tuple[float, float], ...]:
        """The patrol of a stance, or the longest part of it that is clear."""
        predictor, names = self._predictor, tuple(standing)
        model = predictor.model(names, self._scene.mover)
        slips = [belief.leapt.get(name, 0.0) for name in names]
        found = cells(model, np.array(list(standing.values())), predictor.margins(0.0, names), predictor.free, slips)
        if len(found.places) < 2:
            raise InputError("the observers share no view")
        points = patrol(found.places, heading)
        parts = [points, points[:3], points[1:], points[:2], points[1:3], points[2:], (points[0], points[3])]
        others = [pose[:2] for pose in standing.values()]
        for part in parts:
            if clear_way(part, others, predictor.free, to_robot=ROOM.apart(slips)):
                return part
        raise InputError("no patrol is clear")


def shortest(scene: Scene, sigma: float) -> Mission:
    """The shortest mission of a gait on a straight way that promises a sigma of its last positions [m].

    Raises
    ------
    InputError
        If no gait does.
    """
    if len(scene.course.points) > 2 or len(scene.observers) > 2:
        raise InputError("the shortest mission is sought on straight ways of two observers")
    search = GaitSearch(scene.predictor, scene.course.length, scene.observers[:2], scene.mover)
    return least_time(lambda time: search.planned(search.ranked(time=time)), sigma, search.shortest(sigma))[1]


def mounted(mission: Mission) -> int | None:
    """Number of stances after which all observers' tilts and rolls are known to `MOUNT_SIGMA_DEG`; None if never."""
    for k, promise in enumerate(mission.promises):
        belief = promise.belief
        at = [belief.index(name) + POSE + n for name in mission.plan.observers for n in (1, 2)]
        if np.sqrt(belief.covariance[at, at].max()) <= math.radians(MOUNT_SIGMA_DEG):
            return k + 1
    return None


def missions(scene: Scene, only: Sequence[str]) -> dict[str, Mission]:
    """Missions of a scene, by name: those of `only`, all by default; without those that no robot can follow there."""
    fixed = FixedGaits(scene)
    made: dict[str, Mission] = {}

    def planner(objective: Objective) -> Horizon:
        return Horizon(
            scene.predictor, scene.course, scene.observers, scene.mover, scene.capture, objective=objective
        )  # fmt: skip

    def horizon(objective: Objective, start: Gait | None = None) -> Mission:
        one = planner(objective)
        poses = one.starts()
        if start is not None:
            poses = {name: fixed.stop(start, 0.0, k) for k, name in enumerate(scene.observers)}
        return one.mission(Belief.start(scene.team, {**poses, scene.mover: MOVER_START}))

    ways: dict[str, Callable[[], Mission]] = {
        "b0": lambda: fixed.mission(PAPER),
        "b1": lambda: fixed.mission(FIG_4),
        "b2": fixed.best,
        "b3": lambda: horizon("information"),
        "b4": lambda: horizon("view"),
        "b5": lambda: horizon("random"),
        "gait": lambda: fixed.best(designed=True),
        "horizon": lambda: horizon("goal"),
        "from b0": lambda: horizon("goal", PAPER),
        "short": lambda: shortest(scene, fixed.mission(PAPER).end_sigma),
    }
    for name, way in ways.items():
        if only and name not in only:
            continue
        try:
            made[name] = way()
        except InputError as error:
            print(f"{name:8} is not possible here: {error}", flush=True)
    return made
