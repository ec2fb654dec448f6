"""Calibrate a camera from images of a board, with standard deviations that hold for other images."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.calibration.board import Board
from coloc_graph.calibration.bundle import Bundle, adjust, adjust_pose, rms, start_pose
from coloc_graph.calibration.corners import View, Views, neighbours
from coloc_graph.calibration.lens import FISHEYE_NAMES, LENS_NAMES, folds, ray_sigmas
from coloc_graph.calibration.lens_choice import Trial, choose_lens
from coloc_graph.calibration.projection import Model
from coloc_graph.calibration.residuals import fitted_directions, noise_and_shared
from coloc_graph.errors import DegenerateGeometry, EstimationError, InputError
from coloc_graph.team import Camera

Array = NDArray[np.float64]

#: Numbers of lens coefficients tried, by model: none; k1, k2, p1, p2; k3 too; rational. Of a fisheye none, or k1 to k4.
LENSES: dict[Model, tuple[int, ...]] = {"pinhole": (0, 4, 5, 8), "fisheye": (0, 4)}
ANGLES_TRIED = (60.0, 90.0, 120.0, 150.0, 180.0, 220.0)  # deg across, with which a fisheye's calibration begins
MIN_IMAGES = 6
MAX_PARTS = 40  # parts into which images are divided for the jackknife
OUTLIER = 3.0  # ratio of an image's RMS to the median above which it shows another board, or one that moved or is bent
MAX_REJECTED = 1 / 3  # share of the images above which it is unclear which are right
MAX_FOCAL_SIGMA = 0.1  # relative standard deviation of a focal length that counts as determined


@dataclass(frozen=True)
class ImageFit:
    """Fit of one image.

    Attributes
    ----------
    name
        Path of the image.
    corners
        Number of corners.
    rms
        RMS distance of the corners from their projections [px]; of a rejected image under the camera of the others.
    tilt_deg
        Angle between the board and the image plane [deg].
    rejected
        Reason why the image was rejected, or None.
    """

    name: str
    corners: int
    rms: float
    tilt_deg: float
    rejected: str | None = None


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """Calibrated camera.

    Attributes
    ----------
    camera
        The camera; its `bias_px` combines `shared_px` and `lens_px`.
    covariance
        Covariance of fx, fy, cx, cy [px] and the lens coefficients, (p, p), by a jackknife over the board's positions,
        so that errors shared by the corners of an image count.
    independent_covariance
        The same for independent corners, as OpenCV's stdDeviationsIntrinsics, (p, p).
    images
        Fits of all images.
    trials
        Numbers of lens coefficients that were tried.
    places
        Number of different positions of the board.
    shared_px
        Standard deviation of the error that neighbouring corners share, for each axis [px].
    lens_px
        Standard deviation of a ray's pixel where corners were, for each axis [px].
    board, used, bundle
        Board, its views that were used, and the adjustment.
    """

    camera: Camera
    covariance: Array
    independent_covariance: Array
    images: tuple[ImageFit, ...]
    trials: tuple[Trial, ...]
    places: int
    shared_px: float
    lens_px: float
    board: Board
    used: Views
    bundle: Bundle

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of the covariances."""
        names = FISHEYE_NAMES if self.camera.model == "fisheye" else LENS_NAMES
        return names[: len(self.covariance)]

    @property
    def sigmas(self) -> Array:
        """Standard deviations (p,) by the jackknife."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def rejected(self) -> tuple[ImageFit, ...]:
        """Rejected images."""
        return tuple(image for image in self.images if image.rejected)


def calibrate_camera(
    seen: Views,
    board: Board,
    coefficients: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    model: Model = "pinhole",
) -> CameraCalibration:
    """Calibrate a camera by least squares, with the fewest lens coefficients that suffice.

    Parameters
    ----------
    seen
        Boards in images.
    board
        The board.
    coefficients
        Number of lens coefficients, 0, 4, 5 or 8. By default more are taken only if they predict held-out images
        better than fewer do, by more than the standard error.
    progress
        Called with (done, total).
    model
        Lens model; a fisheye has 0 or 4 coefficients.

    Returns
    -------
    CameraCalibration
        Camera with its covariance.

    Raises
    ------
    InputError
        There are too few images, or too many contradict the others.
    DegenerateGeometry
        The images do not determine the camera.
    """
    if len(seen.views) < MIN_IMAGES:
        raise InputError(
            f"{board} is in {len(seen.views)} of {seen.images} images, but at least {MIN_IMAGES} are needed: "
            "take more, 20 are good, with the board tilted and in all parts of the image"
        )
    wanted = LENSES[model] if coefficients is None else (coefficients,)
    if not set(wanted) <= set(LENSES[model]):
        raise InputError(f"a {model} has no {coefficients} lens coefficients; give {_listed(LENSES[model])}")
    start = _fisheye_start(seen) if model == "fisheye" else _start(seen, 4 if coefficients is None else coefficients)
    kept, bundle, rejected = _without_outliers(seen, board, start)
    views = Views(seen.width, seen.height, tuple(kept), seen.missed)
    place = places(kept, board.square)
    count = int(place.max()) + 1
    if count < MIN_IMAGES:
        raise InputError(
            f"{len(kept)} images show {board} in only {count} places, but at least {MIN_IMAGES} are needed: "
            "move the board between images"
        )
    _require_known(bundle, _independent(bundle))
    fit, trials = choose_lens(views, bundle, place % MAX_PARTS, wanted, progress)
    best, covariance = fit.bundle, fit.covariance
    fold = folds(best.intrinsics, seen.width, seen.height, model)
    if fold:
        raise DegenerateGeometry(
            f"the images do not determine {len(best.intrinsics) - 4} lens coefficients, since with them the lens "
            f"{fold}: choose fewer with --distortion, or hold the board in the corners of the image, too"
        )
    _require_known(best, covariance)
    noise, shared = noise_and_shared(kept, best.residuals, fitted_directions(kept, best), board.square)
    uv = np.concatenate([v.uv for v in kept])
    lens = float(np.sqrt(np.mean(ray_sigmas(best.intrinsics, covariance, uv, model=model) ** 2)))
    fx, fy, cx, cy = best.intrinsics[:4].tolist()
    camera = Camera(
        width=seen.width,
        height=seen.height,
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        model=model,
        distortion=tuple(best.intrinsics[4:].tolist()),
        noise_px=max(noise, 1e-6),
        bias_px=math.hypot(shared, lens),
    )
    fitted = [
        ImageFit(view.name, len(r), rms([r]), tilt_deg(pose))
        for view, pose, r in zip(kept, best.poses, best.residuals, strict=True)
    ]
    order = {view.name: index for index, view in enumerate(seen.views)}
    images = tuple(sorted([*fitted, *rejected], key=lambda image: order[image.name]))
    return CameraCalibration(
        camera, covariance, _independent(best), images, trials, count, shared, lens, board, views, best
    )


def tilt_deg(pose: Array) -> float:
    """Angle between a board's plane and the image plane, from its pose (6,) [deg]."""
    R, _ = cv2.Rodrigues(pose[:3])
    return math.degrees(math.acos(min(1.0, abs(float(R[2, 2])))))


def places(views: Sequence[View], square: float) -> NDArray[np.int64]:
    """Number the board's positions in views (n,), from 0; views with coinciding corners have the same position.

    Such views share the errors of their corners and are not independent evidence.
    """
    place: list[int] = []
    firsts: list[tuple[View, float]] = []
    for view in views:
        pairs = neighbours(view.points, square)
        spacing = float(np.median(np.linalg.norm(view.uv[pairs[:, 0]] - view.uv[pairs[:, 1]], axis=1)))
        for index, (first, of_first) in enumerate(firsts):
            near = 0.1 * min(spacing, of_first)
            if np.linalg.norm(view.uv.mean(axis=0) - first.uv.mean(axis=0)) > 2 * near:
                continue
            apart = np.linalg.norm(view.uv[:, None] - first.uv[None], axis=-1).min(axis=1)
            if np.median(apart) < near:
                place.append(index)
                break
        else:
            place.append(len(firsts))
            firsts.append((view, spacing))
    return np.array(place)


def _start(seen: Views, coefficients: int) -> Bundle:
    """Start with OpenCV's calibration of all images, adjusted to convergence."""
    flags = {
        0: cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST,
        4: cv2.CALIB_FIX_K3,
        5: 0,
        8: cv2.CALIB_RATIONAL_MODEL,
    }[coefficients]
    points: list[Any] = [view.points.astype(np.float32) for view in seen.views]
    corners: list[Any] = [view.uv.astype(np.float32)[:, None] for view in seen.views]
    guess: Any = None
    try:
        _, K, lens, rotations, translations = cv2.calibrateCamera(
            points, corners, (seen.width, seen.height), guess, guess, flags=flags
        )
    except cv2.error as error:
        raise DegenerateGeometry(_undetermined("OpenCV finds no camera for them")) from error
    intrinsics = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *lens.ravel()[:coefficients]])
    poses = np.hstack([np.array(rotations).reshape(-1, 3), np.array(translations).reshape(-1, 3)])
    if not (np.isfinite(intrinsics).all() and np.isfinite(poses).all()):
        raise DegenerateGeometry(_undetermined("OpenCV finds no camera for them"))
    return adjust(seen.views, intrinsics, poses)


def _fisheye_start(seen: Views) -> Bundle:
    """Start with equidistant lenses of several focal lengths, each adjusted to convergence, and take the best."""
    found: Bundle | None = None
    for angle in np.deg2rad(ANGLES_TRIED):
        focal = seen.width / angle
        intrinsics = np.array([focal, focal, (seen.width - 1) / 2, (seen.height - 1) / 2, 0.0, 0.0, 0.0, 0.0])
        try:
            with np.errstate(all="ignore"):
                starts = [start_pose(view, intrinsics, "fisheye") for view in seen.views]
                pairs = zip(seen.views, starts, strict=True)
                poses = np.array([adjust_pose(view, intrinsics, start, "fisheye")[0] for view, start in pairs])
                bundle = adjust(seen.views, intrinsics, poses, "fisheye")
        except (np.linalg.LinAlgError, EstimationError):
            continue
        if np.isfinite(bundle.rms) and (found is None or bundle.rms < found.rms):
            found = bundle
    if found is None:
        raise DegenerateGeometry(_undetermined("no fisheye fits them"))
    return found


def _listed(numbers: Sequence[int]) -> str:
    return " or ".join(map(str, numbers))


def _without_outliers(seen: Views, board: Board, bundle: Bundle) -> tuple[list[View], Bundle, list[ImageFit]]:
    """Reject images one by one, the worst first, with a new adjustment of the others each time."""
    kept, out = list(seen.views), []
    while True:
        off = np.array([rms([r]) for r in bundle.residuals])
        worst = int(off.argmax())
        if off[worst] <= OUTLIER * np.median(off):
            break
        out.append(kept.pop(worst))
        if len(out) > MAX_REJECTED * len(seen.views) or len(kept) < MIN_IMAGES:
            raise InputError(
                f"{len(out)} of {len(seen.views)} images contradict the others ({', '.join(v.name for v in out[:3])}"
                f"{', ...' if len(out) > 3 else ''}): check that all show the same flat board, {board}, and are sharp"
            )
        bundle = adjust(kept, bundle.intrinsics, np.delete(bundle.poses, worst, axis=0), bundle.model)
    usual = float(np.median(off))
    rejected = []
    for view in out:
        start = start_pose(view, bundle.intrinsics, bundle.model)
        pose, r, _ = adjust_pose(view, bundle.intrinsics, start, bundle.model)
        why = (
            f"its corners have an RMS error of {rms([r]):.2f} px, others have {usual:.2f} px: "
            "it shows another board, or one that moved or is not flat"
        )
        rejected.append(ImageFit(view.name, len(r), rms([r]), tilt_deg(pose), why))
    return kept, bundle, rejected


def _independent(bundle: Bundle) -> Array:
    """Covariance (p, p) of the intrinsics for independent corners."""
    dof = sum(2 * len(r) - 6 for r in bundle.residuals) - len(bundle.intrinsics)
    squares = sum(float((r**2).sum()) for r in bundle.residuals)
    try:
        return np.asarray(squares / dof * np.linalg.inv(bundle.information), float)
    except np.linalg.LinAlgError:
        return np.full(bundle.information.shape, math.inf)


def _require_known(bundle: Bundle, covariance: Array) -> None:
    sigma = float(np.sqrt(np.diag(covariance)[:2]).max())
    focal = float(bundle.intrinsics[:2].min())
    if not (math.isfinite(sigma) and focal > 0 and sigma < MAX_FOCAL_SIGMA * focal):
        raise DegenerateGeometry(_undetermined(f"estimated focal length {focal:.0f} +- {sigma:.0f} px"))


def _undetermined(what: str) -> str:
    return (
        f"the images do not determine the camera ({what}): tilt the board by 20 to 45 deg in all directions, "
        "and hold it in all parts of the image"
    )
