"""Extrinsics of a camera, from images of a board that lies flat on the floor in front of its robot.

The board's plane is the floor, so that each image tells the camera's height, tilt and roll; where the board lies, and
which way it is turned, is free. All images are weighed together by generalised least squares: what each corner has
alone, what a floor is uneven by under each board, and what all images share (the camera's intrinsics, the floor under
the robot) are counted apart.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray
from scipy.special import chdtri

from coloc_graph.calibration.bundle import adjust_pose, project, rms, start_pose
from coloc_graph.calibration.corners import View
from coloc_graph.calibration.fusion import Said, disagreement, fuse, fuse_scaled
from coloc_graph.calibration.residuals import noise_and_shared
from coloc_graph.errors import DegenerateGeometry, InputError
from coloc_graph.geometry.lie import so3_exp
from coloc_graph.geometry.mounting import tilt_and_roll
from coloc_graph.team import Camera, Floor, Mount

Array = NDArray[np.float64]

#: An image contradicts the others where chance would do so in one of so many calibrations.
CHANCE = 1e-3
#: A board that is so near to the others [m, deg] is on the floor, as flat as floors are; sigmas make up for it.
NEAR_HEIGHT = 0.003
NEAR_DEG = 0.3
#: Where all images together disagree by more than such a chance, their own errors count as larger.
DISAGREE = 1e-2
#: Images whose corners are off by so many times what is usual show another board, or one that is not flat.
OUTLIER = 3.0
#: Corners that are better than this are no reason to refuse others [px].
LEAST_NOISE = 0.03


@dataclass(frozen=True)
class BoardOnFloor:
    """Estimate from one image: height [m], tilt and roll [deg] of the camera, RMS distance of the corners [px].

    `refused` says why it was left out.
    """

    name: str
    corners: int
    rms: float
    height: float
    tilt_deg: float
    roll_deg: float
    refused: str | None = None


@dataclass(frozen=True, eq=False)
class MountCalibration:
    """A mount's height, tilt and roll; what a board on the floor does not say (x, y, yaw) is as it was.

    `covariance` (3, 3) is of (height [m], tilt [rad], roll [rad]). `chi2` over `dof` says how the images agree: 1 where
    corners and floor are as stated. Where it is more than chance, by `scale`, the part of the covariance that is not
    shared is larger by that. `noise_px` is the corners', an axis, in these images.
    """

    mount: Mount
    covariance: Array
    images: tuple[BoardOnFloor, ...]
    chi2: float
    dof: int
    scale: float
    noise_px: float

    @property
    def refused(self) -> tuple[BoardOnFloor, ...]:
        """The images that were left out."""
        return tuple(image for image in self.images if image.refused)


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
    """Height, tilt and roll of a camera whose robot stands still, from boards that lie on the floor.

    `square` is the side of the board's squares, `thickness` the board's [m]. `intrinsics_covariance` (p, p) is that of
    fx, fy, cx, cy and the lens coefficients; where it is None, what is not known of the camera is a shift of its image
    by `camera.bias_px`. `floor` says how uneven it is. x, y and yaw are those of `mount`.

    Raises `InputError` where images contradict each other and it is not clear which are right, `DegenerateGeometry`
    where a board is seen from below or on edge.
    """
    if not views:
        raise InputError("no image shows the board; give at least one")
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])
    shared = intrinsics_covariance
    if shared is None:
        shared = np.zeros((len(intrinsics), len(intrinsics)))
        shared[2, 2] = shared[3, 3] = camera.bias_px**2
    if shared.shape != (len(intrinsics),) * 2:
        raise InputError(
            f"the calibration has {len(shared)} parameters and the robot's camera {len(intrinsics)}; "
            "write the camera of this calibration into the team first"
        )
    fitted = [_fit(view, intrinsics, thickness) for view in views]
    sound, refused = _refused_by_corners(fitted)
    noise, counted = _noise([views[i] for i in sound], [fitted[i] for i in sound], square)
    uneven = np.zeros(3) if floor is None else np.array([floor.height_sigma, *[math.radians(floor.tilt_sigma_deg)] * 2])
    by_camera = np.array([fit.by_intrinsics for fit in fitted])
    said = Said(
        np.array([fit.value for fit in fitted]),
        np.array([counted**2 * fit.covariance + fit.by_floor * uneven**2 @ fit.by_floor.T for fit in fitted]),
        np.einsum("nip,pq,mjq->nimj", by_camera, shared, by_camera),
    )
    kept, others = _refused_by_others(views, said, sound)
    refused |= others
    fused = fuse_scaled(said.of(kept), DISAGREE)
    covariance = fused.covariance + np.diag(uneven**2)  # the floor under the robot itself
    images = tuple(
        BoardOnFloor(
            view.name,
            len(view.uv),
            rms([fit.residuals]),
            float(fit.value[0]),
            math.degrees(fit.value[1]),
            math.degrees(fit.value[2]),
            refused.get(index),
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
    """One image: (height, tilt, roll), its covariance for corners of 1 px, how it changes with the intrinsics (3, p)
    and with the floor under the board (its height, its tilts: (3, 3)), the residuals (n, 2) [px], and the directions
    that the pose took of them (2n, 6)."""

    value: Array
    covariance: Array
    by_intrinsics: Array
    by_floor: Array
    residuals: Array
    directions: Array


def _fit(view: View, intrinsics: Array, thickness: float) -> _Fit:
    try:
        pose, residuals, information = adjust_pose(view, intrinsics, start_pose(view, intrinsics))
        R, t, middle = so3_exp(pose[:3]), pose[3:], view.points.mean(axis=0)
        value = _height_tilt_roll(R, t, thickness)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise DegenerateGeometry(
            f"{view.name}: the board has no pose that lies before the camera and below it; "
            "lay it flat on the floor, in full view"
        ) from error

    def where_pose_is_off(off: Array) -> Array:
        return _height_tilt_roll(so3_exp(pose[:3] + off[:3]), t + off[3:], thickness)

    def where_floor_is_off(off: Array) -> Array:
        # higher under the board, or tilted about where it lies
        turned = R @ so3_exp([off[1], off[2], 0.0])
        return _height_tilt_roll(turned, t + (R - turned) @ middle + off[0] * R[:, 2], thickness)

    by_pose = _derivative(where_pose_is_off, 6)
    _, A, B = project(intrinsics, pose, view.points)
    return _Fit(
        value,
        by_pose @ np.linalg.solve(information, by_pose.T),
        # where the intrinsics change, the best pose does, too
        by_pose @ -np.linalg.solve(information, B.T @ A),
        _derivative(where_floor_is_off, 3),
        residuals,
        np.linalg.qr(B)[0],
    )


def _height_tilt_roll(R: Array, t: Array, thickness: float) -> Array:
    """(height [m], tilt [rad], roll [rad]) of a camera that sees a board on the floor in the pose R (3, 3), t (3,)."""
    up = R[:, 2]
    distance = float(up @ -t)
    if distance < 0:  # a board's z is up or down as its corners are counted; the camera is above it
        up, distance = -up, -distance
    return np.array([distance + thickness, *tilt_and_roll(up)])


def _derivative(of: Callable[[Array], Array], size: int) -> Array:
    """Of a function of (size,) at zero."""
    step = 1e-6
    return np.array([(of(off) - of(-off)) / (2 * step) for off in step * np.eye(size)]).T


def _noise(views: Sequence[View], fitted: Sequence[_Fit], square: float) -> tuple[float, float]:
    """The corners' standard deviation an axis [px], and what independent ones would have that say as little.

    Corners that share errors with their four neighbours are fewer than they seem.
    """
    alone, shared = noise_and_shared(views, [f.residuals for f in fitted], [f.directions for f in fitted], square)
    return max(math.hypot(alone, shared), 1e-6), max(math.sqrt(alone**2 + 5 * shared**2), 1e-6)


def _refused_by_corners(fitted: Sequence[_Fit]) -> tuple[list[int], dict[int, str]]:
    off = [rms([fit.residuals]) for fit in fitted]
    usual = float(np.median(off))
    refused = {
        index: f"its corners are off by {one:.2f} px where {usual:.2f} px are usual: "
        "another board, or one that moved or is not flat"
        for index, one in enumerate(off)
        if one > OUTLIER * max(usual, LEAST_NOISE)
    }
    return [index for index in range(len(fitted)) if index not in refused], refused


def _refused_by_others(views: Sequence[View], said: Said, kept: list[int]) -> tuple[list[int], dict[int, str]]:
    """The images that agree, and those whose board is not in the plane of the others: the furthest goes first."""
    refused: dict[int, str] = {}
    kept = list(kept)
    while len(kept) > 1:
        off = disagreement(said.of(kept))
        worst = int(off.argmax())
        others = kept[:worst] + kept[worst + 1 :]
        rest = fuse(said.of(others))
        apart = said.values[kept[worst]] - rest.value
        # of boards that are not quite flat, or a floor that is not, all are off by more than noise: so many times
        usual = min(float(np.median(off) / chdtri(3, 0.5)), rest.chi2 / rest.dof) if rest.dof else 1.0
        by_chance = off[worst] <= max(usual, 1.0) * chdtri(3, CHANCE / len(views))
        if by_chance or (abs(apart[0]) < NEAR_HEIGHT and np.abs(apart[1:]).max() < math.radians(NEAR_DEG)):
            break
        if len(kept) == 2:
            a, b = (views[index].name for index in kept)
            raise InputError(
                f"{a} and {b} contradict each other by {_difference(apart)}: one board was not flat on the floor; "
                "take a third image, or leave one out"
            )
        index, kept = kept[worst], others
        refused[index] = (
            f"its board is not in the plane of the others, by {_difference(apart)}: "
            "not flat on the floor, or the robot moved"
        )
        if len(refused) > max(1, len(views) // 3):
            raise InputError(
                f"{len(refused)} of {len(views)} images contradict the others ({views[index].name}: {refused[index]}); "
                "lay the board flat on the floor in each, and leave the robot where it is"
            )
    return kept, refused


def _difference(off: Array) -> str:
    height, tilt, roll = 1000 * off[0], *np.rad2deg(off[1:])
    return f"{height:.1f} mm in height, {tilt:.2f} deg in tilt and {roll:.2f} deg in roll"
