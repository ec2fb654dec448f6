"""What all figures share: style, colours, ellipses, headings, and which poses are worth drawing.

`truth` is, by robot, the true poses T_world_body (n, 4, 4) [m] in the estimate's world at the estimate's
stances. Tangent covariances are rotation first, in the body frame; they are turned into the world here.
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

#: Okabe and Ito's colours that stand out on white; told apart with any colour vision.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
#: A marker a robot, so that colour is never the only difference.
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
INK = "#24292f"
GREY = "#6e7781"
PALE = "#d8dee4"
BAD = "#D55E00"
#: Radius of the ellipse that holds 95 % of a planar Gaussian, in standard deviations.
K_95 = float(np.sqrt(5.991464547107979))
#: At most so many ellipses, ticks or rings a robot; more would be a smear.
MOST_SHOWN = 80

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
#: Decorates what makes or writes a figure: the user's own matplotlib settings change nothing.
styled = matplotlib.style.context(_RC, after_reset=True)


def colour_of(estimate: Estimate, robot: str) -> str:
    """The robot's colour: by its place in the team."""
    return COLOURS[_place(estimate, robot) % len(COLOURS)]


def marker_of(estimate: Estimate, robot: str) -> str:
    """The robot's marker: by its place in the team."""
    return MARKERS[_place(estimate, robot) % len(MARKERS)]


def _place(estimate: Estimate, robot: str) -> int:
    robots = estimate.source.robots
    return robots.index(robot) if robot in robots else len(robots)


def trajectories_of(estimate: Estimate) -> list[Trajectory]:
    """The trajectories that hold a pose, in the team's order."""
    return sorted(
        (one for one in estimate.trajectories.values() if len(one)), key=lambda one: _place(estimate, one.robot)
    )


def truth_of(trajectory: Trajectory, truth: Truth | None) -> Array | None:
    """The robot's true poses (n, 4, 4), None where there are none; `InputError` where their number differs."""
    true = None if truth is None else truth.get(trajectory.robot)
    if true is not None and true.shape != trajectory.T_world_body.shape:
        raise InputError(
            f"robot {trajectory.robot} has {len(trajectory)} estimated poses and truth of shape {true.shape}; "
            "give one true pose (4, 4) for each"
        )
    return true


def ellipse_points(mean: ArrayLike, cov: ArrayLike, k: float = K_95, count: int = 49) -> Array:
    """Closed outlines (..., count, 2) of the `k`-sigma ellipses of covariances (..., 2, 2) about (..., 2)."""
    values, vectors = np.linalg.eigh(np.asarray(cov, float))
    # a row of `axes` is a semi-axis; rounding can make a tiny eigenvalue negative
    axes = k * np.sqrt(values.clip(min=0))[..., None] * np.swapaxes(vectors, -1, -2)
    angle = np.linspace(0, 2 * np.pi, count)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.asarray(np.asarray(mean, float)[..., None, :] + circle @ axes)


def world_covariances(trajectory: Trajectory) -> tuple[Array, Array]:
    """Covariances of position (n, 3, 3) [m^2] and of rotation (n, 3, 3) [rad^2] along the world's axes.

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


def thinned(index: NDArray[np.int64], most: int = MOST_SHOWN) -> NDArray[np.int64]:
    """At most so many of the indices, evenly, first and last among them."""
    if len(index) <= most:
        return index
    return np.asarray(index[np.linspace(0, len(index) - 1, most).round().astype(int)])


def standing_places(trajectory: Trajectory) -> NDArray[np.int64]:
    """Indices of the poses that differ from the one before: a pose held over several stances counts once."""
    same = (trajectory.T_world_body[1:] == trajectory.T_world_body[:-1]).all(axis=(1, 2))
    return np.flatnonzero(np.concatenate([[True], ~same]))


def held_places(estimate: Estimate, trajectory: Trajectory) -> NDArray[np.int64]:
    """Indices of the poses that a stay-put constraint holds, each place once."""
    if trajectory.stances is None:
        return np.empty(0, np.int64)
    held = [one.before for one in estimate.graph.stay_puts if one.robot == trajectory.robot]
    index = np.flatnonzero(np.isin(trajectory.stances, held))
    return index[np.isin(index, standing_places(trajectory))]


def draw_landmarks(axes: Axes, estimate: Estimate, scale: float = 1.0) -> None:
    """A star a landmark with its name, and the 95 % ellipse of its place, its axes drawn `scale` times as long."""
    for name, placed in estimate.landmarks.items():
        x, y, _ = placed.planar
        outline = ellipse_points([x, y], placed.covariance_xy_yaw[:2, :2], K_95 * scale)
        axes.add_collection(
            PolyCollection([outline], facecolors=INK + "1a", edgecolors=INK + "80", linewidths=0.7, zorder=2)
        )
        axes.plot([x], [y], linestyle="", marker="*", markersize=9, color=INK, zorder=6, gid="landmark")
        axes.annotate(name, (x, y), (6, 5), textcoords="offset points", color=INK, fontsize=8, zorder=6)


def bounds(estimate: Estimate, truth: Truth | None) -> tuple[Array, Array]:
    """The least and greatest x, y [m] of all finite poses; the unit square about 0 where there are none."""
    points = [one.positions[:, :2] for one in trajectories_of(estimate)]
    points += [np.array([placed.planar[:2]]) for placed in estimate.landmarks.values()]
    points += [T[:, :2, 3] for one in trajectories_of(estimate) if (T := truth_of(one, truth)) is not None]
    every = np.concatenate([np.empty((0, 2)), *points])
    every = every[np.isfinite(every).all(axis=1)]
    if not len(every):
        return np.array([-0.5, -0.5]), np.array([0.5, 0.5])
    return every.min(axis=0), every.max(axis=0)


def draw_ellipses(axes: Axes, trajectory: Trajectory, colour: str, scale: float = 1.0) -> None:
    """95 % ellipses of x, y, their axes drawn `scale` times as long."""
    index = thinned(standing_places(trajectory))
    planar = world_covariances(trajectory)[0][index, :2, :2]
    finite = np.isfinite(planar).all(axis=(1, 2))
    outlines = ellipse_points(trajectory.positions[index[finite], :2], planar[finite], K_95 * scale)
    axes.add_collection(
        PolyCollection(list(outlines), facecolors=colour + "26", edgecolors=colour + "b0", linewidths=0.7, zorder=2)
    )


def draw_headings(axes: Axes, T_world_body: Array, colour: str, length: float, width: float = 1.4) -> None:
    """A tick of `length` [m] along the heading of each pose (n, 4, 4)."""
    start = T_world_body[:, :2, 3]
    heading = yaw(T_world_body)
    end = start + length * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    axes.add_collection(LineCollection(list(np.stack([start, end], axis=1)), colors=colour, linewidths=width, zorder=4))
