"""The report report.html: accuracy, warnings, calibration, figures and measurements in one file, without scripts."""

import dataclasses
import math
from collections.abc import Iterator
from html import escape
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from coloc_graph._version import __version__
from coloc_graph.evaluation import Accuracy, RobotAccuracy
from coloc_graph.exchange.landmarks import LandmarkRow, landmark_rows, map_row
from coloc_graph.frontend import PairMeasurement
from coloc_graph.pipeline.solution import Solution
from coloc_graph.report.accuracy import accuracy_section
from coloc_graph.report.comparison import comparison_drawings, drawn
from coloc_graph.report.drawing import Truth, position_sigmas, trajectories_of
from coloc_graph.report.page import DASH, document, figure_card, many, number, table, warnings_section
from coloc_graph.report.plots import error_figure, map_figure, residual_figure, trajectories_figure


def render_report(solution: Solution, accuracy: Accuracy | None, truth: Truth | None) -> str:
    """Return the report of a solution as one self-contained HTML document.

    Parameters
    ----------
    solution : Solution
        The solution.
    accuracy, truth : optional
        The accuracy, and by robot the true poses T_world_body (n, 4, 4) of `evaluation.align`; None without truth.

    Raises
    ------
    InputError
        `truth` has another number of poses than the estimate.

    Notes
    -----
    It holds no time of day and no timing: the same input gives the same text.
    """
    name, is_ranging = solution.run.path.name, solution.estimate.is_ranging
    world = "the reference robot's body at its first stance"
    if is_ranging:
        world = "the map of the landmarks" if solution.estimate.ranging.on_map else "the first robot's first pose"
    sections = [
        f"<h1>{escape(name)}</h1>",
        f'<p class="soft">{_headline(solution)}</p>',
        "" if is_ranging else _verdict(solution, accuracy),
        accuracy_section(accuracy) if accuracy is not None else "",
        warnings_section([*solution.warnings, *(accuracy.warnings if accuracy is not None else ())]),
        _calibration_section(solution),
        _noise_section(solution),
        _landmarks_section(solution),
        _figures_section(solution, accuracy, truth),
        _used_section(solution),
        _ranges_section(solution) if is_ranging else _measurements_section(solution),
        f"<footer>coloc-graph {escape(__version__)}. Metres, degrees and pixels; the world is {world}.</footer>",
    ]
    return document(f"{name}: {solution.estimate.method}", sections)


def _headline(solution: Solution) -> str:
    estimate, count = solution.estimate, solution.count
    robots = ", ".join(one.robot for one in trajectories_of(estimate))
    poses = many(len(solution.run.stances), "stance")
    if estimate.is_ranging:
        poses = many(sum(map(len, estimate.ranging.keyframes.times)), "keyframe")
    return (
        f"Method <b>{escape(estimate.method)}</b>{', incremental' * solution.options.incremental}; robots "
        f"{escape(robots) or DASH}; {poses}; {many(count.used, 'measurement')} used, {count.rejected} rejected"
    )


def _verdict(solution: Solution, accuracy: Accuracy | None) -> str:
    lines = []
    if accuracy is not None:
        lines = [_robot_verdict(row) for row in accuracy.robots]
    else:
        for one in trajectories_of(solution.estimate):
            length = 100 * float(np.linalg.norm(one.positions[-1] - one.positions[0]))
            sigma = number(200 * float(position_sigmas(one)[-1]), 1)
            lines.append(f"{escape(one.robot)}: {number(length, 1)} cm estimated, end ± {sigma} cm (predicted 2σ)")
    return f'<div class="verdict">{"<br>".join(lines)}</div>' if lines else ""


def _robot_verdict(row: RobotAccuracy) -> str:
    name = escape(row.robot)
    if row.length_error_percent is None:
        return f"{name}: standing, position error {number(100 * row.end_position_error, 2)} cm"
    return (
        f"{name}: {number(100 * row.true_length, 1)} cm true, {number(100 * row.estimated_length, 1)} cm estimated, "
        f"<b>{number(row.length_error_percent, 2)} %</b>"
    )


def _calibration_section(solution: Solution) -> str:
    """Return the table of numbers stated with a tolerance, as stated and as estimated."""
    rows = solution.estimate.calibration.rows
    if not rows:
        return ""

    def value(number: float, sigma: float, unit: str) -> str:
        factor, shown, digits = {"m": (1000, "mm", 2), "deg": (1, "°", 3)}.get(unit, (1, unit, 4))
        return f"{factor * number:.{digits}f} ± {factor * sigma:.{digits}f} {shown}".rstrip()

    head = ["Robot", "Parameter", "Stated", "Estimated", "Difference [σ stated]"]
    cells = [
        [
            escape(row.robot),
            escape(row.what),
            value(row.stated, row.stated_sigma, row.unit),
            value(row.found, row.found_sigma, row.unit),
            f'<span class="bad">{row.sigmas:.1f}</span>' if row in solution.estimate.calibration.far
            else f"{row.sigmas:.1f}",
        ]
        for row in rows
    ]  # fmt: skip
    return f"<h2>Calibration</h2>\n{table(head, cells, [0, 1])}"


def _noise_section(solution: Solution) -> str:
    """Noise of marker centres, as stated and as learnt."""
    rows = solution.noise.rows(solution.run.team) if solution.noise is not None else []
    if not rows:
        return ""

    def value(number: float, factor: float, unit: str) -> str:
        return f"{number:.4f} {unit}" + (f" ×/÷ {factor:.2f}" if factor > 1 else "")

    head = ["Camera", "Noise of marker centres", "Stated", "Learnt"]
    cells = [
        [
            escape(row.robot),
            escape(row.what),
            value(row.stated, row.stated_factor, row.unit),
            value(row.learnt, row.learnt_factor, row.unit),
        ]
        for row in rows
    ]
    return f"<h2>Noise</h2>\n{table(head, cells, [0, 1])}"


def _landmarks_section(solution: Solution) -> str:
    """Return the table of the poses of the landmarks and of the map."""
    rows = landmark_rows(solution.estimate)
    if not rows:
        return ""

    def cells(row: LandmarkRow) -> list[str]:
        return [
            escape(row.name),
            f"{row.x:.3f} ± {row.x_sigma:.3f}",
            f"{row.y:.3f} ± {row.y_sigma:.3f}",
            f"{row.yaw_deg:.2f} ± {row.yaw_sigma_deg:.2f}" if math.isfinite(row.yaw_deg) else DASH,
            str(row.measurements),
        ]

    head = ["Landmark", "x [m]", "y [m]", "Yaw [°]", "Measurements"]
    here = map_row(solution.estimate)
    foot = [] if here is None else ["The map's origin", *cells(here)[1:]]
    return f"<h2>Landmarks</h2>\n{table(head, map(cells, rows), [0], foot)}"


def _figures_section(solution: Solution, accuracy: Accuracy | None, truth: Truth | None) -> str:
    figures = _ranging_figures(solution, accuracy, truth) if solution.estimate.is_ranging else _figures(solution, truth)
    parts = [figure_card(name, figure, caption) for name, figure, caption in figures]
    return "<h2>Figures</h2>\n" + "\n".join(parts)


def _figures(solution: Solution, truth: Truth | None) -> Iterator[tuple[str, Figure, str]]:
    """Yield name, figure and caption of a run with stances."""
    estimate = solution.estimate
    errors = "Error of position and heading by distance travelled; the band is the predicted 2σ."
    if not truth:
        errors = "Predicted 2σ of position and heading by distance travelled; there is no truth to compare with."
    yield "above", trajectories_figure(estimate, truth), "The team from above, in the world of the reference robot."
    yield "errors", error_figure(estimate, truth), errors
    caption = "Residuals of each stance's points in units of the stated pixel noise, expected 1."
    yield "residuals", residual_figure([m.homography for m in solution.measurements]), caption


def _ranging_figures(
    solution: Solution, accuracy: Accuracy | None, truth: Truth | None
) -> Iterator[tuple[str, Figure, str]]:
    """Yield name, figure and caption of a ranging run."""
    captions = {
        "errors": "Error of position and heading over time; bands are the predicted 2σ.",
        "rpe": "Relative errors by the distance travelled.",
    }
    yield "above", map_figure(solution.estimate, truth), "Robots and landmarks from above."
    if accuracy is not None and truth is not None:
        drawings = comparison_drawings(solution.estimate.trajectories, truth, accuracy, on_floor=True)
        for name, caption in captions.items():
            if name in drawings:
                yield name, drawn(*drawings[name]), caption


def _used_section(solution: Solution) -> str:
    estimate = solution.estimate
    agreement = f"{estimate.chi2 / estimate.dof:.2f} ({estimate.dof:.0f} degrees of freedom)" if estimate.dof else DASH
    facts = [
        *((f"{kind} measurements used", str(one.used)) for kind, one in solution.counts.items()),
        *((f"{kind} measurements rejected", str(one.rejected)) for kind, one in solution.counts.items()),
        *((f"{one.kind} not used", f"{one.count}: {one.reason}") for one in solution.unused),
        ("poses not tied to the reference", str(len(estimate.disconnected))),
        *([] if estimate.is_ranging else [("stay-put constraints", str(len(estimate.graph.stay_puts)))]),
        *([("landmarks", str(len(estimate.landmarks)))] if estimate.landmarks else []),
        ("chi²/dof, expected 1", agreement),
        ("iterations", str(estimate.iterations)),
        *_flat("", dataclasses.asdict(solution.options)),
    ]
    rows = [[escape(key), escape(value)] for key, value in facts]
    return f"<h2>Measurements and options</h2>\n{table(['Item', 'Value'], rows, [0, 1])}"


def _flat(prefix: str, options: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield options by dotted name."""
    for key, value in options.items():
        if isinstance(value, dict):
            yield from _flat(f"{prefix}{key}.", value)
        else:
            yield prefix + key, DASH if value is None else str(value)


def _measurements_section(solution: Solution) -> str:
    measurements = solution.measurements
    head = ["Stance", "Pair", "Points", "Inliers", "Residual", "Overlap [px]", "Normal error [°]", "Used"]
    rows = table(head, (_measurement_row(one, solution.reason(one)) for one in measurements), [1, 7])
    return (
        f"<h2>Measurements</h2>\n<details>\n<summary>{many(len(measurements), 'measured pair')}</summary>\n"
        f"{rows}\n</details>"
    )


def _measurement_row(measured: PairMeasurement, reason: str | None) -> list[str]:
    h, pose = measured.homography, measured.relative_pose
    return [
        str(h.stance),
        f"{escape(h.robot_i)}&nbsp;–&nbsp;{escape(h.robot_j)}",
        str(h.points),
        str(h.inliers),
        number(h.residual, 2),
        number(h.overlap_px, 0),
        number(None if pose is None or pose.normal_error is None else math.degrees(pose.normal_error), 2),
        "yes" if reason is None else f'<span class="bad">{escape(reason)}</span>',
    ]


def _ranges_section(solution: Solution) -> str:
    """Return the table of ranges and bearings by robot, with the factors on their stated noise."""
    problem = solution.estimate.ranging
    robot, rows = problem.keyframes.measured.robot, []
    for number_, name in enumerate(problem.keyframes.robots):
        own = robot == number_
        noise = (number(factor, 2) for factor in problem.noise[number_].tolist())
        rows.append(
            [escape(name), str((own & problem.used).sum()), str((own & problem.outliers).sum()),
             str((own & ~problem.used & ~problem.outliers).sum()), *noise]
        )  # fmt: skip
    head = ["Robot", "Used", "Outliers", "Without poses", "Range noise ×", "Bearing noise ×"]
    note = "Noise × is the ratio of residuals to the stated standard deviations."
    return f'<h2>Ranges and bearings</h2>\n{table(head, rows, [0])}\n<p class="soft">{note}</p>'
