"""Figures of a camera's calibration: coverage by corners, uncertainty of rays, residuals."""

import io
import json
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from numpy.typing import NDArray

from coloc_graph.calibration.camera import CameraCalibration
from coloc_graph.calibration.lens import pixel_grid, ray_sigmas
from coloc_graph.calibration.summary import SUMMARY, summarise_camera
from coloc_graph.calibration.verdict import REGIONS, cell_counts, uncovered, verdict
from coloc_graph.errors import InputError
from coloc_graph.report.drawing import BAD, COLOURS, GREY, INK, PALE, round_125, styled
from coloc_graph.run.atomic_file import write_atomically

Array = NDArray[np.float64]

COVERAGE = "coverage.png"
RESIDUALS = "residuals.png"
CELLS = 24  # cells along the longer side of the image in which corners are counted
MAX_NAMED = 40  # images up to which bars have names


@styled
def coverage_figure(calibration: CameraCalibration) -> Figure:
    """Draw the coverage of the image by corners, and the uncertainty of a ray's pixel."""
    used = calibration.used
    uv = np.concatenate([view.uv for view in used.views])
    figure = Figure(figsize=(11, 0.9 + 5.2 * used.height / used.width), layout="constrained")
    figure.suptitle(_wrapped("; ".join(verdict(calibration))), x=0.01, ha="left", size=10.5, weight="bold")
    seen, known = figure.subplots(1, 2)
    cell = max(used.width, used.height) / CELLS
    columns, rows = max(1, round(used.width / cell)), max(1, round(used.height / cell))
    counts = cell_counts(uv, used.width, used.height, columns, rows).astype(float)
    extent = (-0.5, used.width - 0.5, used.height - 0.5, -0.5)
    heat = seen.imshow(np.where(counts > 0, counts, np.nan), extent=extent, cmap="Blues", vmin=0, aspect="equal")
    figure.colorbar(heat, ax=seen, shrink=0.62, label="corners per cell")
    for view in used.views:
        seen.add_patch(Polygon(_hull(view.uv), closed=True, fill=False, edgecolor=INK, linewidth=0.5, alpha=0.35))
    for name in uncovered(uv, used.width, used.height):
        row, column = next((r, names.index(name)) for r, names in enumerate(REGIONS) if name in names)
        size = used.width / 3, used.height / 3
        corner = column * size[0] - 0.5, row * size[1] - 0.5
        seen.add_patch(Rectangle(corner, *size, fill=False, hatch="///", edgecolor=BAD, linewidth=0, alpha=0.6))
        seen.text(corner[0] + size[0] / 2, corner[1] + size[1] / 2, "not\ncovered", color=BAD, ha="center", va="center")
    images = f"{len(used.views)} images, {len(uv)} corners"
    _of_image(seen, calibration, f"Coverage by corners ({images})")

    grid = pixel_grid(used.width, used.height, 2 * columns, 2 * rows)
    sigmas = ray_sigmas(
        calibration.bundle.intrinsics, calibration.covariance, uv, grid.reshape(-1, 2), calibration.camera.model
    )
    sigmas = sigmas.reshape(grid.shape[:2])
    top = float(np.nanpercentile(sigmas[np.isfinite(sigmas)], 99)) if np.isfinite(sigmas).any() else 1.0
    map_ = known.imshow(sigmas, extent=extent, cmap="viridis_r", vmin=0, vmax=max(top, 1e-6), aspect="equal")
    figure.colorbar(map_, ax=known, shrink=0.62, label="standard deviation per axis, px", extend="max")
    _of_image(known, calibration, "Uncertainty of a ray's pixel, without that of the camera's rotation")
    return figure


@styled
def residuals_figure(calibration: CameraCalibration) -> Figure:
    """Draw the residual of each corner, enlarged, and the RMS of each image, with those that were rejected."""
    used = calibration.used
    uv, r = np.concatenate([view.uv for view in used.views]), np.concatenate(calibration.bundle.residuals)
    figure = Figure(figsize=(11, 0.9 + 5.2 * used.height / used.width), layout="constrained")
    figure.suptitle(
        f"{calibration.bundle.rms:.3f} px RMS: per axis {calibration.camera.noise_px:.3f} px independent, "
        f"{calibration.shared_px:.3f} px shared by neighbouring corners",
        x=0.01,
        ha="left",
        size=10.5,
        weight="bold",
    )
    field, bars = figure.subplots(1, 2)
    enlarged = round_125(used.width / 40 / max(float(np.percentile(np.linalg.norm(r, axis=1), 95)), 1e-9))
    field.quiver(
        *uv.T,
        *r.T,
        np.repeat(np.arange(len(used.views)), [len(view.uv) for view in used.views]),
        cmap="turbo",
        angles="xy",
        scale_units="xy",
        scale=1 / enlarged,
        width=0.0016,
        alpha=0.8,
    )
    _of_image(field, calibration, f"Residuals, enlarged {enlarged:g} times; one colour per image")
    images = calibration.images
    at = np.arange(len(images))
    off = np.array([image.rms for image in images])
    colours = [BAD if image.rejected else COLOURS[0] for image in images]
    bars.bar(at, off, color=colours)
    usual = max(image.rms for image in images if not image.rejected)
    bars.set_ylim(0, 1.25 * min(off.max(), 4 * usual))
    for x, image in zip(at, images, strict=True):
        if image.rejected:
            bars.text(x, 0.02 * usual, f"rejected: {image.rms:.2f}", rotation=90, ha="center", va="bottom", size=8)
    bars.axhline(calibration.bundle.rms, color=GREY, linewidth=1, linestyle="--")
    bars.set_ylabel("RMS of an image, px")
    names = [Path(image.name).name for image in images]
    if len(names) <= MAX_NAMED:
        bars.set_xticks(at, names, rotation=90, size=7)
    bars.grid(visible=False, axis="x")
    bars.set_title("RMS by image; dashed: of all used images", loc="left", size=10)
    return figure


def require_output_folder(out: Path, *, force: bool) -> None:
    """Raise `InputError` where a calibration cannot be written to the folder `out`, or one exists without `force`."""
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} exists and is not a folder; give another folder")
    if (out / SUMMARY).exists():
        if not force:
            raise InputError(f"{out} holds an earlier calibration; replace it with --force, or give another folder")
    elif out.is_dir() and any(out.iterdir()):
        raise InputError(f"{out} holds files that are not a calibration; give another folder, or empty it")


def write_camera_calibration(calibration: CameraCalibration, out: Path) -> tuple[Path, ...]:
    """Write calibration.json, coverage.png and residuals.png to the folder `out`, and return their paths."""
    files: dict[Path, str | bytes] = {
        out / SUMMARY: json.dumps(summarise_camera(calibration), indent=2) + "\n",
        out / COVERAGE: _png(coverage_figure(calibration)),
        out / RESIDUALS: _png(residuals_figure(calibration)),
    }
    out.mkdir(parents=True, exist_ok=True)
    for path, data in files.items():
        write_atomically(path, data)
    return tuple(files)


@styled
def _png(figure: Figure) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=110, metadata={"Software": None})
    return out.getvalue()


def _of_image(axes: Axes, calibration: CameraCalibration, title: str) -> None:
    axes.set_xlim(-0.5, calibration.used.width - 0.5)
    axes.set_ylim(calibration.used.height - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_title(title, loc="left", size=10)
    axes.plot(calibration.camera.cx, calibration.camera.cy, "+", color=INK, markersize=9)
    axes.grid(visible=False)
    for side in ("top", "right", "bottom", "left"):
        axes.spines[side].set_visible(True)
        axes.spines[side].set_color(PALE)


def _hull(uv: Array) -> Array:
    from scipy.spatial import ConvexHull

    return np.asarray(uv[ConvexHull(uv).vertices])


def _wrapped(text: str) -> str:
    import textwrap

    return "\n".join(textwrap.wrap(text[:1].upper() + text[1:], 120))
