"""Reasons and warnings of a solution, in words."""

import re
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from scipy.special import chdtr, chdtrc

from coloc_graph.backend import DisconnectedComponent, Estimate, diagnose
from coloc_graph.backend.ranging import RangingProblem
from coloc_graph.frontend import PairMeasurement, UnusedSighting, little_in_common
from coloc_graph.frontend.pairing.plane_check import implausible
from coloc_graph.pipeline.disagreement import worst_kinds
from coloc_graph.pipeline.moves import described_bumps
from coloc_graph.pipeline.options import SolveOptions
from coloc_graph.run import Run

WARNING_P_VALUE = 1e-4  # probability of a chi2 by noise alone below which a warning says that measurements disagree
MISFIT = 1.5  # chi2/dof from which on the prediction is off by half; below the inverse square it is too wide
MAX_REASONS = 3  # kinds of reasons that are named where no measurement is usable


def reasons(measurements: Sequence[PairMeasurement]) -> str:
    """Reasons for which all measurements are unusable: one of each kind with its count, most frequent first."""
    kinds: dict[str, list[str]] = {}
    for measured in measurements:
        h = measured.homography
        kinds.setdefault(_kind(h.unusable or "", h.robot_i, h.robot_j), []).append(
            f"stance {h.stance}, {h.robot_i} and {h.robot_j}: {h.unusable}"
        )
    by_count = sorted(kinds.values(), key=lambda kind: -len(kind))
    total = len(measurements)
    named = [
        kind[0] + (f" (the same in {len(kind)} of {total} measurements)" if total > 1 else "")
        for kind in by_count[:MAX_REASONS]
    ]
    more = sum(map(len, by_count[MAX_REASONS:]))
    return "; ".join([*named, f"and {more} more for other reasons"] if more else named)


def _kind(reason: str, *robots: str) -> str:
    """Return a reason without the numbers and names that differ from stance to stance."""
    for robot in robots:
        reason = re.sub(rf"\b{re.escape(robot)}\b", "?", reason)
    reason = re.sub(r"`[^`]*`(, `[^`]*`)*", "?", reason)
    return re.sub(r"\d+(\.\d+)?(e[+-]?\d+)?", "?", reason)


def without_poses(
    run: Run,
    options: SolveOptions,
    estimate: Estimate,
    measurements: Iterable[PairMeasurement],
    unused: Iterable[UnusedSighting],
) -> dict[str, str]:
    """Reasons, by robot, why robots of a team with stances have no pose."""
    team, stances = run.team, run.stances
    sighted = {one.landmark: one.why for one in unused if one.is_robot}
    disconnected = {robot for robot, _ in estimate.disconnected}
    measured = {m.homography.stance for m in measurements if not m.homography.unusable}
    found: dict[str, str] = {}
    for robot in team.names:
        if robot in estimate.trajectories:
            continue
        moved = [stance for stance in stances if robot in stance.movers]
        if any(robot in stance.observers for stance in stances) or robot in disconnected:
            why = "no measurement that is used ties it to the reference"
        elif not moved:
            why = "it takes part in no stance"
        elif options.method == "chain":
            why = "a chain places observers only, and it was watched; solve with another method"
        elif team[robot].markers is None:
            why = "the team states no markers of it; state where they are"
        elif not any(stance.index in measured for stance in moved):
            why = "no stance in which it moved could be measured"
        elif team.floor is None:
            why = "nothing says how it stands under its markers; state the [floor] in the team"
        elif all(stance.index in run.planes for stance in moved):
            why = "the marker planes are stated, and not where they are above the floor"
        else:
            why = sighted.get(robot, "its markers were not seen well enough")
        found[robot] = why
    return found


def implausible_planes(run: Run, options: SolveOptions, measurements: Sequence[PairMeasurement]) -> Iterator[str]:
    """Stated planes that contradict the markers seen in them: the first of each observer, and the number of others."""
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


def why_disconnected(disconnected: tuple[DisconnectedComponent, ...], measurements: Iterable[PairMeasurement]) -> str:
    """Describe the first unusable measurement, or else the first disconnected part with its remedy."""
    unusable = [m.homography for m in measurements if m.homography.unusable]
    if unusable:
        return f"stance {unusable[0].stance}, {unusable[0].robot_i} and {unusable[0].robot_j}: {unusable[0].unusable}"
    return str(disconnected[0])


def warnings_of_graph(
    estimate: Estimate,
    measurements: Sequence[PairMeasurement],
    run: Run | None = None,
) -> list[str]:
    """Warnings of an estimate of stances: unusable and rejected measurements, bumps, unlikely calibrations, chi2.

    With the `run`, what its wheels say of bumps is told, too.
    """
    stances = estimate.graph.by_index
    disconnected = diagnose(estimate.graph.without(one.measurement for one in estimate.rejected))
    warnings = [
        f"stance {m.homography.stance}: {m.homography.robot_i} and {m.homography.robot_j} not used: "
        f"{m.homography.unusable}"
        for m in measurements
        if m.homography.unusable and not little_in_common(m.homography, stances[m.homography.stance])
    ]
    warnings += [
        f"stance {m.homography.stance}: {m.homography.robot_i} and {m.homography.robot_j} are used, but suspicious: "
        f"{m.homography.doubt}"
        for m in measurements
        if m.homography.doubt
    ]
    warnings += [f"{part} (left out of the result)" for part in disconnected[:MAX_REASONS]]
    if len(disconnected) > MAX_REASONS:
        warnings.append(f"{len(disconnected) - MAX_REASONS} more groups of poses are not tied to the reference")
    warnings += [f"the {one.measurement} was rejected: it is {one.reason}" for one in estimate.rejected]
    bumped = estimate.bumped
    warnings += map(str, bumped) if run is None else described_bumps(run, stances, bumped)
    warnings += _far(estimate)
    return [*warnings, *_unobservable(estimate), *_misfit(estimate)]


def _misfit(estimate: Estimate) -> list[str]:
    """Warn where chi2/dof says that predicted variances are off by half or more, beyond chance."""
    if estimate.dof <= 0:
        return []
    per_dof = estimate.chi2 / estimate.dof
    p_value = float(chdtrc(estimate.dof, estimate.chi2))
    if per_dof > MISFIT and p_value < WARNING_P_VALUE:
        return [
            f"the measurements disagree (chi2/dof {per_dof:.1f} with {estimate.dof} degrees of "
            f"freedom, expected 1; probability by noise alone {_p_value(p_value)}); {worst_kinds(estimate)}"
        ]
    if per_dof < 1 / MISFIT**2 and float(chdtr(estimate.dof, estimate.chi2)) < WARNING_P_VALUE:
        return [
            f"the measurements agree better than expected (chi2/dof {per_dof:.2f} with {estimate.dof} degrees of "
            "freedom, expected 1): predicted uncertainties are too large; state smaller tolerances of mounts, floor, "
            "odometry or noise"
        ]
    return []


def _unobservable(estimate: Estimate) -> Iterator[str]:
    """Tolerances of mounts, wheels and range sensors that were stated, and that the measurements do not narrow."""
    mounts = {name: set(mount.rows) for name, mount in estimate.calibration.mounts.items()}
    names: dict[tuple[str, str], list[str]] = {}
    for row in estimate.calibration.unobservable:
        if row in mounts.get(row.robot, ()):
            remedy = f"record wheel odometry of {row.robot} while it turns and drives between its stances"
        elif row.what.startswith("odometry"):
            remedy = f"let it drive further and turn more, or state it as exact in {row.robot}'s [robots.wheels]"
        else:
            remedy = (
                f"let it measure range at more distances to more robots, or state it as exact in {row.robot}'s "
                "[robots.ranging]"
            )
        names.setdefault((row.robot, remedy), []).append(row.what)
    for (robot, remedy), whats in names.items():
        yield f"{robot}: {', '.join(whats)} not observable, and as uncertain as stated: {remedy}"


def _p_value(p_value: float) -> str:
    """Format a small probability."""
    return "below 1e-9" if p_value < 1e-9 else f"{p_value:.0e}"


def warnings_of_ranges(estimate: Estimate) -> list[str]:
    """Warnings of the estimate of a ranging run: outliers, unlikely calibrations."""
    outliers = [_outliers(estimate.ranging)] if estimate.rejected else []
    return [*outliers, *_far(estimate), *_unobservable(estimate), *_misfit(estimate)]


def _outliers(problem: RangingProblem) -> str:
    m = problem.keyframes.measured
    pairs: dict[tuple[int, int], int] = {}
    for row in np.flatnonzero(problem.outliers).tolist():
        pair = int(m.robot[row]), int(m.target[row])
        pairs[pair] = pairs.get(pair, 0) + 1
    (robot, target), count = max(pairs.items(), key=lambda one: one[1])
    return (
        f"{sum(pairs.values())} of {len(m)} measurements were rejected as outliers (robust weight near 0), "
        f"{count} of them of {problem.names[target]} by {problem.names[robot]}"
    )


def _far(estimate: Estimate) -> list[str]:
    return [
        f"{row} is {row.sigmas:.1f} sigmas from the team's value: measure it again, or update the team file"
        for row in estimate.calibration.far
    ]
