"""Common parts of all figures: style, colours, ellipses, headings, selection of poses.

`truth` is, by robot, the true poses T_world_body (n, 4, 4) [m] in the estimate's world at the estimate's stances.
"""

from collections.abc import Mapping

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from numpy.typing import ArrayLike, NDArray

from coloc_graph.backend import Estimate
from coloc_graph.errors import InputError
from coloc_graph.geometry.lie import yaw
from coloc_graph.geometry.trajectory import Trajectory

Array = NDArray[np.float64]
Truth = Mapping[str, NDArray[np.float64]]

#: Okabe and Ito's colours that are visible on white; distinguishable with any colour vision.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
#: One marker per robot, so that colour is never the only difference.
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
INK = "#24292f"
GREY = "#6e7781"
PALE = "#d8dee4"
BAD = "#D55E00"
K_95 = float(np.sqrt(5.991464547107979))  # standard deviations to the ellipse that holds 95 % of a planar Gaussian
MAX_SHOWN = 80  # ellipses, ticks or rings per robot

_RC = {
    "svg.hashsalt": "coloc",
    "svg.fonttype": "none",
    "text.parse_math": False,
    "font.size": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#8c959f",
    "axes.labelcolor": INK,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#eaeef2",
    "grid.linewidth": 0.8,
    "text.color": INK,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "legend.frameon": False,
    "lines.solid_capstyle": "round",
}
#: Decorator of functions that make or write a figure: the user's own matplotlib settings have no effect.
styled = matplotlib.style.context(_RC, after_reset=True)


def colour_of(estimate: Estimate, robot: str) -> str:
    """Return the robot's colour, by its index in the team."""
    return COLOURS[_index(estimate, robot) % len(COLOURS)]


def marker_of(estimate: Estimate, robot: str) -> str:
    """Return the robot's marker, by its index in the team."""
    return MARKERS[_index(estimate, robot) % len(MARKERS)]


def _index(estimate: Estimate, robot: str) -> int:
    robots = estimate.source.robots
    return robots.index(robot) if robot in robots else len(robots)


def trajectories_of(estimate: Estimate) -> list[Trajectory]:
    """Return the trajectories that hold a pose, in the team's order."""
    return sorted(
        (one for one in estimate.trajectories.values() if len(one)), key=lambda one: _index(estimate, one.robot)
    )


def truth_of(trajectory: Trajectory, truth: Truth | None) -> Array | None:
    """Return the robot's true poses (n, 4, 4), None where there are none; `InputError` where their number differs."""
    true = None if truth is None else truth.get(trajectory.robot)
    if true is not None and true.shape != trajectory.T_world_body.shape:
        raise InputError(
            f"robot {trajectory.robot} has {len(trajectory)} estimated poses and truth of shape {true.shape}; "
            "give one true pose (4, 4) for each"
        )
    return true


def ellipse_points(mean: ArrayLike, cov: ArrayLike, k: float = K_95, count: int = 49) -> Array:
    """Return closed outlines (..., count, 2) of the `k`-sigma ellipses of covariances (..., 2, 2) about (..., 2)."""
    values, vectors = np.linalg.eigh(np.asarray(cov, float))
    # a row of `axes` is a semi-axis; rounding can make a tiny eigenvalue negative
    axes = k * np.sqrt(values.clip(min=0))[..., None] * np.swapaxes(vectors, -1, -2)
    angle = np.linspace(0, 2 * np.pi, count)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.asarray(np.asarray(mean, float)[..., None, :] + circle @ axes)


def world_covariances(trajectory: Trajectory) -> tuple[Array, Array]:
    """Return covariances of position (n, 3, 3) [m^2] and of rotation (n, 3, 3) [rad^2] along the world's axes.

    NaN where the trajectory has no covariance, or one that is not finite.
    """
    covariances = trajectory.covariances
    if covariances is None:
        covariances = np.full((len(trajectory), 6, 6), np.nan)
    R = trajectory.T_world_body[:, :3, :3]
    finite = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))[:, None, None]
    both = [R @ covariances[:, s, s] @ R.transpose(0, 2, 1) for s in (slice(3, 6), slice(0, 3))]
    return np.where(finite, both[0], np.nan), np.where(finite, both[1], np.nan)


def position_sigmas(trajectory: Trajectory) -> Array:
    """Standard deviation of x, y along the worst direction, (n,) [m]; NaN where there is no covariance."""
    planar = world_covariances(trajectory)[0][:, :2, :2]
    a, b, c = planar[:, 0, 0], planar[:, 1, 1], planar[:, 0, 1]
    largest = (a + b) / 2 + np.hypot((a - b) / 2, c)
    return np.asarray(np.sqrt(largest.clip(min=0)))


def heading_sigmas(trajectory: Trajectory) -> Array:
    """Standard deviation of the heading, (n,) [rad]; NaN where there is no covariance."""
    return np.asarray(np.sqrt(world_covariances(trajectory)[1][:, 2, 2].clip(min=0)))


def thinned(index: NDArray[np.int64], count: int = MAX_SHOWN) -> NDArray[np.int64]:
    """Return at most `count` of the indices, evenly spaced, the first and the last included."""
    if len(index) <= count:
        return index
    return np.asarray(index[np.linspace(0, len(index) - 1, count).round().astype(int)])


def round_125(value: float) -> float:
    """Round a number down to 1, 2, 5, 10, 20, ..."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)))


def new_poses(trajectory: Trajectory) -> NDArray[np.int64]:
    """Return indices of the poses that differ from the one before: a pose held over several stances counts once."""
    same = (trajectory.T_world_body[1:] == trajectory.T_world_body[:-1]).all(axis=(1, 2))
    return np.flatnonzero(np.concatenate([[True], ~same]))


def held_poses(estimate: Estimate, trajectory: Trajectory) -> NDArray[np.int64]:
    """Return indices of the poses that a stay-put constraint holds, each pose once."""
    if trajectory.stances is None:
        return np.empty(0, np.int64)
    held = [one.before for one in estimate.graph.stay_puts if one.robot == trajectory.robot]
    index = np.flatnonzero(np.isin(trajectory.stances, held))
    return index[np.isin(index, new_poses(trajectory))]


def draw_landmarks(axes: Axes, estimate: Estimate, scale: float = 1.0) -> None:
    """Draw each landmark as a star with its name and 95 % ellipse, `scale` times enlarged."""
    for name, placed in estimate.landmarks.items():
        x, y, _ = placed.planar
        outline = ellipse_points([x, y], placed.covariance_xy_yaw[:2, :2], K_95 * scale)
        axes.add_collection(
            PolyCollection([outline], facecolors=INK + "1a", edgecolors=INK + "80", linewidths=0.7, zorder=2)
        )
        axes.plot([x], [y], linestyle="", marker="*", markersize=9, color=INK, zorder=6, gid="landmark")
        axes.annotate(name, (x, y), (6, 5), textcoords="offset points", color=INK, fontsize=8, zorder=6)


def bounds(estimate: Estimate, truth: Truth | None) -> tuple[Array, Array]:
    """Return the minimum and maximum x, y [m] of all finite poses; the unit square about 0 where there are none."""
    points = [one.positions[:, :2] for one in trajectories_of(estimate)]
    points += [np.array([placed.planar[:2]]) for placed in estimate.landmarks.values()]
    points += [T[:, :2, 3] for one in trajectories_of(estimate) if (T := truth_of(one, truth)) is not None]
    every = np.concatenate([np.empty((0, 2)), *points])
    every = every[np.isfinite(every).all(axis=1)]
    if not len(every):
        return np.array([-0.5, -0.5]), np.array([0.5, 0.5])
    return every.min(axis=0), every.max(axis=0)


def draw_ellipses(axes: Axes, trajectory: Trajectory, colour: str, scale: float = 1.0) -> None:
    """Draw the 95 % ellipses of x, y, `scale` times enlarged."""
    index = thinned(new_poses(trajectory))
    planar = world_covariances(trajectory)[0][index, :2, :2]
    finite = np.isfinite(planar).all(axis=(1, 2))
    outlines = ellipse_points(trajectory.positions[index[finite], :2], planar[finite], K_95 * scale)
    axes.add_collection(
        PolyCollection(list(outlines), facecolors=colour + "26", edgecolors=colour + "b0", linewidths=0.7, zorder=2)
    )


def draw_headings(axes: Axes, T_world_body: Array, colour: str, length: float, width: float = 1.4) -> None:
    """Draw a tick of `length` [m] along the heading of each pose (n, 4, 4)."""
    start = T_world_body[:, :2, 3]
    heading = yaw(T_world_body)
    end = start + length * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    axes.add_collection(LineCollection(list(np.stack([start, end], axis=1)), colors=colour, linewidths=width, zorder=4))
