"""The README's figure: a team leap-frogs down a hallway."""

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, ConnectionPatch, FancyArrowPatch, Rectangle, Wedge

from coloc_graph.backend import Estimate
from coloc_graph.geometry.lie import floor_pose, yaw
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.measurements import Odometry
from coloc_graph.report.drawing import (
    GREY,
    INK,
    K_95,
    Array,
    Truth,
    bounds,
    colour_of,
    draw_ellipses,
    draw_headings,
    marker_of,
    new_poses,
    position_sigmas,
    styled,
    thinned,
    trajectories_of,
    truth_of,
)

BODY_RADIUS = 0.16  # m, of a robot as drawn: the paper's iRobot Create
# m, margins about the poses, with the cameras' views ahead
_BEFORE = np.array([0.35, 0.3])
_AHEAD = np.array([0.75, 0.3])
_FLOOR = "#f4f6f8"
_TRUTH: dict[str, Any] = {"color": INK, "linewidth": 1.0, "linestyle": (0, (4, 3))}


@styled
def hero_figure(estimate: Estimate, truth: Truth | None = None, fov_deg: float = 56.0) -> Figure:
    """Draw a wide (2:1) figure of a run: all of it from above, its first leaps, its last pose.

    Parameters
    ----------
    estimate : Estimate
        Of a run with stances.
    truth : mapping of str to (n, 4, 4) float, optional
        True poses by robot.
    fov_deg : float
        Horizontal field of view of the cameras, drawn along the robots' headings.

    Raises
    ------
    InputError
        `truth` has another number of poses than the estimate.
    """
    estimate, truth = _along_x(estimate, truth)
    figure = Figure(figsize=(12, 6), facecolor="white")
    whole = _panel(figure, (0.03, 0.505, 0.94, 0.365))
    first = _panel(figure, (0.03, 0.065, 0.445, 0.355))
    end = _panel(figure, (0.7925, 0.065, 0.1775, 0.355))
    trajectories = trajectories_of(estimate)
    low, high = bounds(estimate, truth)
    _frame(whole, low - _BEFORE, high + _AHEAD)
    for trajectory in trajectories:
        _draw_whole(whole, estimate, trajectory, truth_of(trajectory, truth), fov_deg)
    _scale_bar(whole, 1.0, "1 m", at=0.55)
    _draw_first_leaps(first, estimate, truth, fov_deg)
    if trajectories:
        last = max(trajectories, key=_distance_and_sigma)
        _draw_end(end, estimate, last, truth_of(last, truth))
        _connect(figure, whole, first, box=True)
        _connect(figure, whole, end, box=False)
    _write_text(figure, estimate, truth)
    return figure


def _along_x(estimate: Estimate, truth: Truth | None) -> tuple[Estimate, Truth | None]:
    """Rotate estimate and truth about the world's z so that the team travels to the right."""
    ways = [one.positions[-1] - one.positions[0] for one in trajectories_of(estimate)]
    x, y, _ = np.sum([np.zeros(3), *ways], axis=0)
    T_picture_world = floor_pose(0.0, 0.0, -np.arctan2(y, x))
    turned = {
        robot: replace(one, T_world_body=T_picture_world @ one.T_world_body)
        for robot, one in estimate.trajectories.items()
    }
    true = None if truth is None else {robot: T_picture_world @ T for robot, T in truth.items()}
    return replace(estimate, trajectories=turned), true


def _distance_and_sigma(one: Trajectory) -> tuple[float, float]:
    """Return the distance that a robot travelled, to the centimetre, and the uncertainty of its last pose [m]."""
    sigma = float(np.nan_to_num(position_sigmas(one)[-1]))
    return round(float(np.linalg.norm(one.positions[-1] - one.positions[0])), 2), sigma


def _panel(figure: Figure, box: tuple[float, float, float, float]) -> Axes:
    axes = figure.add_axes(box, facecolor=_FLOOR, xticks=[], yticks=[])
    axes.spines[:].set(visible=True, color="#d0d7de", linewidth=0.8)
    return axes


def _frame(axes: Axes, low: Array, high: Array) -> None:
    """Show at least this part of the world [m], x and y to the same scale, and a faint grid of metres."""
    box = axes.get_position()
    figure = axes.figure
    aspect = box.width * figure.get_figwidth() / (box.height * figure.get_figheight())  # type: ignore[union-attr]
    middle, size = (low + high) / 2, high - low
    half = max(float(size[0]), float(size[1]) * aspect) / 2
    axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half / aspect, middle[1] + half / aspect))
    axes.set_aspect("equal", adjustable="box")


def _draw_whole(axes: Axes, estimate: Estimate, trajectory: Trajectory, true: Array | None, fov_deg: float) -> None:
    colour, xy = colour_of(estimate, trajectory.robot), trajectory.positions[:, :2]
    poses = new_poses(trajectory)
    for index in thinned(poses, 6):
        _draw_camera(axes, trajectory.T_world_body[index], colour, fov_deg, 0.55, 0.13)
    shown = thinned(poses).tolist()
    axes.plot(
        *xy.T, color=colour, linewidth=2.2, marker=marker_of(estimate, trajectory.robot), markersize=6,
        markevery=shown, markeredgecolor="white", markeredgewidth=0.8, zorder=4,
    )  # fmt: skip
    draw_headings(axes, trajectory.T_world_body[shown], colour, 0.13, 1.6)
    if true is not None:
        axes.plot(*true[:, :2, 3].T, **_TRUTH, zorder=5)
    axes.annotate(
        trajectory.robot, xy[0].tolist(), (-13, 0), textcoords="offset points", ha="right", va="center", color=colour,
        size=14, weight="bold", zorder=6,
    )  # fmt: skip


def _draw_camera(axes: Axes, T: Array, colour: str, fov_deg: float, reach: float, alpha: float) -> None:
    heading = float(np.rad2deg(yaw(T)))
    cone = (heading - fov_deg / 2, heading + fov_deg / 2)
    axes.add_patch(Wedge(tuple(T[:2, 3]), reach, *cone, color=colour, alpha=alpha, linewidth=0, zorder=1))


def _first_poses(trajectory: Trajectory, count: int = 5) -> Array:
    return np.asarray(trajectory.T_world_body[new_poses(trajectory)[:count]])


def _draw_first_leaps(axes: Axes, estimate: Estimate, truth: Truth | None, fov_deg: float) -> None:
    """Draw the first five poses of each robot as bodies, with their cameras, and arrows from each to the next."""
    trajectories = trajectories_of(estimate)
    seen = np.concatenate([np.zeros((0, 2)), *[_first_poses(one)[:, :2, 3] for one in trajectories]])
    if len(seen):
        _frame(axes, seen.min(axis=0) - _BEFORE, seen.max(axis=0) + _AHEAD)
    side_of = [one.positions[0, 1] for one in trajectories]
    for trajectory in trajectories:
        colour, poses = colour_of(estimate, trajectory.robot), _first_poses(trajectory)
        side = 1 if trajectory.positions[0, 1] >= np.mean(side_of) else -1
        for number, T in enumerate(poses):
            last = number == len(poses) - 1
            _draw_camera(axes, T, colour, fov_deg, 0.75, 0.14 if last else 0.07)
            _draw_body(axes, T, colour, "white" if not last else colour)
        for T, T_next in itertools.pairwise(poses):
            here, there = (tuple(one[:2, 3] + (0, 1.15 * BODY_RADIUS * side)) for one in (T, T_next))
            arc = f"arc3,rad={-0.5 * side}"
            look: dict[str, Any] = {"mutation_scale": 12, "color": colour, "linewidth": 1.4, "zorder": 6}
            axes.add_patch(FancyArrowPatch(here, there, connectionstyle=arc, arrowstyle="-|>", **look))
        true = truth_of(trajectory, truth)
        if true is not None:
            axes.plot(*true[:, :2, 3].T, **_TRUTH, zorder=5)


def _draw_body(axes: Axes, T: Array, colour: str, face: str) -> None:
    axes.add_patch(Circle(tuple(T[:2, 3]), BODY_RADIUS, facecolor=face, edgecolor=colour, linewidth=1.6, zorder=3))
    draw_headings(axes, T[None], colour if face == "white" else "white", BODY_RADIUS, 2.0)


def _draw_end(axes: Axes, estimate: Estimate, trajectory: Trajectory, true: Array | None) -> None:
    """Draw the last pose: estimate with its 95 % ellipse, and truth."""
    colour, xy = colour_of(estimate, trajectory.robot), trajectory.positions[-1, :2]
    off = 0.0 if true is None else float(np.linalg.norm(true[-1, :2, 3] - xy))
    sigma = float(np.nan_to_num(position_sigmas(trajectory)[-1]))
    reach = 1.5 * max(K_95 * sigma, off, 0.002)
    _frame(axes, xy - reach, xy + reach)
    draw_ellipses(axes, trajectory.where(np.arange(len(trajectory)) == len(trajectory) - 1), colour)
    axes.plot(*xy, marker=marker_of(estimate, trajectory.robot), markersize=8, color=colour, markeredgecolor="white")
    if true is not None:
        axes.plot(*true[-1, :2, 3], marker="+", markersize=13, color=INK, markeredgewidth=1.6, zorder=6)
    step = 10.0 ** np.floor(np.log10(reach))
    _scale_bar(axes, step, f"{100 * step:g} cm" if step >= 0.01 else f"{1000 * step:g} mm")


def _scale_bar(axes: Axes, length: float, label: str, at: float = 0.97) -> None:
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    x, y = left + at * (right - left), low + 0.08 * (high - low)
    axes.plot([x - length, x], [y, y], color=GREY, linewidth=2, solid_capstyle="butt", zorder=7)
    axes.annotate(label, (x - length / 2, y), (0, 3), textcoords="offset points", ha="center", color=GREY, size=9)


def _connect(figure: Figure, whole: Axes, part: Axes, box: bool) -> None:
    """Outline the region of an inset in the whole figure, and draw lines between both."""
    (left, right), (low, high) = part.get_xlim(), part.get_ylim()
    if box:
        (min_x, max_x), (min_y, max_y) = whole.get_xlim(), whole.get_ylim()
        left, right = max(left, min_x), min(right, max_x)
        low, high = max(low, min_y), min(high, max_y)
        whole.add_patch(Rectangle((left, low), right - left, high - low, fill=False, edgecolor=GREY, linewidth=0.8))
        pairs = [((left, low), (0.0, 1.0)), ((right, low), (1.0, 1.0))]
    else:
        middle = ((left + right) / 2, (low + high) / 2)
        pairs = [(middle, (0.0, 1.0)), (middle, (1.0, 1.0))]
    for at, corner in pairs:
        line = ConnectionPatch(at, corner, whole.transData, part.transAxes, color="#afb8c1", linewidth=0.7, zorder=9)
        figure.add_artist(line)


def _write_text(figure: Figure, estimate: Estimate, truth: Truth | None) -> None:
    trajectories = trajectories_of(estimate)
    stances = len(estimate.graph.stances)
    lengths = [float(np.linalg.norm(one.positions[-1] - one.positions[0])) for one in trajectories]
    count = {1: "One robot", 2: "Two robots", 3: "Three robots"}.get(len(lengths), f"{len(lengths)} robots")
    way = [f"{max(lengths):.1f} m"] if lengths and max(lengths) > 0.05 else []
    title = [count, *way, f"{stances} stance{'s' * (stances != 1)}", "no GPS"]
    figure.text(0.03, 0.915, "  ·  ".join(title), size=20, weight="bold")
    small: dict[str, Any] = {"size": 10, "color": GREY}
    wheels = any(isinstance(one, Odometry) for one in estimate.graph.measurements)
    by = "from cameras, LED markers and wheels" if wheels else "from cameras and LED markers alone"
    figure.text(0.97, 0.9, by, ha="right", **small)
    figure.text(0.03, 0.02, "While one stays put, the other leaps ahead; their cameras watch a third.", **small)
    if trajectories:
        cross = ", + truth" if truth else ""
        figure.text(0.97, 0.02, f"Last pose: 95 % ellipse{cross}", ha="right", **small)
    y = 0.385
    for one, length in zip(trajectories[:3], lengths, strict=False):
        colour, true = colour_of(estimate, one.robot), truth_of(one, truth)
        big, note = f"{one.robot}  {100 * length:.1f} cm", f"± {200 * position_sigmas(one)[-1]:.1f} cm predicted (2σ)"
        if true is not None:
            right = float(np.linalg.norm(true[-1, :3, 3] - true[0, :3, 3]))
            rate = f", {100 * abs(length - right) / right:.2f} %" if right > 0.05 else ""
            note = f"true {100 * right:.1f} cm, length error {100 * abs(length - right):.1f} cm{rate}"
        figure.text(0.505, y, big, size=18, weight="bold", color=colour, va="center")
        figure.text(0.505, y - 0.045, note, size=10, va="center")
        y -= 0.105
    handles = [Line2D([], [], color=colour_of(estimate, one.robot), linewidth=2.2) for one in trajectories[:1]]
    labels = ["estimate"] * len(handles)
    if truth:
        handles.append(Line2D([], [], **_TRUTH))
        labels.append("truth")
    figure.legend(handles, labels, loc="lower left", bbox_to_anchor=(0.495, 0.045), ncols=2)
