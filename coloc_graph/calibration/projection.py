"""Projection of board corners with derivatives, for both lens models, and the pose of a board from its rays.

Intrinsics are one vector: fx, fy, cx, cy [px], then the coefficients of the model as in `Camera.distortion`.
"""

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.team import fisheye

Array = NDArray[np.float64]
Model = Literal["pinhole", "fisheye"]


def project(intrinsics: Array, pose: Array, points: Array, model: Model = "pinhole") -> tuple[Array, Array, Array]:
    """Project points (n, 3) to pixels (n, 2), with derivatives by intrinsics (2n, p) and by pose (2n, 6)."""
    if model == "fisheye":
        return _through_fisheye(intrinsics, pose, points)
    K = np.array([[intrinsics[0], 0, intrinsics[2]], [0, intrinsics[1], intrinsics[3]], [0, 0, 1.0]])
    uv, J = cv2.projectPoints(points[:, None], pose[:3], pose[3:], K, intrinsics[4:] if len(intrinsics) > 4 else None)
    return np.asarray(uv.reshape(-1, 2)), np.asarray(J[:, 6 : 6 + len(intrinsics)]), np.asarray(J[:, :6])


def _through_fisheye(intrinsics: Array, pose: Array, points: Array) -> tuple[Array, Array, Array]:
    R, by_rotation = cv2.Rodrigues(pose[:3])
    p = points @ R.T + pose[3:]
    k = tuple(intrinsics[4:].tolist())
    m, _ = fisheye.image_of(k, p)
    focal, n = intrinsics[:2], len(points)
    by_pose = np.empty((n, 3, 6))
    by_pose[:, :, :3] = np.einsum("ijk,nk->nji", np.asarray(by_rotation).reshape(3, 3, 3), points)
    by_pose[:, :, 3:] = np.eye(3)
    B = focal[:, None] * (fisheye.derivative(k, p) @ by_pose)
    A = np.zeros((n, 2, len(intrinsics)))
    A[:, 0, 0], A[:, 1, 1] = m.T
    A[:, 0, 2] = A[:, 1, 3] = 1.0
    if k:
        r = np.hypot(p[:, 0], p[:, 1])
        theta = np.arctan2(r, p[:, 2])
        powers = theta[:, None] ** np.array([3, 5, 7, 9])
        outward = p[:, :2] / np.maximum(r, 1e-12)[:, None]
        A[:, :, 4:] = (focal * outward)[:, :, None] * powers[:, None, :]
    return m * focal + intrinsics[2:4], A.reshape(2 * n, -1), B.reshape(2 * n, 6)


def pose_by_rays(rays: Array, points: Array) -> Array:
    """Compute the pose (6,) of a plane board by a direct linear transform of unit rays.

    Rays may be at any angle from the axis: r ~ H (x, y, 1) says that r x H (x, y, 1) is 0.

    Parameters
    ----------
    rays
        Unit rays to the points, (n, 3).
    points
        Points on the board, z = 0, (n, 3) [m].
    """
    middle, size = points.mean(axis=0), np.abs(points - points.mean(axis=0)).max()
    q = np.column_stack([(points[:, :2] - middle[:2]) / size, np.ones(len(points))])
    x, y, z = rays.T[:, :, None]
    zero = np.zeros_like(q)
    rows = np.concatenate(
        [np.hstack([zero, -z * q, y * q]), np.hstack([z * q, zero, -x * q]), np.hstack([-y * q, x * q, zero])]
    )
    H = np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 3)
    H *= np.sign(((q @ H.T) * rays).sum())  # the points are in front of their rays' origin
    H *= 2 / (np.linalg.norm(H[:, 0]) + np.linalg.norm(H[:, 1]))
    U, _, Vt = np.linalg.svd(np.column_stack([H[:, 0], H[:, 1], np.cross(H[:, 0], H[:, 1])]))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return np.concatenate([cv2.Rodrigues(R)[0].ravel(), size * H[:, 2] - R @ middle])
