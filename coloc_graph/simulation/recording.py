"""`simulate`: let a scenario happen and write it down as the run that a real team would have written."""

from collections.abc import Callable, Iterator
from pathlib import Path as FilePath
from typing import Literal, Protocol, get_args

import numpy as np
from numpy.typing import ArrayLike

from coloc_graph.errors import InputError
from coloc_graph.planning.floor_map import FloorMap
from coloc_graph.planning.formation import Gait
from coloc_graph.planning.plan import Plan
from coloc_graph.run import atomic_run
from coloc_graph.run.messages import Detections, Image, Motion, OdometrySample, Ranges, Stance
from coloc_graph.simulation.blinking import with_codes
from coloc_graph.simulation.mess import messy_frames
from coloc_graph.simulation.paths import Array
from coloc_graph.simulation.planned import planned, require_clear
from coloc_graph.simulation.rig import FISHEYE_BIAS_PX, Imperfections, reference_team, wide_team
from coloc_graph.simulation.scenarios import TeamScenario, scenario
from coloc_graph.simulation.scenery import Scenery, frames, make_scenery
from coloc_graph.simulation.teams import build_team_world
from coloc_graph.simulation.tracks import observe
from coloc_graph.simulation.uwb import uwb_ranges, with_ranged_landmarks
from coloc_graph.simulation.wheels import Odometry, move_times, odometry
from coloc_graph.simulation.world import EPOCH, Capture, Depth, World, build_world, stream
from coloc_graph.team import Team

ImageFormat = Literal["jpeg", "raw", "png"]
Record = Detections | Image | OdometrySample | Motion | Ranges | Stance


class Recorder(Protocol):
    """Receiver of a world's records: `run.RunWriter`, or anything with these methods."""

    def write(self, record: Record) -> None:
        """Take one record."""

    def write_truth(self, robot: str, time: float, T_world_body: ArrayLike) -> None:
        """Take one true pose."""

    def write_true_team(self, team: Team) -> None:
        """Take the true team."""


def simulate(
    scenario_name: str,
    out: str | FilePath,
    *,
    depth: Depth = "tracks",
    seed: int = 0,
    points: int | None = None,
    stances: int | None = None,
    imperfections: Imperfections | None = None,
    l: float | None = None,  # noqa: E741 (the paper's name)
    theta_deg: float | None = None,
    robots: int | None = None,
    at_once: int | None = None,
    length: float | None = None,
    landmark_every: float | None = None,
    laps: int | None = None,
    known: bool = False,
    gait: Gait | None = None,
    plan: Plan | None = None,
    blink: bool = False,
    fps: float = 10.0,
    image_format: ImageFormat = "jpeg",
    messy: bool = False,
    fisheye_deg: float | None = None,
    uwb_landmarks: int = 0,
    team: Team | None = None,
    floor_map: FloorMap | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> World:
    """Simulate a scenario (`single-step`, `six-step`, `hallway`, `team`, `landmarks`), written as a run to `out`.

    `points` correspondences a stance (250 for single-step and for images, else 100), two from each frame at depth
    images, which `messy` makes of a world of glare, mirrors, flicker and a person in the way. Cameras are fisheyes of
    `fisheye_deg` [deg] across where it is given. `l` [m] and `theta_deg` are single-step's; `robots`, how many move
    `at_once`, and whether they `blink` and markers have no names (2000 points then) are team's; `length` [m] in all, in
    how many `laps`, with a landmark every so many metres, and whether the team is told where these are (`known`), are
    landmarks'; `uwb_landmarks` are ranged and not seen. `gait` is the formation; a `plan` is followed instead, at
    `fps`, by a `team` (default: the reference's robots), with the points that its drives bring, among the walls of a
    `floor_map`, behind which nothing is seen. `progress` is called with the stances done and their number. The same
    arguments give the same bytes. Returns what was true. Raises `InputError`, and leaves no file, where an argument is
    wrong or the pair has no common view.
    """
    if depth not in get_args(Depth):
        raise InputError(f"`depth` is {depth!r}; use tracks or images")
    if blink and scenario_name != "team":
        raise InputError(f"`blink` belongs to team, not to {scenario_name}; leave it out")
    if known and scenario_name != "landmarks":
        raise InputError(f"`known` belongs to landmarks, not to {scenario_name}; leave it out")
    if messy and depth != "images":
        raise InputError("`messy` is of images: use it with depth images")
    if image_format not in get_args(ImageFormat):
        raise InputError(f"`image_format` is {image_format!r}; use jpeg, png or raw")
    if seed < 0:
        raise InputError(f"`seed` is {seed}; give a whole number that is not negative")
    given = (stances, points, gait, robots, at_once, l, theta_deg)
    if plan is not None and (any(one is not None for one in given) or blink):
        raise InputError("a plan has its own robots, stances, points and gait: leave these out")
    if team is not None and plan is None:
        raise InputError("a team of your own follows a plan: give one, too")
    if floor_map is not None and plan is None:
        raise InputError("robots keep off the walls of a map by a plan: give one that was planned with this map")
    if floor_map is not None and (depth == "images" or scenario_name == "landmarks"):
        raise InputError(
            "walls of a map hide markers of robots at depth tracks: leave out images, landmarks, or the map"
        )
    rng = stream(seed, "formation")
    what = scenario(
        scenario_name, stances=stances, l=l, theta_deg=theta_deg, robots=robots, at_once=at_once,
        length=length, landmark_every=landmark_every, laps=laps, rng=rng, gait=gait,
    )  # fmt: skip
    if plan is not None:
        if floor_map is not None:
            require_clear(plan, floor_map)
        what = planned(plan, stream(seed, "formation"), floor_map, what.landmarks)
        team = team or _reference_of(plan)
    if points is None:
        points = 250 if depth == "images" or scenario_name == "single-step" else 2000 if blink else 100
    if isinstance(what, TeamScenario):
        if depth == "images":
            raise InputError("the scenario team has tracks and no images: leave out `depth`")
        if fisheye_deg is not None:
            raise InputError("the scenario team has pinhole cameras: leave out `fisheye_deg`")
        coded = with_codes(reference_team(names=what.names)) if blink else None
        world = build_team_world(what, seed=seed, points=points, imperfections=imperfections, team=coded)
    else:
        bias_px = FISHEYE_BIAS_PX if depth == "images" else 0.0
        if fisheye_deg is not None and team is not None:
            raise InputError("`fisheye_deg` is of the reference's robots: leave it out with a team of your own")
        team = team if fisheye_deg is None else wide_team(fisheye_deg, bias_px)
        world = build_world(what, depth=depth, seed=seed, points=points, imperfections=imperfections, fps=fps,
                            known=known, team=team)  # fmt: skip
    if uwb_landmarks:
        if world.imperfections.uwb_sigma == 0:
            raise InputError("`uwb_landmarks` are ranged: give `uwb_sigma` too")
        world = with_ranged_landmarks(world, uwb_landmarks)

    with atomic_run(out, world.team, image_format=image_format) as writer:
        record(world, writer, depth, progress, messy=messy)
    return world


def _reference_of(plan: Plan) -> Team | None:
    """Return robots of the reference rig with the names of a plan; None for its own A, B and C."""
    names = {*plan.observers, *(stance.mover for stance in plan.stances)}
    return None if names <= {"A", "B", "C"} else reference_team(names=tuple(sorted(names)))


def record(
    world: World,
    recorder: Recorder,
    depth: Depth,
    progress: Callable[[int, int], None] | None = None,
    *,
    messy: bool = False,
) -> None:
    """Write all that happens in a world to a recorder, each topic in the order of time."""
    recorder.write_true_team(world.true_team)
    wheels = {
        robot: odometry(
            path,
            [(start, end) for mover, start, end in world.moves if mover == robot],
            stream(world.seed, "wheels", world.team.names.index(robot)),
        )
        for robot, path in world.paths.items()
    }
    ranges = uwb_ranges(world)
    scenery = make_scenery(world) if depth == "images" else None
    begin = EPOCH
    for k, stance in enumerate(world.stances):
        events = _truth(world, begin, stance)
        events += _moves(world, begin, stance, wheels)
        events += [_write(one, one.time) for each in ranges.values() for one in each if begin <= one.time < stance.end]
        events += _seen(world, k, scenery, messy_frames if messy else frames)
        # stable, so that what happens at one instant is written in the order above
        for _, happen in sorted(events, key=lambda event: event[0]):
            happen(recorder)
        begin = stance.end
        if progress is not None:
            progress(k + 1, len(world.stances))


Event = tuple[float, Callable[[Recorder], None]]
#: What makes the images of a capture in a stance.
Rendering = Callable[[World, int, Capture, Scenery], Iterator[Image]]


def _write(record: Record, time: float) -> Event:
    return time, lambda recorder: recorder.write(record)


def _write_truth(robot: str, time: float, T_world_body: Array) -> Event:
    return time, lambda recorder: recorder.write_truth(robot, time, T_world_body)


def _truth(world: World, begin: float, stance: Stance) -> list[Event]:
    """True poses of all robots: while they move at 10 Hz and where they turn, and at both ends of the stance."""
    events = []
    for robot, path in world.paths.items():
        moving = [move_times(s, e) for mover, s, e in world.moves if mover == robot and begin <= s < stance.end]
        turns = path.times[(path.times >= begin) & (path.times <= stance.end)]  # between them its speed is constant
        times = np.unique(np.concatenate([*moving, turns, [stance.start, stance.end]]))
        events += [_write_truth(robot, t, T) for t, T in zip(times.tolist(), path.pose_at(times), strict=True)]
    return events


def _moves(world: World, begin: float, stance: Stance, wheels: dict[str, Odometry]) -> list[Event]:
    """The stance, and motions and odometry since `begin`, by the robots' own clocks."""
    events = [_write(stance, stance.start)]
    for robot, start, end in world.moves:
        if begin <= start < stance.end:
            on, off = world.clock(robot, [start, end]).tolist()
            events += [_write(Motion(robot, on, True), on), _write(Motion(robot, off, False), off)]
    for robot, odometer in wheels.items():
        late = float(world.clock(robot, 0.0))
        events += [_write(sample, sample.time) for sample in odometer.records(robot, begin, stance.end, late)]
    return events


def _seen(world: World, k: int, scenery: Scenery | None, rendered: Rendering) -> list[Event]:
    """Records of the observers of stance k: images where there is scenery, otherwise detections."""
    if scenery is None:
        return [_write(found, found.time) for tracks in observe(world, k) for found in tracks.records()]
    events = []
    for capture in world.captures[k]:
        images = rendered(world, k, capture, scenery)
        events += [(stamp, _write_next(images)) for stamp in capture.stamps.tolist()]
    return events


def _write_next(images: Iterator[Image]) -> Callable[[Recorder], None]:
    # rendered when its turn comes: a stance's images need not be in memory together
    return lambda recorder: recorder.write(next(images))
