"""Judge a calibration, in sentences with a remedy."""

import numpy as np
from numpy.typing import NDArray

from coloc_graph.calibration.camera import CameraCalibration
from coloc_graph.calibration.lens import pixel_grid, ray_sigmas

Array = NDArray[np.float64]

GOOD = "good"
#: Regions of the image.
REGIONS = (
    ("upper left", "top", "upper right"),
    ("left", "middle", "right"),
    ("lower left", "bottom", "lower right"),
)
CELLS = 4  # cells of a region in each direction
MIN_COVERED = 0.2  # share of a region's cells that must contain a corner
MIN_TILTED = 3  # boards that must be tilted, to determine the focal length
MIN_TILT = 20.0  # deg, of a tilted board
MAX_FOCAL_SIGMA = 0.01  # relative standard deviation of a focal length
MAX_RAY_SIGMA = 1.0  # px, standard deviation of a ray
MAX_RMS = 1.0  # px, of the corners of a sharp board
MIN_PLACES = 10  # positions of the board; with fewer, sigmas are uncertain by a quarter and more


def cell_counts(uv: Array, width: int, height: int, columns: int, rows: int) -> NDArray[np.int64]:
    """Count pixels uv (n, 2) in each cell of a grid over an image, (rows, columns)."""
    edges = (np.linspace(-0.5, height - 0.5, rows + 1), np.linspace(-0.5, width - 0.5, columns + 1))
    return np.histogram2d(uv[:, 1], uv[:, 0], bins=edges)[0].astype(np.int64)


def uncovered(uv: Array, width: int, height: int) -> tuple[str, ...]:
    """Names of the regions of an image with hardly any corner."""
    seen = cell_counts(uv, width, height, 3 * CELLS, 3 * CELLS) > 0
    part = seen.reshape(3, CELLS, 3, CELLS).mean(axis=(1, 3))
    return tuple(REGIONS[row][column] for row, column in np.argwhere(part < MIN_COVERED))


def verdict(calibration: CameraCalibration) -> tuple[str, ...]:
    """Judge a calibration.

    Parameters
    ----------
    calibration
        Calibration of a camera.

    Returns
    -------
    tuple of str
        Sentences with remedies, the most important first; only `GOOD` if there are none.
    """
    used = calibration.used
    uv = np.concatenate([view.uv for view in used.views])
    said = []
    fit = calibration.bundle.rms
    if fit > MAX_RMS:
        said.append(
            f"the RMS error of the corners is {fit:.2f} px: the images are blurred, the board is not flat, or --board "
            "is wrong"
        )
    tilts = np.array([image.tilt_deg for image in calibration.images if image.rejected is None])
    focal = float((calibration.sigmas[:2] / calibration.bundle.intrinsics[:2]).max())
    if tilts.max() < MIN_TILT:
        said.append(
            f"the board was never tilted by more than {tilts.max():.0f} deg: the focal length is uncertain "
            f"({100 * focal:.2g} %); tilt it by 20 to 45 deg in all directions"
        )
    elif (tilts >= MIN_TILT).sum() < MIN_TILTED:
        tilted = int((tilts >= MIN_TILT).sum())
        said.append(
            f"the board was tilted in only {tilted} of {len(tilts)} images, which determine the focal length: "
            "tilt it more often, by 20 to 45 deg"
        )
    elif focal > MAX_FOCAL_SIGMA:
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
    sigmas = ray_sigmas(calibration.bundle.intrinsics, calibration.covariance, uv, grid, calibration.camera.model)
    worst = int(sigmas.argmax())
    if sigmas[worst] > MAX_RAY_SIGMA:
        row, column = np.array(np.unravel_index(worst, (3 * CELLS, 3 * CELLS))) // CELLS
        said.append(
            f"at the {REGIONS[row][column]} of the image the lens is uncertain by {sigmas[worst]:.1f} px: "
            "take more images with the board there"
        )
    if calibration.places < MIN_PLACES:
        said.append(
            f"the board was in only {calibration.places} places, so the sigmas are rough: "
            f"use {MIN_PLACES} or more, 20 are good"
        )
    return tuple(said) or (GOOD,)


def _listed(names: tuple[str, ...]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _is(names: tuple[str, ...]) -> str:
    return "is" if len(names) == 1 else "are"
