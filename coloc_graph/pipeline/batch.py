"""From a run to an estimate, whatever the run holds: `solve`. Stances as in sections III and IV of the paper."""

import contextlib
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from coloc_graph.backend import Estimate, Estimator, KeyframeGraph, PoseGraph, chain, diagnose, joint, smooth
from coloc_graph.backend.planar import LAG, UPDATE_PERIOD, Latest
from coloc_graph.errors import EstimationError
from coloc_graph.frontend import PairMeasurement, UnusedSighting, describe_unused, share_clock_offsets
from coloc_graph.frontend.keyframes import keyframes_of
from coloc_graph.frontend.learnt_noise import NoiseBelief, measured_again
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.pipeline.clocks import (
    RunClocks,
    clocks_instead,
    clocks_of_images_apart,
    clocks_of_run,
    contradicts,
    misfit,
    suspicious,
    unknown_clocks,
)
from coloc_graph.pipeline.contents import Unused, repeated_in, require_applicable, unused_in, unused_ranges
from coloc_graph.pipeline.explanations import (
    implausible_planes,
    reasons,
    warnings_of_graph,
    warnings_of_ranges,
    why_disconnected,
    without_poses,
)
from coloc_graph.pipeline.incremental import (
    EnteredStance,
    IncrementalSolver,
    OdometryAndSightings,
    measure_stance,
)
from coloc_graph.pipeline.lever_arm import LeverArm, find_lever_arms, with_lever_arms
from coloc_graph.pipeline.moves import infer_moves, moves_unstated
from coloc_graph.pipeline.odometry_checks import CheckedRun
from coloc_graph.pipeline.options import METHODS, SolveOptions
from coloc_graph.pipeline.ranges import ranges_of_run, with_outside
from coloc_graph.pipeline.shared_errors import learn_shared_errors
from coloc_graph.pipeline.solution import Solution
from coloc_graph.run import Run, Stance
from coloc_graph.run.recorded import Restated
from coloc_graph.team import Team

__all__ = ["METHODS", "EnteredStance", "IncrementalSolver", "Progress", "Solution", "SolveOptions", "solve"]

log = logging.getLogger(__name__)

NOISE_ROUNDS = 2  # of learning the noise and measuring again: which points are inliers depends on it
FEW_STANCES = 4  # stances below which an offset of clocks may pass for another fault
MAX_MISFIT = 2.0  # misfit of an estimate from which on clocks are doubted in any case

BATCH = {"chain": chain, "smooth": smooth, "joint": joint}

#: Called with the number done and the total: of measured stances, or of seconds of a ranging run.
Progress = Callable[[int, int], None]

#: Called with each update of an incremental estimate: a stance, or the newest poses of a ranging run.
OnUpdate = Callable[[EnteredStance | Latest], None]


@dataclass(frozen=True, eq=False)
class _Solved:
    """An estimate, its measurements and warnings, and the durations of the front end and of each update [s]."""

    estimate: Estimate
    warnings: Sequence[str]
    seconds_frontend: float
    measured: tuple[PairMeasurement, ...] = ()
    seconds_updates: tuple[float, ...] = ()
    online: Mapping[str, Trajectory] = field(default_factory=dict)
    without_pose: Mapping[str, str] = field(default_factory=dict)
    noise: NoiseBelief | None = None
    unused: tuple[Unused, ...] = ()


def solve(
    run: Run,
    options: SolveOptions | None = None,
    progress: Progress | None = None,
    on_update: OnUpdate | None = None,
) -> Solution:
    """Localise a team.

    Where at least two robots observe in a stance, the run is solved by its stances: every pair of observers is
    measured, and the world is the reference robot's body at its first stance. Otherwise it is solved by ranges,
    bearings and wheel odometry: the world is the map of the landmarks where the team states it, else the first robot's
    first pose.

    Parameters
    ----------
    run : Run
        The recording, by `open_run`.
    options : SolveOptions, optional
        Defaults depend on what the run holds.
    progress : callable, optional
        Called with the number of stances (or seconds) done and the total.
    on_update : callable, optional
        Called with each update of an incremental estimate: `EnteredStance`, or `Latest` of a ranging run.

    Returns
    -------
    Solution
        The estimate with its measurements. `warnings` and `unused` name recorded data that was left out.

    Raises
    ------
    InputError
        The run holds nothing to solve, or an option does not apply to it.
    EstimationError
        No measurement ties any robot to the world frame.
    """
    options, recorded = options or SolveOptions(), run
    kind = require_applicable(run, options)
    unused = unused_in(run, options)
    if options.odometry:
        run = CheckedRun(run)  # type: ignore[assignment]
    started = time.perf_counter()
    if kind == "ranges":
        solved = _by_ranges(run, options, progress, on_update)
    else:
        options = options.resolved()
        measure = _Counted(run, options, progress)
        solved = (
            _by_stance(run, options, measure, on_update)
            if options.incremental
            else _or_by_clocks(run, options, measure, _in_batch(run, options, measure))
        )
    unused = (*unused, *repeated_in(recorded), *solved.unused)
    return Solution(
        run=recorded,
        options=options,
        estimate=solved.estimate,
        measurements=solved.measured,
        warnings=(
            *run.warnings,
            *(str(one) for one in unused if not one.requested),
            *solved.warnings,
            *(
                f"robot {robot} has no pose: {why}"
                for robot, why in solved.without_pose.items()
                if options.method != "chain" and not any(why in one for one in solved.warnings)
            ),
        ),
        seconds_frontend=solved.seconds_frontend,
        seconds_backend=time.perf_counter() - started - solved.seconds_frontend,
        seconds_updates=solved.seconds_updates,
        unused=unused,
        online=solved.online,
        without_pose=solved.without_pose,
        noise=solved.noise,
    )


def _in_batch(
    run: Run,
    options: SolveOptions,
    measure: "_Counted",
    clocks: RunClocks | None = None,
    before: float = 0.0,
    *,
    doubt_clocks: bool = True,
) -> _Solved:
    """Solve all stances together, and again with corrected stamps if `clocks` turn out to be wrong.

    `before` are the seconds that were spent on measurements before. Clocks that are corrected already, or which
    `doubt_clocks` leaves alone, are not looked for.
    """
    doubt_clocks = doubt_clocks and clocks is None
    started = time.perf_counter() - before
    belief = NoiseBelief.of(run.team)
    alone = [one for stance in run.stances for one in measure(stance, belief.used(run.team))]
    measured, clock_warnings = share_clock_offsets(alone, run.team.clock_sigma)
    if doubt_clocks and (found := clocks_of_run(run, measured)) is not None:
        doubted = next(suspicious(measured), None) is not None
        return _best_explained(run, options, measure, found, time.perf_counter() - started, doubted=doubted)
    if doubt_clocks and not run.team.clock_sigma and not _usable(measured):
        apart = clocks_of_images_apart(measured)
        if apart is not None:
            looser = apart.corrected(run)
            with contextlib.suppress(EstimationError):  # what is wrong with the run as it is says more
                return _in_batch(looser, options, measure.of(looser), apart, time.perf_counter() - started)
    noise = belief
    for _ in range(NOISE_ROUNDS):
        last, noise = noise, belief.updated(measured)
        if last is not belief and not noise.differs_from(last):
            break
        measured = measured_again(measured, noise.used(run.team))
    log.info("%d stances measured: %d of %d pairs usable", len(run.stances), _usable(measured), len(measured))
    _require_poses(run, options, measured)
    moves = infer_moves(run.stances, measured) if moves_unstated(run) else None
    if moves is not None:
        run = moves.applied(run)
    made = time.perf_counter()
    graph, sources = _graph_of(run, options, measured, noise.used(run.team))
    _require_ties(run, graph, measured)
    assert options.method is not None  # resolved
    estimate = BATCH[options.method](graph)
    if doubt_clocks and contradicts(estimate):
        found = clocks_of_run(run, measured, any_pair=True)
        if found is not None:
            return _best_explained(run, options, measure, found, made - started, doubted=True)
    arms = dict[str, LeverArm]()
    if options.method != "chain":
        arms, estimate = find_lever_arms(estimate, BATCH[options.method])
    if options.method == "joint":

        def again(noisier: NoiseBelief, measured: Sequence[PairMeasurement], start: Estimate) -> Estimate:
            graph, _ = _graph_of(run, options, measured, noisier.used(run.team))
            _require_ties(run, graph, measured)
            return joint(with_lever_arms(graph, arms), start=start.values)

        estimate, noise, measured = learn_shared_errors(estimate, noise, measured, run.team, again)
    estimate, left_out = _with_ranges(run, options, estimate)
    measured = tuple(replace(one, with_team=None) for one in measured)
    log.info("%s: chi2/dof %.6g/%d, %d rejected", options.method, estimate.chi2, estimate.dof, len(estimate.rejected))
    said = [*(clocks.sentences() if clocks else ()), *clock_warnings, *map(str, arms.values())]
    said += [moves.sentence()] if moves else []
    warnings = _warnings(run, options, estimate, measured, said, sources.unused)
    missing = without_poses(run, options, estimate, measured, sources.unused)
    return _Solved(estimate, warnings, made - started, measured, without_pose=missing, noise=noise, unused=left_out)


def _with_ranges(run: Run, options: SolveOptions, estimate: Estimate) -> tuple[Estimate, tuple[Unused, ...]]:
    """Return the joint estimate of stances and ranges, starting from the stances, and the ranges not in it."""
    if options.method != "joint" or not run.has_ranges:
        return estimate, ()
    found = ranges_of_run(run, estimate, odometry=options.odometry)
    if found.ranges:
        graph = replace(estimate.graph, measurements=(*estimate.graph.measurements, *found.ranges))
        both = joint(graph, start=estimate.values)
        estimate = replace(both, bumped=(*estimate.bumped, *both.bumped))
    return estimate, unused_ranges(found)


def _usable(measured: Sequence[PairMeasurement]) -> int:
    """Number of pairs that have a relative pose."""
    return sum(one.relative_pose is not None for one in measured)


def _best_explained(
    run: Run, options: SolveOptions, measure: "_Counted", clocks: RunClocks, before: float, *, doubted: bool
) -> _Solved:
    """Solve with corrected stamps, and with those of the run, too; keep the better fit.

    Where the run's own were `doubted`, corrected ones that fit are kept without that. Elsewhere pairs of cameras agree
    on what they saw, wheels that slip look like another clock, and a correction has to gain its price.
    """
    right = clocks.corrected(run)
    try:
        corrected = _in_batch(right, options, measure.of(right), clocks, before)
    except EstimationError:
        return _in_batch(run, options, measure, before=before, doubt_clocks=False)
    if doubted and not contradicts(corrected.estimate):
        return corrected
    try:
        plain = _in_batch(run, options, measure, before=before, doubt_clocks=False)
    except EstimationError:
        return corrected
    price = 0.0 if doubted else clocks.price / max(corrected.estimate.dof, 1)
    return corrected if misfit(corrected.estimate) + price <= misfit(plain.estimate) else plain


def _or_by_clocks(run: Run, options: SolveOptions, measure: "_Counted", plain: _Solved) -> _Solved:
    """Solve with unknown clocks where that explains contradictions at least as well.

    A constant offset shows in every stance: of longer runs only those are doubted that no other cause explains.
    """
    estimate = plain.estimate
    short = len(run.stances) < FEW_STANCES and contradicts(estimate)
    loose = unknown_clocks(run) if short or misfit(estimate) > MAX_MISFIT else None
    if loose is None:
        return plain
    looser = loose.corrected(run)
    try:
        solved = _in_batch(looser, options, measure.of(looser), loose, plain.seconds_frontend)
    except EstimationError:
        return plain
    said = clocks_instead(run, estimate, solved.estimate)
    if said is None:
        return plain
    if _usable(solved.measured) < _usable(plain.measured):  # too far off to be searched for
        return replace(plain, warnings=[said, *plain.warnings])
    return replace(solved, warnings=[said, *solved.warnings])


def _graph_of(
    run: Run, options: SolveOptions, measured: Sequence[PairMeasurement], team: Team
) -> tuple[PoseGraph, OdometryAndSightings]:
    """The graph of all measurements, with the noise of a team's cameras, and the source of its other measurements."""
    poses = [m.relative_pose for m in measured if m.relative_pose is not None]
    motions, sources = [], OdometryAndSightings(run.team, odometry=options.odometry)
    if options.method != "chain" and run.team.floor is not None:
        # the paper's chain uses neither, and wheels measure on a floor only
        for stance in run.stances:
            pairs = [m for m in measured if m.homography.stance == stance.index]
            motions += sources.of_stance(Restated(run, team), stance, pairs)
    graph = PoseGraph.of(run.team, run.stances, [*poses, *motions])
    return replace(graph, robot_models=options.robot_models(run.team) or graph.robot_models), sources


def _by_stance(run: Run, options: SolveOptions, measure: "_Counted", on_update: OnUpdate | None) -> _Solved:
    """Solve one stance after the other."""
    solver = IncrementalSolver(run.team, options)
    for stance in run.stances:
        measured = solver.measure(run, stance, measure(stance, solver.noise.used(run.team)))
        one = solver.enter(run, stance, measured, solver.ranges_before(run, stance))
        if on_update is not None:
            on_update(one)
    _require_poses(run, options, solver.measured)
    _require_ties(run, solver.estimator.graph, solver.measured)
    arms, estimate = find_lever_arms(solver.estimator.estimate(), BATCH[options.method or "joint"])
    frontend, updates = zip(*solver.seconds, strict=True)
    said = [*solver.warnings, *map(str, arms.values())]
    warnings = _warnings(run, options, estimate, solver.measured, said, solver.unused)
    missing = without_poses(run, options, estimate, solver.measured, solver.unused)
    left_out = unused_ranges(with_outside(run, solver.ranges)) if options.method == "joint" else ()
    return _Solved(estimate, warnings, sum(frontend), solver.measured, updates, {}, missing, solver.noise, left_out)


def _by_ranges(run: Run, options: SolveOptions, progress: Progress | None, on_update: OnUpdate | None) -> _Solved:
    """Solve the ranges, bearings and odometry of a run, all together or second by second."""
    started = time.perf_counter()
    keyframes = keyframes_of(run, between_robots=options.between_robots)
    seconds = time.perf_counter() - started
    graph, updates = KeyframeGraph(run.team, keyframes), list[float]()
    online: Mapping[str, Trajectory] = {}
    if options.incremental:
        incremental = Estimator.of(run.team, "ranging", LAG if options.lag is None else options.lag)
        begin, end = keyframes.measured.time[[0, -1]].tolist()
        count = int((end - begin) / UPDATE_PERIOD) + 1
        for number in range(count):
            new = keyframes.between(begin + number * UPDATE_PERIOD, begin + (number + 1) * UPDATE_PERIOD)
            before = time.perf_counter()
            latest = incremental.add(new)
            updates.append(time.perf_counter() - before)
            if on_update is not None:
                on_update(latest)
            if progress is not None:
                progress(number + 1, count)
        estimate, online = incremental.estimate(), incremental.online
    else:
        try:
            estimate = joint(graph)
        except EstimationError as failure:
            raise EstimationError(f"{run.path}: {failure}") from failure
    loose = diagnose(graph) if len(estimate.trajectories) < len(run.team.names) else ()
    if not estimate.ranging.used.any():
        raise EstimationError(f"{run.path}: no measurement could be used; {'; '.join(map(str, loose))}")
    missing = {part.robot: part.remedy for part in loose if part.robot is not None}
    warnings = [*keyframes.warnings, *warnings_of_ranges(estimate)]
    return _Solved(estimate, warnings, seconds, (), tuple(updates), online, missing)


def _warnings(
    run: Run,
    options: SolveOptions,
    estimate: Estimate,
    measured: Sequence[PairMeasurement],
    found: Sequence[str],
    unused: Sequence[UnusedSighting],
) -> list[str]:
    """Warnings of a run with stances."""
    return [
        *found,
        *describe_unused(unused),
        *implausible_planes(run, options, measured),
        *warnings_of_graph(estimate, measured, run),
    ]


class _Counted:
    """Iterator over the measurements of a stance that reports progress."""

    def __init__(self, run: Run, options: SolveOptions, progress: Progress | None) -> None:
        self._run, self._options, self._progress = run, options, progress
        self._done = 0

    def of(self, run: Run) -> "_Counted":
        """Return the same of a run with corrected stamps."""
        return _Counted(run, self._options, self._progress)

    def __call__(self, stance: Stance, team: Team) -> Iterator[PairMeasurement]:
        yield from measure_stance(Restated(self._run, team), stance, self._options)
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, len(self._run.stances))


def _require_poses(run: Run, options: SolveOptions, measured: Sequence[PairMeasurement]) -> None:
    if not any(m.relative_pose is not None for m in measured):
        unlikely = [f"; {what}" for what in implausible_planes(run, options, measured)][:1]
        raise EstimationError(f"{run.path}: no stance gives a relative pose; {reasons(measured)}{''.join(unlikely)}")


def _require_ties(run: Run, graph: PoseGraph, measured: Sequence[PairMeasurement]) -> None:
    disconnected = diagnose(graph)
    tied = set(graph.nodes) - {node for part in disconnected for node in part.nodes}
    if not any(robot != run.team.reference for robot, _ in tied):
        raise EstimationError(
            f"{run.path}: no measurement ties a robot to the reference {run.team.reference}; "
            f"{why_disconnected(disconnected, measured)}"
        )
