"""The whole road from a run to an estimate; reads like sections III and IV of the paper."""

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, get_args

from coloc_graph.backend import Estimate, PoseGraph, chain, smooth
from coloc_graph.errors import EstimationError, InputError
from coloc_graph.frontend import FrontendOptions, PairMeasurement, measure_pair, share_clock_offsets
from coloc_graph.run import Run

Method = Literal["chain", "smooth"]
METHODS: tuple[Method, ...] = get_args(Method)

#: Called with how many measurements are done, and of how many.
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SolveOptions:
    """Everything that a result depends on besides the run.

    `chain` is the paper: homographies by least squares in one image, eq. (2), composition. `smooth` takes
    maximum-likelihood homographies and relative poses into a pose graph.
    """

    method: Method = "smooth"
    frontend: FrontendOptions | None = None

    def resolved(self) -> "SolveOptions":
        """With the front end that belongs to the method, where none is chosen."""
        if self.frontend is not None:
            return self
        paper = FrontendOptions(criterion="transfer", pose="eq2")
        return replace(self, frontend=paper if self.method == "chain" else FrontendOptions())


@dataclass(frozen=True, eq=False)
class Solution:
    """A result: the estimate, every measurement it was made of or that was refused, and how long it took [s]."""

    run: Run
    options: SolveOptions
    estimate: Estimate
    measurements: tuple[PairMeasurement, ...]
    warnings: tuple[str, ...]
    seconds_frontend: float
    seconds_backend: float


def solve(run: Run, options: SolveOptions | None = None, progress: Progress | None = None) -> Solution:
    """Localise a team: measure every pair of observers in every stance, and make an estimate of it all.

    Raises `InputError` where the run holds nothing to solve and `EstimationError` where no measurement ties
    any robot to the reference; what is merely left out is said in `Solution.warnings`.
    """
    options = (options or SolveOptions()).resolved()
    if options.method not in METHODS:
        raise InputError(f"there is no method `{options.method}`; choose one of {', '.join(METHODS)}")
    _require_observers(run)
    started = time.perf_counter()

    measurements, clock_warnings = share_clock_offsets(_measure(run, options, progress), run.team.clock_sigma)
    poses = tuple(m.relative_pose for m in measurements if m.relative_pose is not None)
    if not poses:
        first = measurements[0].homography
        raise EstimationError(
            f"{run.path}: no stance gives a relative pose; at stance {first.stance}, {first.robot_i} and "
            f"{first.robot_j}: {first.unusable}"
        )
    measured = time.perf_counter()

    graph = PoseGraph(run.team.reference, run.team.names, run.stances, poses, run.team.floor)
    estimate = chain(graph) if options.method == "chain" else smooth(graph)
    solved = time.perf_counter()
    if all(len(trajectory) == 0 or robot == run.team.reference for robot, trajectory in estimate.trajectories.items()):
        raise EstimationError(
            f"{run.path}: no measurement ties a robot to the reference {run.team.reference}; "
            f"{_why_untied(estimate, measurements)}"
        )
    return Solution(
        run=run,
        options=options,
        estimate=estimate,
        measurements=measurements,
        warnings=(*run.warnings, *clock_warnings, *_warnings(estimate, measurements)),
        seconds_frontend=measured - started,
        seconds_backend=solved - measured,
    )


def _require_observers(run: Run) -> None:
    if not run.stances:
        raise InputError(f"{run.path}: the run holds no stance, so that there is nothing to solve; record one first")
    if not any(len(stance.observers) >= 2 for stance in run.stances):
        raise InputError(
            f"{run.path}: stance {run.stances[0].index} has one observer only, as has every other; "
            "at least two robots must stand and watch the same mover"
        )


def _measure(run: Run, options: SolveOptions, progress: Progress | None) -> tuple[PairMeasurement, ...]:
    assert options.frontend is not None
    pairs = [(stance, *pair) for stance in run.stances for pair in itertools.combinations(stance.observers, 2)]
    measurements = []
    for done, (stance, robot_i, robot_j) in enumerate(pairs, start=1):
        measurements.append(measure_pair(run, stance, robot_i, robot_j, options.frontend))
        if progress is not None:
            progress(done, len(pairs))
    return tuple(measurements)


def _why_untied(estimate: Estimate, measurements: tuple[PairMeasurement, ...]) -> str:
    refused = [m.homography for m in measurements if m.homography.unusable]
    if refused:
        return f"stance {refused[0].stance}, {refused[0].robot_i} and {refused[0].robot_j}: {refused[0].unusable}"
    robot, stance = estimate.untied[0]
    return f"robot {robot} at stance {stance} shares no measurement with a robot whose pose is known"


def _warnings(estimate: Estimate, measurements: tuple[PairMeasurement, ...]) -> list[str]:
    warnings = [
        f"stance {m.homography.stance}: {m.homography.robot_i} and {m.homography.robot_j} not used: "
        f"{m.homography.unusable}"
        for m in measurements
        if m.homography.unusable
    ]
    if estimate.untied:
        robot, stance = estimate.untied[0]
        warnings.append(
            f"{len(estimate.untied)} poses are not tied to the reference, from robot {robot} at stance {stance} on, "
            "and are left out: a measurement there, or an anchor that stays, would tie them"
        )
    if estimate.dof > 0 and estimate.chi2 > 3 * estimate.dof:
        warnings.append(
            f"the measurements disagree (chi2/dof {estimate.chi2 / estimate.dof:.1f}, expected 1): "
            "a robot moved that is called an anchor, or mounts, heights or the floor are not as stated"
        )
    return warnings
