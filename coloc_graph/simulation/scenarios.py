"""Standing poses of the robots, stance by stance: `Scenario` and the formations of the paper's experiments."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.planning.formation import PAPER, Gait

#: x [m], y [m], yaw [rad] of a body on the floor.
Pose = tuple[float, float, float]

TEAM_GAIT = Gait(leap=0.45, abreast=0.8, toe_in_deg=17.0)  # rows and lanes of a team

COURSE_GAIT = Gait(leap=0.25)  # formation on a course
CORNER = 1.2  # m, radius of the corners of a course
WALL = 0.95  # m, distance of its outer wall

#: Half the angle between the pair's cameras in the multi-step experiments.
HALF_ANGLE = math.radians(17.0)


@dataclass(frozen=True)
class Box:
    """Region in which marker points are spread, from the middle of the standing pair: x and y from and to [m]."""

    x: tuple[float, float]
    y: tuple[float, float]


@dataclass(frozen=True)
class Scenario:
    """A leap-frog: `poses[k]` is where robot `pair[k % 2]` stands; in stance k, poses k and k+1 are taken.

    Robot `pair[(k + 1) % 2]` drives from `poses[k-1]` to `poses[k+1]` between stances k-1 and k, and `mover` drives
    about during the stances. `landmarks` are the poses of landmarks, facing the team. `box` is where its markers are
    spread. If it `meanders`, it drives one curve in a stance, as on a mission; otherwise to poses drawn one by one, as
    in the single steps of the paper.
    """

    name: str
    poses: tuple[Pose, ...]
    box: Box
    pair: tuple[str, str] = ("A", "B")
    mover: str = "C"
    meanders: bool = False
    landmarks: tuple[Pose, ...] = ()

    def __post_init__(self) -> None:
        if len(self.poses) < 2:
            raise InputError(f"scenario `{self.name}` has {len(self.poses)} standing poses; give at least 2")

    @property
    def stances(self) -> int:
        """The number of stances."""
        return len(self.poses) - 1

    def stander(self, k: int) -> str:
        """The robot that stands at `poses[k]`."""
        return self.pair[k % 2]

    def observers(self, k: int) -> tuple[str, ...]:
        """The robots of stance k: the one at `poses[k]`, the anchor, then the one at `poses[k+1]`."""
        return self.stander(k), self.stander(k + 1)

    def anchors(self, k: int) -> tuple[str, ...]:
        """The robot that has stayed put since stance k-1."""
        return (self.stander(k),) if k else ()

    def standing(self, k: int) -> dict[str, int]:
        """Robot -> number of its standing pose, in stance k."""
        return {self.stander(k): k, self.stander(k + 1): k + 1}

    def leaps(self, k: int) -> dict[str, int]:
        """Observer -> number of the standing pose to which it drives between stances k-1 and k."""
        return {self.stander(k + 1): k + 1}

    def heading(self, k: int) -> float:
        """Heading of the team in stance k [rad]; its box lies ahead."""
        return 0.0

    def middle(self, k: int) -> tuple[float, float]:
        """The middle of the pair in stance k [m]."""
        (xi, yi, _), (xj, yj, _) = self.poses[k], self.poses[k + 1]
        return (xi + xj) / 2, (yi + yj) / 2


@dataclass(frozen=True)
class TeamScenario(Scenario):
    """Leap-frog of robots `names` in lanes.

    In each stance the hindmost `at_once` drive about in view of all others, and then stand in front. Robot s modulo
    their number stands at `poses[s]`; in stance k, the poses from k * at_once on are taken.
    """

    names: tuple[str, ...] = ()
    at_once: int = 1

    @property
    def stances(self) -> int:
        """The number of stances."""
        return (len(self.poses) - len(self.names)) // self.at_once + 1

    def stander(self, k: int) -> str:
        """The robot that stands at `poses[k]`."""
        return self.names[k % len(self.names)]

    def observers(self, k: int) -> tuple[str, ...]:
        """The robots that stand in stance k, the hindmost first."""
        return tuple(self.standing(k))

    def anchors(self, k: int) -> tuple[str, ...]:
        """The robots that have stayed put since stance k-1."""
        return tuple(name for name in self.standing(k) if name in self.standing(k - 1)) if k else ()

    def standing(self, k: int) -> dict[str, int]:
        """Robot -> number of its standing pose, in stance k."""
        first = k * self.at_once
        return {self.stander(n): n for n in range(first, first + len(self.names) - self.at_once)}

    def driving(self, k: int) -> dict[str, int]:
        """Robot -> number of the standing pose that it takes after stance k."""
        first = k * self.at_once + len(self.names) - self.at_once
        return {self.stander(n): n for n in range(first, first + self.at_once)}


@dataclass(frozen=True)
class CourseScenario(Scenario):
    """Leap-frog round a course; `headings[k]` is the team's direction in stance k [rad]."""

    headings: tuple[float, ...] = ()

    def heading(self, k: int) -> float:
        """Heading of the team in stance k [rad]; its box lies ahead."""
        return self.headings[k]


def single_step(l: float = 0.8, theta_deg: float = 35.0) -> Scenario:  # noqa: E741 (the paper's name)
    """Fig. 4: A and B a distance `l` [m] apart, turned towards each other by `theta_deg` in all."""
    if not (math.isfinite(l) and l > 0):
        raise InputError(f"`l` is {l}; give the distance between the two robots in metres, above 0")
    if not math.isfinite(theta_deg):
        raise InputError(f"`theta_deg` is {theta_deg}; give the angle between the two robots in degrees")
    half = math.radians(theta_deg) / 2
    poses = ((0.0, l / 2, -half), (0.0, -l / 2, half))
    return Scenario("single-step", poses, Box((0.2, 2.5), (-1.5, 1.5)))


def six_step(stances: int = 6, rng: np.random.Generator | None = None, gait: Gait | None = None) -> Scenario:
    """Table I: the standing points a to g at the paper's own distances, or those of a `gait`, at most 6 stances."""
    if not 1 <= stances <= 6:
        raise InputError(f"six-step has 1 to 6 stances, not {stances}; use the hallway for more")
    if gait is not None:
        return replace(hallway(stances, rng, gait), name="six-step", meanders=False)
    places = (
        (0.0, 0.0), (-0.0127, -0.7713), (0.3622, 0.0), (0.3496, -0.7828), (0.7401, 0.0076),
        (0.7262, -0.7970), (1.0971, 0.0211),
    )  # fmt: skip
    poses = tuple((x, y, HALF_ANGLE if k % 2 else -HALF_ANGLE) for k, (x, y) in enumerate(places))
    return Scenario("six-step", poses[: stances + 1], Box((0.3, 2.5), (-1.0, 1.0)))


def hallway(stances: int | None = None, rng: np.random.Generator | None = None, gait: Gait = PAPER) -> Scenario:
    """Simulate Table II's leap-frog down a hallway, each stop off by a centimetre and a degree.

    Parameters
    ----------
    stances
        Number of stances (default: 7.4 m of the `gait`).
    rng
        Random numbers of the stops.
    gait
        Leap, distance abreast and toe-in of the observers; the paper's by default.

    Raises
    ------
    InputError
        If there is no stance.
    """
    stances = max(round(40 * PAPER.leap / gait.leap), 1) if stances is None else stances
    if stances < 1:
        raise InputError(f"the hallway has {stances} stances; give at least 1")
    rng = np.random.default_rng(0) if rng is None else rng
    # row by row, so that a longer hallway begins as a shorter one does
    off = rng.standard_normal((stances + 1, 3)) * (0.01, 0.01, np.deg2rad(1.0))
    poses = np.array([gait.stop(k) for k in range(stances + 1)]) + off
    places = tuple((float(x), float(y), float(w)) for x, y, w in poses)
    return Scenario("hallway", places, Box((max(0.3, gait.leap / 2 + 0.1), 2.5), (-1.0, 1.0)), meanders=True)


def team_of(
    robots: int = 10,
    at_once: int | None = None,
    stances: int = 30,
    rng: np.random.Generator | None = None,
    gait: Gait | None = None,
) -> TeamScenario:
    """Team of `robots` in lanes, of which `at_once` (by default a quarter) move at a time.

    Each stop has errors of some centimetres and degrees. The leap of a `gait` is the distance between robots of one
    lane, and its toe-in that of teams in two lanes.
    """
    gait = TEAM_GAIT if gait is None else gait
    at_once = max(robots // 4, 1) if at_once is None else at_once
    if not 3 <= robots <= 255:
        raise InputError(f"a team has 3 to 255 robots, not {robots}")
    if not 1 <= at_once <= robots - 2:
        raise InputError(f"of {robots} robots 1 to {robots - 2} may move at once, not {at_once}: two must watch")
    if stances < 1:
        raise InputError(f"the team has {stances} stances; give at least 1")
    rng = np.random.default_rng(0) if rng is None else rng
    n = np.arange((stances - 1) * at_once + robots)
    lanes = max(2, round(1.2 * math.sqrt(robots)))
    lane, row = n % lanes, n // lanes
    y = (lane - (lanes - 1) / 2) * gait.abreast
    yaw = -np.sign(y) * np.radians(gait.toe_in_deg) * (lanes == 2)  # two lanes look to each other, more look ahead
    off = rng.standard_normal((len(n), 3)) * (0.02, 0.02, np.deg2rad(2.0))
    poses = np.stack([gait.leap * row + gait.leap / 2 * (lane % 2), y, yaw], axis=1) + off
    names = tuple(chr(ord("A") + k) if robots <= 26 else f"R{k:02}" for k in range(robots))
    places = tuple((float(x), float(y), float(w)) for x, y, w in poses)
    return TeamScenario("team", places, Box((0.7, 2.1), (-0.7, 0.7)), names=names, at_once=at_once)


def course(
    length: float = 100.0,
    landmark_every: float = 10.0,
    laps: int = 4,
    rng: np.random.Generator | None = None,
    gait: Gait = COURSE_GAIT,
) -> CourseScenario:
    """Leap-frog of `length` [m] in all, `laps` times round a square with round corners.

    Landmarks are on its outer wall at regular distances; each stop has errors of a centimetre and a degree.
    """
    if laps < 1:
        raise InputError(f"`laps` is {laps}; give at least 1")
    for name, value in (("length", length), ("landmark_every", landmark_every)):
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"`{name}` is {value}; give metres, above 0")
    lap = length / laps
    if lap < 4 * CORNER * math.pi / 2:
        raise InputError(
            f"a lap of {lap:.1f} m has no room for four corners; give fewer laps, or a `length` of at least "
            f"{4 * CORNER * math.pi / 2 * laps:.0f} m"
        )
    rng = np.random.default_rng(0) if rng is None else rng
    k = np.arange(round(length / gait.leap) + 1)
    side = np.where(k % 2, -1.0, 1.0)
    x, y, yaw = _along(gait.leap * k, lap).T
    left, turn = gait.abreast / 2 * side, math.radians(gait.toe_in_deg) * side
    at = np.stack([x - left * np.sin(yaw), y + left * np.cos(yaw), yaw - turn], axis=1)
    poses = at + rng.standard_normal(at.shape) * (0.01, 0.01, np.deg2rad(1.0))
    count = max(round(lap / landmark_every), 1)
    way = np.arange(count) * lap / count + 0.75 * (lap / 4 - CORNER * math.pi / 2)  # the first towards a straight's end
    x, y, yaw = _along(way, lap).T
    x, y = x + WALL * np.sin(yaw), y - WALL * np.cos(yaw)
    faced = _along(way - 2.0, lap)
    landmarks = np.stack([x, y, np.arctan2(faced[:, 1] - y, faced[:, 0] - x)], axis=1)
    return CourseScenario(
        "landmarks",
        tuple((float(x), float(y), float(w)) for x, y, w in poses),
        Box((0.3, 2.5), (-0.8, 0.8)),
        meanders=True,
        headings=tuple(_along(gait.leap * (k[:-1] + 0.5), lap)[:, 2].tolist()),
        landmarks=tuple((float(x), float(y), float(w)) for x, y, w in landmarks),
    )


def _along(way: NDArray[np.floating], lap: float) -> NDArray[np.float64]:
    """x, y [m] and heading [rad, unwrapped] after so many metres (n,) round a course, (n, 3)."""
    arc = CORNER * math.pi / 2
    straight = lap / 4 - arc
    quarter = np.floor(way / (straight + arc))
    into = way - quarter * (straight + arc)
    turned = np.maximum(into - straight, 0.0) / CORNER
    ahead = np.minimum(into, straight) + CORNER * np.sin(turned)
    left = CORNER * (1 - np.cos(turned))
    reach = straight + CORNER  # a side, from corner to corner but for one radius
    starts = np.array([[0.0, 0.0], [reach, CORNER], [reach - CORNER, reach + CORNER], [-CORNER, reach]])
    c, s = np.cos(quarter * math.pi / 2), np.sin(quarter * math.pi / 2)
    from_x, from_y = starts[quarter.astype(int) % 4].T
    x, y = from_x + c * ahead - s * left, from_y + s * ahead + c * left
    return np.stack([x, y, quarter * math.pi / 2 + turned], axis=1)


def scenario(
    name: str,
    *,
    stances: int | None = None,
    l: float | None = None,  # noqa: E741
    theta_deg: float | None = None,
    robots: int | None = None,
    at_once: int | None = None,
    length: float | None = None,
    landmark_every: float | None = None,
    laps: int | None = None,
    rng: np.random.Generator | None = None,
    gait: Gait | None = None,
) -> Scenario:
    """The scenario of a name; `InputError` where there is none, or an argument is not one of its own."""
    if name != "landmarks" and (length is not None or landmark_every is not None or laps is not None):
        raise InputError(f"`length`, `landmark_every` and `laps` belong to landmarks, not to {name}; leave them out")
    if name != "single-step" and (l is not None or theta_deg is not None):
        raise InputError(f"`l` and `theta_deg` belong to single-step, not to {name}; give {name} a `gait`, if any")
    if name == "single-step" and gait is not None:
        raise InputError("single-step has no leap: give it `l` and `theta_deg` instead of a gait")
    if name != "team" and (robots is not None or at_once is not None):
        raise InputError(f"`robots` and `at_once` belong to team, not to {name}; leave them out")
    if name == "single-step":
        if stances not in (None, 1):
            raise InputError(f"single-step has one stance, not {stances}; leave `stances` out, or use the hallway")
        return single_step(0.8 if l is None else l, 35.0 if theta_deg is None else theta_deg)
    if name == "six-step":
        return six_step(6 if stances is None else stances, rng, gait)
    if name == "hallway":
        return hallway(stances, rng, PAPER if gait is None else gait)
    if name == "team":
        return team_of(10 if robots is None else robots, at_once, 30 if stances is None else stances, rng, gait)
    if name == "landmarks":
        if stances is not None:
            raise InputError("the scenario landmarks is as long as its `length` [m]; give that instead of `stances`")
        return course(100.0 if length is None else length, 10.0 if landmark_every is None else landmark_every,
                      4 if laps is None else laps, rng, COURSE_GAIT if gait is None else gait)  # fmt: skip
    raise InputError(f"there is no scenario `{name}`; choose one of {', '.join(SCENARIOS)}")


#: The scenarios, by name.
SCENARIOS: dict[str, Callable[..., Scenario]] = {
    "single-step": single_step,
    "six-step": six_step,
    "hallway": hallway,
    "team": team_of,
    "landmarks": course,
}
