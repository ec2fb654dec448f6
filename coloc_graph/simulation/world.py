"""The true world of one run: who the robots are, where each is at every instant, what happens when."""

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from msgspec.structs import replace as with_fields
from numpy.typing import ArrayLike, NDArray

from coloc_graph.errors import InputError
from coloc_graph.geometry.lie import floor_pose, rotation_z
from coloc_graph.run.messages import Stance
from coloc_graph.simulation.landmarks import drawn, in_view, standing_landmarks, unsurveyed, with_landmarks
from coloc_graph.simulation.meander import meander
from coloc_graph.simulation.paths import Array, Path, PathBuilder, drive, tilt_rotation
from coloc_graph.simulation.planned import PlannedScenario
from coloc_graph.simulation.rig import MILD_LENS, Imperfections, reference_team, stated_team, true_team
from coloc_graph.simulation.scenarios import Pose, Scenario
from coloc_graph.simulation.tours import MAX_BURST, Tour, patrol, scatter
from coloc_graph.team import Team
from coloc_graph.team.shared_view import View

#: When every simulated run begins [UTC s].
EPOCH = 1_700_000_000.0

#: Fewer correspondences a stance make no homography; `frontend.homography` asks for as many.
MINIMUM_POINTS = 6
#: All stand still for this long [s] before and after the mover's drive; half of it belongs to the stance.
REST = 0.5

#: How many captures a pose of the mover gets where clocks differ: enough to tell how fast the marker moves.
BURST = 3

Depth = Literal["tracks", "images"]

# every purpose draws from a stream of its own, so that, say, other noise leaves the geometry as it was
_STREAMS = (
    "formation",
    "team",
    "standing",
    "floor",
    "tour",
    "clock",
    "detection",
    "wheels",
    "scenery",
    "sensor",
    "person",
    "landmarks",
    "blink",
    "uwb",
)


def stream(seed: int, purpose: str, index: int = 0) -> np.random.Generator:
    """The random numbers of one purpose (a stance's or a robot's, by `index`) in the run of a seed."""
    return np.random.default_rng((seed, _STREAMS.index(purpose), index))


@dataclass(frozen=True, eq=False)
class Capture:
    """The captures of one stance by one observer: at true `times` (n,) [s], by its clock at `stamps` (n,).

    `recorded` (n, m) says which of the movers' markers, and then of those of robots and landmarks that are `standing`
    in view, its detections hold (tracks depth).
    """

    robot: str
    view: View
    times: Array
    stamps: Array
    recorded: NDArray[np.bool_]
    standing: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class World:
    """Everything that is true of a run. `team` is the stated one; `stances` are in true time [UTC s].

    `paths` maps a robot to its movement, `moves` are (robot, start, end) in order, `captures` (one tuple a
    stance) what the observers take. The world frame is the floor, z = 0, not the reference's body.
    `T_world_landmark` (4, 4) are the landmarks by name.
    """

    scenario: Scenario
    team: Team
    true_team: Team
    imperfections: Imperfections
    seed: int
    paths: dict[str, Path]
    stances: tuple[Stance, ...]
    moves: tuple[tuple[str, float, float], ...]
    captures: tuple[tuple[Capture, ...], ...]
    T_world_landmark: dict[str, Array] = field(default_factory=dict)

    def clock(self, robot: str, times: ArrayLike) -> Array:
        """Time of a robot's clock at true times [s]."""
        return stamp(robot, self.team, self.imperfections, times)

    def markers_world(self, robot: str, times: ArrayLike) -> Array:
        """True places (n, m, 3) [m] of a robot's or a landmark's markers at true times (n,); m may be 0."""
        T_still = self.T_world_landmark.get(robot)
        if T_still is not None:
            (seen,) = (one.seen_as for one in self.true_team.landmarks if one.name == robot)
            p_landmark = np.zeros((0, 3)) if seen is None else seen.p_body
            places = p_landmark @ T_still[:3, :3].T + T_still[:3, 3]
            return np.broadcast_to(places, (len(np.atleast_1d(times)), *places.shape))
        markers = self.true_team[robot].markers
        p_body = np.zeros((0, 3)) if markers is None else markers.p_body
        T = self.paths[robot].pose_at(times)
        return np.asarray(np.einsum("nij,mj->nmi", T[:, :3, :3], p_body) + T[:, None, :3, 3])


def build_world(
    scenario: Scenario,
    *,
    depth: Depth = "tracks",
    seed: int = 0,
    points: int = 100,
    imperfections: Imperfections | None = None,
    fps: float = 10.0,
    team: Team | None = None,
    burst: int | None = None,
    stopping: bool = False,
    known: bool = False,
) -> World:
    """Let a scenario happen once. Nothing is written, nothing rendered: for Monte Carlo, with `observe`.

    `points` correspondences a stance at depth tracks, `points` / 2 frames at `fps` at depth images. `team` is
    nominal (the reference rig by default). `burst` captures are made of each pose of the mover at depth
    tracks, 1 by default or 3 where clocks differ. With `stopping` the mover stops and goes on its way at depth
    images. Where landmarks stand the team knows if they are `known`. Raises `InputError` where the pair has no common
    view.
    """
    if points < MINIMUM_POINTS:
        raise InputError(f"`points` is {points}; a homography needs at least {MINIMUM_POINTS} a stance")
    if not (np.isfinite(fps) and fps > 0):
        raise InputError(f"`fps` is {fps}; give frames a second, above 0")
    if seed < 0:
        raise InputError(f"`seed` is {seed}; give a whole number that is not negative")
    if burst is not None and not 1 <= burst <= MAX_BURST:
        raise InputError(f"`burst` is {burst}; give 1 to {MAX_BURST} captures")
    imperfections = imperfections or Imperfections()
    nominal = team or (reference_team(MILD_LENS) if depth == "images" else reference_team())
    stated = with_landmarks(stated_team(nominal, imperfections), scenario, tags=depth == "images")
    true = true_team(stated, stream(seed, "team"))
    true = with_fields(true, landmarks=drawn(true.landmarks, stream(seed, "landmarks")))
    stated = stated if known else unsurveyed(stated)
    if burst is None:
        burst = BURST if imperfections.clocks_differ else 1
    return _Builder(scenario, true, imperfections, seed, points, depth, fps, burst, stopping).build(stated)


class _Builder:
    """Lays the stances of a scenario one after the other in time."""

    def __init__(
        self,
        scenario: Scenario,
        true: Team,
        imperfections: Imperfections,
        seed: int,
        points: int,
        depth: Depth,
        fps: float,
        burst: int,
        stopping: bool,
    ) -> None:
        self.scenario, self.true, self.imperfections, self.seed = scenario, true, imperfections, seed
        self.points, self.depth, self.fps, self.burst, self.stopping = points, depth, fps, burst, stopping
        self.sigma = float(np.deg2rad(imperfections.floor_sigma_deg))
        # drawn for all standing poses first, row by row: those of a longer run begin as a shorter one's do
        self.tilts = self.sigma * stream(seed, "standing").standard_normal((len(scenario.poses), 2))
        self.T_world_landmark = standing_landmarks(true, self.sigma, stream(seed, "landmarks", 1))
        self.moves: list[tuple[str, float, float]] = []
        self.builders: dict[str, PathBuilder] = {}

    def build(self, stated: Team) -> World:
        stances, captures = [], []
        time = EPOCH
        for k in range(self.scenario.stances):
            views = self._views(k)
            tour = self._tour(k, views, time)
            start = self._gather(k, tour, time) + REST if k else time + REST
            tour = self._shifted(tour, start - float(tour.leg.times[0]))
            if k == 0:
                self._place(tour, time)
            mover = self.scenario.mover
            self.builders[mover].follow(tour.leg)
            end = float(tour.leg.times[-1])
            self.moves.append((mover, start, end))
            observers = self.scenario.observers(k)
            # the stance is longer than the drive, so that no capture falls out of it by its clock
            stances.append(Stance(k, start - REST / 2, end + REST / 2, observers, (mover,), self.scenario.anchors(k)))
            captures.append(self._captures(k, tour, views, stated))
            time = end + REST
        paths = {robot: builder.path() for robot, builder in self.builders.items()}
        moves = tuple(sorted(self.moves, key=lambda move: move[1]))
        return World(
            scenario=self.scenario,
            team=stated,
            true_team=self.true,
            imperfections=self.imperfections,
            seed=self.seed,
            paths=paths,
            stances=tuple(stances),
            moves=moves,
            captures=tuple(captures),
            T_world_landmark=self.T_world_landmark,
        )

    def _views(self, k: int) -> tuple[View, ...]:
        return tuple(
            View(
                self.true[robot].camera,
                standing_pose(self.scenario.poses[n], self.tilts[n]) @ self.true[robot].mount.T_body_camera,
            )
            for robot, n in self.scenario.standing(k).items()
        )

    def _tour(self, k: int, views: tuple[View, ...], start: float) -> Tour:
        markers = self.true[self.scenario.mover].markers
        if markers is None:
            raise InputError(f"robot `{self.scenario.mover}` moves but has no markers; give it [robots.markers]")
        middle = self.scenario.middle(k)
        if heading := self.scenario.heading(k):
            # drawn where the team goes along x, and turned back
            T_world_ahead = turned_about(middle, heading)
            T_ahead_world = turned_about(middle, -heading)
            turned = tuple(View(view.camera, T_ahead_world @ view.T_world_camera) for view in views)
            return _turned(self._drawn_tour(k, turned, start), T_world_ahead, heading)
        return self._drawn_tour(k, views, start)

    def _drawn_tour(self, k: int, views: tuple[View, ...], start: float) -> Tour:
        markers = self.true[self.scenario.mover].markers
        assert markers is not None
        where, rng, middle = f"stance {k}", stream(self.seed, "tour", k), self.scenario.middle(k)
        if isinstance(self.scenario, PlannedScenario):
            return self.scenario.tour(k, views, markers.p_body, self.fps, start, where)
        first, second = views
        views = first, second
        if self.depth == "images":
            frames = max(self.points // 2, 1)
            return patrol(views, markers.p_body, middle, frames, self.fps, start, rng, where, self.stopping)
        box = self.scenario.box
        drive_tour = meander if self.scenario.meanders else scatter
        return drive_tour(views, markers.p_body, box, middle, self.points, self.burst, start, rng, where)

    def _place(self, tour: Tour, time: float) -> None:
        """Put every robot where it is at the beginning."""
        scenario = self.scenario
        for robot, n in scenario.standing(0).items():
            floor = stream(self.seed, "floor", n)
            self.builders[robot] = PathBuilder(time, scenario.poses[n], self.sigma, floor, self.tilts[n])
        floor = stream(self.seed, "floor", 2)
        self.builders[scenario.mover] = PathBuilder(time, tour.leg.knots[0], self.sigma, floor)

    def _gather(self, k: int, tour: Tour, time: float) -> float:
        """Move the robots between stances: the one behind overtakes its partner, the mover drives to its next tour.

        Returns the time when both have arrived.
        """
        scenario, ends = self.scenario, []
        for robot, target, tilt in (
            *((robot, np.array(scenario.poses[n]), self.tilts[n]) for robot, n in scenario.leaps(k).items()),
            (scenario.mover, tour.leg.knots[0], None),
        ):
            builder = self.builders[robot]
            leg, _ = drive(np.stack([builder.pose, target]), time, reverse=robot == scenario.mover)
            builder.follow(leg, tilt)
            ends.append(float(leg.times[-1]))
            self.moves.append((robot, time, ends[-1]))
        return max(ends)

    @staticmethod
    def _shifted(tour: Tour, by: float) -> Tour:
        leg = type(tour.leg)(tour.leg.times + by, tour.leg.knots)
        return replace(tour, leg=leg, instants=tour.instants + by)

    def _captures(self, k: int, tour: Tour, views: tuple[View, ...], stated: Team) -> tuple[Capture, ...]:
        rng, out = stream(self.seed, "clock", k), []
        for n, (robot, view) in enumerate(zip(self.scenario.observers(k), views, strict=True)):
            jitter = self.imperfections.time_jitter * rng.standard_normal(len(tour.instants))
            order = np.argsort(tour.instants + jitter)
            times = (tour.instants + jitter)[order]
            stamps = stamp(robot, stated, self.imperfections, times)
            still = in_view(view, self.true, self.T_world_landmark)
            mine = tour.recorded if tour.by_view is None else tour.by_view[n]
            recorded = np.hstack([mine[order], np.ones((len(order), self._lights(still)), bool)])
            out.append(Capture(robot, view, times, stamps, recorded, still))
        return tuple(out)

    def _lights(self, landmarks: Collection[str]) -> int:
        seen = (one.seen_as for one in self.true.landmarks if one.name in landmarks)
        return sum(len(markers.positions) for markers in seen if markers is not None)


def turned_about(middle: tuple[float, float], angle: float) -> Array:
    """Transform (4, 4) of a turn of the floor about a point of it [m] by an angle [rad]."""
    T = np.eye(4)
    T[:3, :3] = rotation_z(angle)
    at = np.array([*middle, 0.0])
    T[:3, 3] = at - T[:3, :3] @ at
    return T


def _turned(tour: Tour, T_world_ahead: Array, angle: float) -> Tour:
    """A tour in a turned world."""
    xy = tour.leg.knots[:, :2] @ T_world_ahead[:2, :2].T + T_world_ahead[:2, 3]
    knots = np.column_stack([xy, tour.leg.knots[:, 2] + angle])
    return replace(tour, leg=replace(tour.leg, knots=knots))


def stamp(robot: str, team: Team, imperfections: Imperfections, times: ArrayLike) -> Array:
    """Time of a robot's clock at true times [s]."""
    late = 0.0 if robot == team.reference else imperfections.clock_offset
    return np.asarray(times, float) + late


def standing_pose(pose: Pose, tilt: ArrayLike) -> Array:
    """T_world_body (4, 4) of a robot at rest: x, y [m], yaw [rad], tilted by roll, pitch (2,) [rad]."""
    T_world_body = floor_pose(*pose)
    T_world_body[:3, :3] = T_world_body[:3, :3] @ tilt_rotation(*np.asarray(tilt, float))
    return T_world_body
