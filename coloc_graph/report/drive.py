"""The report of a drive: one HTML file with its accuracy, its figures, and what turned out of wheels and sensors."""

import math
from collections.abc import Mapping
from html import escape

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from coloc_graph._version import __version__
from coloc_graph.evaluation import Accuracy
from coloc_graph.pipeline.ranging import DriveSolution
from coloc_graph.report.accuracy import accuracy_section
from coloc_graph.report.comparison import Drawing, comparison_drawings
from coloc_graph.report.drawing import COLOURS, GREY, INK, K_95, ellipse_points, styled
from coloc_graph.report.page import document, figure_card, number, table, warnings_section

Array = NDArray[np.float64]


def render_drive_report(solution: DriveSolution, accuracy: Accuracy | None, true: Mapping[str, Array] | None) -> str:
    """The report as one self-contained HTML document; `true` is, by robot, the true poses of `evaluation.align`."""
    estimate = solution.estimate
    how = "as it happened" if solution.options.incremental else "all at once"
    keyframes = sum(map(len, estimate.drive.times))
    world = "the landmarks' map" if estimate.on_map else "the reference robot's first pose"
    figures = [figure_card("above", map_figure(solution, true), "Robots and landmarks from above.")]
    if accuracy is not None and true is not None:
        for name, (height, draw) in comparison_drawings(estimate.trajectories, true, accuracy, on_floor=True).items():
            if name != "trajectories":
                figures.append(figure_card(name, _drawn(height, draw), _CAPTIONS[name]))
    sections = [
        f"<h1>{escape(solution.run.path.name)}</h1>",
        f'<p class="soft">{len(estimate.trajectories)} robots and {len(estimate.landmarks)} landmarks, {keyframes} '
        f"keyframes, {len(estimate.drive.measured)} ranges and bearings; estimated {how}; the world is {world}.</p>",
        accuracy_section(accuracy) if accuracy is not None else "",
        warnings_section([*solution.warnings, *(accuracy.warnings if accuracy is not None else ())]),
        "<h2>Figures</h2>\n" + "\n".join(figures),
        _calibration(solution),
        f"<footer>coloc-graph {escape(__version__)}. Metres and degrees.</footer>",
    ]
    return document(solution.run.path.name, sections)


_CAPTIONS = {
    "errors": "Error of position and heading in time; bands are what the covariances predict (2σ).",
    "rpe": "Relative errors by the distance travelled.",
}


@styled
def _drawn(height: float, draw: Drawing) -> Figure:
    figure = Figure(figsize=(9.0, height), layout="constrained")
    draw(figure)
    return figure


@styled
def map_figure(solution: DriveSolution, true: Mapping[str, Array] | None = None) -> Figure:
    """Where the robots went, and the landmarks with their 95 % ellipses, from above."""
    figure = Figure(figsize=(9.0, 8.0), layout="constrained")
    axes = figure.add_subplot()
    for n, (robot, trajectory) in enumerate(solution.estimate.trajectories.items()):
        if true is not None:
            axes.plot(*true[robot][:, :2, 3].T, color=GREY, linewidth=0.6, label="truth" if not n else None)
        axes.plot(*trajectory.positions[:, :2].T, color=COLOURS[n % len(COLOURS)], linewidth=0.9, label=robot)
    for one in solution.estimate.landmarks:
        axes.plot(*one.position, marker="^", color=INK, markersize=6, linestyle="none")
        x, y = one.position.tolist()
        axes.annotate(one.name, (x, y), xytext=(5, 4), textcoords="offset points", fontsize=8, color=INK)
        if not one.stated:
            axes.plot(*ellipse_points(one.position, one.covariance, K_95).T, color=INK, linewidth=0.8)
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.legend(loc="upper right", fontsize=8)
    return figure


def _calibration(solution: DriveSolution) -> str:
    """What is off of wheels and sensors, and what their noise was multiplied with."""
    estimate, rows = solution.estimate, []

    def value(number_: float, sigma: float, unit: str, digits: int) -> str:
        return f"{number_:.{digits}f} ± {sigma:.{digits}f}{unit}"

    for n, robot in enumerate(estimate.drive.robots):
        errors = estimate.errors[robot]
        cells = ["–"] * 8
        if errors.wheels is not None:
            off, sigmas = errors.wheels[0], np.sqrt(np.diagonal(errors.wheels[1]))
            cells[:3] = [
                value(100 * off[0], 100 * sigmas[0], " %", 1),
                value(100 * off[1], 100 * sigmas[1], " %", 1),
                value(off[2], sigmas[2], " s", 3),
            ]
        if errors.ranging is not None:
            off, sigmas = errors.ranging[0], np.sqrt(np.diagonal(errors.ranging[1]))
            cells[3:] = [
                value(100 * off[0], 100 * sigmas[0], " cm", 1),
                value(100 * off[1], 100 * sigmas[1], " %", 1),
                value(math.degrees(off[2]), math.degrees(sigmas[2]), "°", 2),
                value(off[5], sigmas[5], "", 2),
                value(100 * off[6], 100 * sigmas[6], " cm", 1),
            ]
        rows.append([escape(robot), *cells, ", ".join(number(one, 2) for one in estimate.noise[n].tolist())])
    head = ["Robot", "Way", "Turn", "Delay", "Range", "Scale", "Bearing", "Depth", "To robots", "Noise ×"]
    note = (
        "What was found beyond what the team states, ± one sigma. Noise: what the stated one of ranges, and of "
        "bearings, was multiplied with."
    )
    return f'<h2>Wheels and sensors</h2>\n{table(head, rows, [0])}\n<p class="soft">{note}</p>'
