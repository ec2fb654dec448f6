"""Figures of a result: trajectories from above, errors with predicted bands, residuals by stance.

Each function returns a `matplotlib.figure.Figure`: no pyplot, no global state. `figure_svg` writes one as text, the
same figure always as the same bytes.
"""

import io
import re
from collections.abc import Iterable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from scipy.special import chdtri

from coloc_graph.backend import Estimate
from coloc_graph.geometry.lie import se3_inverse, yaw
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.measurements import HomographyMeasurement
from coloc_graph.report.drawing import (
    BAD,
    COLOURS,
    GREY,
    INK,
    K_95,
    PALE,
    Array,
    Truth,
    bounds,
    colour_of,
    draw_ellipses,
    draw_headings,
    draw_landmarks,
    heading_sigmas,
    held_poses,
    marker_of,
    new_poses,
    position_sigmas,
    round_125,
    styled,
    thinned,
    trajectories_of,
    truth_of,
)

_WIDTH = 9.0  # in


@styled
def map_figure(estimate: Estimate, truth: Truth | None = None) -> Figure:
    """Return the paths of a ranging run and its landmarks with their 95 % ellipses, from above [m]."""
    figure = Figure(figsize=(_WIDTH, 8.0), layout="constrained")
    axes = figure.add_subplot(xlabel="x [m]", ylabel="y [m]")
    for number, trajectory in enumerate(trajectories_of(estimate)):
        true = truth_of(trajectory, truth)
        if true is not None:
            axes.plot(*true[:, :2, 3].T, color=GREY, linewidth=0.6, label=None if number else "truth")
        colour = colour_of(estimate, trajectory.robot)
        axes.plot(*trajectory.positions[:, :2].T, color=colour, linewidth=0.9, label=trajectory.robot)
    draw_landmarks(axes, estimate)
    axes.set_aspect("equal")
    axes.legend(loc="upper right", fontsize=8)
    return figure


@styled
def trajectories_figure(estimate: Estimate, truth: Truth | None = None) -> Figure:
    """Draw the team from above, world frame [m]: estimate and truth, headings, 95 % ellipses, rings on held poses.

    Ellipses that are too small to be seen are enlarged by the round factor in the legend. Raises `InputError` where
    `truth` has another number of poses than the estimate.
    """
    low, high = bounds(estimate, truth)
    size = np.maximum(high - low, 0.5)
    height = float(np.clip(0.95 * _WIDTH * size[1] / size[0] + 1.6, 2.8, 6.0))
    figure = Figure(figsize=(_WIDTH, height), layout="constrained")
    axes = figure.add_subplot(xlabel="x [m]", ylabel="y [m]")
    scale = _ellipse_scale(estimate, float(size.max()))
    for trajectory in trajectories_of(estimate):
        colour = colour_of(estimate, trajectory.robot)
        draw_ellipses(axes, trajectory, colour, scale)
        _draw_path(axes, estimate, trajectory)
        shown = thinned(new_poses(trajectory))
        draw_headings(axes, trajectory.T_world_body[shown], colour, 0.022 * float(size.max()))
        true = truth_of(trajectory, truth)
        if true is not None:
            axes.plot(*true[:, :2, 3].T, color=INK, linewidth=1.0, linestyle=(0, (4, 3)), zorder=5, gid="truth")
        _label_start(axes, trajectory, colour, above=_is_above(estimate, trajectory))
    draw_landmarks(axes, estimate, scale)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(x=0.05, y=0.12)
    figure.legend(handles=_legend(estimate, truth, scale), loc="outside upper left", ncols=6)
    return figure


def _draw_path(axes: Axes, estimate: Estimate, trajectory: Trajectory) -> None:
    colour, xy = colour_of(estimate, trajectory.robot), trajectory.positions[:, :2]
    every = thinned(np.arange(len(trajectory)), 200).tolist()
    size = 4.0 if len(trajectory) <= 200 else 2.0
    axes.plot(
        *xy.T, color=colour, linewidth=1.6, marker=marker_of(estimate, trajectory.robot), markersize=size,
        markevery=every, zorder=3, label=trajectory.robot,
    )  # fmt: skip
    held = thinned(held_poses(estimate, trajectory))
    axes.plot(
        *xy[held].T, linestyle="", marker="o", markersize=9.5, markerfacecolor="none", markeredgecolor=colour,
        markeredgewidth=0.9, zorder=4, gid="held",
    )  # fmt: skip


def _is_above(estimate: Estimate, trajectory: Trajectory) -> bool:
    """Return whether a robot starts above the team's middle, where its label then goes."""
    starts = [one.positions[0, 1] for one in trajectories_of(estimate)]
    return bool(trajectory.positions[0, 1] >= np.mean(starts))


def _label_start(axes: Axes, trajectory: Trajectory, colour: str, above: bool) -> None:
    axes.annotate(
        f"{trajectory.robot} start", trajectory.positions[0, :2].tolist(), (0, 10 if above else -10),
        textcoords="offset points", ha="center", va="bottom" if above else "top", color=colour, weight="bold", zorder=6,
    )  # fmt: skip


def _ellipse_scale(estimate: Estimate, extent: float) -> float:
    """Return 1, or the round factor that makes the largest ellipse's half axis about a fortieth of the figure."""
    sigmas = np.concatenate([[0.0], *[position_sigmas(one) for one in trajectories_of(estimate)]])
    largest = K_95 * float(np.nanmax(sigmas))
    if largest <= 0 or largest > 0.01 * extent:
        return 1.0
    return round_125(extent / 40 / largest)


def _legend(estimate: Estimate, truth: Truth | None, scale: float) -> list[Line2D | Patch]:
    handles: list[Line2D | Patch] = []
    for one in trajectories_of(estimate):
        colour, marker = colour_of(estimate, one.robot), marker_of(estimate, one.robot)
        handles.append(Line2D([], [], color=colour, marker=marker, markersize=4, label=one.robot))
    if truth:
        handles.append(Line2D([], [], color=INK, linewidth=1, linestyle=(0, (4, 3)), label="truth"))
    if any(len(held_poses(estimate, one)) for one in trajectories_of(estimate)):
        ring = Line2D([], [], linestyle="", marker="o", markersize=9, markeredgecolor=GREY, label="stayed put")
        ring.set_markerfacecolor("none")
        handles.append(ring)
    if estimate.landmarks:
        handles.append(Line2D([], [], linestyle="", marker="*", markersize=8, color=INK, label="landmark"))
    if any(np.isfinite(position_sigmas(one)).any() for one in trajectories_of(estimate)):
        drawn = f", {scale:g} times enlarged" if scale > 1 else ""
        handles.append(Patch(facecolor=GREY + "40", edgecolor=GREY, label=f"95 % ellipse{drawn}"))
    return handles


@styled
def error_figure(estimate: Estimate, truth: Truth | None = None) -> Figure:
    """Draw errors of position (x, y) [cm] and heading [deg] by each robot's own estimated path length [m].

    Bands are the predicted 2 sigma, of the position in its worst direction; without truth they are drawn alone. Raises
    `InputError` where `truth` has another number of poses than the estimate.
    """
    figure = Figure(figsize=(_WIDTH, 4.6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    any_truth = False
    for trajectory in trajectories_of(estimate):
        xy = trajectory.positions[:, :2]
        travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
        off, turned = _errors(trajectory, truth_of(trajectory, truth))
        any_truth |= off is not None
        position, heading = 200 * position_sigmas(trajectory), 2 * np.rad2deg(heading_sigmas(trajectory))
        _draw_error(above, estimate, trajectory.robot, travelled, off, np.zeros_like(position), position)
        _draw_error(below, estimate, trajectory.robot, travelled, turned, -heading, heading)
    if above.get_xlim()[1] < 0.1:
        above.set_xlim(-0.5, 0.5)  # no robot moved
    above.set_ylim(bottom=0)
    below.axhline(0, color=GREY, linewidth=0.8)
    what = "error" if any_truth else "predicted 2σ"
    above.set_ylabel(f"position {what} [cm]")
    below.set_ylabel(f"heading {what} [°]")
    below.set_xlabel("distance travelled, along the robot's estimated path [m]")
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=colour_of(estimate, one.robot), label=one.robot) for one in trajectories_of(estimate)
    ]
    handles.append(Patch(facecolor=GREY + "33", edgecolor=GREY, linestyle=":", label="predicted 2σ"))
    figure.legend(handles=handles, loc="outside upper left", ncols=8)
    return figure


def _errors(trajectory: Trajectory, true: Array | None) -> tuple[Array | None, Array | None]:
    """Distance in x, y [cm] and heading error [deg], each (n,)."""
    if true is None:
        return None, None
    off = 100 * np.linalg.norm(trajectory.positions[:, :2] - true[:, :2, 3], axis=1)
    turned = np.rad2deg(yaw(se3_inverse(true) @ trajectory.T_world_body))
    return np.asarray(off), np.asarray(turned)


def _draw_error(
    axes: Axes, estimate: Estimate, robot: str, x: Array, error: Array | None, low: Array, high: Array
) -> None:
    colour = colour_of(estimate, robot)
    axes.fill_between(x, low, high, color=colour, alpha=0.13, linewidth=0)
    if x[-1] == 0:  # a band without width would not be seen
        axes.vlines(x[-1:], low[-1:], high[-1:], color=colour, alpha=0.3, linewidth=8)
    for edge in (low, high):
        if np.any(edge):
            axes.plot(x, edge, color=colour, linewidth=0.9, linestyle=":", gid="sigma")
    if error is not None:
        marker = marker_of(estimate, robot) if len(x) <= 200 else ""
        axes.plot(x, error, color=colour, linewidth=1.6, marker=marker, markersize=3.5, label=robot)


@styled
def residual_figure(measurements: Iterable[HomographyMeasurement]) -> Figure:
    """Draw, by stance, the RMS residual in units of the noise (1 is expected), and the numbers of points and inliers.

    A grey bar is the 95 % interval by noise alone; a cross on the axis is an unusable measurement.
    """
    measured = list(measurements)
    good = [one for one in measured if one.unusable is None]
    bad = [one for one in measured if one.unusable is not None]
    stance = np.array([one.stance for one in good], float)
    size = 26 if len(measured) <= 200 else 6
    figure = Figure(figsize=(_WIDTH, 4.2), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)

    dof = np.array([max(one.dof, 1) for one in good], float)
    low, high = (np.sqrt(chdtri(dof, p) / dof) for p in (0.975, 0.025))
    _bars(above, stance, low, high, len(measured))
    above.axhline(1, color=GREY, linewidth=0.9, linestyle="--")
    above.scatter(stance, [one.residual for one in good], s=size, color=COLOURS[0], zorder=3)
    above.set_ylabel("RMS residual [noise]")

    points, inliers = ([getattr(one, name) for one in good] for name in ("points", "inliers"))
    _bars(below, stance, np.array(inliers, float), np.array(points, float), len(measured))
    below.scatter(stance, points, s=size, marker="_", color=GREY, zorder=3)
    below.scatter(stance, inliers, s=size, color=COLOURS[0], zorder=3)
    below.set_ylabel("points")
    below.set_xlabel("stance")
    numbers = [one.stance for one in measured] or [0]
    below.set_xlim(min(numbers) - 0.7, max(numbers) + 0.7)
    below.xaxis.set_major_locator(MaxNLocator(integer=True))
    for axes in (above, below):
        axes.set_ylim(bottom=0, top=max(1.5 if axes is above else 1.0, 1.08 * axes.get_ylim()[1]))
        at = [one.stance for one in bad]
        axes.scatter(at, np.zeros(len(at)), marker="x", s=36, color=BAD, linewidths=1.8, clip_on=False, zorder=5)
    figure.legend(handles=_residual_legend(bool(bad)), loc="outside upper left", ncols=4)
    return figure


def _bars(axes: Axes, x: Array, low: Array, high: Array, count: int) -> None:
    lines = np.stack([np.stack([x, x], axis=1), np.stack([low, high], axis=1)], axis=2)
    width = float(np.clip(300 / max(count, 1), 0.6, 9))
    axes.add_collection(LineCollection(list(lines), colors=PALE, linewidths=width, capstyle="butt", zorder=1))


def _residual_legend(any_bad: bool) -> list[Line2D | Patch]:
    handles: list[Line2D | Patch] = [
        Line2D([], [], linestyle="", marker="o", markersize=5, color=COLOURS[0], label="residual; inliers"),
        Line2D([], [], linestyle="", marker="_", markersize=8, color=GREY, label="all points"),
        Patch(facecolor=PALE, label="95 % interval by noise alone; outliers"),
    ]
    if any_bad:
        handles.append(Line2D([], [], linestyle="", marker="x", markersize=6, color=BAD, label="not used"))
    return handles


@styled
def figure_svg(figure: Figure, name: str = "figure") -> str:
    """Return the figure as an <svg> element for HTML: ids begin with `name`, nothing refers outside."""
    out = io.StringIO()
    metadata = {"Date": None, "Creator": None, "Format": None, "Type": None}
    # drawn once: `savefig` would draw twice, the first time for the layout, which drawing makes anyway
    FigureCanvasSVG(figure).print_svg(out, metadata=metadata)  # type: ignore[no-untyped-call]
    svg = out.getvalue()
    svg = svg[svg.index("<svg") :].strip()
    svg = re.sub(r"\s*<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    return _with_ids_of_its_own(svg, name)


def _with_ids_of_its_own(svg: str, name: str) -> str:
    """Keep the ids that something refers to, once each (matplotlib repeats equal definitions), under `name`."""
    wanted = set(re.findall(r'(?:href="#|url\(#)([^")]+)', svg))

    def keep(match: re.Match[str]) -> str:
        if match[1] not in wanted:
            return ""
        wanted.remove(match[1])
        return f' id="{name}-{match[1]}"'

    svg = re.sub(r'\sid="([^"]*)"', keep, svg)
    return re.sub(r'(href="#|url\(#)', rf"\g<1>{name}-", svg)
