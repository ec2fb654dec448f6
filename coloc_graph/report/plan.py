"""Figures of plans: where the robots stand, where the mover drives, and the promised uncertainty; `plan_figure`."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from coloc_graph.planning.floor_map import FloorMap
from coloc_graph.planning.mission import Mission
from coloc_graph.report.drawing import COLOURS, GREY, INK, K_95, PALE, styled

ENLARGED = 10.0  # ellipses are drawn this much larger than they are
ARROW = 0.22  # length of an arrow that shows where a camera looks [m]


@styled
def plan_figure(missions: Sequence[tuple[str, Mission]], floor_map: FloorMap | None = None) -> Figure:
    """Draw plans one above the other, each with its name and what it promises.

    Parameters
    ----------
    missions
        Name and mission of each plan.
    floor_map
        Walls to draw, too; None for none.
    """
    height = 2.6 if floor_map is None else 6.0
    figure = Figure(figsize=(11, height * len(missions) + 0.3), layout="constrained")
    axes = figure.subplots(len(missions), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for axis, (name, mission) in zip(axes, missions, strict=True):
        if floor_map is not None:
            rows, columns = floor_map.distance.shape
            x, y = floor_map.origin
            extent = x, x + columns * floor_map.resolution, y, y + rows * floor_map.resolution
            axis.imshow(floor_map.distance <= 0, extent=extent, origin="lower", cmap="Greys", alpha=0.4, zorder=-1)
        _draw(axis, mission)
        axis.set_title(
            f"{name}: {len(mission.plan.stances)} stances, {mission.duration:.0f} s; promised at the end "
            f"{1e3 * mission.end_sigma:.1f} mm and {np.degrees(mission.heading_sigma):.3f} deg (1 sigma)",
            loc="left",
            color=INK,
        )
        axis.set_ylabel("y [m]")
    axes[-1].set_xlabel(f"x [m]; ellipses: 95 %, enlarged {ENLARGED:g} times; lines: the mover's drives")
    return figure


def _draw(axis: Axes, mission: Mission) -> None:
    robots = mission.plan.observers
    stances = mission.plan.stances
    shades = np.linspace(0.35, 1.0, len(stances))
    for stance, promise, shade in zip(stances, mission.promises, shades, strict=True):
        x, y = np.array(stance.waypoints).T
        axis.plot(x, y, color=COLOURS[2], alpha=0.35 * shade + 0.1, linewidth=1.0)
        axis.plot(x[0], y[0], ".", color=COLOURS[2], alpha=shade, markersize=4)
        for name, (px, py, yaw) in stance.standing.items():
            colour = COLOURS[robots.index(name) if robots.index(name) < 2 else 3]
            if name in stance.leapers or not stance.anchors:
                axis.annotate(
                    "", (px + ARROW * np.cos(yaw), py + ARROW * np.sin(yaw)), (px, py),
                    arrowprops={"arrowstyle": "->", "color": colour, "alpha": float(shade)},
                )  # fmt: skip
                axis.plot(px, py, "o", color=colour, markersize=4)
                values, vectors = np.linalg.eigh(promise.belief.position_covariance(name))
                width, height = 2 * ENLARGED * K_95 * np.sqrt(np.maximum(values, 0.0))
                angle = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
                axis.add_patch(Ellipse((px, py), width, height, angle=angle, facecolor="none", edgecolor=colour))
    for name in robots:
        positions = np.array([stance.standing[name][:2] for stance in stances if name in stance.standing])
        axis.plot(*positions.T, color=PALE, zorder=0)
        axis.annotate(name, positions[0], xytext=(-12, 0), textcoords="offset points", color=GREY)
    axis.set_aspect("equal")
    axis.margins(x=0.02, y=0.1)
