"""Verdict on a calibration, in words that say what to do."""

import numpy as np
from numpy.typing import NDArray

from coloc_graph.calibration.camera import CameraCalibration
from coloc_graph.calibration.lens import pixel_grid, ray_sigmas

Array = NDArray[np.float64]

GOOD = "good"
#: The image in three by three regions, each of CELLS x CELLS cells; a region is covered where so many hold a corner.
REGIONS = (
    ("upper left", "top", "upper right"),
    ("left", "middle", "right"),
    ("lower left", "bottom", "lower right"),
)
CELLS = 4
COVERED = 0.2
#: At least so many boards tilted by so much [deg] give the focal length.
TILTED = 3
TILT = 20.0
#: A focal length is uncertain where it is known no better than by this part, a ray where by so many pixels.
FOCAL = 0.01
RAY = 1.0
#: Corners of a sharp board are found to less than this [px].
SHARP = 1.0
#: Sigmas that stand on fewer places are uncertain themselves, by a quarter and more.
PLACES = 10


def cell_counts(uv: Array, width: int, height: int, columns: int, rows: int) -> NDArray[np.int64]:
    """Number of pixels uv (n, 2) in each cell of an image (rows, columns)."""
    edges = (np.linspace(-0.5, height - 0.5, rows + 1), np.linspace(-0.5, width - 0.5, columns + 1))
    return np.histogram2d(uv[:, 1], uv[:, 0], bins=edges)[0].astype(np.int64)


def uncovered(uv: Array, width: int, height: int) -> tuple[str, ...]:
    """The regions of an image that hardly hold a corner, by name."""
    seen = cell_counts(uv, width, height, 3 * CELLS, 3 * CELLS) > 0
    part = seen.reshape(3, CELLS, 3, CELLS).mean(axis=(1, 3))
    return tuple(REGIONS[row][column] for row, column in np.argwhere(part < COVERED))


def verdict(calibration: CameraCalibration) -> tuple[str, ...]:
    """Sentences on what to do about a calibration, the most important first; `GOOD` alone if nothing."""
    used = calibration.used
    uv = np.concatenate([view.uv for view in used.views])
    said = []
    fit = calibration.bundle.rms
    if fit > SHARP:
        said.append(
            f"the corners are off by {fit:.2f} px RMS: the images are blurred, the board is not flat, or its count is "
            "wrong"
        )
    tilts = np.array([image.tilt_deg for image in calibration.images if image.refused is None])
    focal = float((calibration.sigmas[:2] / calibration.bundle.intrinsics[:2]).max())
    if tilts.max() < TILT:
        said.append(
            f"the board was never tilted by more than {tilts.max():.0f} deg: the focal length is uncertain "
            f"({100 * focal:.2g} %); tilt it by 20 to 45 deg, this way and that"
        )
    elif (tilts >= TILT).sum() < TILTED:
        tilted = int((tilts >= TILT).sum())
        said.append(
            f"the board was tilted in {tilted} of {len(tilts)} images only: the focal length hangs on them; "
            "tilt it more often, by 20 to 45 deg"
        )
    elif focal > FOCAL:
        said.append(
            f"the focal length is uncertain by {100 * focal:.2g} %: take more images, with the board tilted and near"
        )
    bare = uncovered(uv, used.width, used.height)
    corners = [name for name in bare if " " in name]
    if len(corners) == 4:
        said.append(f"the corners of the image are not covered: hold the board at the {_listed(bare)}")
    elif bare:
        said.append(f"the {_listed(bare)} of the image {_is(bare)} not covered: hold the board there")
    grid = pixel_grid(used.width, used.height, 3 * CELLS, 3 * CELLS).reshape(-1, 2)
    sigmas = ray_sigmas(calibration.bundle.intrinsics, calibration.covariance, uv, grid)
    worst = int(sigmas.argmax())
    if sigmas[worst] > RAY:
        row, column = np.array(np.unravel_index(worst, (3 * CELLS, 3 * CELLS))) // CELLS
        said.append(
            f"at the {REGIONS[row][column]} of the image the lens is uncertain by {sigmas[worst]:.1f} px: "
            "take more images with the board there"
        )
    if calibration.places < PLACES:
        said.append(
            f"the board was in {calibration.places} places only, so that the sigmas are rough: "
            f"take {PLACES} or more, 20 are good"
        )
    return tuple(said) or (GOOD,)


def _listed(names: tuple[str, ...]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _is(names: tuple[str, ...]) -> str:
    return "is" if len(names) == 1 else "are"
