"""Figures of an estimate and truth: trajectories, errors over time, RPE by distance; in one file or three.

For trajectories of any origin; `plots` has the figures of a result with its graph.
"""

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import NullFormatter, ScalarFormatter

from coloc_graph.errors import InputError
from coloc_graph.evaluation import Accuracy, Alignment
from coloc_graph.geometry.lie import yaw
from coloc_graph.geometry.se2 import wrap
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.report.drawing import COLOURS, GREY, INK, MARKERS, Array, Truth, styled, world_covariances

_WIDTH = 9.0  # in
NAMES = ("trajectories", "errors", "rpe")  # figures; without the last one where no robot travelled far enough
SUFFIXES = (".png", ".svg", ".pdf")  # formats of pictures
_ALIGNED: dict[Alignment, str] = {
    "reference": "aligned by the reference robot's first pose",
    "team": "one rigid alignment of the team",
    "robot": "each robot aligned on its own",
    "none": "not aligned",
}

Drawing = Callable[[FigureBase], None]


def comparison_drawings(
    estimated: Mapping[str, Trajectory], true: Truth, accuracy: Accuracy, *, on_floor: bool
) -> dict[str, tuple[float, Drawing]]:
    """Return the figures by name: their heights [in] and the functions that draw them.

    Parameters
    ----------
    estimated : mapping of str to Trajectory
        Estimated poses by robot.
    true : mapping of str to (n, 4, 4) float
        True poses by `evaluation.align`, NaN where there is no truth.
    accuracy : Accuracy
        Of these; bands of 2 sigma are drawn where it has a NEES.
    on_floor : bool
        Draw no errors of z.
    """
    has_rpe = any(one.pairs for one in accuracy.relative)
    return {
        "trajectories": (
            _height_of_trajectories(estimated, true), lambda figure: _trajectories(figure, estimated, true, accuracy)
        ),
        "errors": (
            0.9 + 1.35 * len(estimated), lambda figure: _errors(figure, estimated, true, accuracy, on_floor=on_floor)
        ),
        **({"rpe": (3.2, lambda figure: _rpe(figure, accuracy))} if has_rpe else {}),
    }  # fmt: skip


@styled
def drawn(height: float, draw: Drawing) -> Figure:
    """Return a separate figure of a drawing, `height` [in] high."""
    figure = Figure(figsize=(_WIDTH, height), layout="constrained")
    draw(figure)
    return figure


def require_plot_path(out: str | Path, *, force: bool) -> None:
    """Raise `InputError` where plots cannot be written to `out`, a picture (.png, .svg, .pdf) or a folder."""
    out = Path(out)
    if out.suffix and out.suffix.lower() not in SUFFIXES and not out.is_dir():
        raise InputError(f"{out} is not a kind of picture; name one of {', '.join(SUFFIXES)}, or a folder")
    if out.suffix.lower() not in SUFFIXES and out.exists() and not out.is_dir():
        raise InputError(f"{out} exists and is not a folder; give another path, or remove it")
    if out.suffix.lower() in SUFFIXES and out.is_dir():
        raise InputError(f"{out} is a folder with the name of a picture; give another path")
    if not out.absolute().parent.is_dir():
        raise InputError(f"{out} cannot be written: its folder does not exist; make it, or give another path")
    existing = [path for path in _paths(out, NAMES) if path.exists()]
    if existing and not force:
        raise InputError(f"{existing[0]} exists; replace it with --force, or give another name")


@styled
def write_plots(out: str | Path, drawings: Mapping[str, tuple[float, Drawing]], *, force: bool) -> list[Path]:
    """Write the drawings into one picture, or one each into a folder, atomically, and return the paths.

    Raises `InputError` as `require_plot_path` does.
    """
    out = Path(out)
    require_plot_path(out, force=force)
    if out.suffix.lower() in SUFFIXES:
        heights = [height for height, _ in drawings.values()]
        whole = Figure(figsize=(_WIDTH, sum(heights)), layout="constrained")
        parts = whole.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
        for part, (_, draw) in zip(parts, drawings.values(), strict=True):
            draw(part)
        figures = [whole]
    else:
        out.mkdir(exist_ok=True)
        figures = []
        for height, draw in drawings.values():
            figures.append(Figure(figsize=(_WIDTH, height), layout="constrained"))
            draw(figures[-1])
    paths = _paths(out, tuple(drawings))
    with tempfile.TemporaryDirectory(prefix=".plots-", dir=out.absolute().parent) as work:
        for figure, path in zip(figures, paths, strict=True):
            figure.savefig(Path(work) / path.name, dpi=130, metadata=_WITHOUT_DATE[path.suffix.lower()])
        for path in paths:
            (Path(work) / path.name).replace(path)
    for path in set(_paths(out, NAMES)) - set(paths):
        path.unlink(missing_ok=True)  # left by an earlier comparison
    return paths


_WITHOUT_DATE: dict[str, dict[str, None]] = {
    ".png": {"Software": None},
    ".svg": {"Date": None},
    ".pdf": {"CreationDate": None},
}


def _paths(out: Path, names: tuple[str, ...]) -> list[Path]:
    return [out] if out.suffix.lower() in SUFFIXES else [out / f"{name}.png" for name in names]


def _height_of_trajectories(estimated: Mapping[str, Trajectory], true: Truth) -> float:
    every = np.concatenate([one.positions[:, :2] for one in estimated.values()])
    every = np.concatenate([every, *(poses[:, :2, 3] for poses in true.values())])
    size = np.maximum(np.nanmax(every, axis=0) - np.nanmin(every, axis=0), 0.5)
    return float(np.clip(0.95 * _WIDTH * size[1] / size[0] + 1.6, 2.8, 7.0))


def _trajectories(figure: FigureBase, estimated: Mapping[str, Trajectory], true: Truth, accuracy: Accuracy) -> None:
    """Draw the team from above, in the estimate's world."""
    axes = figure.add_subplot(xlabel="x [m]", ylabel="y [m]")
    handles = []
    for number, (robot, one) in enumerate(estimated.items()):
        colour, marker = COLOURS[number % len(COLOURS)], MARKERS[number % len(MARKERS)]
        xy = one.positions[:, :2]
        (line,) = axes.plot(*xy.T, color=colour, linewidth=1.6, zorder=3, label=robot, gid="estimate")
        axes.plot(*xy[:1].T, color=colour, marker=marker, markersize=7, linestyle="", zorder=4)
        axes.plot(*true[robot][:, :2, 3].T, color=INK, linewidth=1.0, linestyle=(0, (4, 3)), zorder=5, gid="truth")
        handles.append(line)
    axes.set_aspect("equal", adjustable="datalim")
    handles.append(Line2D([], [], color=INK, linewidth=1.0, linestyle=(0, (4, 3)), label="truth"))
    handles.append(Line2D([], [], color=GREY, marker="o", linestyle="", label="start"))
    figure.legend(handles=handles, loc="outside upper left", ncols=8)
    axes.set_title(f"{_ALIGNED[accuracy.alignment]}; ATE {100 * accuracy.ate:.2f} cm", fontsize=9.5, color=GREY)


def _errors(
    figure: FigureBase, estimated: Mapping[str, Trajectory], true: Truth, accuracy: Accuracy, *, on_floor: bool
) -> None:
    """Draw errors along the world's axes [cm] and of the heading [deg] over time, one row per robot."""
    columns = ["x", "y", *([] if on_floor else ["z"]), "heading"]
    grid = figure.subplots(len(estimated), len(columns), sharex=True, squeeze=False)
    begin = min(float(one.times[0]) for one in estimated.values())
    banded = accuracy.anees is not None  # otherwise the covariances are not of these errors
    any_band = False
    for number, (robot, one) in enumerate(estimated.items()):
        colour = COLOURS[number % len(COLOURS)]
        position, rotation = world_covariances(one)
        offs = 100 * (one.positions - true[robot][:, :3, 3])
        turned = yaw(one.T_world_body) - yaw(true[robot])
        values = [*offs.T[: len(columns) - 1], np.rad2deg(wrap(turned))]
        sigmas = [100 * np.sqrt(position[:, i, i].clip(min=0)) for i in range(len(columns) - 1)]
        sigmas.append(np.rad2deg(np.sqrt(rotation[:, 2, 2].clip(min=0))))
        for axes, value, sigma in zip(grid[number], values, sigmas, strict=True):
            if banded and np.isfinite(sigma).any():
                any_band = True
                _band(axes, one.times - begin, 2 * sigma, colour)
            marker = MARKERS[number % len(MARKERS)] if len(one) <= 60 else ""
            axes.plot(one.times - begin, value, color=colour, linewidth=1.4, marker=marker, markersize=3, gid="error")
            axes.axhline(0, color=GREY, linewidth=0.7)
        grid[number][0].set_ylabel(robot, rotation=0, ha="right", weight="bold", color=colour)
    for axes, name in zip(grid[0], columns, strict=True):
        axes.set_title(f"{name} [{'°' if name == 'heading' else 'cm'}]", fontsize=9.5)
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    if any_band:
        band = Patch(facecolor=GREY + "33", edgecolor=GREY, linestyle=":", label="predicted 2σ")
        figure.legend(handles=[Line2D([], [], color=GREY, label="estimate less truth"), band], loc="outside upper left",
                      ncols=2)  # fmt: skip


def _band(axes: Axes, times: Array, reach: Array, colour: str) -> None:
    axes.fill_between(times, -reach, reach, color=colour, alpha=0.13, linewidth=0, gid="sigma")
    for edge in (-reach, reach):
        axes.plot(times, edge, color=colour, linewidth=0.8, linestyle=":")


def _rpe(figure: FigureBase, accuracy: Accuracy) -> None:
    """Draw relative errors by distance: translation in % of it, and rotation."""
    left, right = figure.subplots(1, 2)
    rows = [(row.robot, row.relative, COLOURS[number % len(COLOURS)], MARKERS[number % len(MARKERS)], 1.2)
            for number, row in enumerate(accuracy.robots)]  # fmt: skip
    if len(rows) > 1:
        rows.append(("team", accuracy.relative, INK, "o", 2.2))
    for name, relative, colour, marker, width in rows:
        there = [one for one in relative if one.pairs]
        distance = [one.distance for one in there]
        style = {"color": colour, "marker": marker, "markersize": 4, "linewidth": width}
        left.plot(distance, [one.translation_percent for one in there], label=name if there else None, **style)
        right.plot(distance, [one.rotation_deg for one in there], **style)
    for axes, name in ((left, "translation error (RPE) [%]"), (right, "rotation error (RPE) [°]")):
        axes.set_xscale("log")
        ticks = [one.distance for one in accuracy.relative if one.pairs]
        axes.set_xticks(ticks)
        axes.xaxis.set_major_formatter(ScalarFormatter())
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel("distance travelled [m]")
        axes.set_ylabel(name)
        axes.set_ylim(bottom=0)
    figure.legend(loc="outside upper left", ncols=8)
