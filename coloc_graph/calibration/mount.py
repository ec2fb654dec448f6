"""Calibrate a camera's mount from images of a board that lies flat on the floor in front of its robot.

The board's plane is the floor, so that each image gives the camera's height, tilt and roll; position and heading of the
board are free. All images are fused by generalised least squares with separate errors: of each corner, of the floor
under each board, and shared by all images (the intrinsics, the floor under the robot).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray
from scipy.special import chdtri

from coloc_graph.calibration.bundle import adjust_pose, rms, start_pose
from coloc_graph.calibration.corners import View
from coloc_graph.calibration.fusion import Estimates, disagreement, fuse, fuse_scaled
from coloc_graph.calibration.projection import Model, project
from coloc_graph.calibration.residuals import noise_and_shared
from coloc_graph.errors import DegenerateGeometry, InputError
from coloc_graph.geometry.lie import so3_exp
from coloc_graph.geometry.mounting import tilt_and_roll
from coloc_graph.team import Camera, Floor, Mount

Array = NDArray[np.float64]

P_OUTLIER = 1e-3  # p-value, in a whole calibration, below which an image contradicts the others
NEAR_HEIGHT = 0.003  # m from the others within which a board counts as on the floor
NEAR_DEG = 0.3  # deg, the same for its tilt
P_DISAGREE = 1e-2  # p-value of the images' agreement below which their independent errors are enlarged
OUTLIER = 3.0  # ratio of an image's RMS to the median above which it shows another board, or one that is not flat
MIN_NOISE = 0.03  # px, lower bound of that median


@dataclass(frozen=True)
class BoardOnFloor:
    """Height [m], tilt and roll [deg] of the camera from one image, with the RMS error of the corners [px].

    `rejected` is the reason why the image was rejected, or None.
    """

    name: str
    corners: int
    rms: float
    height: float
    tilt_deg: float
    roll_deg: float
    rejected: str | None = None


@dataclass(frozen=True, eq=False)
class MountCalibration:
    """Calibrated mount.

    Attributes
    ----------
    mount
        The mount with new height, tilt and roll; x, y and yaw, which a board on the floor does not determine, are kept.
    covariance
        Covariance of height [m], tilt [rad], roll [rad], (3, 3).
    images
        Estimates of all images.
    chi2, dof
        Agreement of the images; chi2 / dof is about 1 if corners and floor are as stated.
    scale
        Factor by which variances of independent errors were scaled, if the images disagree beyond chance.
    noise_px
        Standard deviation of the corners for each axis [px].
    """

    mount: Mount
    covariance: Array
    images: tuple[BoardOnFloor, ...]
    chi2: float
    dof: int
    scale: float
    noise_px: float

    @property
    def rejected(self) -> tuple[BoardOnFloor, ...]:
        """Rejected images."""
        return tuple(image for image in self.images if image.rejected)


def calibrate_mount(
    views: Sequence[View],
    camera: Camera,
    mount: Mount,
    square: float,
    *,
    thickness: float = 0.0,
    floor: Floor | None = None,
    intrinsics_covariance: Array | None = None,
) -> MountCalibration:
    """Calibrate height, tilt and roll of a camera from boards on the floor in front of the robot, which stands still.

    Parameters
    ----------
    views
        Boards in images.
    camera, mount
        Camera, and its mount, of which x, y and yaw are kept.
    square
        Side of the board's squares [m].
    thickness
        Thickness of the board [m].
    floor
        Tolerances of the floor.
    intrinsics_covariance
        Covariance of fx, fy, cx, cy and the lens coefficients, (p, p); by default a shift of the image by
        `camera.bias_px`.

    Returns
    -------
    MountCalibration
        Mount with its covariance.

    Raises
    ------
    InputError
        Images contradict each other, and it is unclear which are right.
    DegenerateGeometry
        A board is seen from below or edge-on.
    """
    if not views:
        raise InputError("no image shows the board: give at least one that does")
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])
    shared = intrinsics_covariance
    if shared is None:
        shared = np.zeros((len(intrinsics), len(intrinsics)))
        shared[2, 2] = shared[3, 3] = camera.bias_px**2
    if shared.shape != (len(intrinsics),) * 2:
        raise InputError(
            f"the calibration has {len(shared)} parameters, but the robot's camera has {len(intrinsics)}: "
            "write the camera of this calibration into the team first"
        )
    fitted = [_fit(view, intrinsics, thickness, camera.model) for view in views]
    sound, rejected = _rejected_by_corners(fitted)
    noise, counted = _noise([views[i] for i in sound], [fitted[i] for i in sound], square)
    uneven = np.zeros(3) if floor is None else np.array([floor.height_sigma, *[math.radians(floor.tilt_sigma_deg)] * 2])
    by_camera = np.array([fit.by_intrinsics for fit in fitted])
    said = Estimates(
        np.array([fit.value for fit in fitted]),
        np.array([counted**2 * fit.covariance + fit.by_floor * uneven**2 @ fit.by_floor.T for fit in fitted]),
        np.einsum("nip,pq,mjq->nimj", by_camera, shared, by_camera),
    )
    kept, others = _rejected_by_others(views, said, sound)
    rejected |= others
    fused = fuse_scaled(said.of(kept), P_DISAGREE)
    covariance = fused.covariance + np.diag(uneven**2)  # the floor under the robot itself
    images = tuple(
        BoardOnFloor(
            view.name,
            len(view.uv),
            rms([fit.residuals]),
            float(fit.value[0]),
            math.degrees(fit.value[1]),
            math.degrees(fit.value[2]),
            rejected.get(index),
        )
        for index, (view, fit) in enumerate(zip(views, fitted, strict=True))
    )
    sigmas = np.sqrt(np.diag(covariance))
    return MountCalibration(
        mount=replace(
            mount,
            height=float(fused.value[0]),
            tilt_deg=math.degrees(fused.value[1]),
            roll_deg=math.degrees(fused.value[2]),
            height_sigma=float(sigmas[0]),
            tilt_sigma_deg=math.degrees(sigmas[1]),
            roll_sigma_deg=math.degrees(sigmas[2]),
        ),
        covariance=covariance,
        images=images,
        chi2=fused.chi2,
        dof=fused.dof,
        scale=fused.scale,
        noise_px=noise,
    )


@dataclass(frozen=True, eq=False)
class _Fit:
    """Fit of one image.

    Attributes
    ----------
    value
        Height [m], tilt, roll [rad], (3,).
    covariance
        Its covariance for corner noise of 1 px, (3, 3).
    by_intrinsics, by_floor
        Derivatives by the intrinsics, (3, p), and by height and tilts of the floor under the board, (3, 3).
    residuals
        Residuals of the corners, (n, 2) [px].
    directions
        Orthonormal directions of the residuals that the pose absorbs, (2n, 6).
    """

    value: Array
    covariance: Array
    by_intrinsics: Array
    by_floor: Array
    residuals: Array
    directions: Array


def _fit(view: View, intrinsics: Array, thickness: float, model: Model) -> _Fit:
    try:
        pose, residuals, information = adjust_pose(view, intrinsics, start_pose(view, intrinsics, model), model)
        R, t, middle = so3_exp(pose[:3]), pose[3:], view.points.mean(axis=0)
        value = _height_tilt_roll(R, t, thickness)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise DegenerateGeometry(
            f"{view.name}: the board has no pose in front of the camera and below it: "
            "lay it flat on the floor, in full view"
        ) from error

    def where_pose_is_off(off: Array) -> Array:
        return _height_tilt_roll(so3_exp(pose[:3] + off[:3]), t + off[3:], thickness)

    def where_floor_is_off(off: Array) -> Array:
        # higher under the board, or tilted about its position
        turned = R @ so3_exp([off[1], off[2], 0.0])
        return _height_tilt_roll(turned, t + (R - turned) @ middle + off[0] * R[:, 2], thickness)

    by_pose = _derivative(where_pose_is_off, 6)
    _, A, B = project(intrinsics, pose, view.points, model)
    return _Fit(
        value,
        by_pose @ np.linalg.solve(information, by_pose.T),
        # the best pose changes with the intrinsics
        by_pose @ -np.linalg.solve(information, B.T @ A),
        _derivative(where_floor_is_off, 3),
        residuals,
        np.linalg.qr(B)[0],
    )


def _height_tilt_roll(R: Array, t: Array, thickness: float) -> Array:
    """Height [m], tilt and roll [rad] of a camera from the pose R (3, 3), t (3,) of a board on the floor."""
    up = R[:, 2]
    distance = float(up @ -t)
    if distance < 0:  # the board's z points up or down, depending on the order of its corners
        up, distance = -up, -distance
    return np.array([distance + thickness, *tilt_and_roll(up)])


def _derivative(of: Callable[[Array], Array], size: int) -> Array:
    """Derivative at zero of a function of a vector (size,)."""
    step = 1e-6
    return np.array([(of(off) - of(-off)) / (2 * step) for off in step * np.eye(size)]).T


def _noise(views: Sequence[View], fitted: Sequence[_Fit], square: float) -> tuple[float, float]:
    """Standard deviation of a corner for each axis [px], and the equivalent one of independent corners.

    The latter is larger, since corners share errors with their four neighbours.
    """
    alone, shared = noise_and_shared(views, [f.residuals for f in fitted], [f.directions for f in fitted], square)
    return max(math.hypot(alone, shared), 1e-6), max(math.sqrt(alone**2 + 5 * shared**2), 1e-6)


def _rejected_by_corners(fitted: Sequence[_Fit]) -> tuple[list[int], dict[int, str]]:
    off = [rms([fit.residuals]) for fit in fitted]
    usual = float(np.median(off))
    rejected = {
        index: f"its corners have an RMS error of {one:.2f} px, others have {usual:.2f} px: "
        "it shows another board, or one that moved or is not flat"
        for index, one in enumerate(off)
        if one > OUTLIER * max(usual, MIN_NOISE)
    }
    return [index for index in range(len(fitted)) if index not in rejected], rejected


def _rejected_by_others(views: Sequence[View], said: Estimates, kept: list[int]) -> tuple[list[int], dict[int, str]]:
    """Reject images whose board is not in the plane of the others, one by one, the furthest first."""
    rejected: dict[int, str] = {}
    kept = list(kept)
    while len(kept) > 1:
        off = disagreement(said.of(kept))
        worst = int(off.argmax())
        others = kept[:worst] + kept[worst + 1 :]
        rest = fuse(said.of(others))
        apart = said.values[kept[worst]] - rest.value
        # of boards that are not quite flat, or a floor that is not, all are off by more than noise: so many times
        usual = min(float(np.median(off) / chdtri(3, 0.5)), rest.chi2 / rest.dof) if rest.dof else 1.0
        by_chance = off[worst] <= max(usual, 1.0) * chdtri(3, P_OUTLIER / len(views))
        if by_chance or (abs(apart[0]) < NEAR_HEIGHT and np.abs(apart[1:]).max() < math.radians(NEAR_DEG)):
            break
        if len(kept) == 2:
            a, b = (views[index].name for index in kept)
            raise InputError(
                f"{a} and {b} contradict each other by {_difference(apart)}: one board was not flat on the floor; "
                "take a third image, or remove one"
            )
        index, kept = kept[worst], others
        rejected[index] = (
            f"its board is not in the plane of the others, by {_difference(apart)}: "
            "not flat on the floor, or the robot moved"
        )
        if len(rejected) > max(1, len(views) // 3):
            raise InputError(
                f"{len(rejected)} of {len(views)} images contradict the others ({views[index].name}: "
                f"{rejected[index]}); lay the board flat on the floor in each, and do not move the robot"
            )
    return kept, rejected


def _difference(off: Array) -> str:
    height, tilt, roll = 1000 * off[0], *np.rad2deg(off[1:])
    return f"{height:.1f} mm in height, {tilt:.2f} deg in tilt and {roll:.2f} deg in roll"
