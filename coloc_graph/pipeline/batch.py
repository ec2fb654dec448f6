"""The whole road from a run to an estimate; reads like sections III and IV of the paper."""

import math
import re
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from scipy.special import chdtrc

from coloc_graph.backend import DisconnectedComponent, Estimate, PoseGraph, chain, diagnose, joint, smooth
from coloc_graph.errors import EstimationError, InputError
from coloc_graph.frontend import Doubt, PairMeasurement, in_words, little_in_common, share_clock_offsets
from coloc_graph.frontend.pairing.plane_check import implausible
from coloc_graph.pipeline.contents import require_applicable, unused_in
from coloc_graph.pipeline.incremental import (
    METHODS,
    EnteredStance,
    OdometryAndSightings,
    SolveOptions,
    StanceSolver,
    measure_stance,
)
from coloc_graph.run import Run, Stance

__all__ = ["METHODS", "EnteredStance", "Progress", "Solution", "SolveOptions", "StanceSolver", "solve"]

BATCH = {"chain": chain, "smooth": smooth, "joint": joint}

#: Measurements that noise alone lets disagree less often than this are warned of.
LEAST_CHANCE = 1e-4
#: So many kinds of reasons are named where every measurement is refused.
REASONS_NAMED = 3

#: Called with how many stances are measured, and of how many.
Progress = Callable[[int, int], None]


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


@dataclass(frozen=True, eq=False)
class _Solved:
    """What comes of all stances of a run; seconds are of the front end, and of each stance's update."""

    estimate: Estimate
    measured: tuple[PairMeasurement, ...]
    clock_warnings: list[str]
    seconds_frontend: float
    seconds_updates: tuple[float, ...] = ()
    doubts: Sequence[Doubt] = ()


def solve(
    run: Run,
    options: SolveOptions | None = None,
    progress: Progress | None = None,
    entered: Callable[[EnteredStance], None] | None = None,
) -> Solution:
    """Localise a team: measure every pair of observers in every stance, and make an estimate of it all.

    `entered` hears of each stance of an incremental estimate as soon as it is in. Raises `InputError` where the run
    holds nothing to solve and `EstimationError` where no measurement ties any robot to the reference; what is merely
    left out is said in `Solution.warnings`.
    """
    options = options or SolveOptions()
    if require_applicable(run, options) == "ranges":
        raise InputError(f"{run.path} is solved by its ranges: call coloc_graph.pipeline.ranging.solve_drive")
    options = options.resolved()
    started = time.perf_counter()
    counted = _Counted(run, options, progress)
    solved = _incrementally(run, options, counted, entered) if options.incremental else _at_once(run, options, counted)
    estimate, measured = solved.estimate, solved.measured
    return Solution(
        run=run,
        options=options,
        estimate=estimate,
        measurements=measured,
        warnings=(
            *run.warnings,
            *(str(one) for one in unused_in(run, options) if not one.asked),
            *solved.clock_warnings,
            *in_words(solved.doubts),
            *_implausible(run, options, measured),
            *_warnings(estimate, diagnose(estimate.graph), measured),
        ),
        seconds_frontend=solved.seconds_frontend,
        seconds_backend=time.perf_counter() - started - solved.seconds_frontend,
        seconds_updates=solved.seconds_updates,
    )


def _at_once(run: Run, options: SolveOptions, measure: "_Counted") -> _Solved:
    started = time.perf_counter()
    alone = [one for stance in run.stances for one in measure(stance)]
    measured, clock_warnings = share_clock_offsets(alone, run.team.clock_sigma)
    poses = [m.relative_pose for m in measured if m.relative_pose is not None]
    _require_poses(run, options, measured)
    made = time.perf_counter()
    motions, sources = [], OdometryAndSightings(run.team, odometry=options.odometry)
    if options.method != "chain" and run.team.floor is not None:
        # the paper's chain takes neither, and wheels know the floor alone
        for stance in run.stances:
            pairs = [m for m in measured if m.homography.stance == stance.index]
            motions += sources.of_stance(run, stance, pairs)
    graph = PoseGraph.of(run.team, run.stances, [*poses, *motions])
    graph = replace(graph, rigs=options.rigs(run.team) or graph.rigs)
    _require_ties(run, graph, measured)
    assert options.method is not None  # resolved
    return _Solved(BATCH[options.method](graph), measured, clock_warnings, made - started, doubts=sources.doubts)


def _incrementally(
    run: Run, options: SolveOptions, measure: "_Counted", entered: Callable[[EnteredStance], None] | None
) -> _Solved:
    solver = StanceSolver(run.team, options)
    for stance in run.stances:
        one = solver.enter(run, stance, solver.measure(run, stance, measure(stance)))
        if entered is not None:
            entered(one)
    _require_poses(run, options, solver.measured)
    graph = solver.estimator.graph
    _require_ties(run, graph, solver.measured)
    estimate = solver.estimator.estimate()
    # what was refused, was it that an anchor was pushed? An estimator looks at one stance at a time
    estimate = replace(estimate, bumped=solver.estimator.bumps())
    frontend, updates = zip(*solver.seconds, strict=True)
    return _Solved(estimate, solver.measured, solver.warnings, sum(frontend), updates, solver.doubts)


class _Counted:
    """Measures stances, and says how many are done."""

    def __init__(self, run: Run, options: SolveOptions, progress: Progress | None) -> None:
        self._run, self._options, self._progress = run, options, progress
        self._done = 0

    def __call__(self, stance: Stance) -> Iterator[PairMeasurement]:
        yield from measure_stance(self._run, stance, self._options)
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, len(self._run.stances))


def _require_poses(run: Run, options: SolveOptions, measured: Sequence[PairMeasurement]) -> None:
    if not any(m.relative_pose is not None for m in measured):
        unlikely = [f"; {what}" for what in _implausible(run, options, measured)][:1]
        raise EstimationError(f"{run.path}: no stance gives a relative pose; {_reasons(measured)}{''.join(unlikely)}")


def _require_ties(run: Run, graph: PoseGraph, measured: Sequence[PairMeasurement]) -> None:
    loose = diagnose(graph)
    tied = set(graph.nodes) - {node for part in loose for node in part.nodes}
    if not any(robot != run.team.reference for robot, _ in tied):
        raise EstimationError(
            f"{run.path}: no measurement ties a robot to the reference {run.team.reference}; "
            f"{_why_untied(loose, measured)}"
        )


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
    if options.by_span:
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


def _why_untied(loose: tuple[DisconnectedComponent, ...], measurements: Iterable[PairMeasurement]) -> str:
    refused = [m.homography for m in measurements if m.homography.unusable]
    if refused:
        return f"stance {refused[0].stance}, {refused[0].robot_i} and {refused[0].robot_j}: {refused[0].unusable}"
    return str(loose[0])


def _warnings(
    estimate: Estimate, loose: Sequence[DisconnectedComponent], measurements: Sequence[PairMeasurement]
) -> list[str]:
    stances = estimate.graph.by_index
    warnings = [
        f"stance {m.homography.stance}: {m.homography.robot_i} and {m.homography.robot_j} not used: "
        f"{m.homography.unusable}"
        for m in measurements
        if m.homography.unusable and not little_in_common(m.homography, stances[m.homography.stance])
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
