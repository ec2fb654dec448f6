"""Robots that drive about and range each other and landmarks by radio, without stances: `simulate_drives`."""

from itertools import combinations, product
from pathlib import Path as FilePath

import numpy as np
from msgspec.structs import replace as with_fields

from coloc_graph.errors import InputError
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.run import atomic_run
from coloc_graph.run.messages import Ranges
from coloc_graph.simulation.paths import Array, Path
from coloc_graph.simulation.uwb import ASIDE, MIN_RANGE, NLOS_EXCESS
from coloc_graph.simulation.wheels import odometry
from coloc_graph.simulation.world import EPOCH, stream
from coloc_graph.team import Floor, Landmark, Ranging, Robot, Team, Wheels

RATE = 5.0  # ranges of each pair a second
TRUTH_RATE = 10.0  # true poses a second
LANE = 2.2  # m, between the middles of the robots' figures of eight
SIZE = (0.9, 0.7)  # m, half length and half width of one
PACE = 0.25  # rad/s at which it is driven: at most 0.4 m/s
MAP_SIGMA = 0.01  # m, error of the positions of known landmarks
ANTENNA = (-0.08, 0.0)  # m, place of the antenna on a body


def simulate_drives(
    out: str | FilePath,
    *,
    seed: int = 0,
    robots: int = 3,
    seconds: float = 60.0,
    sigma: float = 0.05,
    offset_sigma: float = 0.0,
    nlos: float = 0.0,
    landmarks: int = 4,
    known: bool = False,
) -> None:
    """Write the run of robots that drive figures of eight beside each other for some `seconds`, with its truth.

    All pairs, and all robots and `landmarks`, range each other at `RATE` with a noise of `sigma` [m], offsets of the
    radios of `offset_sigma` [m], and a share `nlos` without line of sight. The team is told where landmarks are if they
    are `known`. Wheels are wrong by 2 % (1 sigma). Raises `InputError` where an argument is wrong.
    """
    if robots < 1 or (robots == 1 and not landmarks) or landmarks < 0:
        raise InputError(f"{robots} robots and {landmarks} landmarks range nobody: give 2 robots, or 1 and landmarks")
    for name, value in {"seconds": seconds, "sigma": sigma}.items():
        if not 0 < value < np.inf:
            raise InputError(f"`{name}` is {value}; give a number above 0")
    if not (0 <= nlos <= 1 and 0 <= offset_sigma < np.inf):
        raise InputError("offsets are metres of 0 or more, and the share without line of sight is 0 to 1")
    team, true = _teams(stream(seed, "uwb"), robots, sigma, offset_sigma, landmarks, known=known)
    times = np.arange(EPOCH, EPOCH + seconds, 1 / RATE)
    paths = {name: _path(stream(seed, "formation", n), n, seconds) for n, name in enumerate(team.names)}
    ranges = _ranges(stream(seed, "uwb", 1), true, paths, times, nlos)
    with atomic_run(out, team) as writer:
        for n, name in enumerate(team.names):
            wheels, path = true[name].wheels, paths[name]
            assert wheels is not None
            said = _integrated(_increments(path) / (wheels.scale, wheels.scale, wheels.turn_scale))
            told = Path(path.times, said, path.tilt_times, path.tilts)
            wheel = odometry(told, [(EPOCH, EPOCH + seconds)], stream(seed, "wheels", n))
            for sample in wheel.records(name, EPOCH, np.inf, 0.0):
                writer.write(sample)
            for record in ranges.get(name, []):
                writer.write(record)
            for time in np.arange(EPOCH, EPOCH + seconds, 1 / TRUTH_RATE).tolist():
                writer.write_truth(name, time, path.pose_at(time)[0])
        writer.write_true_team(true)


def _teams(
    rng: np.random.Generator, robots: int, sigma: float, offset_sigma: float, landmarks: int, *, known: bool
) -> tuple[Team, Team]:
    """Return the team as stated, and as it is."""
    ranging = Ranging(range_sigma=sigma, offset_sigma=offset_sigma, two_way=True, x=ANTENNA[0], y=ANTENNA[1])
    wheels = Wheels(scale_sigma=0.02, turn_scale_sigma=0.02)
    along = np.linspace(-LANE / 2, LANE * (robots - 0.5), landmarks + 2)[1:-1].tolist()
    places = [(at, (SIZE[1] + ASIDE) * (1 if n % 2 else -1)) for n, at in enumerate(along)]
    names = [f"U{n}" for n in range(1, landmarks + 1)]
    marks = tuple(Landmark(name=name, position=at) for name, at in zip(names, places, strict=True))
    told = tuple(Landmark(name=name) for name in names)
    if known:
        off = MAP_SIGMA * rng.standard_normal((landmarks, 2))
        told = tuple(
            Landmark(name=name, position=(x + dx, y + dy), position_sigma=MAP_SIGMA)
            for name, (x, y), (dx, dy) in zip(names, places, off.tolist(), strict=True)
        )
    stated = [Robot(name=f"R{n}", ranging=ranging, wheels=wheels) for n in range(1, robots + 1)]
    actual = [
        with_fields(
            one,
            ranging=with_fields(ranging, offset=offset_sigma * float(rng.standard_normal())),
            wheels=with_fields(
                wheels,
                scale=1 + 0.02 * float(rng.standard_normal()),
                turn_scale=1 + 0.02 * float(rng.standard_normal()),
            ),
        )
        for one in stated
    ]
    return (
        Team(reference="R1", robots=tuple(stated), floor=Floor(), landmarks=told),
        Team(reference="R1", robots=tuple(actual), floor=Floor(), landmarks=marks),
    )


def _path(rng: np.random.Generator, number: int, seconds: float) -> Path:
    """Return a figure of eight about the middle of a lane."""
    t = np.arange(0.0, seconds + 0.1, 0.05)
    phase, way = rng.uniform(0, 2 * np.pi), rng.choice([-1.0, 1.0])
    w = way * PACE * rng.uniform(0.8, 1.2)
    x, y = LANE * number + SIZE[0] * np.sin(w * t + phase), SIZE[1] * np.sin(2 * (w * t + phase))
    yaw = np.unwrap(np.arctan2(2 * SIZE[1] * np.cos(2 * (w * t + phase)) * way, SIZE[0] * np.cos(w * t + phase) * way))
    return Path(EPOCH + t, np.stack([x, y, yaw], axis=1), np.array([EPOCH]), np.zeros((1, 2)))


def _increments(path: Path) -> Array:
    """Steps (n, 3) between the knots of a path, in the body before; 0 first."""
    d = np.diff(path.knots, axis=0, prepend=path.knots[:1])
    before = np.concatenate([path.knots[:1, 2], path.knots[:-1, 2]])
    c, s = np.cos(before), np.sin(before)
    return np.stack([c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1], d[:, 2]], axis=1)


def _integrated(steps: Array) -> Array:
    """Poses (n, 3) of steps in the body before, from 0."""
    yaw = np.cumsum(steps[:, 2])
    before = np.concatenate([[0.0], yaw[:-1]])
    c, s = np.cos(before), np.sin(before)
    x, y = np.cumsum(c * steps[:, 0] - s * steps[:, 1]), np.cumsum(s * steps[:, 0] + c * steps[:, 1])
    return np.stack([x, y, yaw], axis=1)


def _ranges(
    rng: np.random.Generator, team: Team, paths: dict[str, Path], times: Array, nlos: float
) -> dict[str, list[Ranges]]:
    """Return the ranges of all pairs, by the robot that measured."""
    antennas = {}
    for name, path in paths.items():
        sensor = team[name].ranging
        assert sensor is not None
        antennas[name] = (floor_pose(*path.planar_at(times).T) @ np.array([sensor.x, sensor.y, 0.0, 1.0]))[:, :2]
    measured: dict[str, list[tuple[str, Array]]] = {name: [] for name in paths}
    marks = {one.name: one for one in team.landmarks}
    for i, j in [*combinations(paths, 2), *product(paths, marks)]:
        one, other = team[i].ranging, team[j].ranging if j in paths else None
        assert one is not None
        there = antennas[j] if j in paths else np.array(marks[j].position)
        excess = rng.exponential(NLOS_EXCESS, len(times)) * (rng.random(len(times)) < nlos)
        noise = one.range_sigma * rng.standard_normal(len(times))
        offset = one.offset + (0.0 if other is None else other.offset)
        apart = np.linalg.norm(there - antennas[i], axis=1) + offset + noise + excess
        measured[i].append((j, np.maximum(apart, MIN_RANGE)))
    return {
        name: [
            Ranges(name, time, tuple(who for who, _ in pairs), np.array([r[n] for _, r in pairs]))
            for n, time in enumerate(times.tolist())
        ]
        for name, pairs in measured.items()
        if pairs
    }
