"""A team's measurements drawn directly, without cameras: for Monte Carlo of the back end alone, with any team."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.geometry.lie import floor_pose, se3_exp, se3_inverse
from coloc_graph.measurements import Measurement, Node, Odometry, RelativePose, Sighting
from coloc_graph.run.messages import Stance
from coloc_graph.simulation.paths import tilt_rotation
from coloc_graph.team import Floor

Array = NDArray[np.float64]

#: Deviations of a relative pose in GTSAM's tangent [rad, m], as eq. (2) and better have them at l = 0.8 m.
RELATIVE = (4e-3, 4e-3, 3e-3, 5e-3, 5e-3, 4e-3)
#: Of odometry over a step and of a sighting: heading [rad], x, y [m].
WHEELS = (0.01, 0.01, 0.01)
SEEN = (0.02, 0.008, 0.008)
APART = 0.6  # m, distance across between robots
STEP = 0.45  # m, distance of a move ahead


@dataclass(frozen=True, eq=False)
class MeasuredTeam:
    """Measurements of a team, and the truth: `T_world_body` (4, 4) of every node, in the world of the estimate.

    `wrong` are the relative poses that have nothing to do with the truth.
    """

    robots: tuple[str, ...]
    stances: tuple[Stance, ...]
    measurements: tuple[Measurement, ...]
    floor: Floor | None
    T_world_body: dict[Node, Array]
    wrong: tuple[RelativePose, ...]


def measured_team(
    robots: int,
    stances: int,
    rng: np.random.Generator,
    *,
    floor: Floor | None = None,
    neighbours: int = 2,
    odometry: bool = True,
    sightings: bool = True,
    wrong: float = 0.0,
    rotating: bool = True,
) -> MeasuredTeam:
    """A leap-frog of 3 robots or more down a hallway.

    Each stance one robot drives and all others watch it. Each observer measures so many `neighbours`; the roles
    rotate, or else (three robots) the last one always drives and the other two take turns, as in the paper. Odometry
    and sightings need a `floor`. A share `wrong` of the relative poses is drawn anew from anywhere.
    """
    if robots < 3 or (robots > 3 and not rotating):
        raise InputError(f"a team of {robots} robots cannot leap-frog so; give 3, or more that rotate")
    astray = rng.spawn(1)[0]  # so that all else is the same with and without
    names = tuple(f"R{n}" if robots > 26 else chr(ord("A") + n) for n in range(robots))
    tilt = 0.0 if floor is None else float(np.deg2rad(floor.tilt_sigma_deg))

    def place(n: int, k: int) -> Array:
        lane = (n - (robots - 1) / 2) * APART
        T = floor_pose(STEP * (k + n % 2) + rng.normal(0, 0.03), lane + rng.normal(0, 0.03), rng.normal(0, 0.2))
        T[:3, :3] = T[:3, :3] @ tilt_rotation(*(tilt * rng.standard_normal(2)))
        return T

    def mixed(root: Array) -> Array:
        root = root @ (np.eye(len(root)) + 0.3 * rng.standard_normal(root.shape))
        return np.asarray(root @ root.T)

    def noisy(T_i_j: Array, C: Array) -> Array:
        xi = np.zeros(6)
        drawn = np.linalg.cholesky(C) @ rng.standard_normal(len(C))
        xi[slice(0, 6) if len(C) == 6 else slice(2, 5)] = drawn
        return T_i_j @ se3_exp(-xi)

    # at stance k the driver of k-1 stands at a new place, and so does one who makes room in the paper's pair
    at = {name: place(n, 0) for n, name in enumerate(names)}
    at[names[0]] = floor_pose(0, 0, 0) @ np.block(
        [[tilt_rotation(*(tilt * rng.standard_normal(2))), np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]]
    )
    T: dict[Node, Array] = {}
    last: dict[str, int] = {}
    when: list[Stance] = []
    made: list[Measurement] = []
    bad: list[RelativePose] = []
    wheels, seen = (mixed(np.diag(sigmas)) for sigmas in (WHEELS, SEEN))
    for k in range(stances):
        driver = names[(robots - 1 + k) % robots] if rotating else names[-1]
        moved = {names[(robots - 2 + k) % robots]} if rotating else {names[(k + 1) % 2]}
        if k:
            for name in moved:
                at[name] = place(names.index(name), k)
        at[driver] = place(names.index(driver), k)
        observers = tuple(name for name in names if name != driver)
        anchors = tuple(name for name in observers if name not in moved) if k else ()
        if not rotating:
            observers = (*anchors, *(o for o in observers if o not in anchors))
        when.append(Stance(k, 10.0 * k, 10.0 * k + 5, observers, (driver,), anchors))
        present = [*observers, driver] if sightings and floor else list(observers)
        for name in present:
            T[name, k] = at[name]
            if odometry and floor and name in last and name not in anchors:
                step = se3_inverse(T[name, last[name]]) @ at[name]
                made.append(Odometry(name, last[name], k, noisy(step, wheels), wheels))
            last[name] = k
        if sightings and floor:
            T_i_j = noisy(se3_inverse(at[observers[0]]) @ at[driver], seen)
            made.append(Sighting(k, observers[0], driver, 10.0 * k + 2, T_i_j, seen))
        for n, i in enumerate(observers):
            for j in observers[n + 1 : n + 1 + neighbours]:
                C = mixed(np.diag(RELATIVE))
                T_i_j = noisy(se3_inverse(at[i]) @ at[j], C)
                is_wrong = astray.uniform() < wrong
                if is_wrong:
                    x, y, yaw = astray.uniform((-1.5, -1.5, -np.pi / 2), (1.5, 1.5, np.pi / 2))
                    T_i_j = floor_pose(x, y, yaw)
                measured = RelativePose(k, i, j, T_i_j, C)
                made.append(measured)
                if is_wrong:
                    bad.append(measured)
    return MeasuredTeam(names, tuple(when), tuple(made), floor, T, tuple(bad))
