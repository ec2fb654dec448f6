"""`report.html`: one file that says how well a run was solved, with nothing to fetch and nothing to execute."""

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from html import escape
from typing import Any

import numpy as np

from coloc_graph._version import __version__
from coloc_graph.evaluation import Accuracy, RobotAccuracy
from coloc_graph.exchange.landmarks import LandmarkRow, landmark_rows, map_row
from coloc_graph.frontend import PairMeasurement
from coloc_graph.pipeline import Solution
from coloc_graph.report.drawing import Truth, position_sigmas, trajectories_of
from coloc_graph.report.plots import error_figure, figure_svg, residual_figure, trajectories_figure

DASH = "–"

_CSS = """
:root { color-scheme: light dark; --ink: #24292f; --soft: #59636e; --line: #d8dee4; --page: #ffffff;
  --wash: #f6f8fa; --bad: #a63a00; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6edf3; --soft: #9aa4af; --line: #30363d; --page: #0d1117;
  --wash: #161b22; --bad: #ff9d66; } }
body { margin: 0 auto; padding: 2.5rem 1.5rem 4rem; max-width: 60rem; background: var(--page); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
h1 { font-size: 1.75rem; line-height: 1.25; margin: 0; overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 2.5rem 0 .75rem; }
p { margin: .5rem 0; }
.soft, figcaption, footer { color: var(--soft); font-size: .9rem; }
.verdict { margin: 1.5rem 0; padding: .75rem 1.1rem; background: var(--wash); border-left: 4px solid #0072b2;
  border-radius: 4px; font-size: 1.1rem; font-variant-numeric: tabular-nums; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .9rem; font-variant-numeric: tabular-nums; }
th, td { padding: .35rem .65rem; text-align: right; border-bottom: 1px solid var(--line); vertical-align: top; }
th { color: var(--soft); font-weight: 600; }
th.text, td.text { text-align: left; overflow-wrap: break-word; }
tfoot td { font-weight: 600; border-bottom: 0; }
.bad { color: var(--bad); }
figure { margin: 0 0 1.75rem; }
.card { background: #ffffff; border: 1px solid var(--line); border-radius: 6px; padding: .75rem; }
.card svg { display: block; width: 100%; height: auto; }
figcaption { margin-top: .4rem; }
summary { cursor: pointer; }
ul { padding-left: 1.2rem; }
li { margin: .3rem 0; overflow-wrap: anywhere; }
footer { margin-top: 3rem; border-top: 1px solid var(--line); padding-top: .75rem; }
"""


def render_report(solution: Solution, accuracy: Accuracy | None, truth: Truth | None) -> str:
    """The report of a solution as one self-contained HTML document.

    `truth` is, by robot, the true poses T_world_body (n, 4, 4) of `evaluation.align`; `accuracy` is made of it;
    both are None where the run has no truth. No time of day and no timing is in it: the same input gives the
    same text. Raises `InputError` where `truth` has another number of poses than the estimate.
    """
    name = solution.run.path.name
    sections = [
        f"<h1>{escape(name)}</h1>",
        f'<p class="soft">{_headline(solution)}</p>',
        _verdict(solution, accuracy),
        _accuracy_section(accuracy) if accuracy is not None else "",
        _warnings_section(solution.warnings),
        _calibration_section(solution),
        _landmarks_section(solution),
        _figures_section(solution, truth),
        _used_section(solution),
        _measurements_section(solution),
        f"<footer>coloc-graph {escape(__version__)}. Metres, degrees and pixels; the world is the reference robot's "
        "body at its first stance.</footer>",
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'\">\n"
        f"<title>{escape(name)}: {escape(solution.estimate.method)}</title>\n<style>{_CSS}</style>\n</head>\n<body>\n"
        + "\n".join(section for section in sections if section)
        + "\n</body>\n</html>\n"
    )


def _headline(solution: Solution) -> str:
    used, refused = _counts(solution)
    robots = ", ".join(one.robot for one in trajectories_of(solution.estimate))
    return (
        f"Method <b>{escape(solution.estimate.method)}</b>; robots {escape(robots) or DASH}; "
        f"{_many(len(solution.run.stances), 'stance')}; {_many(used, 'measurement')} used, {refused} refused"
    )


def _counts(solution: Solution) -> tuple[int, int]:
    refused = len(solution.measurements) - solution.used
    return len(solution.measurements) - refused, refused


def _many(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _number(value: float | None, digits: int) -> str:
    """A number, or a dash where there is none."""
    return f"{value:.{digits}f}" if value is not None and math.isfinite(value) else DASH


def _verdict(solution: Solution, accuracy: Accuracy | None) -> str:
    lines = []
    if accuracy is not None:
        lines = [_robot_verdict(row) for row in accuracy.robots]
    else:
        for one in trajectories_of(solution.estimate):
            length = 100 * float(np.linalg.norm(one.positions[-1] - one.positions[0]))
            sigma = _number(200 * float(position_sigmas(one)[-1]), 1)
            lines.append(f"{escape(one.robot)}: {_number(length, 1)} cm estimated, end ± {sigma} cm (predicted 2σ)")
    return f'<div class="verdict">{"<br>".join(lines)}</div>' if lines else ""


def _robot_verdict(row: RobotAccuracy) -> str:
    name = escape(row.robot)
    if row.length_error_percent is None:
        return f"{name}: stayed where it was, {_number(100 * row.end_position_error, 2)} cm off"
    return (
        f"{name}: {_number(100 * row.true_length, 1)} cm true, {_number(100 * row.estimated_length, 1)} cm estimated, "
        f"<b>{_number(row.length_error_percent, 2)} %</b>"
    )


def _table(head: Sequence[str], rows: Iterable[Sequence[str]], text: Sequence[int], foot: Sequence[str] = ()) -> str:
    """A table of cells that are HTML already; the columns of `text` are set to the left."""

    def cells(tag: str, row: Sequence[str]) -> str:
        return "".join(
            f'<{tag} class="text">{cell}</{tag}>' if column in text else f"<{tag}>{cell}</{tag}>"
            for column, cell in enumerate(row)
        )

    body = "\n".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    last = f"<tfoot><tr>{cells('td', foot)}</tr></tfoot>" if foot else ""
    head_row = f"<thead><tr>{cells('th', head)}</tr></thead>"
    return f'<div class="wide"><table>{head_row}\n<tbody>\n{body}\n</tbody>{last}</table></div>'


def _accuracy_section(accuracy: Accuracy) -> str:
    head = ["Robot", "True [cm]", "Est. [cm]", "Error [cm]", "Error [%]", "ATE [cm]", "End [cm]", "Heading [°]"]
    rows = [
        [
            escape(row.robot),
            _number(100 * row.true_length, 1),
            _number(100 * row.estimated_length, 1),
            _number(100 * abs(row.length_error), 2),
            _number(row.length_error_percent, 2),
            _number(100 * row.ate, 2),
            _number(100 * row.end_position_error, 2),
            _number(row.heading_error_deg, 2),
        ]
        for row in accuracy.robots
    ]
    team = [_number(100 * accuracy.ate, 2), _number(100 * accuracy.end_position_error, 2)]
    foot = ["Team", *[""] * 4, *team, _number(accuracy.heading_error_deg, 2)]
    note = (
        "Lengths are straight from the first to the last pose, as in the paper's Table II. ATE is the RMS position "
        "error over all poses; end and heading are those of the last pose, the team's its worst."
    )
    if accuracy.anees is not None:
        note += (
            f" The squared error is {_number(accuracy.anees, 2)} times what the covariances predict "
            f"(NEES per degree of freedom, {_many(accuracy.nees_poses, 'pose')}; 1 is honest)."
        )
    return f'<h2>Accuracy</h2>\n{_table(head, rows, [0], foot)}\n<p class="soft">{note}</p>'


def _calibration_section(solution: Solution) -> str:
    """What was stated with a tolerance, and what it turned out to be."""
    rows = solution.estimate.calibration.rows
    if not rows:
        return ""

    def value(number: float, sigma: float, unit: str) -> str:
        number, sigma, unit, digits = (1000 * number, 1000 * sigma, "mm", 2) if unit == "m" else (number, sigma, "°", 3)
        return f"{number:.{digits}f} ± {sigma:.{digits}f} {unit}"

    head = ["Robot", "What", "Stated", "Found", "Off by (σ of what was stated)"]
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
    return f"<h2>Calibration</h2>\n{_table(head, cells, [0, 1])}"


def _landmarks_section(solution: Solution) -> str:
    """Where the landmarks are, and the map."""
    rows = landmark_rows(solution.estimate)
    if not rows:
        return ""

    def cells(row: LandmarkRow) -> list[str]:
        return [
            escape(row.name),
            f"{row.x:.3f} ± {row.x_sigma:.3f}",
            f"{row.y:.3f} ± {row.y_sigma:.3f}",
            f"{row.yaw_deg:.2f} ± {row.yaw_sigma_deg:.2f}",
            str(row.sightings),
        ]

    head = ["Landmark", "x [m]", "y [m]", "Yaw [°]", "Sightings"]
    here = map_row(solution.estimate)
    foot = [] if here is None else ["The map's origin", *cells(here)[1:]]
    return f"<h2>Landmarks</h2>\n{_table(head, map(cells, rows), [0], foot)}"


def _warnings_section(warnings: Sequence[str]) -> str:
    if not warnings:
        return ""
    items = "\n".join(f"<li>{escape(warning)}</li>" for warning in warnings)
    return f'<h2 class="bad">Warnings</h2>\n<ul>\n{items}\n</ul>'


def _figures_section(solution: Solution, truth: Truth | None) -> str:
    estimate = solution.estimate
    errors = "Error of position and heading along the way; the band is what the covariances predict (2σ)."
    if not truth:
        errors = "What the covariances predict along the way (2σ): there is no truth to compare with."
    figures = [
        ("above", trajectories_figure(estimate, truth), "The team from above, in the world of the reference robot."),
        ("errors", error_figure(estimate, truth), errors),
        (
            "residuals",
            residual_figure([m.homography for m in solution.measurements]),
            "How well one homography explains each stance: 1 is what the stated pixel noise gives.",
        ),
    ]
    parts = [
        f'<figure>\n<div class="card" role="img" aria-label="{escape(caption)}">{figure_svg(figure, name)}</div>\n'
        f"<figcaption>{escape(caption)}</figcaption>\n</figure>"
        for name, figure, caption in figures
    ]
    return "<h2>Figures</h2>\n" + "\n".join(parts)


def _used_section(solution: Solution) -> str:
    estimate, (used, refused) = solution.estimate, _counts(solution)
    agreement = f"{estimate.chi2 / estimate.dof:.2f} ({estimate.dof} degrees of freedom)" if estimate.dof else DASH
    facts = [
        ("measurements used", str(used)),
        ("measurements refused", str(refused)),
        ("poses not tied to the reference", str(len(estimate.untied))),
        ("stay-put constraints", str(len(estimate.graph.stay_puts))),
        *([("landmarks", str(len(estimate.landmarks)))] if estimate.landmarks else []),
        ("chi²/dof of the graph, expected 1", agreement),
        ("iterations", str(estimate.iterations)),
        *_flat("", dataclasses.asdict(solution.options)),
    ]
    rows = [[escape(key), escape(value)] for key, value in facts]
    return f"<h2>What was used</h2>\n{_table(['What', 'Value'], rows, [0, 1])}"


def _flat(prefix: str, options: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Options by dotted name."""
    for key, value in options.items():
        if isinstance(value, dict):
            yield from _flat(f"{prefix}{key}.", value)
        else:
            yield prefix + key, DASH if value is None else str(value)


def _measurements_section(solution: Solution) -> str:
    measurements = solution.measurements
    head = ["Stance", "Pair", "Points", "Inliers", "Residual", "Overlap [px]", "Normal error [°]", "Usable, or why not"]
    table = _table(head, (_measurement_row(one, solution.why_not(one)) for one in measurements), [1, 7])
    return (
        f"<h2>Measurements</h2>\n<details>\n<summary>{_many(len(measurements), 'measured pair')}</summary>\n"
        f"{table}\n</details>"
    )


def _measurement_row(measured: PairMeasurement, why_not: str | None) -> list[str]:
    h, pose = measured.homography, measured.relative_pose
    return [
        str(h.stance),
        f"{escape(h.robot_i)}&nbsp;–&nbsp;{escape(h.robot_j)}",
        str(h.points),
        str(h.inliers),
        _number(h.residual, 2),
        _number(h.overlap_px, 0),
        _number(math.degrees(pose.normal_error) if pose else None, 2),
        "yes" if why_not is None else f'<span class="bad">{escape(why_not)}</span>',
    ]
