"""Multi-step runs for Tables I and II, simulated and solved as in the paper and by our estimate."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend import Method
from coloc_graph.errors import EstimationError
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.results.writer import assess
from coloc_graph.run import open_run
from coloc_graph.simulation import simulate
from coloc_graph.simulation.world import Depth

Array = NDArray[np.float64]

#: Eq. (2) and composition, as the paper; maximum likelihood and the pose graph, ours.
SOLVED_BY: dict[str, Method] = {"eq2": "chain", "ours": "smooth"}


@dataclass(frozen=True, eq=False)
class Course:
    """One robot's places on the floor (stances, 2) [m], in the world of its team: true, and by each method."""

    robot: str
    true: Array
    eq2: Array
    ours: Array

    def length(self, places: Array) -> float:
        """Straight from the first to the last of places (n, 2) [m]: the length of Table II."""
        return float(np.linalg.norm(places[-1] - places[0]))

    def error_cm(self, places: Array) -> float:
        """Size of a length's error [cm]."""
        return 100 * abs(self.length(places) - self.length(self.true))

    def rate_percent(self, places: Array) -> float:
        """Size of a length's error [% of the true length]; NaN for a robot that did not get anywhere."""
        true = self.length(self.true)
        return self.error_cm(places) / true if true > 0.05 else float("nan")

    def end_error_cm(self, places: Array) -> float:
        """Distance of the last position from the true one [cm]."""
        return float(100 * np.linalg.norm(places[-1] - self.true[-1]))


@dataclass(frozen=True, eq=False)
class Outing:
    """A run of a seed: the observers' courses by robot. In stance k, robot `pair[k % 2]` is the anchor."""

    seed: int
    pair: tuple[str, str]
    courses: Mapping[str, Course]

    def standing(self, method: str) -> Array:
        """The places (stances + 1, 2) [m] where robots stood, in order (a, b, c, ...): `true`, `eq2`, `ours`."""
        stances = len(self.courses[self.pair[0]].true)
        # the robot at place k comes to it before stance k-1, and is still there in stance k
        return np.array([getattr(self.courses[self.pair[k % 2]], method)[max(k - 1, 0)] for k in range(stances + 1)])


def measure_outing(seed: int, scenario: str, depth: Depth, stances: int | None) -> Outing:
    """Simulate a scenario and solve it by both methods.

    Raises `EstimationError` if a method does not estimate all poses, since the two could then not be compared.
    """
    with TemporaryDirectory(prefix="coloc-") as folder:
        path = Path(folder) / "run.mcap"
        world = simulate(scenario, path, depth=depth, seed=seed, stances=stances)
        run = open_run(path)
        places: dict[str, dict[str, Array]] = {robot: {} for robot in world.scenario.pair}
        for name, method in SOLVED_BY.items():
            # without odometry: both see the same pixels, and nothing else
            solution = solve(run, SolveOptions(method=method, odometry=False))
            if solution.estimate.disconnected:
                raise EstimationError(f"{scenario}, seed {seed}: {solution.warnings[0]}")
            assessed = assess(solution)
            assert assessed is not None  # a simulated run holds truth
            for robot in places:
                places[robot][name] = solution.estimate.trajectories[robot].positions[:, :2]
                places[robot]["true"] = assessed[1][robot][:, :2, 3]
    courses = {robot: Course(robot, one["true"], one["eq2"], one["ours"]) for robot, one in places.items()}
    return Outing(seed, world.scenario.pair, courses)
