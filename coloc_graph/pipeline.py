"""The whole road from a run to an estimate; reads like sections III and IV of the paper."""

import itertools
import math
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import get_args

from scipy.special import chdtrc

from coloc_graph.backend import Estimate, Loose, Method, PoseGraph, chain, diagnose, joint, loosened, replay, smooth
from coloc_graph.errors import EstimationError, InputError
from coloc_graph.frontend import (
    FrontendOptions,
    PairMeasurement,
    Scale,
    WheelTrack,
    measure_pair,
    share_clock_offsets,
    sight_movers,
)
from coloc_graph.frontend.plausibility import implausible
from coloc_graph.measurements import Measurement, RelativePose
from coloc_graph.run import Run

METHODS: tuple[Method, ...] = get_args(Method)

BATCH = {"chain": chain, "smooth": smooth, "joint": joint}

#: Where the scale comes from the markers' span alone, the heights of cameras are known no better than this [m].
UNKNOWN_HEIGHT = 0.1
#: Measurements that noise alone lets disagree less often than this are warned of.
LEAST_CHANCE = 1e-4
#: So many kinds of reasons are named where every measurement is refused.
REASONS_NAMED = 3

#: Called with how many measurements are done, and of how many.
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SolveOptions:
    """Everything that a result depends on besides the run.

    `chain` is the paper: homographies by least squares in one image, eq. (2), composition. `smooth` takes
    maximum-likelihood homographies and relative poses into a pose graph, with `odometry` and where the movers are
    seen. `joint` takes the homographies themselves, and calibrates mounts, markers and clocks along with the poses.
    `incremental` feeds the graph to an estimator stance by stance, as a team in the field would.
    """

    method: Method = "joint"
    frontend: FrontendOptions | None = None
    odometry: bool = True
    incremental: bool = False

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise InputError(f"there is no method `{self.method}`; choose one of {', '.join(METHODS)}")
        if self.incremental and self.method == "chain":
            raise InputError("a chain is composed, and never incremental: leave out `incremental`, or use joint")

    def resolved(self) -> "SolveOptions":
        """With the front end that belongs to the method, where none is chosen."""
        if self.frontend is not None:
            return self
        paper = FrontendOptions(criterion="transfer", pose="eq2")
        return replace(self, frontend=paper if self.method == "chain" else FrontendOptions())


@dataclass(frozen=True, eq=False, repr=False)
class Solution:
    """A result: the estimate, every measurement it was made of or that was refused, and how long it took [s].

    `seconds_updates` are of each stance of an incremental estimate, () of one in batch.
    """

    run: Run
    options: SolveOptions
    estimate: Estimate
    measurements: tuple[PairMeasurement, ...]
    warnings: tuple[str, ...]
    seconds_frontend: float
    seconds_backend: float
    seconds_updates: tuple[float, ...] = ()

    def why_not(self, measured: PairMeasurement) -> str | None:
        """Why a measurement is not in the estimate, in words; None where it is."""
        if measured.homography.unusable is not None:
            return measured.homography.unusable
        return next((r.reason for r in self.estimate.refused if r.measurement is measured.relative_pose), None)

    @property
    def used(self) -> int:
        """How many of the measurements are in the estimate."""
        return sum(self.why_not(measured) is None for measured in self.measurements)

    def __repr__(self) -> str:
        return (
            f"Solution({self.run!r}, {self.options.method}, {self.used} of {len(self.measurements)} measurements used, "
            f"{len(self.warnings)} warnings)"
        )


def solve(run: Run, options: SolveOptions | None = None, progress: Progress | None = None) -> Solution:
    """Localise a team: measure every pair of observers in every stance, and make an estimate of it all.

    Raises `InputError` where the run holds nothing to solve and `EstimationError` where no measurement ties
    any robot to the reference; what is merely left out is said in `Solution.warnings`.
    """
    options = (options or SolveOptions()).resolved()
    _require_observers(run)
    started = time.perf_counter()

    measurements, clock_warnings = share_clock_offsets(_measure(run, options, progress), run.team.clock_sigma)
    poses = [m.relative_pose for m in measurements if m.relative_pose is not None]
    if not poses:
        unlikely = [f"; {what}" for what in _implausible(run, options, measurements)][:1]
        raise EstimationError(
            f"{run.path}: no stance gives a relative pose; {_reasons(measurements)}{''.join(unlikely)}"
        )
    measured = time.perf_counter()

    graph = PoseGraph.of(run.team, run.stances, [*poses, *_motions(run, options, measurements, poses)])
    loose = diagnose(graph)
    if not any(
        robot != run.team.reference for robot, _ in set(graph.nodes) - {n for part in loose for n in part.nodes}
    ):
        raise EstimationError(
            f"{run.path}: no measurement ties a robot to the reference {run.team.reference}; "
            f"{_why_untied(loose, measurements)}"
        )
    assert options.frontend is not None
    if options.method == "joint" and options.frontend.scale == "span":
        graph = replace(graph, rigs=loosened(graph.rigs, UNKNOWN_HEIGHT))
    updates: tuple[float, ...] = ()
    if options.incremental:
        estimate, updates = replay(graph, options.method)
        if estimate.refused:  # or was it that an anchor was pushed? An estimator looks at one stance at a time
            estimate = replace(estimate, bumped=BATCH[options.method](graph).bumped)
    else:
        estimate = BATCH[options.method](graph)
    solved = time.perf_counter()
    return Solution(
        run=run,
        options=options,
        estimate=estimate,
        measurements=measurements,
        warnings=(
            *run.warnings,
            *clock_warnings,
            *_implausible(run, options, measurements),
            *_warnings(estimate, loose, measurements),
        ),
        seconds_frontend=measured - started,
        seconds_backend=solved - measured,
        seconds_updates=updates,
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
    # a joint estimate takes the scale from the spans by itself, and the heights for a start
    scale: Scale = "heights" if options.method == "joint" else options.frontend.scale
    frontend = replace(options.frontend, scale=scale)
    pairs = [(stance, *pair) for stance in run.stances for pair in itertools.combinations(stance.observers, 2)]
    measurements = []
    for done, (stance, robot_i, robot_j) in enumerate(pairs, start=1):
        measurements.append(measure_pair(run, stance, robot_i, robot_j, frontend))
        if progress is not None:
            progress(done, len(pairs))
    return tuple(measurements)


def _motions(
    run: Run, options: SolveOptions, measurements: Sequence[PairMeasurement], poses: Sequence[RelativePose]
) -> list[Measurement]:
    """Where the movers were seen, and what the wheels say of each robot's way from one pose to its next."""
    if options.method == "chain" or run.team.floor is None:
        return []  # the paper's chain takes neither, and wheels know the floor alone
    wheels = {robot: WheelTrack(robot, list(run.odometry(robot))) for robot in run.team.names}
    sightings = sight_movers(run, measurements, wheels)
    if not options.odometry:
        return list(sightings)
    graph = PoseGraph.of(run.team, run.stances, [*poses, *sightings])
    ways: list[Measurement] = []
    last: dict[str, int] = {}
    for robot, stance in graph.nodes:
        before = last.get(robot)
        last[robot] = stance
        if before is not None and graph.key(robot, before) != graph.key(robot, stance):
            start, end = graph.times[robot, before], graph.times[robot, stance]
            way = wheels[robot].between(before, stance, start, end, run.team.clock_sigma)
            ways += [] if way is None else [way]
    return [*sightings, *ways]


def _reasons(measurements: Sequence[PairMeasurement]) -> str:
    """Why all measurements were refused: one of each kind of reason with how many there are, most frequent first."""
    kinds: dict[str, list[str]] = {}
    for measured in measurements:
        h = measured.homography
        kinds.setdefault(_kind(h.unusable or "", h.robot_i, h.robot_j), []).append(
            f"at stance {h.stance}, {h.robot_i} and {h.robot_j}: {h.unusable}"
        )
    by_count = sorted(kinds.values(), key=lambda kind: -len(kind))
    total = len(measurements)
    named = [
        kind[0] + (f" (the same in {len(kind)} of {total} measurements)" if total > 1 else "")
        for kind in by_count[:REASONS_NAMED]
    ]
    more = sum(map(len, by_count[REASONS_NAMED:]))
    return "; ".join([*named, f"and {more} more for other reasons"] if more else named)


def _kind(reason: str, *robots: str) -> str:
    """A reason without the numbers and names that differ from stance to stance."""
    for robot in robots:
        reason = re.sub(rf"\b{re.escape(robot)}\b", "?", reason)
    reason = re.sub(r"`[^`]*`(, `[^`]*`)*", "?", reason)
    return re.sub(r"\d+(\.\d+)?(e[+-]?\d+)?", "?", reason)


def _implausible(run: Run, options: SolveOptions, measurements: Sequence[PairMeasurement]) -> Iterator[str]:
    """Where the stated plane contradicts the markers that were seen; the first of each observer, and how many."""
    assert options.frontend is not None
    if options.frontend.scale == "span":
        return  # the stated distance is not used
    stances = {stance.index: stance for stance in run.stances}
    found: dict[str, list[tuple[int, str]]] = {}
    for measured in measurements:
        if measured.correspondences is not None:
            robot, stance = measured.homography.robot_i, stances[measured.homography.stance]
            what = implausible(run, stance, robot, measured.correspondences)
            if what is not None and stance.index not in [index for index, _ in found.get(robot, [])]:
                found.setdefault(robot, []).append((stance.index, what))
    for each in found.values():
        others = len(each) - 1
        yield f"stance {each[0][0]}{f' (and {others} more alike)' if others else ''}: {each[0][1]}"


def _why_untied(loose: tuple[Loose, ...], measurements: tuple[PairMeasurement, ...]) -> str:
    refused = [m.homography for m in measurements if m.homography.unusable]
    if refused:
        return f"stance {refused[0].stance}, {refused[0].robot_i} and {refused[0].robot_j}: {refused[0].unusable}"
    return str(loose[0])


def _warnings(estimate: Estimate, loose: Sequence[Loose], measurements: Sequence[PairMeasurement]) -> list[str]:
    warnings = [
        f"stance {m.homography.stance}: {m.homography.robot_i} and {m.homography.robot_j} not used: "
        f"{m.homography.unusable}"
        for m in measurements
        if m.homography.unusable
    ]
    warnings += [f"{part} (left out of the result)" for part in loose[:REASONS_NAMED]]
    if len(loose) > REASONS_NAMED:
        warnings.append(f"{len(loose) - REASONS_NAMED} more groups of poses are not tied to the reference")
    warnings += [f"the {one.measurement} is not used: it is {one.reason}" for one in estimate.refused]
    warnings += [str(bump) for bump in estimate.bumped]
    warnings += [
        f"{row} is {row.sigmas:.1f} sigmas off what the team says: measure it again, or state it so"
        for row in estimate.calibration.far
    ]
    chance = float(chdtrc(estimate.dof, estimate.chi2)) if estimate.dof > 0 else 1.0
    if chance < LEAST_CHANCE:
        warnings.append(
            f"the measurements disagree (chi2/dof {estimate.chi2 / estimate.dof:.1f} with {estimate.dof} degrees of "
            f"freedom, expected 1; noise alone does that {_once_in(chance)}): a robot moved that is called an anchor, "
            "or mounts, heights, the floor or the noise are not as stated"
        )
    return warnings


def _once_in(chance: float) -> str:
    """A small probability in words."""
    if chance < 1e-9:
        return "less than once in 1 000 000 000 runs"
    return f"about once in {10 ** round(-math.log10(chance)):,} runs".replace(",", " ")
