"""Camera and board poses that explain the corners best: bundle adjustment, each image's pose eliminated.

Intrinsics are one vector: fx, fy, cx, cy [px], then OpenCV's k1, k2, p1, p2[, k3[, k4, k5, k6]]. A board's pose is its
rotation vector [rad] and translation [m] in the camera, (6,), as OpenCV has it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.calibration.corners import View
from coloc_graph.errors import EstimationError

Array = NDArray[np.float64]
#: Steps at most; a step that lowers the sum of squares by less than this part of it is the last: the next would move
#: no parameter by a thousandth of its sigma.
STEPS = 60
STILL = 1e-11
#: Damping to begin with: valleys are shallow (a focal length is a part in a million of the curvature), starts are good.
DAMPING = 1e-9
UNDETERMINED = "the images do not determine the camera; take more, with the board tilted and in all parts of the image"


@dataclass(frozen=True, eq=False)
class Bundle:
    """An adjusted camera: `intrinsics` (p,), `poses` (images, 6), `residuals` by image (n, 2) [px], seen - projected.

    `information` (p, p) is that of the intrinsics for corners of 1 px, the poses eliminated; `influence` (images, p)
    is what each image draws the intrinsics with, which sums to nothing at the optimum.
    """

    intrinsics: Array
    poses: Array
    residuals: tuple[Array, ...]
    information: Array
    influence: Array

    @property
    def rms(self) -> float:
        """Root mean square distance of a corner from its projection, as OpenCV's calibration states it [px]."""
        return rms(self.residuals)


def rms(residuals: Sequence[Array]) -> float:
    """Root mean square length of residuals (n, 2) [px]."""
    every = np.concatenate(residuals)
    return float(np.sqrt((every**2).sum() / len(every)))


def project(intrinsics: Array, pose: Array, points: Array) -> tuple[Array, Array, Array]:
    """Pixels (n, 2) of a board's points (n, 3), and how they change with intrinsics (2n, p) and pose (2n, 6)."""
    K = np.array([[intrinsics[0], 0, intrinsics[2]], [0, intrinsics[1], intrinsics[3]], [0, 0, 1.0]])
    uv, J = cv2.projectPoints(points[:, None], pose[:3], pose[3:], K, intrinsics[4:] if len(intrinsics) > 4 else None)
    return np.asarray(uv.reshape(-1, 2)), np.asarray(J[:, 6 : 6 + len(intrinsics)]), np.asarray(J[:, :6])


def start_pose(view: View, intrinsics: Array) -> Array:
    """A board's pose (6,) under known intrinsics, near enough for `adjust_pose`."""
    K = np.array([[intrinsics[0], 0, intrinsics[2]], [0, intrinsics[1], intrinsics[3]], [0, 0, 1.0]])
    # about its middle and in its own size, as the method wants a board to be
    middle, size = view.points.mean(axis=0), np.abs(view.points).max()
    _, rotation, translation = cv2.solvePnP(
        (view.points - middle) / size, view.uv, K, intrinsics[4:], flags=cv2.SOLVEPNP_IPPE
    )
    R, _ = cv2.Rodrigues(rotation)
    return np.concatenate([rotation.ravel(), size * translation.ravel() - R @ middle])


def adjust(views: Sequence[View], intrinsics: Array, poses: Array) -> Bundle:
    """The bundle of least squares from a start (p,), (images, 6), by Levenberg and Marquardt.

    Raises `EstimationError` where the images do not determine the intrinsics.
    """
    intrinsics, poses = np.array(intrinsics, float), np.array(poses, float)
    damping, at = DAMPING, _linearise(views, intrinsics, poses)
    for _ in range(STEPS):
        try:
            step = _step(at, damping)
            moved = _linearise(views, intrinsics + step[0], poses + step[1])
        except np.linalg.LinAlgError:
            moved = None
        if moved is not None and moved.cost <= at.cost:
            done = at.cost - moved.cost <= STILL * max(at.cost, 1e-12)
            intrinsics, poses, at, damping = intrinsics + step[0], poses + step[1], moved, damping / 100
            if done:
                break
        else:
            damping = 100 * damping
            if damping > 1e3:
                break
    try:
        S, influence = _reduced(at, 0.0)
    except np.linalg.LinAlgError as error:
        raise EstimationError(UNDETERMINED) from error
    return Bundle(intrinsics, poses, at.residuals, S, influence)


def adjust_pose(view: View, intrinsics: Array, pose: Array) -> tuple[Array, Array, Array]:
    """The pose (6,) of one board under known intrinsics, its residuals (n, 2) [px] and information (6, 6) at 1 px."""
    pose, damping = np.array(pose, float), DAMPING
    uv, _, B = project(intrinsics, pose, view.points)
    r = view.uv - uv
    for _ in range(STEPS):
        N = B.T @ B
        step = np.linalg.solve(N + damping * np.diag(np.diag(N)), B.T @ r.ravel())
        uv, _, moved_B = project(intrinsics, pose + step, view.points)
        moved = view.uv - uv
        gain = float((r**2).sum() - (moved**2).sum())
        if gain >= 0:
            pose, r, B, damping = pose + step, moved, moved_B, damping / 100
            if gain <= STILL * max(float((r**2).sum()), 1e-12):
                break
        else:
            damping = 100 * damping
            if damping > 1e3:
                break
    return pose, r, B.T @ B


@dataclass(frozen=True, eq=False)
class _Linear:
    """The normal equations, by image: U = A'A, W = A'B, V = B'B, a = A'r, b = B'r."""

    cost: float
    residuals: tuple[Array, ...]
    U: Array
    W: Array
    V: Array
    a: Array
    b: Array


def _linearise(views: Sequence[View], intrinsics: Array, poses: Array) -> _Linear:
    residuals, parts = [], []
    for view, pose in zip(views, poses, strict=True):
        uv, A, B = project(intrinsics, pose, view.points)
        r = view.uv - uv
        residuals.append(r)
        r = r.ravel()
        parts.append((A.T @ A, A.T @ B, B.T @ B, A.T @ r, B.T @ r))
    U, W, V, a, b = (np.array(part) for part in zip(*parts, strict=True))
    return _Linear(float(sum((r**2).sum() for r in residuals)), tuple(residuals), U, W, V, a, b)


def _reduced(at: _Linear, damping: float) -> tuple[Array, Array]:
    """Information (p, p) of the intrinsics with the poses eliminated, and each image's pull (images, p)."""
    V = at.V + damping * at.V * np.eye(6)
    WV = np.linalg.solve(V, at.W.mT).mT
    S = (at.U - WV @ at.W.mT).sum(axis=0) + damping * at.U.sum(axis=0) * np.eye(at.U.shape[-1])
    return S, at.a - (WV @ at.b[..., None])[..., 0]


def _step(at: _Linear, damping: float) -> tuple[Array, Array]:
    S, pull = _reduced(at, damping)
    scale = 1 / np.sqrt(np.diag(S).clip(min=1e-300))  # pixels and lens coefficients are worlds apart
    step = scale * np.linalg.solve(scale * S * scale[:, None], scale * pull.sum(axis=0))
    V = at.V + damping * at.V * np.eye(6)
    return step, np.linalg.solve(V, (at.b - at.W.mT @ step)[..., None])[..., 0]
