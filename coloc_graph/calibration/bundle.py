"""Bundle adjustment of intrinsics and board poses, with the pose of each image eliminated.

Intrinsics are one vector, see `projection`. A board's pose is its
rotation vector [rad] and translation [m] in the camera frame, (6,), as in OpenCV.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.calibration.corners import View
from coloc_graph.calibration.projection import Model, pose_by_rays, project
from coloc_graph.errors import EstimationError
from coloc_graph.team import fisheye

Array = NDArray[np.float64]
MAX_STEPS = 300
# the next step would move no parameter by a thousandth of its standard deviation
CONVERGED = 1e-11  # relative decrease of the sum of squares by a step below which the search ends
INITIAL_DAMPING = 1e-9  # small: valleys are shallow (focal length: 1e-6 of the curvature) and starts are good
UNDETERMINED = "the images do not determine the camera: take more, with the board tilted and in all parts of the image"


@dataclass(frozen=True, eq=False)
class Bundle:
    """Adjusted camera and board poses.

    Attributes
    ----------
    intrinsics
        Intrinsics, (p,).
    poses
        Pose of the board in each image, (images, 6).
    residuals
        Observed minus projected corners of each image, (n, 2) [px].
    information
        Information of the intrinsics for corner noise of 1 px, with the poses eliminated, (p, p).
    influence
        Gradient of each image on the intrinsics, (images, p), which sums to zero at the optimum.
    model
        Lens model.
    """

    intrinsics: Array
    poses: Array
    residuals: tuple[Array, ...]
    information: Array
    influence: Array
    model: Model = "pinhole"

    @property
    def rms(self) -> float:
        """RMS distance of corners from their projections, as OpenCV's calibration reports it [px]."""
        return rms(self.residuals)


def rms(residuals: Sequence[Array]) -> float:
    """Root mean square length of residuals (n, 2) [px]."""
    every = np.concatenate(residuals)
    return float(np.sqrt((every**2).sum() / len(every)))


def start_pose(view: View, intrinsics: Array, model: Model = "pinhole") -> Array:
    """Initial pose (6,) of a board under known intrinsics, for `adjust_pose`."""
    if model == "fisheye":
        rays = fisheye.rays_of(tuple(intrinsics[4:].tolist()), (view.uv - intrinsics[2:4]) / intrinsics[:2])
        seen = np.isfinite(rays).all(axis=1)
        return pose_by_rays(rays[seen], view.points[seen])
    K = np.array([[intrinsics[0], 0, intrinsics[2]], [0, intrinsics[1], intrinsics[3]], [0, 0, 1.0]])
    # centred and scaled to unit size, as IPPE requires
    middle, size = view.points.mean(axis=0), np.abs(view.points).max()
    _, rotation, translation = cv2.solvePnP(
        (view.points - middle) / size, view.uv, K, intrinsics[4:], flags=cv2.SOLVEPNP_IPPE
    )
    R, _ = cv2.Rodrigues(rotation)
    return np.concatenate([rotation.ravel(), size * translation.ravel() - R @ middle])


def adjust(views: Sequence[View], intrinsics: Array, poses: Array, model: Model = "pinhole") -> Bundle:
    """Adjust intrinsics and board poses by Levenberg-Marquardt.

    Parameters
    ----------
    views
        Boards in images.
    intrinsics, poses
        Start, (p,) and (images, 6).
    model
        Lens model.

    Raises
    ------
    EstimationError
        The images do not determine the intrinsics.
    """
    intrinsics, poses = np.array(intrinsics, float), np.array(poses, float)
    damping, at = INITIAL_DAMPING, _linearise(views, intrinsics, poses, model)
    for _ in range(MAX_STEPS):
        try:
            step = _step(at, damping)
            moved = _linearise(views, intrinsics + step[0], poses + step[1], model)
        except np.linalg.LinAlgError:
            moved = None
        if moved is not None and moved.cost <= at.cost:  # NaN is not
            done = at.cost - moved.cost <= CONVERGED * max(at.cost, 1e-12)
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
    return Bundle(intrinsics, poses, at.residuals, S, influence, model)


def adjust_pose(view: View, intrinsics: Array, pose: Array, model: Model = "pinhole") -> tuple[Array, Array, Array]:
    """Adjust the pose of one board under known intrinsics.

    Returns its pose (6,), residuals (n, 2) [px], and information (6, 6) for corner noise of 1 px.
    """
    pose, damping = np.array(pose, float), INITIAL_DAMPING
    uv, _, B = project(intrinsics, pose, view.points, model)
    r = view.uv - uv
    for _ in range(MAX_STEPS):
        N = B.T @ B
        step = np.linalg.solve(N + damping * np.diag(np.diag(N)), B.T @ r.ravel())
        uv, _, moved_B = project(intrinsics, pose + step, view.points, model)
        moved = view.uv - uv
        gain = float((r**2).sum() - (moved**2).sum())
        if gain >= 0:
            pose, r, B, damping = pose + step, moved, moved_B, damping / 100
            if gain <= CONVERGED * max(float((r**2).sum()), 1e-12):
                break
        else:
            damping = 100 * damping
            if damping > 1e3:
                break
    return pose, r, B.T @ B


@dataclass(frozen=True, eq=False)
class _Linear:
    """Normal equations of each image: U = A'A, W = A'B, V = B'B, a = A'r, b = B'r."""

    cost: float
    residuals: tuple[Array, ...]
    U: Array
    W: Array
    V: Array
    a: Array
    b: Array


def _linearise(views: Sequence[View], intrinsics: Array, poses: Array, model: Model) -> _Linear:
    residuals, parts = [], []
    for view, pose in zip(views, poses, strict=True):
        uv, A, B = project(intrinsics, pose, view.points, model)
        r = view.uv - uv
        residuals.append(r)
        r = r.ravel()
        parts.append((A.T @ A, A.T @ B, B.T @ B, A.T @ r, B.T @ r))
    U, W, V, a, b = (np.array(part) for part in zip(*parts, strict=True))
    return _Linear(float(sum((r**2).sum() for r in residuals)), tuple(residuals), U, W, V, a, b)


def _reduced(at: _Linear, damping: float) -> tuple[Array, Array]:
    """Information (p, p) and gradients by image (images, p) of the intrinsics with the poses eliminated."""
    V = at.V + damping * at.V * np.eye(6)
    WV = np.linalg.solve(V, at.W.mT).mT
    S = (at.U - WV @ at.W.mT).sum(axis=0) + damping * at.U.sum(axis=0) * np.eye(at.U.shape[-1])
    return S, at.a - (WV @ at.b[..., None])[..., 0]


def _step(at: _Linear, damping: float) -> tuple[Array, Array]:
    S, pull = _reduced(at, damping)
    scale = 1 / np.sqrt(np.diag(S).clip(min=1e-300))  # pixels and lens coefficients differ by orders of magnitude
    step = scale * np.linalg.solve(scale * S * scale[:, None], scale * pull.sum(axis=0))
    V = at.V + damping * at.V * np.eye(6)
    return step, np.linalg.solve(V, (at.b - at.W.mT @ step)[..., None])[..., 0]
