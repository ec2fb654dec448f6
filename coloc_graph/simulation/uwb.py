"""Ranges between the antennas of robots (UWB): `uwb_ranges`."""

from dataclasses import replace
from itertools import combinations, product

import numpy as np
from msgspec.structs import replace as with_fields

from coloc_graph.run.messages import Ranges
from coloc_graph.simulation.paths import Array
from coloc_graph.simulation.world import EPOCH, World, stream
from coloc_graph.team import Landmark

RATE = 10.0  # ranges of each pair of robots a second
LANDMARK_EVERY = 5  # instants between two at which a robot ranges all landmarks
ASIDE = 2.0  # m, distance of landmarks from the robots' paths
NLOS_EXCESS = 0.5  # m, mean by which a range without line of sight is too long, distributed exponentially
MIN_RANGE = 0.01  # m, of a range that noise would make negative


def uwb_ranges(world: World) -> dict[str, list[Ranges]]:
    """Ranges of a world by robot; a pair is ranged by the robot that comes first in the team, at `RATE`.

    None where the team has no range sensors. The offsets of both robots add to a range; landmarks have none.
    """
    team, wrong = world.true_team, world.imperfections
    if any(robot.ranging is None for robot in team.robots):
        return {}
    times = np.arange(EPOCH, world.stances[-1].end, 1 / RATE)
    places = {name: _antenna(world, name, times) for name in team.names}
    rng = stream(world.seed, "uwb")
    found: dict[str, list[tuple[str, Array]]] = {name: [] for name in team.names}
    for i, j in combinations(team.names, 2):
        one, other = team[i].ranging, team[j].ranging
        assert one is not None and other is not None
        apart = np.linalg.norm(places[i] - places[j], axis=1)
        excess = rng.exponential(NLOS_EXCESS, len(times)) * (rng.random(len(times)) < wrong.uwb_nlos)
        noise = one.range_sigma * rng.standard_normal(len(times))
        found[i].append((j, np.maximum(apart + one.offset + other.offset + noise + excess, MIN_RANGE)))
    seen = [one for one in team.landmarks if one.seen_as is None and one.position is not None]
    rare = {name: list[tuple[str, Array]]() for name in team.names}
    for name, landmark in product(team.names, seen):
        sensor = team[name].ranging
        assert sensor is not None and landmark.position is not None
        apart = np.linalg.norm(places[name][:, :2] - landmark.position, axis=1)
        excess = rng.exponential(NLOS_EXCESS, len(times)) * (rng.random(len(times)) < wrong.uwb_nlos)
        noise = sensor.range_sigma * rng.standard_normal(len(times))
        rare[name].append((landmark.name, np.maximum(apart + sensor.offset + noise + excess, MIN_RANGE)))
    records: dict[str, list[Ranges]] = {}
    for name in team.names:
        often = found[name]
        for n, stamp in enumerate(world.clock(name, times).tolist()):
            pairs = [*often, *rare[name]] if n % LANDMARK_EVERY == 0 else often
            if pairs:
                record = Ranges(name, stamp, tuple(who for who, _ in pairs), np.array([r[n] for _, r in pairs]))
                records.setdefault(name, []).append(record)
    return records


def with_ranged_landmarks(world: World, count: int) -> World:
    """Return the world with landmarks that are ranged and not seen, on both sides of the way, unknown to the team."""
    paths = np.concatenate([path.knots[:, :2] for path in world.paths.values()])
    (low_x, low_y), (high_x, high_y) = paths.min(axis=0), paths.max(axis=0)
    along = np.linspace(low_x, high_x, count + 2)[1:-1].tolist()
    positions = [(x, float(high_y) + ASIDE if n % 2 else float(low_y) - ASIDE) for n, x in enumerate(along)]
    names = [f"U{n}" for n in range(1, count + 1)]
    true = tuple(Landmark(name=name, position=xy) for name, xy in zip(names, positions, strict=True))
    return replace(
        world,
        team=with_fields(world.team, landmarks=(*world.team.landmarks, *(Landmark(name=name) for name in names))),
        true_team=with_fields(world.true_team, landmarks=(*world.true_team.landmarks, *true)),
    )


def _antenna(world: World, name: str, times: Array) -> Array:
    """Places (n, 3) of a robot's antenna [m], which is at the height of all others."""
    sensor = world.true_team[name].ranging
    assert sensor is not None
    T_world_body = world.paths[name].pose_at(times)
    return np.asarray(T_world_body[:, :3, :3] @ np.array([sensor.x, sensor.y, 0.0]) + T_world_body[:, :3, 3])
