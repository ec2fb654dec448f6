"""Fit homographies to point pairs without outliers, by least squares or maximum likelihood, many at once.

Everything is vectorised over leading axes. Coordinates of a homography are those of sl(3) on the right,
`lie.SL3_BASIS`; `homography.fit` explains the two criteria.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.geometry.lie import sl3_hat, sl3_normalise

Array = NDArray[np.float64]
Criterion = Literal["transfer", "reprojection"]

# the next step would lower chi2 by about the square of this times 1e-4 (measured); the first, from z = x_i, is ignored
CONVERGED = 0.3  # decrease of chi2 by a step below which a fit has converged


@dataclass(frozen=True, eq=False)
class PointPairs:
    """The same n points in images i and j: normalised coordinates (n, 2) and their covariances (n, 2, 2)."""

    x_i: Array
    x_j: Array
    covariance_i: Array
    covariance_j: Array

    def __len__(self) -> int:
        return len(self.x_i)

    def __getitem__(self, which: NDArray[np.bool_] | NDArray[np.int64]) -> "PointPairs":
        return PointPairs(self.x_i[which], self.x_j[which], self.covariance_i[which], self.covariance_j[which])

    @property
    def sigma(self) -> float:
        """Typical standard deviation of one coordinate in one image."""
        i, j = self.covariance_i, self.covariance_j
        return float(np.sqrt(np.median(i[..., 0, 0] + i[..., 1, 1] + j[..., 0, 0] + j[..., 1, 1]) / 4))


@dataclass(frozen=True, eq=False)
class Linearised:
    """Reprojection residuals of both images at each point, linearised, with the latent z eliminated, and whitened.

    `e0`, `e1` (..., n) are the whitened residuals; the whitening is (g0, -k g0 g1, g1). `b` are the six entries of
    d pi(D z) / dD at D = H, of which the first two of each row are also d pi / dz (`by_z`).
    """

    b: tuple[Array, ...]
    r: tuple[Array, Array]
    e0: Array
    e1: Array
    g0: Array
    g1: Array
    k: Array

    @property
    def by_z(self) -> Array:
        """Derivative of pi(H z) by z at each point, (..., n, 2, 2)."""
        return _by_z(self.b)

    @property
    def residual_j(self) -> Array:
        """Positions in image j less those that the homography predicts from image i, (..., n, 2)."""
        e0 = self.e0 / self.g0
        return np.stack([e0, self.e1 / self.g1 + self.k * self.e0], -1)


def _project(H: Array, z: Array) -> tuple[Array, Array, tuple[Array, ...]]:
    """Compute x and y (..., n) of pi(H z), and the six entries (..., n) of d pi(D z) / dD at D = H, row by row."""
    # component by component, since numpy's stacked 2x2 products would cost more than the rest
    h = [[H[..., i, j, None] for j in range(3)] for i in range(3)]
    x, y = z[..., 0], z[..., 1]
    w = 1 / (h[2][0] * x + h[2][1] * y + h[2][2])
    p0 = (h[0][0] * x + h[0][1] * y + h[0][2]) * w
    p1 = (h[1][0] * x + h[1][1] * y + h[1][2]) * w
    b0 = [(h[0][j] - p0 * h[2][j]) * w for j in range(3)]
    b1 = [(h[1][j] - p1 * h[2][j]) * w for j in range(3)]
    return p0, p1, (*b0, *b1)


def _by_z(b: tuple[Array, ...]) -> Array:
    b00, b01, _, b10, b11, _ = b
    return np.stack([np.stack([b00, b01], -1), np.stack([b10, b11], -1)], -2)


def projection(H: Array, z: Array) -> tuple[Array, Array, Array]:
    """Compute pi(H z) (n, 2), its derivative by z (n, 2, 2), and by h of H exp(h) at h = 0 (n, 2, 8)."""
    p0, p1, b = _project(H, z)
    return np.stack([p0, p1], -1), _by_z(b), _by_h(b, z)


def linearise(H: Array, z: Array, pairs: PointPairs) -> Linearised:
    """Linearise the residuals of H (..., 3, 3) on pairs (..., n) at latent positions z (..., n, 2) in image i."""
    p0, p1, b = _project(H, z)
    b00, b01, _, b10, b11, _ = b
    r0, r1 = pairs.x_i[..., 0] - z[..., 0], pairs.x_i[..., 1] - z[..., 1]
    g0, g1, k = _whitening(b, pairs)
    e0 = (pairs.x_j[..., 0] - p0 - b00 * r0 - b01 * r1) * g0
    e1 = (pairs.x_j[..., 1] - p1 - b10 * r0 - b11 * r1 - k * e0) * g1
    return Linearised(b, (r0, r1), e0, e1, g0, g1, k)


def _whitening(b: tuple[Array, ...], pairs: PointPairs) -> tuple[Array, Array, Array]:
    """Inverse Cholesky factor g0, g1, k (..., n) of both images' noise, propagated to image j."""
    b00, b01, _, b10, b11, _ = b
    c_i, c_j = pairs.covariance_i, pairs.covariance_j
    c00, c01, c11 = c_i[..., 0, 0], c_i[..., 0, 1], c_i[..., 1, 1]
    m00, m01 = b00 * c00 + b01 * c01, b00 * c01 + b01 * c11
    s00 = c_j[..., 0, 0] + m00 * b00 + m01 * b01
    s01 = c_j[..., 0, 1] + m00 * b10 + m01 * b11
    s11 = c_j[..., 1, 1] + b10 * (b10 * c00 + 2 * b11 * c01) + b11 * b11 * c11
    g0 = 1 / np.sqrt(s00)
    k = s01 * g0
    return g0, 1 / np.sqrt(s11 - k * k), k


def _rows(b: tuple[Array, ...], z: Array) -> Array:
    """Derivative of pi(H exp(h) z) by h at h = 0, in the order of `lie.SL3_BASIS`, (..., 8, 2n): all x, then all y."""
    x, y = z[..., 0], z[..., 1]
    n = z.shape[-2]
    rows = np.empty((*z.shape[:-2], 8, 2 * n))
    for half, (u, v, w) in ((slice(0, n), b[:3]), (slice(n, None), b[3:])):
        vy = v * y
        for index, entry in enumerate((u * y, u, v * x, v, w * x, w * y, u * x - vy, vy - w)):
            rows[..., index, half] = entry
    return rows


def _by_h(b: tuple[Array, ...], z: Array) -> Array:
    """`_rows` at each of n points, (n, 2, 8)."""
    return np.ascontiguousarray(np.moveaxis(_rows(b, z).reshape(8, 2, len(z)), 0, -1).swapaxes(0, 1))


def whitened_rows(at: Linearised, z: Array) -> Array:
    """Whitened `_rows`, (..., 8, 2n)."""
    upper = [entry * at.g0 for entry in at.b[:3]]
    lower = [(entry - at.k * above) * at.g1 for entry, above in zip(at.b[3:], upper, strict=True)]
    return _rows((*upper, *lower), z)


def _latent_step(at: Linearised, left: Array, pairs: PointPairs) -> Array:
    """Optimal change (..., n, 2) of z, given the remaining whitened residual (..., 2n)."""
    n = pairs.x_i.shape[-2]
    f1 = left[..., n:] * at.g1
    f0 = (left[..., :n] - at.k * f1) * at.g0
    b00, b01, _, b10, b11, _ = at.b
    back0, back1 = b00 * f0 + b10 * f1, b01 * f0 + b11 * f1
    c = pairs.covariance_i
    return np.stack(
        [
            at.r[0] + c[..., 0, 0] * back0 + c[..., 0, 1] * back1,
            at.r[1] + c[..., 0, 1] * back0 + c[..., 1, 1] * back1,
        ],
        axis=-1,
    )


def _solve(normal: Array, right: Array) -> Array:
    """Gauss-Newton step; raises `DegenerateGeometry` if it diverges (points beyond the horizon, wrong pairs)."""
    try:
        step = np.linalg.solve(normal, right[..., None])[..., 0]
    except np.linalg.LinAlgError:
        step = np.full_like(right, np.nan)
    if not np.abs(step).max() < 10.0:
        raise DegenerateGeometry("no homography explains the tracks: look for wrong pairs, let the moving robot turn")
    return np.asarray(step, float)


def refine(
    pairs: PointPairs, H: Array, criterion: Criterion = "reprojection", max_iterations: int = 20
) -> tuple[Array, Array, int]:
    """Minimise a criterion over all points from a start.

    Parameters
    ----------
    pairs
        Point pairs, (..., n).
    H
        Start, (..., 3, 3).
    criterion
        "reprojection" or "transfer".
    max_iterations
        Number of Gauss-Newton steps at most.

    Returns
    -------
    tuple
        H (..., 3, 3), its information (..., 8, 8) under both images' noise whatever the criterion, and the number of
        iterations.

    Raises
    ------
    DegenerateGeometry
        The search diverges.
    """
    return (_reprojection if criterion == "reprojection" else _transfer)(pairs, H, max_iterations)


def _reprojection(pairs: PointPairs, H: Array, max_iterations: int) -> tuple[Array, Array, int]:
    z = pairs.x_i
    for iteration in range(1, max_iterations + 1):
        at = linearise(H, z, pairs)
        rows = whitened_rows(at, z)
        residual = np.concatenate([at.e0, at.e1], axis=-1)
        information = rows @ rows.mT
        gradient = (rows @ residual[..., None])[..., 0]
        step = _solve(information, gradient)
        z = z + _latent_step(at, residual - (step[..., None, :] @ rows)[..., 0, :], pairs)
        H = H + H @ sl3_hat(step)
        if iteration > 1 and (step * gradient).sum(-1).max() < CONVERGED:
            break
    return sl3_normalise(H), information, iteration


def _transfer(pairs: PointPairs, H: Array, max_iterations: int) -> tuple[Array, Array, int]:
    H, iterations, b, rows = _least_squares(pairs, H, max_iterations)
    # unweighted least squares is not efficient: its covariance is a sandwich
    normal = rows @ rows.mT
    g0, g1, k = (part[..., None, :] for part in _whitening(b, pairs))
    n = pairs.x_i.shape[-2]
    first, second = rows[..., :n], rows[..., n:]
    coloured = np.concatenate([first / g0 + second * k, second / g1], axis=-1)
    noise = coloured @ coloured.mT
    return H, np.asarray(normal @ np.linalg.solve(noise, normal), float), iterations


def least_squares(pairs: PointPairs) -> Array:
    """Fit the paper's homographies, criterion "transfer", determinant 1, (..., 3, 3), to points without outliers."""
    return _least_squares(pairs, direct(pairs), 20)[0]


def _least_squares(pairs: PointPairs, H: Array, max_iterations: int) -> tuple[Array, int, tuple[Array, ...], Array]:
    limit = 30 * pairs.sigma**2  # the remaining error is a fiftieth of the estimate's sigma (measured)
    for iteration in range(1, max_iterations + 1):
        p0, p1, b = _project(H, pairs.x_i)
        rows = _rows(b, pairs.x_i)
        residual = np.concatenate([pairs.x_j[..., 0] - p0, pairs.x_j[..., 1] - p1], axis=-1)
        gradient = (rows @ residual[..., None])[..., 0]
        step = _solve(rows @ rows.mT, gradient)
        H = H + H @ sl3_hat(step)
        if (step * gradient).sum(-1).max() < limit:
            break
    return sl3_normalise(H), iteration, b, rows


def squared_residuals(H: Array, pairs: PointPairs) -> Array:
    """Squared reprojection errors (..., n) of both images together, in units of the noise, to first order (Sampson)."""
    at = linearise(H, pairs.x_i, pairs)
    return np.asarray(at.e0**2 + at.e1**2)


def direct(pairs: PointPairs) -> Array:
    """Normalised direct linear transform (..., 3, 3) of points without outliers: a start for `refine`.

    Source: Hartley, "In Defense of the Eight-Point Algorithm", 1997.
    """
    S_i, (u, v) = _similarity(pairs.x_i)
    S_j, (x, y) = _similarity(pairs.x_j)
    n = u.shape[-1]
    rows = np.zeros((*u.shape[:-1], 8, 2 * n))
    for half, first, seen in ((slice(0, n), 0, x), (slice(n, None), 3, y)):
        rows[..., first, half], rows[..., first + 1, half], rows[..., first + 2, half] = u, v, 1.0
        rows[..., 6, half], rows[..., 7, half] = -seen * u, -seen * v
    # with both centres at the origin the last entry is not near 0, and may be set to 1
    h = np.linalg.solve(rows @ rows.mT, rows @ np.concatenate([x, y], axis=-1)[..., None])[..., 0]
    H = np.concatenate([h, np.ones_like(h[..., :1])], axis=-1).reshape(*u.shape[:-1], 3, 3)
    return sl3_normalise(np.linalg.inv(S_j) @ H @ S_i)


def _similarity(points: Array) -> tuple[Array, tuple[Array, Array]]:
    """Similarity (..., 3, 3) that moves points (..., n, 2) to the origin with unit spread, and the moved x and y."""
    x, y = points[..., 0], points[..., 1]
    mean_x, mean_y = x.mean(axis=-1, keepdims=True), y.mean(axis=-1, keepdims=True)
    x, y = x - mean_x, y - mean_y
    scale = np.sqrt(2 / (x * x + y * y).mean(axis=-1, keepdims=True))
    S = np.zeros((*points.shape[:-2], 3, 3))
    S[..., 0, 0] = S[..., 1, 1] = scale[..., 0]
    S[..., 0, 2], S[..., 1, 2] = -(scale * mean_x)[..., 0], -(scale * mean_y)[..., 0]
    S[..., 2, 2] = 1.0
    return S, (x * scale, y * scale)
