"""The world of the scenario `team`: many robots that leap-frog in rotating roles, several at a time."""

import math

import numpy as np

from coloc_graph.errors import InputError
from coloc_graph.run.messages import Stance
from coloc_graph.simulation.crowd import STEP, wander
from coloc_graph.simulation.paths import Array, Leg, PathBuilder, drive
from coloc_graph.simulation.rig import Imperfections, reference_team, stated_team, true_team
from coloc_graph.simulation.scenarios import TeamScenario
from coloc_graph.simulation.world import EPOCH, REST, Capture, World, stamp, standing_pose, stream
from coloc_graph.team import MIN_IMAGES_PER_BIT, Team
from coloc_graph.team.shared_view import View

# movers wander ahead of the foremost row, from and to, and to either side of their lanes [m], for a time [s]
AHEAD = (0.7, 2.1)
ASIDE = 0.7
WANDERING = 20.0
#: Of the poses of their ways each so manieth is kept.
COARSE = 5


def build_team_world(
    scenario: TeamScenario,
    *,
    seed: int = 0,
    points: int = 100,
    imperfections: Imperfections | None = None,
    team: Team | None = None,
) -> World:
    """Simulate a team scenario at depth tracks, with `points` correspondences for a pair that always sees two movers.

    Cameras detect the markers of all movers, and of the robots at rest before them. Robots pass through each other
    when they change places. Raises `InputError` if robots blink and `points` means too few images to recognise a code.
    """
    imperfections = imperfections or Imperfections()
    bits = [one.blink.bit for one in team.robots if one.blink] if team else []
    least = max((math.ceil(4 * MIN_IMAGES_PER_BIT * WANDERING / bit) for bit in bits), default=0)
    if points < least:
        raise InputError(f"`points` is {points}, too few to see robots blink; give at least {least}")
    stated = stated_team(team or reference_team(names=scenario.names), imperfections)
    true = true_team(stated, stream(seed, "team"))
    sigma = float(np.deg2rad(imperfections.floor_sigma_deg))
    poses = scenario.poses
    tilts = sigma * stream(seed, "standing").standard_normal((len(poses), 2))
    builders = {
        name: PathBuilder(EPOCH, poses[n], sigma, stream(seed, "floor", n), tilts[n])
        for n, name in enumerate(scenario.names)
    }
    time, moves, stances, captures = EPOCH, [], [], []
    for k in range(scenario.stances):
        standing, driving = scenario.standing(k), scenario.driving(k)
        front = max(poses[s][0] for s in standing.values())
        ways = _ways(scenario, driving, front, stream(seed, "tour", k))
        legs = {}
        for robot, way in ways.items():
            leg, _ = drive(np.stack([builders[robot].pose, way[0]]), time, reverse=True)
            builders[robot].follow(leg)
            legs[robot] = float(leg.times[-1])
            moves.append((robot, time, legs[robot]))
        begin = max(legs.values()) + REST
        end = begin + WANDERING
        for robot, way in ways.items():
            builders[robot].follow(Leg(np.asarray(begin + COARSE * STEP * np.arange(len(way)), float), way))
            moves.append((robot, begin, end))
        anchors = tuple(name for name in standing if k and name in scenario.standing(k - 1))
        stances.append(Stance(k, begin - REST / 2, end + REST / 2, tuple(standing), tuple(driving), anchors))
        views = {
            name: View(true[name].camera, standing_pose(poses[s], tilts[s]) @ true[name].mount.T_body_camera)
            for name, s in standing.items()
        }
        captures.append(_captures(k, scenario, views, begin, points, stated, true, imperfections, seed))
        time = end + REST
        if k + 1 < scenario.stances:
            arrived = []
            for robot, s in driving.items():
                leg, _ = drive(np.stack([builders[robot].pose, poses[s]]), time, reverse=True)
                builders[robot].follow(leg, tilts[s])
                arrived.append(float(leg.times[-1]))
                moves.append((robot, time, arrived[-1]))
            time = max(arrived)
    return World(
        scenario=scenario,
        team=stated,
        true_team=true,
        imperfections=imperfections,
        seed=seed,
        paths={robot: builder.path() for robot, builder in builders.items()},
        stances=tuple(stances),
        moves=tuple(sorted(moves, key=lambda move: move[1])),
        captures=tuple(captures),
    )


def _ways(scenario: TeamScenario, driving: dict[str, int], front: float, rng: np.random.Generator) -> dict[str, Array]:
    """Path of each mover: poses (n, 3), every `STEP`."""
    lanes = np.array([scenario.poses[s][1] for s in driving.values()])
    areas = np.stack(
        [
            np.full(len(lanes), front + AHEAD[0]),
            np.full(len(lanes), front + AHEAD[1]),
            lanes - ASIDE,
            lanes + ASIDE,
        ],
        axis=1,
    )
    poses = wander(len(driving), WANDERING + STEP, areas, rng)
    return {
        robot: np.column_stack([poses[:, n, :2], np.unwrap(poses[:, n, 2])])[::COARSE]
        for n, robot in enumerate(driving)
    }


def _captures(
    k: int,
    scenario: TeamScenario,
    views: dict[str, View],
    begin: float,
    points: int,
    stated: Team,
    true: Team,
    imperfections: Imperfections,
    seed: int,
) -> tuple[Capture, ...]:
    rng, out = stream(seed, "clock", k), []
    frames = max(math.ceil(points / 4), 4)
    instants = begin + WANDERING * (np.arange(frames) + 0.5) / frames
    for robot, view in views.items():
        jittered = instants + imperfections.time_jitter * rng.standard_normal(frames)
        times = np.sort(jittered)
        others = tuple(name for name in views if name != robot)
        lights = sum(_lights(true, name) for name in (*scenario.driving(k), *others))
        recorded = np.ones((frames, lights), bool)
        out.append(Capture(robot, view, times, stamp(robot, stated, imperfections, times), recorded, others))
    return tuple(out)


def _lights(team: Team, robot: str) -> int:
    markers = team[robot].markers
    return 0 if markers is None else len(markers.positions)
