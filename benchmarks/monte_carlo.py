"""Simulated runs in memory, and statistics over seeds; what the benchmarks share.

A file per seed would only cost time: this is the same world, seen through the same methods that `Run` has.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy.stats import chi2

from coloc_graph.evaluation import Accuracy, align, evaluate
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.pipeline.batch import Solution, SolveOptions, solve
from coloc_graph.run import Detections, OdometrySample, Planes, Ranges
from coloc_graph.simulation import EPOCH, World, build_world, observe, scenario
from coloc_graph.simulation.uwb import uwb_ranges
from coloc_graph.simulation.wheels import odometry
from coloc_graph.simulation.world import stream

T = TypeVar("T")


class MemoryRun:
    """A world at depth tracks, as `Run` shows it."""

    def __init__(self, world: World) -> None:
        self.path = Path(f"{world.scenario.name}-{world.seed}")
        self.team = world.team
        self.warnings: tuple[str, ...] = ()
        self.stances = tuple(world.stances)
        self.topics: dict[str, int] = {}
        self.repeated: dict[str, int] = {}
        self.planes: dict[int, Planes] = {}
        self._detections: dict[str, list[Detections]] = {name: [] for name in world.team.names}
        for k in range(len(world.stances)):
            for tracks in observe(world, k):
                self._detections[tracks.robot] += tracks.records()
        self._odometry: dict[str, list[OdometrySample]] = {}
        self._ranges: dict[str, list[Ranges]] | None = None
        self._world = world

    def has_detections(self, robot: str) -> bool:
        """As `Run`."""
        return bool(self._detections[robot])

    def detections(self, robot: str, start: float, end: float) -> Iterator[Detections]:
        """As `Run`."""
        seen = self._detections[robot]
        first = bisect_left(seen, start, key=lambda one: one.time)
        return iter(seen[first : bisect_right(seen, end, key=lambda one: one.time)])

    @property
    def has_ranges(self) -> bool:
        """As `Run`."""
        return self._world.imperfections.uwb_sigma > 0

    def ranges(self, robot: str, start: float | None = None, end: float | None = None) -> Iterator[Ranges]:
        """As `Run`."""
        if self._ranges is None:
            self._ranges = uwb_ranges(self._world)
        for one in self._ranges.get(robot, ()):
            if (start is None or one.time >= start) and (end is None or one.time <= end):
                yield one

    def odometry(self, robot: str, start: float | None = None, end: float | None = None) -> Iterator[OdometrySample]:
        """As `Run`."""
        if robot not in self._odometry:
            world = self._world
            moves = [(begin, finish) for mover, begin, finish in world.moves if mover == robot]
            wheels = odometry(world.paths[robot], moves, stream(world.seed, "wheels", world.team.names.index(robot)))
            late = float(world.clock(robot, 0.0))
            self._odometry[robot] = list(wheels.records(robot, EPOCH, world.stances[-1].end, late))
        samples = self._odometry[robot]
        first = 0 if start is None else bisect_left(samples, start, key=lambda one: one.time)
        last = len(samples) if end is None else bisect_right(samples, end, key=lambda one: one.time)
        return iter(samples[first:last])


def truth_of(world: World) -> dict[str, Trajectory]:
    """The truth at the beginning of each stance and at each capture."""
    captured = [capture.times for captures in world.captures for capture in captures]
    times = np.unique(np.concatenate([[EPOCH], [stance.start for stance in world.stances], *captured]))
    return {robot: Trajectory(robot, times, path.pose_at(times)) for robot, path in world.paths.items()}


def simulated(name: str, seed: int, *, points: int, **options: Any) -> World:
    """The world that `coloc simulate NAME --seed SEED` writes, at depth tracks."""
    shape = {key: options.pop(key) for key in ("stances", "l", "theta_deg") if key in options}
    what = scenario(name, rng=stream(seed, "formation"), **{"stances": None, "l": None, "theta_deg": None} | shape)
    return build_world(what, depth="tracks", seed=seed, points=points, **options)


def solved(world: World, options: SolveOptions) -> tuple[Solution, Accuracy]:
    """A world solved and compared with its truth."""
    solution = solve(MemoryRun(world), options)
    return solution, compared(world, solution.estimate.trajectories)


def compared(world: World, trajectories: Mapping[str, Trajectory]) -> Accuracy:
    """Trajectories compared with the truth of their world."""
    on_floor = world.team.floor is not None
    true = align(trajectories, truth_of(world), world.team.reference, on_floor=on_floor)
    return evaluate(trajectories, true, on_floor=on_floor)


def over_seeds(work: Callable[[int], T], seeds: Sequence[int], processes: int = 2) -> list[T]:
    """`work` of each seed, in the order of the seeds, on several processes; of one seed in this process."""
    if len(seeds) == 1:
        return [work(seeds[0])]
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        return list(pool.map(work, seeds))


def rms_interval(errors: Sequence[float], confidence: float = 0.95) -> tuple[float, float, float]:
    """RMS of zero-mean errors and its confidence interval."""
    n, square = len(errors), float(np.square(errors).mean())
    low, high = chi2.ppf([(1 - confidence) / 2, (1 + confidence) / 2], n)
    return np.sqrt(square), np.sqrt(n * square / high), np.sqrt(n * square / low)


def anees_interval(poses: int, dimensions: int, confidence: float = 0.95) -> tuple[float, float]:
    """Interval of the mean NEES per degree of freedom of independent poses if covariances are right."""
    dof = poses * dimensions
    low, high = chi2.ppf([(1 - confidence) / 2, (1 + confidence) / 2], dof)
    return low / dof, high / dof
