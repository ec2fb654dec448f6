"""Ranges between the antennas of robots (UWB): `uwb_ranges`."""

from itertools import combinations

import numpy as np

from coloc_graph.run.messages import Ranges
from coloc_graph.simulation.paths import Array
from coloc_graph.simulation.world import EPOCH, World, stream

RATE = 10.0  # ranges of each pair a second
NLOS_EXCESS = 0.5  # m, mean by which a range without line of sight is too long, distributed exponentially
MIN_RANGE = 0.01  # m, of a range that noise would make negative


def uwb_ranges(world: World) -> dict[str, list[Ranges]]:
    """Ranges of a world by robot; a pair is ranged by the robot that comes first in the team, at `RATE`.

    None where the team has no range sensors. Both sensors' offsets add to a range.
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
    return {
        name: [
            Ranges(name, stamp, tuple(who for who, _ in pairs), np.array([r[n] for _, r in pairs]))
            for n, stamp in enumerate(world.clock(name, times).tolist())
        ]
        for name, pairs in found.items()
        if pairs
    }


def _antenna(world: World, name: str, times: Array) -> Array:
    """Places (n, 3) of a robot's antenna [m], which is at the height of all others."""
    sensor = world.true_team[name].ranging
    assert sensor is not None
    T_world_body = world.paths[name].pose_at(times)
    return np.asarray(T_world_body[:, :3, :3] @ np.array([sensor.x, sensor.y, 0.0]) + T_world_body[:, :3, 3])
