"""Relative pose of two cameras from the homography of a plane: the paper's eq. (2), and both SVD solutions.

Convention (paper, section III; Ma et al., "An Invitation to 3-D Vision", section 5.3): x2 ~ H x1 in normalised
coordinates, H = R + T N^T / d, X2 = R X1 + T, N the unit normal in camera 1 from the camera to the plane,
d > 0 the camera's distance to it. (R, T) is T_c2_c1. All functions are vectorised over leading axes.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coloc_graph.geometry.lie import closest_rotation, cross

Array = NDArray[np.float64]


def metric_scale(H: ArrayLike) -> Array:
    """Homographies (..., 3, 3) scaled so that the middle singular value is 1 and det H > 0."""
    H = np.asarray(H, float)
    middle = np.linalg.svd(H, compute_uv=False)[..., 1]
    return np.asarray(H * (np.sign(np.linalg.det(H)) / middle)[..., None, None])


def decompose_with_normal(H: ArrayLike, N: ArrayLike, d: ArrayLike) -> tuple[Array, Array]:
    """Decompose homographies with a known plane normal, by the paper's eq. (2).

    Parameters
    ----------
    H
        Homographies, x2 ~ H x1 in normalised coordinates, (..., 3, 3), of any scale.
    N
        Unit normal of the plane in camera 1, from the camera to the plane, (..., 3).
    d
        Distance of camera 1 from the plane [m].

    Returns
    -------
    tuple of numpy.ndarray
        R (..., 3, 3) and T (..., 3) [m] of T_c2_c1.

    Notes
    -----
    v2 is the right singular vector of H for its middle singular value. Without noise N is orthogonal to v2 and W U^T is
    a rotation. With noise N is made orthogonal for U; T is computed from W U^T as the paper prints it, and R is the
    rotation nearest to it.
    """
    N, d, scaled = np.asarray(N, float), np.asarray(d, float), np.asarray(H, float)
    # the middle eigenvector and eigenvalue of H^T H are the middle right singular vector and value, squared
    squares, vectors = np.linalg.eigh(scaled.mT @ scaled)
    v2 = vectors[..., 1]
    scaled = scaled * (np.sign(np.linalg.det(scaled)) / np.sqrt(squares[..., 1]))[..., None, None]
    N_level = N - np.sum(N * v2, -1, keepdims=True) * v2
    N_level = N_level / np.linalg.norm(N_level, axis=-1, keepdims=True)
    WUt = _turn(scaled, v2, cross(N_level, v2), N_level)
    T = d[..., None] * ((scaled - WUt) @ N[..., None])[..., 0]
    return closest_rotation(WUt), np.asarray(T)


def decompose_svd(H: ArrayLike) -> tuple[Array, Array, Array]:
    """Decompose homographies without a known normal.

    Parameters
    ----------
    H
        Homographies, (..., 3, 3), of any scale.

    Returns
    -------
    tuple of numpy.ndarray
        R (2, ..., 3, 3), T/d (2, ..., 3) and N (2, ..., 3) of both solutions. Of the textbook's four these are the two
        whose plane lies in front of camera 1 (N_z > 0). If H is a pure rotation, T/d is 0 and N is undetermined.
    """
    given = np.asarray(H, float)
    _, s, Vt = np.linalg.svd(given)
    scaled = given * (np.sign(np.linalg.det(given)) / s[..., 1])[..., None, None]
    s = s / s[..., 1:2]
    v1, v2, v3 = Vt[..., 0, :], Vt[..., 1, :], Vt[..., 2, :]
    s1, s3 = s[..., 0] ** 2, s[..., 2] ** 2
    width = np.sqrt(np.maximum(s1 - s3, 1e-300))
    a, b = np.sqrt(np.maximum(1 - s3, 0.0)) / width, np.sqrt(np.maximum(s1 - 1, 0.0)) / width
    u = a[..., None] * v1 + np.multiply.outer([1.0, -1.0], b[..., None] * v3)
    N = cross(v2, u)
    R = closest_rotation(_turn(scaled, v2, u, N))
    N = N * np.where(N[..., 2:] < 0, -1.0, 1.0)
    return R, ((scaled - R) @ N[..., None])[..., 0], N


def _turn(H: Array, v2: Array, u: Array, N: Array) -> Array:
    """Rotation W U^T (..., 3, 3) that maps v2, u and N to H v2, H u and their cross product."""
    U = np.stack(np.broadcast_arrays(v2, u, N), axis=-1)
    W = H @ U
    W[..., 2] = cross(W[..., 0], W[..., 1])
    return np.asarray(W @ U.mT)


def choose_by_normal(N_solutions: ArrayLike, N: ArrayLike) -> tuple[NDArray[np.int64], Array]:
    """Index of the solution whose normal (2, ..., 3) is nearer to N (..., 3), and the angle between them [rad]."""
    cosine = np.sum(np.asarray(N_solutions, float) * np.asarray(N, float), axis=-1)
    which = cosine.argmax(axis=0)
    return which, np.arccos(np.clip(np.take_along_axis(cosine, which[None], axis=0)[0], -1.0, 1.0))
