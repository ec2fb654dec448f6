"""Figs. 4 and 5 as pictures."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, MultipleLocator

from coloc_graph.experiments.paper import BIN_CM, FIG4_MEAN_CM, fig4_within_1cm
from coloc_graph.experiments.single_step import Cell
from coloc_graph.experiments.single_step_results import Fig4, Fig5, estimates_of, histogram
from coloc_graph.experiments.style import DEPTHS, EQ2, EQ2_LABEL, EQ2_MARKER, OURS, OURS_LABEL, OURS_MARKER, titled
from coloc_graph.report.drawing import GREY, styled

#: What the paper says, over a dark map: bright and warm, which viridis is nowhere.
_PAPER = "#ff7f50"
_MAP = "viridis"


@styled
def fig4_figure(result: Fig4) -> Figure:
    """Eight panels: eq. (2) above, ours below, one column a distance l.

    x is the angle [deg], y the error in bins of 0.5 cm, the colour how many runs fell into a bin, a white
    circle the mean. Orange is what the paper's text says of its own means.
    """
    baselines = sorted({cell.baseline for cell in result.cells})
    figure = Figure(figsize=(2.72 * max(len(baselines), 2) + 1.1, 6.7))
    width, height = figure.get_size_inches()
    grid = figure.add_gridspec(
        2, len(baselines), left=0.95 / width, right=1 - 0.85 / width, bottom=0.85 / height, top=1 - 1.12 / height,
        wspace=0.2, hspace=0.17,
    )  # fmt: skip
    mesh, beyond = None, 0
    for column, baseline in enumerate(baselines):
        cells = sorted((c for c in result.cells if c.baseline == baseline), key=lambda c: c.theta_deg)
        counts = {method: _counts(cells, method) for method in ("eq2", "ours")}
        top = _top(counts)
        beyond += sum(int(one[top:].sum()) for one in counts.values())
        for row, method in enumerate(("eq2", "ours")):
            axes = figure.add_subplot(grid[row, column])
            mesh = _draw_histogram(axes, counts[method], top, result.runs)
            _draw_means(axes, cells, method)
            _draw_paper(axes, cells)
            axes.set_xticks(range(len(cells)), [f"{cell.theta_deg:.0f}°" for cell in cells])
            if row == 0:
                axes.set_title(f"l = {100 * baseline:.0f} cm", size=11)
            if column == 0:
                label = EQ2_LABEL if method == "eq2" else OURS_LABEL
                axes.set_ylabel("error |l_est − l| [cm]")
                middle = axes.get_position().y0 + axes.get_position().height / 2
                figure.text(0.14 / width, middle, label, rotation=90, size=12, weight="bold", va="center")
    assert mesh is not None
    bar = figure.add_axes((1 - 0.7 / width, 0.85 / height, 0.14 / width, 1 - 1.97 / height))
    figure.colorbar(mesh, cax=bar, label=f"runs, of {result.runs}")
    bar.grid(False)
    titled(
        figure,
        "Error of the distance between two robots from one step (the paper's Fig. 4)",
        f"{result.runs} runs of {result.draws} points a cell, bins of {BIN_CM} cm, one world of seed {result.seed}, "
        f"{DEPTHS[result.depth]}. Both rows use the same points. {beyond} of {2 * len(result.cells) * result.runs} "
        "runs lie above the panels.",
    )
    figure.text(0.5, 0.38 / height, "angle θ between the robots", ha="center", color="#24292f")
    _legend(figure)
    return figure


def _counts(cells: Sequence[Cell], method: str) -> np.ndarray[tuple[int, int], np.dtype[np.int64]]:
    """Counts (bins, cells)."""
    each = [histogram(cell.errors_cm(estimates_of(cell, method))) for cell in cells]
    out = np.zeros((max(map(len, each)), len(cells)), np.int64)
    for column, one in enumerate(each):
        out[: len(one), column] = one
    return out


def _draw_histogram(
    axes: Axes, counts: np.ndarray[tuple[int, int], np.dtype[np.int64]], top: int, runs: int
) -> QuadMesh:
    padded = np.zeros((top, counts.shape[1]))
    padded[: len(counts)] = counts[:top]
    x, y = np.arange(counts.shape[1] + 1) - 0.5, np.arange(top + 1) * BIN_CM
    mesh = axes.pcolormesh(x, y, padded, cmap=_MAP, norm=PowerNorm(0.5, 0, runs), rasterized=True)
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.vlines(x[1:-1], 0, y[-1], color="white", alpha=0.25, linewidth=0.6)
    axes.yaxis.set_major_locator(MultipleLocator(_step(y[-1])))
    return mesh


def _top(counts: dict[str, np.ndarray[tuple[int, int], np.dtype[np.int64]]]) -> int:
    """Number of bins that hold all but the last half per cent of a column's runs, and room for the means above."""
    longest = max(map(len, counts.values()))
    every = sum(np.pad(one.sum(axis=1), (0, longest - len(one))) for one in counts.values())
    shown = int(np.searchsorted(np.cumsum(every), 0.995 * np.sum(every))) + 1
    return int(np.ceil(1.12 * (shown + 1)))


def _step(height: float) -> float:
    return next(step for step in (0.5, 1.0, 2.0, 5.0, 10.0, 1e9) if height / step <= 8)


def _draw_means(axes: Axes, cells: Sequence[Cell], method: str) -> None:
    """White circles, and their numbers along the top."""
    means = [cell.mean_cm(estimates_of(cell, method)) for cell in cells]
    axes.plot(
        range(len(cells)), means, linestyle="", marker="o", markersize=6.5, markerfacecolor="#00000055",
        markeredgecolor="white", markeredgewidth=1.6, zorder=4, gid="mean", clip_on=False,
        path_effects=[withStroke(linewidth=3.2, foreground="#000000aa")],
    )  # fmt: skip
    for column, mean in enumerate(means):
        axes.annotate(
            f"{mean:.2f}", (column, 0.975), xycoords=axes.get_xaxis_transform(), ha="center", va="top", size=8.5,
            color="white", weight="bold", zorder=5, gid="mean-text",
        )  # fmt: skip


def _draw_paper(axes: Axes, cells: Sequence[Cell]) -> None:
    """The paper's mean where its text gives one, else on which side of 1 cm it says the mean is."""
    for column, cell in enumerate(cells):
        mean, within = FIG4_MEAN_CM.get((cell.baseline, cell.theta_deg)), fig4_within_1cm(cell.baseline, cell.theta_deg)
        if mean is not None:
            axes.plot([column - 0.42, column + 0.42], [mean, mean], color=_PAPER, linewidth=2.0, zorder=3, gid="paper")
        elif within is not None:
            axes.plot(
                [column], [1.0], color=_PAPER, marker="v" if within else "^", markersize=6, zorder=3, gid="paper"
            )  # fmt: skip
            axes.plot([column - 0.42, column + 0.42], [1, 1], color=_PAPER, linewidth=1.0, zorder=3)


def _legend(figure: Figure) -> None:
    mean = Line2D([], [], linestyle="", marker="o", markersize=6, markeredgecolor="#24292f", markeredgewidth=1.5)
    mean.set_markerfacecolor("none")
    handles = [
        mean,
        Line2D([], [], color=_PAPER, linewidth=2),
        Line2D([], [], color=_PAPER, linewidth=1, marker="v", markersize=6),
        Line2D([], [], color=_PAPER, linewidth=1, marker="^", markersize=6),
    ]
    labels = ["mean of the runs [cm]", "the paper's mean", "the paper: mean within 1 cm", "the paper: mean above 1 cm"]
    figure.legend(handles, labels, loc="lower center", ncols=4, bbox_to_anchor=(0.5, 0.0), borderaxespad=0.2)


@styled
def fig5_figure(result: Fig5, most: int = 60) -> Figure:
    """Error of each run [cm] against the pixels that both cameras see; large marks are the means of the cells.

    Of each cell at most `most` runs are drawn.
    """
    figure = Figure(figsize=(9.0, 5.4))
    axes = figure.add_axes((0.085, 0.115, 0.885, 0.745))
    rng = np.random.default_rng(0)
    looks = (("eq2", EQ2, EQ2_MARKER, EQ2_LABEL), ("ours", OURS, OURS_MARKER, OURS_LABEL))
    for method, colour, marker, label in looks:
        x, y = [], []
        for cell in result.cells:
            estimates = estimates_of(cell, method)
            errors = cell.errors_cm(estimates)
            drawn = rng.permutation(np.flatnonzero(np.isfinite(errors)))[:most]
            x.append(estimates.overlap_px[drawn] / 1000)
            y.append(errors[drawn])
        axes.scatter(
            np.concatenate(x), np.concatenate(y), s=7, marker=marker, color=colour, alpha=0.22, linewidths=0,
            rasterized=True, zorder=2, gid="runs",
        )  # fmt: skip
        means = [cell.mean_cm(estimates_of(cell, method)) for cell in result.cells]
        axes.scatter(
            [cell.overlap_px / 1000 for cell in result.cells], means, s=62, marker=marker, color=colour,
            edgecolors="white", linewidths=1.0, zorder=4, label=f"{label}, mean of a cell", gid="means",
        )  # fmt: skip
    axes.set_yscale("log")
    axes.set_ylim(0.01, None)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_xlabel("overlapping pixels, of 76 800 in an image [thousands]")
    axes.set_ylabel("error |l_est − l| [cm]")
    axes.axhline(1.0, color=GREY, linewidth=0.9, linestyle="--", zorder=1)
    dot = Line2D([], [], linestyle="", marker="o", markersize=3, color=GREY, alpha=0.5, label="single runs")
    axes.legend(handles=[*axes.get_legend_handles_labels()[0], dot], loc="upper right", markerscale=1.0)
    titled(
        figure,
        "The more pixels two cameras share, the smaller the error (the paper's Fig. 5)",
        f"{len(result.cells)} cells of l and θ, runs of {result.draws} points, one world of seed {result.seed}, "
        f"{DEPTHS[result.depth]}",
    )
    return figure
