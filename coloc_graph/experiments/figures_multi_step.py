"""Table I as a picture, and Table II with the trajectories of Fig. 6."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from coloc_graph.experiments.multi_step import Outing
from coloc_graph.experiments.multi_step_results import Table1, Table2
from coloc_graph.experiments.paper import TABLE1
from coloc_graph.experiments.style import (
    DEPTHS,
    EQ2,
    EQ2_LABEL,
    EQ2_MARKER,
    OURS,
    OURS_LABEL,
    OURS_MARKER,
    PAPER,
    PAPER_MARKER,
    titled,
)
from coloc_graph.report.drawing import GREY, INK, PALE, styled

Array = NDArray[np.float64]

_LOOKS = (("eq2", EQ2, EQ2_MARKER, EQ2_LABEL), ("ours", OURS, OURS_MARKER, OURS_LABEL))
#: Errors below this are drawn on it [cm]: a logarithmic axis has no zero.
_MIN_CM = 0.01


@styled
def table1_figure(result: Table1) -> Figure:
    """Left the standing points a to g [m] of the run that is shown, right the error of each segment [cm]."""
    figure = Figure(figsize=(11.0, 4.9))
    plan = figure.add_axes((0.062, 0.13, 0.33, 0.66))
    errors = figure.add_axes((0.47, 0.13, 0.515, 0.66))
    _draw_plan(plan, result.outings[0])
    _draw_errors(errors, result)
    n = len(result.outings)
    titled(
        figure,
        "Six steps, and the distances between the standing points (the paper's Table I)",
        f"{n} run{'s' * (n > 1)} from seed {result.outings[0].seed} on, {DEPTHS[result.depth]}. Left: seed "
        f"{result.outings[0].seed}. Right: large marks are means, small ones single runs.",
    )
    return figure


def _draw_plan(axes: Axes, outing: Outing) -> None:
    true = _along_x(outing, outing.standing("true"))
    axes.plot(*true.T, color=PALE, linewidth=4, solid_joinstyle="round", zorder=1)
    axes.plot(*true.T, linestyle="", marker="+", markersize=13, markeredgewidth=1.2, color=INK, zorder=5, gid="truth")
    for method, colour, marker, _ in _LOOKS:
        places = _along_x(outing, outing.standing(method))
        axes.plot(
            *places.T, linestyle="", marker=marker, markersize=8 if method == "eq2" else 5, color=colour,
            markerfacecolor="none" if method == "eq2" else colour, markeredgewidth=1.6, zorder=3, gid=method,
        )  # fmt: skip
    middle = true[:, 1].mean()
    for place, letter in zip(true, "abcdefg", strict=False):
        axes.annotate(
            letter, place.tolist(), (0, 10 if place[1] > middle else -10), textcoords="offset points", ha="center",
            va="bottom" if place[1] > middle else "top", weight="bold", size=11,
        )  # fmt: skip
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.12, 0.16)
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    handles = [
        Line2D([], [], linestyle="", marker="+", markersize=11, color=INK, label="truth"),
        Line2D(
            [], [], linestyle="", marker=EQ2_MARKER, color=EQ2, markerfacecolor="none", markersize=7, label=EQ2_LABEL
        ),
        Line2D([], [], linestyle="", marker=OURS_MARKER, color=OURS, markersize=5, label=OURS_LABEL),
    ]
    axes.legend(handles=handles, loc="lower left", bbox_to_anchor=(-0.02, 1.0), ncols=3, borderaxespad=0.2)


def _draw_errors(axes: Axes, result: Table1) -> None:
    at = np.arange(len(TABLE1), dtype=np.float64)
    paper = [max(abs(segment.error_cm), _MIN_CM) for segment in TABLE1]
    axes.plot(
        at, paper, linestyle="", marker=PAPER_MARKER, markersize=21, markeredgewidth=2.2, color=PAPER, zorder=5,
        label="the paper", gid="paper",
    )  # fmt: skip
    for side, (method, colour, marker, label) in zip((-0.17, 0.17), _LOOKS, strict=True):
        every = np.array([result.errors_cm(segment, method) for segment in TABLE1]).clip(_MIN_CM)
        axes.plot(
            np.repeat(at + side, every.shape[1]), every.ravel(), linestyle="", marker=marker, markersize=3.4,
            color=colour, alpha=0.4, markeredgewidth=0, zorder=2,
        )  # fmt: skip
        means = [max(result.errors_cm(segment, method).mean(), _MIN_CM) for segment in TABLE1]
        axes.plot(
            at + side, means, linestyle="", marker=marker, markersize=8, color=colour, markeredgecolor="white",
            zorder=4, label=f"{label} (mean {np.mean(means):.2f} cm)", gid=method,
        )  # fmt: skip
    axes.axhline(1.0, color=GREY, linewidth=0.9, linestyle="--", zorder=1)
    axes.axvline(5.5, color=PALE, linewidth=1.2, zorder=1)
    axes.set_yscale("log")
    axes.set_ylim(0.8 * _MIN_CM, None)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_xticks(at, [segment.name for segment in TABLE1])
    axes.grid(False, axis="x")
    axes.set_ylabel("size of the length's error [cm]")
    axes.legend(loc="lower left", bbox_to_anchor=(-0.02, 1.0), ncols=3, borderaxespad=0.2, markerscale=0.8)


def _along_x(outing: Outing, places: Array) -> Array:
    """Places (n, 2), turned so that the team's true way leads along x, about the first robot's first place."""
    true = outing.standing("true")
    # the zigzag's middle line: from the middle of the first pair to that of the last
    way = (true[-1] + true[-2] - true[0] - true[1]) / 2
    return _turned(places, way)


def _turned(places: Array, way: Array) -> Array:
    c, s = way / np.hypot(*way)
    return np.asarray(places @ np.array([[c, -s], [s, c]]))


@styled
def table2_figure(result: Table2) -> Figure:
    """A row a case: the courses of both robots [m] (Fig. 6), and their error rates [%] beside the paper's."""
    shown = result.outings[:2]
    figure = Figure(figsize=(12.0, 0.95 + 2.15 * len(shown)))
    height = figure.get_figheight()
    for index, outing in enumerate(shown):
        bottom = (0.55 + 2.15 * (len(shown) - 1 - index)) / height
        courses = figure.add_axes((0.068, bottom, 0.652, 1.6 / height))
        rates = figure.add_axes((0.782, bottom, 0.208, 1.6 / height))
        _draw_courses(courses, outing, f"Case {index + 1} (seed {outing.seed})")
        _draw_rates(rates, result, index + 1)
        if index == len(shown) - 1:
            courses.set_xlabel("along the hallway [m]")
    titled(
        figure,
        "Down the hallway (the paper's Table II and Fig. 6)",
        f"{result.stances} stances, {DEPTHS[result.depth]}. The places where the robots stood: y is drawn larger than "
        "x, so that the drift is seen.",
    )
    handles = [
        Line2D([], [], color=INK, linewidth=1.2, linestyle=(0, (4, 3)), label="truth"),
        Line2D([], [], color=EQ2, marker=EQ2_MARKER, markersize=4, linewidth=1.3, label=EQ2_LABEL),
        Line2D([], [], color=OURS, marker=OURS_MARKER, markersize=4, linewidth=1.3, label=OURS_LABEL),
        Line2D(
            [],
            [],
            linestyle="",
            marker=PAPER_MARKER,
            markersize=14,
            markeredgewidth=2.2,
            color=PAPER,
            label="the paper",
        ),
    ]
    figure.legend(handles=handles, loc="upper right", ncols=4, bbox_to_anchor=(0.995, 0.995))
    return figure


def _draw_courses(axes: Axes, outing: Outing, title: str) -> None:
    ways = [one.true[-1] - one.true[0] for one in outing.courses.values()]
    way = np.sum(ways, axis=0)
    starts = {robot: _turned(one.true[:1], way)[0] for robot, one in outing.courses.items()}
    middle = np.mean([start[1] for start in starts.values()])
    origin = np.array([min(start[0] for start in starts.values()), middle])
    for robot, course in outing.courses.items():
        for method, colour, marker, _ in _LOOKS:
            x, y = (_turned(getattr(course, method), way) - origin).T
            axes.plot(x, y, color=colour, linewidth=1.3, marker=marker, markersize=3.2, zorder=3, gid=method)
        x, y = (_turned(course.true, way) - origin).T
        axes.plot(x, y, color=INK, linewidth=1.2, linestyle=(0, (4, 3)), zorder=5, gid="truth")
        axes.annotate(
            robot, (x[0], y[0]), (-9, 0), textcoords="offset points", ha="right", va="center", weight="bold", size=11
        )
        axes.annotate(
            f"{100 * course.length(course.true):.0f} cm", (x[-1], y[-1]), (9, 0), textcoords="offset points", ha="left",
            va="center", size=9, color=INK,
        )  # fmt: skip
    axes.margins(x=0.09, y=0.16)
    axes.set_ylabel("across [m]")
    axes.set_title(title, loc="left", size=10.5, weight="bold")


def _draw_rates(axes: Axes, result: Table2, case: int) -> None:
    rows = [(row, course) for row, course in result.cases if row.case == case]
    places = 1.35 * np.arange(len(rows))
    for at, (row, course) in zip(places, rows, strict=True):
        for side, (method, colour, marker, _) in zip((-0.18, 0.18), _LOOKS, strict=True):
            rate = course.rate_percent(getattr(course, method))
            axes.bar(at + side, rate, 0.3, color=colour, zorder=2, gid=method)
            axes.annotate(
                f"{rate:.2f}", (at + side, rate), (0, 2), textcoords="offset points", ha="center", va="bottom", size=8.5
            )
        axes.plot(
            [at - 0.4, at + 0.4], [row.rate_percent] * 2, color=PAPER, linewidth=2.2, solid_capstyle="butt", zorder=3,
            gid="paper",
        )  # fmt: skip
        axes.annotate(
            f"{row.rate_percent:.2f}", (at + 0.42, row.rate_percent), (2, 0), textcoords="offset points", ha="left",
            va="center", size=8.5,
        )  # fmt: skip
    rates = [course.rate_percent(getattr(course, method)) for _, course in rows for method in ("eq2", "ours")]
    axes.set_ylim(0, 1.25 * float(np.nanmax([0.4, *rates])))
    axes.set_xlim(-0.6, places[-1] + 0.8)
    axes.set_xticks(places, [row.robot for row, _ in rows])
    axes.grid(False, axis="x")
    axes.set_ylabel("length error [%]")
    axes.locator_params(axis="y", nbins=5)
