"""Scene of the viewer as arrays: robots by stances, one row per robot, NaN for a robot without a pose."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.frontend import FrontendOptions, WheelTrack
from coloc_graph.geometry.lie import yaw
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.report.drawing import world_covariances
from coloc_graph.run import Run, Stance
from coloc_graph.team import Team

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Layer:
    """Poses of all robots (r) at all stances (s) by one method, NaN where there is none.

    Parameters
    ----------
    name : str
        Its name in the panel.
    times : (r, s) float
        Times of the poses [UTC s].
    xyz, yaw : (r, s, 3) and (r, s) float
        Poses in the world [m], [rad].
    covariance, yaw_sigma : (r, s, 2, 2) and (r, s) float
        Covariance of x, y along the world's axes [m^2], standard deviation of yaw [rad]; NaN where there is none.
    trajectories : mapping of str to Trajectory
        The poses by robot.
    aside : bool
        The layer is that of another result, in a comparison.
    """

    name: str
    times: Array
    xyz: Array
    yaw: Array
    covariance: Array
    yaw_sigma: Array
    trajectories: Mapping[str, Trajectory]
    aside: bool = False

    @cached_property
    def there(self) -> Mask:
        """(r, s), True for a pose."""
        return np.isfinite(self.yaw)

    @cached_property
    def rows(self) -> tuple[Index, ...]:
        """The stances at which each robot has a pose, by its number."""
        return tuple(np.flatnonzero(there) for there in self.there)

    @cached_property
    def arrived(self) -> Mask:
        """(r, s), True for a pose that differs from the one at the stance before."""
        new = self.there.copy()
        with np.errstate(invalid="ignore"):
            new[:, 1:] &= ~((self.xyz[:, 1:] == self.xyz[:, :-1]).all(axis=2) & (self.yaw[:, 1:] == self.yaw[:, :-1]))
        return new


def layer_of(
    name: str,
    robots: Sequence[str],
    stances: Sequence[Stance],
    trajectories: Mapping[str, Trajectory],
    *,
    aside: bool = False,
) -> Layer:
    """Make a layer of trajectories; those without stances have a pose at each stance in order.

    Raises `InputError`, with robot and stance, where a pose is not finite, or of an unknown stance.
    """
    row_of = {stance.index: row for row, stance in enumerate(stances)}
    r, s = len(robots), len(stances)
    times, angle, sigma = (np.full((r, s), np.nan) for _ in range(3))
    xyz, covariance = np.full((r, s, 3), np.nan), np.full((r, s, 2, 2), np.nan)
    for number, robot in enumerate(robots):
        one = trajectories.get(robot)
        if one is None or not len(one):
            continue
        named = one.stances if one.stances is not None else np.array([stance.index for stance in stances][: len(one)])
        unknown = [index for index in named.tolist() if index not in row_of]
        if unknown or len(named) != len(one):
            raise InputError(
                f"{name}: robot {robot} has a pose at stance {unknown[0] if unknown else len(one)}, which the run does "
                "not hold: give the run that was solved"
            )
        bad = ~np.isfinite(one.T_world_body).all(axis=(1, 2)) | ~np.isfinite(one.times)
        if bad.any():
            raise InputError(
                f"{name}: the pose of robot {robot} at stance {named[bad.argmax()]} is not finite; solve the run again"
            )
        rows = np.array([row_of[index] for index in named.tolist()])
        of_position, of_rotation = world_covariances(one)
        times[number, rows], xyz[number, rows], angle[number, rows] = one.times, one.positions, yaw(one.T_world_body)
        covariance[number, rows] = of_position[:, :2, :2]
        sigma[number, rows] = np.sqrt(of_rotation[:, 2, 2].clip(min=0))
    return Layer(name, times, xyz, angle, covariance, sigma, dict(trajectories), aside)


@dataclass(frozen=True, eq=False)
class Edges:
    """Measurements of pairs of observers.

    Parameters
    ----------
    rows : (m,) int
        Rows of the stances.
    i, j : (m,) int
        Robots by number.
    sigmas : (m,) float
        RMS residuals in units of the noise; NaN if unknown.
    reason : tuple of str
        Reasons for rejection; "" of used measurements.
    of_what : str
        Name of the quantity in `sigmas`.
    """

    rows: Index
    i: Index
    j: Index
    sigmas: Array
    reason: tuple[str, ...]
    of_what: str = ""

    def __len__(self) -> int:
        return len(self.rows)

    @cached_property
    def used(self) -> Mask:
        """(m,), True for a measurement in the estimate."""
        return np.array([not why for why in self.reason], bool)


@dataclass(frozen=True, eq=False)
class Links:
    """Sightings or odometry: robots `i` at `rows_i` with robots `j` at `rows_j` (m,) each, in the order of `rows_j`."""

    i: Index
    rows_i: Index
    j: Index
    rows_j: Index

    def __len__(self) -> int:
        return len(self.i)


_NONE: Index = np.empty(0, np.int64)
NO_EDGES = Edges(_NONE, _NONE, _NONE, np.empty(0), ())
NO_LINKS = Links(_NONE, _NONE, _NONE, _NONE)


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Landmarks by number.

    `names`, positions `xy` (l, 2) [m] and `yaw` (l,) [rad] in the world, `covariance` (l, 2, 2) of x, y and `yaw_sigma`
    (l,) [rad]; `sightings` are of robots i, of landmarks j.
    """

    names: tuple[str, ...] = ()
    xy: Array = field(default_factory=lambda: np.zeros((0, 2)))
    yaw: Array = field(default_factory=lambda: np.zeros(0))
    covariance: Array = field(default_factory=lambda: np.zeros((0, 2, 2)))
    yaw_sigma: Array = field(default_factory=lambda: np.zeros(0))
    sightings: Links = NO_LINKS

    def __len__(self) -> int:
        return len(self.names)


NO_LANDMARKS = Landmarks()


@dataclass(frozen=True, eq=False)
class ShownPlan:
    """Plan of a stance.

    Number of the `stance`; by robot, `standing` (3,) of x, y [m], yaw [rad] and promised `covariances` (3, 3) of them;
    waypoints of the mover's `drive` (n, 2) [m]; the robot that leaps before, if any; and the `reason` in one line.
    """

    stance: int
    standing: Mapping[str, Array]
    covariances: Mapping[str, Array]
    drive: Array
    leaper: str | None = None
    reason: str = ""


@dataclass(frozen=True, eq=False)
class Scene:
    """A run and its estimates as shown; immutable.

    Parameters
    ----------
    robots : tuple of str
        Names by number.
    stances : tuple of Stance
        Stances by row.
    layers : tuple of Layer
        Estimates; robots are drawn at the poses of the first.
    edges : Edges
        Measurements of pairs of observers.
    sightings, odometry : Links
        Sightings (observer, seen), and wheel odometry.
    stayed : (q, 2) int
        Stay-put constraints: robot by number, row of the later stance.
    team, calibrated : Team or None
        The team as stated, and as estimated.
    run : Run or None
        Without it there are no images, marker tracks and inspections.
    frontend : FrontendOptions
        Options by which pairs are measured again.
    wheels : mapping of str to WheelTrack
        Odometry, by which robots move between stances.
    title : str
        Title of the page.
    notes : tuple of str
        Sentences on missing parts.
    beside : Scene or None
        Scene of another result, in a comparison: its first layer is `aside`, its edges are numbered on from `edges`.
    landmarks : Landmarks
        Estimated landmarks.
    plans : tuple of ShownPlan
        Planned stances, in their order.
    """

    robots: tuple[str, ...]
    stances: tuple[Stance, ...]
    layers: tuple[Layer, ...] = ()
    edges: Edges = NO_EDGES
    sightings: Links = NO_LINKS
    odometry: Links = NO_LINKS
    stayed: Index = field(default_factory=lambda: np.empty((0, 2), np.int64))
    team: Team | None = None
    calibrated: Team | None = None
    run: Run | None = None
    frontend: FrontendOptions = field(default_factory=FrontendOptions)
    wheels: Mapping[str, WheelTrack] = field(default_factory=dict)
    title: str = ""
    notes: tuple[str, ...] = ()
    beside: "Scene | None" = None
    landmarks: Landmarks = NO_LANDMARKS
    plans: tuple[ShownPlan, ...] = ()

    def __len__(self) -> int:
        return len(self.stances)

    @cached_property
    def starts(self) -> Array:
        """Starts of the stances, (s,) [s]."""
        return np.array([stance.start for stance in self.stances], float)

    @cached_property
    def ends(self) -> Array:
        """Ends of the stances, (s,) [s]."""
        return np.array([stance.end for stance in self.stances], float)

    def row_at(self, time: float) -> int:
        """Row of the last stance that began before a time; the first one if none did, -1 without stances."""
        return min(max(int(np.searchsorted(self.starts, time, side="right")) - 1, 0), len(self) - 1)

    def middle(self, row: int) -> float:
        """Return the middle of a stance [s]; 0 without any."""
        return float(self.starts[row] + self.ends[row]) / 2 if 0 <= row < len(self) else 0.0

    def roles(self, row: int, robot: str) -> str:
        """Role of a robot in a stance."""
        if not 0 <= row < len(self):
            return ""
        stance = self.stances[row]
        if robot in stance.movers:
            return "mover"
        if robot in stance.observers:
            return "anchor" if robot in stance.anchors else "observer"
        return "standby"

    @cached_property
    def standing(self) -> Mask:
        """(r, s), True for a robot that does not move in a stance."""
        out = np.ones((len(self.robots), len(self)), bool)
        number = {robot: n for n, robot in enumerate(self.robots)}
        for row, stance in enumerate(self.stances):
            for robot in stance.movers:
                out[number[robot], row] = False
        return out

    @property
    def other(self) -> Layer | None:
        """The poses of another result, in a comparison."""
        return next((layer for layer in self.layers if layer.aside), None)

    @property
    def other_edges(self) -> Edges:
        """Its edges."""
        return self.beside.edges if self.beside is not None else NO_EDGES

    def edge(self, number: int) -> tuple["Scene", int] | None:
        """Scene that an edge is of, and its number there; None if there is no such edge."""
        if 0 <= number < len(self.edges):
            return self, number
        number -= len(self.edges)
        return (self.beside, number) if self.beside is not None and 0 <= number < len(self.beside.edges) else None

    @property
    def true(self) -> Layer | None:
        """Ground-truth poses of the robots."""
        return next((layer for layer in self.layers if layer.name == TRUE), None)

    def errors(self, layer: Layer) -> Array:
        """Distance of each pose of a layer from the truth, (r, s) [m]; NaN if it is not known."""
        if self.true is None:
            return np.full(layer.yaw.shape, np.nan)
        return np.asarray(np.linalg.norm(layer.xyz[..., :2] - self.true.xyz[..., :2], axis=2))

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Minimum and maximum x, y of all poses [m]; a square of a metre about 0 where there are none."""
        poses = (layer.xyz[layer.there][:, :2] for layer in self.layers)
        every = np.concatenate([np.empty((0, 2)), *poses, self.landmarks.xy])
        if not len(every):
            return np.full(2, -0.5), np.full(2, 0.5)
        return every.min(axis=0), every.max(axis=0)


TRUE = "true"
