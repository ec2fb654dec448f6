"""Rotations, rigid motions and homographies as Lie groups: SO(3), SE(3), SL(3).

Vectorised over leading axes. The tangent of SE(3) is GTSAM's: rotation first, then translation, in the body
frame (T exp(xi)). The tangent of SL(3) is eight coordinates in the basis `SL3_BASIS`, also on the right.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
_IDENTITY: Array = np.eye(3)


def rotation_x(angle: ArrayLike) -> Array:
    """Rotations (..., 3, 3) about x by angles (...) [rad]."""
    return _turned(angle, 1, 2)


def rotation_y(angle: ArrayLike) -> Array:
    """Rotations (..., 3, 3) about y by angles (...) [rad]."""
    return _turned(angle, 2, 0)


def rotation_z(angle: ArrayLike) -> Array:
    """Rotations (..., 3, 3) about z by angles (...) [rad]."""
    return _turned(angle, 0, 1)


def _turned(angle: ArrayLike, a: int, b: int) -> Array:
    """Rotations from axis a to axis b."""
    angle = np.asarray(angle, float)
    out = np.zeros((*angle.shape, 3, 3))
    out[..., a, a] = out[..., b, b] = np.cos(angle)
    out[..., b, a] = sine = np.sin(angle)
    out[..., a, b] = -sine
    out[..., 3 - a - b, 3 - a - b] = 1.0
    return out


def hat(v: ArrayLike) -> Array:
    """Skew matrices (..., 3, 3) of vectors (..., 3): hat(a) @ b = a x b."""
    v = np.asarray(v, float)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def cross(a: Array, b: Array) -> Array:
    """Cross products (..., 3) of vectors (..., 3): numpy's own takes four times as long for a few."""
    return np.asarray((hat(a) @ b[..., None])[..., 0])


def across(N: ArrayLike) -> Array:
    """Two unit vectors (2, 3) orthogonal to a unit vector (3,) and to each other."""
    return np.asarray(np.linalg.svd(np.asarray(N, float)[None])[2][1:])


def closest_rotation(M: ArrayLike) -> Array:
    """The rotations (..., 3, 3) nearest to matrices (..., 3, 3) in the Frobenius norm."""
    R = np.asarray(M, float)
    # near a rotation a few Newton-Schulz steps suffice, at a fraction of the cost of an SVD
    for _ in range(6):
        off = R.mT @ R - np.eye(3)
        size = np.abs(off).max(initial=0.0)
        if size < 1e-15 * 8:
            return R
        if not size < 0.3 or np.linalg.det(R).min(initial=1.0) < 0:
            break
        R = R - 0.5 * R @ off + 0.375 * R @ off @ off
    U, _, Vt = np.linalg.svd(np.asarray(M, float))
    D = np.zeros_like(U)
    D[..., 0, 0] = D[..., 1, 1] = 1.0
    D[..., 2, 2] = np.linalg.det(U @ Vt)
    return np.asarray(U @ D @ Vt)


def quaternion(R: ArrayLike) -> tuple[float, float, float, float]:
    """The unit quaternion (w, x, y, z), w >= 0, of one rotation (3, 3).

    From the largest part, which is exact at every angle: Shepperd, "Quaternion from Rotation Matrix", 1978.
    """
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(R, float).tolist()
    parts = (a + e + i, a - e - i, e - a - i, i - a - e)
    largest = max(range(4), key=parts.__getitem__)
    q = (
        (1 + parts[0], h - f, c - g, d - b),
        (h - f, 1 + parts[1], b + d, c + g),
        (c - g, b + d, 1 + parts[2], f + h),
        (d - b, c + g, f + h, 1 + parts[3]),
    )[largest]
    norm = math.copysign(math.sqrt(sum(part * part for part in q)), q[0])
    return q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm


def so3_log(R: ArrayLike) -> Array:
    """Rotation vectors (..., 3) [rad] of rotations (..., 3, 3); the angle is at most pi."""
    R = np.asarray(R, float)
    # all four of Shepperd's forms, and of each rotation the one with the largest part
    a, b, c, d, e, f, g, h, i = np.moveaxis(R.reshape(*R.shape[:-2], 9), -1, 0)
    parts = np.stack([a + e + i, a - e - i, e - a - i, i - a - e], axis=-1)
    forms = np.stack(
        [
            np.stack([1 + parts[..., 0], h - f, c - g, d - b], axis=-1),
            np.stack([h - f, 1 + parts[..., 1], b + d, c + g], axis=-1),
            np.stack([c - g, b + d, 1 + parts[..., 2], f + h], axis=-1),
            np.stack([d - b, c + g, f + h, 1 + parts[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    q = np.take_along_axis(forms, parts.argmax(-1)[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1)
    angle = 2 * np.arctan2(sine, q[..., 0])
    scale = np.where(sine > 1e-12, angle / np.where(sine > 1e-12, sine, 1.0), 2.0)
    return np.asarray(scale[..., None] * q[..., 1:])


def so3_exp(w: ArrayLike) -> Array:
    """Rotations (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    w = np.asarray(w, float)
    W = hat(w)
    _, a, b = _sines(w)
    return np.asarray(_IDENTITY + a * W + b * (W @ W))


def _sines(w: Array) -> tuple[Array, Array, Array]:
    """Of rotation vectors (..., 3) the angle t, sin t / t, and (1 - cos t) / t^2; (..., 1, 1) each."""
    angle = np.sqrt((w * w).sum(-1))[..., None, None]
    half = np.maximum(angle / 2, 1e-150)
    sinc = np.sin(half) / half
    return angle, sinc * np.cos(half), sinc * sinc / 2


def se3_inverse(T_a_b: ArrayLike) -> Array:
    """T_b_a of T_a_b, (..., 4, 4)."""
    T = np.asarray(T_a_b, float)
    out = np.zeros_like(T)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, :3] = Rt
    out[..., :3, 3] = -(Rt @ T[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def se3_between(T_w_a: ArrayLike, T_w_b: ArrayLike) -> Array:
    """Poses T_a_b of T_w_a and T_w_b, (..., 4, 4); far from w it loses fewer digits than the product."""
    A, B = np.asarray(T_w_a, float), np.asarray(T_w_b, float)
    Rt = A[..., :3, :3].mT
    return se3(Rt @ B[..., :3, :3], (Rt @ (B[..., :3, 3] - A[..., :3, 3])[..., None])[..., 0])


def se3(R: ArrayLike, t: ArrayLike) -> Array:
    """Poses (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3)."""
    R = np.asarray(R, float)
    out = np.zeros((*R.shape[:-2], 4, 4))
    out[..., :3, :3] = R
    out[..., :3, 3] = t
    out[..., 3, 3] = 1.0
    return out


def floor_pose(x: ArrayLike, y: ArrayLike, yaw: ArrayLike) -> Array:
    """Poses (..., 4, 4) on the floor: x, y [m], yaw [rad]."""
    x, y, yaw = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float), np.asarray(yaw, float))
    out = np.zeros((*x.shape, 4, 4))
    out[..., 0, 0] = out[..., 1, 1] = np.cos(yaw)
    out[..., 1, 0] = np.sin(yaw)
    out[..., 0, 1] = -out[..., 1, 0]
    out[..., 0, 3], out[..., 1, 3] = x, y
    out[..., 2, 2] = out[..., 3, 3] = 1.0
    return out


def yaw(T: ArrayLike) -> Array:
    """Heading [rad] of poses (..., 4, 4) or rotations (..., 3, 3)."""
    T = np.asarray(T, float)
    return np.asarray(np.arctan2(T[..., 1, 0], T[..., 0, 0]))


def _sl3_basis() -> Array:
    basis = []
    for i in range(3):
        for j in range(3):
            if i != j:
                E = np.zeros((3, 3))
                E[i, j] = 1.0
                basis.append(E)
    return np.array([*basis, np.diag([1.0, -1.0, 0.0]), np.diag([0.0, 1.0, -1.0])])


#: Basis of sl(3), (8, 3, 3): the six off-diagonal units in row order, then diag(1, -1, 0), diag(0, 1, -1).
SL3_BASIS: Array = _sl3_basis()


def _vee_matrix() -> Array:
    """Matrix from the nine entries, row by row, to the coordinates: the pseudo-inverse of the basis.

    Without the identity's share of the diagonal.
    """
    entries = np.column_stack([SL3_BASIS.reshape(8, 9).T, np.eye(3).ravel()])
    return np.ascontiguousarray(np.linalg.inv(entries)[:8].T)


_VEE: Array = _vee_matrix()


def sl3_hat(h: ArrayLike) -> Array:
    """Traceless matrices (..., 3, 3) of coordinates (..., 8)."""
    return np.asarray(np.tensordot(np.asarray(h, float), SL3_BASIS, axes=1))


def sl3_vee(D: ArrayLike) -> Array:
    """Coordinates (..., 8) of matrices (..., 3, 3), whose trace is removed first."""
    D = np.asarray(D, float)
    return np.asarray(D.reshape(*D.shape[:-2], 9) @ _VEE)


# ad of each basis element, laid so that h @ _SL3_AD is ad(h)
_SL3_AD: Array = np.stack([sl3_vee(G @ SL3_BASIS - SL3_BASIS @ G).T for G in SL3_BASIS], axis=1)


def sl3_normalise(H: ArrayLike) -> Array:
    """Homographies (..., 3, 3) scaled to determinant 1 (the real cube root keeps the sign right)."""
    H = np.asarray(H, float)
    return np.asarray(H / np.cbrt(np.linalg.det(H))[..., None, None])


def sl3_exp(h: ArrayLike) -> Array:
    """Homographies (..., 3, 3) with determinant 1, of coordinates (..., 8)."""
    D = sl3_hat(h)
    # scaling and squaring about a Taylor series: exact to rounding for the small steps it serves, and batched
    norm = float(np.abs(D).sum(-1).max(initial=0.0))
    halvings = max(0, int(np.ceil(np.log2(norm / 0.25)))) if norm > 0.25 else 0
    D = D / 2**halvings
    E = term = np.broadcast_to(_IDENTITY, D.shape)
    largest, norm = 1.0, norm / 2**halvings
    for power in range(1, 13):
        largest *= norm / power
        if largest < 1e-18:
            break
        term = term @ D / power
        E = E + term
    for _ in range(halvings):
        E = E @ E
    return np.asarray(E)


def sl3_log(H: ArrayLike) -> Array:
    """Coordinates (..., 8) of homographies (..., 3, 3) with determinant 1; NaN where there is no real logarithm.

    log E = 2 artanh((E - 1)(E + 1)^-1), after square roots (Denman and Beavers, 1976) have brought E near the identity.
    """
    H = np.asarray(H, float)
    E = H.reshape(-1, 3, 3)
    Z, scale = _cayley(E), np.full(len(E), 2.0)
    for _ in range(8):
        far = ~(np.abs(Z).max(axis=(1, 2)) < 0.2)
        if not far.any():
            break
        E = E.copy()
        E[far] = _square_root(E[far])
        Z[far], scale[far] = _cayley(E[far]), 2 * scale[far]
    else:
        Z[~(np.abs(Z).max(axis=(1, 2)) < 0.2)] = np.nan
    # Z + Z^3 / 3 + Z^5 / 5 + ..., up to where terms are below rounding; the norm is that of the largest of all
    square = Z @ Z
    norm = math.sqrt(float(np.fmax.reduce((Z * Z).sum(axis=(1, 2)), initial=1e-34)))
    terms = max(1, math.ceil(16.5 / (-2 * math.log10(norm)))) if norm < 1 else 60
    series = _IDENTITY / (2 * terms + 1)
    for n in range(2 * terms - 1, 0, -2):
        series = _IDENTITY / n + square @ series
    return sl3_vee(Z @ series * scale[:, None, None]).reshape(*H.shape[:-2], 8)


def _square_root(E: Array) -> Array:
    with np.errstate(all="ignore"):
        Y, W = E, np.broadcast_to(_IDENTITY, E.shape)
        for _ in range(12):
            before = Y
            Y, W = (Y + _inverse(W)) / 2, (W + _inverse(Y)) / 2
            if not np.fmax.reduce(np.abs(Y - before), axis=None, initial=0.0) >= 1e-14:
                break
        return Y


def _cayley(E: Array) -> Array:
    return np.asarray((E - _IDENTITY) @ _inverse(E + _IDENTITY))


def _inverse(M: Array) -> Array:
    """Inverses (n, 3, 3), not finite where there is none."""
    with np.errstate(all="ignore"):
        try:
            return np.asarray(np.linalg.inv(M), float)
        except np.linalg.LinAlgError:
            singular = np.linalg.det(M)[:, None, None] == 0
            return np.asarray(np.linalg.inv(np.where(singular, np.nan, M)), float)


def sl3_adjoint(H: ArrayLike, H_inverse: ArrayLike) -> Array:
    """The adjoints (..., 8, 8) of homographies (..., 3, 3) of any scale: H exp(h) H^-1 = exp(Ad h)."""
    H, H_inverse = (np.asarray(one, float)[..., None, :, :] for one in (H, H_inverse))
    return np.asarray(sl3_vee(H @ SL3_BASIS @ H_inverse).mT)


def sl3_log_derivative(h: ArrayLike) -> Array:
    """Inverse right Jacobian of SL(3), (..., 8, 8): derivative of the coordinates of exp(h) exp(x) by x at 0."""
    ad = (np.asarray(h, float)[..., None, None, :] @ _SL3_AD)[..., 0, :]
    square = ad @ ad
    one = np.eye(8)
    return np.asarray(
        one + ad / 2 + square @ (one / 12 - square @ (one / 720 - square @ (one / 30240 - square / 1209600)))
    )


def se3_exp(xi: ArrayLike) -> Array:
    """Poses (..., 4, 4) of tangents (..., 6), rotation first."""
    xi = np.asarray(xi, float)
    w, v = xi[..., :3], xi[..., 3:]
    W = hat(w)
    square = W @ W
    angle, a, b = _sines(w)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    c = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    V = _IDENTITY + b * W + c * square
    return se3(_IDENTITY + a * W + b * square, (V @ v[..., None])[..., 0])


def se3_log(T: ArrayLike) -> Array:
    """Tangents (..., 6), rotation first, of poses (..., 4, 4)."""
    T = np.asarray(T, float)
    w = so3_log(T[..., :3, :3])
    W = hat(w)
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    small = angle < 1e-3
    half = np.where(small, 1.0, angle) / 2
    c = np.where(small, 1 / 12 + angle**2 / 720, (1 - half / np.tan(half)) / (4 * half**2))
    V_inverse = np.eye(3) - W / 2 + c * (W @ W)
    return np.concatenate([w, (V_inverse @ T[..., :3, 3:])[..., 0]], axis=-1)
