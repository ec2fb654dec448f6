"""The homography between two images of points on a plane: robust first, then a fit on SL(3) to the inliers.

Two criteria (Hartley and Zisserman, "Multiple View Geometry", section 4.2):

- "transfer" is the paper's, and OpenCV's: least squares in image j, which takes image i for exact.
- "reprojection" is maximum likelihood: x_i = z + noise, x_j = pi(H z) + noise with z the true place of each
  point in image i. Both images' noise counts; z is eliminated in closed form at each Gauss-Newton step.

The coordinates of a homography are those of sl(3) on the right: H exp(h), `lie.SL3_BASIS`.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.lie import sl3_hat, sl3_normalise

Array = NDArray[np.float64]
Criterion = Literal["transfer", "reprojection"]

#: 99.9 % of a chi-square variable with 2 degrees of freedom: the gate of a point's squared residual.
INLIER_GATE = 13.8
#: Its median.
MEDIAN_CHI2 = 1.386
#: How much larger than stated the points' variance may turn out to be.
WIDEST_SCALE = 25.0
#: Points that lie within this many sigmas of one line count as collinear.
COLLINEAR_SIGMAS = 5.0
#: The share of the points that have to lie off it.
LEAST_OFF_LINE = 0.15
MINIMUM_POINTS = 6
#: A fit has converged when a step lowers chi2 by less than this. The next one would lower it by about the square
#: of it times 1e-4 (measured); the first one, from z = x_i, does not count.
CONVERGED = 0.3
#: MAGSAC++ marginalises over noise up to this many times the stated one.
MAGSAC_SIGMAS = 10.0


@dataclass(frozen=True, eq=False)
class PointPairs:
    """The same n points in two images: normalised coordinates (n, 2) and their covariances (n, 2, 2)."""

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
class HomographyFit:
    """A fitted homography: `H` (3, 3) with x_j ~ H x_i and determinant 1.

    `information` (8, 8) is that of the sl(3) coordinates on the right. `squared_residuals` (n,) are both
    images' reprojection errors in units of the noise; `chi2` sums them over the `inliers` (n,) and has `dof`
    degrees of freedom.
    """

    H: Array
    information: Array
    inliers: NDArray[np.bool_]
    squared_residuals: Array
    chi2: float
    dof: int
    iterations: int


def fit_homography(pairs: PointPairs, criterion: Criterion = "reprojection") -> HomographyFit:
    """MAGSAC++ to start, then the criterion's fit over its inliers, until they are its own.

    Where the residuals are larger than the stated covariances explain, the gate and the information are scaled
    to what is seen (never the other way); `chi2` is not, so that it tells. Raises `DegenerateGeometry` where
    the points do not determine a homography, with the remedy.
    """
    _require_points(len(pairs), len(pairs))
    sigma = pairs.sigma
    _require_spread(pairs, sigma)
    H = _magsac(pairs, sigma)
    inliers = _inliers(squared_residuals(H, pairs), np.ones(len(pairs), bool))
    iterations = 0
    for _ in range(6):
        _require_points(int(inliers.sum()), len(pairs))
        agreeing = pairs if inliers.all() else pairs[inliers]
        H, information, used = refine(agreeing, H, criterion)
        iterations += used
        squared = squared_residuals(H, pairs)
        before, inliers = inliers, _inliers(squared, inliers)
        if (before == inliers).all():
            break
    if len(agreeing) < 0.9 * len(pairs):
        _require_spread(agreeing, sigma)
    chi2, dof = float(squared[before].sum()), 2 * int(before.sum()) - 8
    if chi2 > dof + 3 * np.sqrt(2 * dof):
        information = information * (dof / chi2)
    return HomographyFit(sl3_normalise(H), information, before, squared, chi2, dof, iterations)


def shared_error(fit: HomographyFit, pairs: PointPairs, groups: NDArray[np.int64], roots: tuple[Array, Array]) -> Array:
    """Covariance (8, 8) that errors add which all points of a group (n,) share, in each image.

    `roots` (n, 2, q) are square roots of such an error's covariance in image i and j at each point, normalised
    coordinates. Many points average noise away, but not this: a lens that is calibrated to 0.02 px, a marker
    whose background pulls it.
    """
    among, groups = pairs[fit.inliers], groups[fit.inliers]
    at = _linearise(fit.H, among.x_i, among)
    rows = _rows(at, among.x_i)
    weighted = np.linalg.inv(rows @ rows.mT) @ rows
    in_i, in_j = (root[fit.inliers] for root in roots)
    added = np.zeros((8, 8))
    for group in np.unique(groups):
        own = groups == group
        for moved in (-(at.by_z[own] @ in_i[own]), in_j[own]):
            whitened = np.concatenate([at.g0[own, None] * moved[:, 0], np.zeros_like(moved[:, 1])])
            whitened[len(moved) :] = at.g1[own, None] * (moved[:, 1] - at.k[own, None] * whitened[: len(moved)])
            by_error = weighted[:, np.tile(own, 2)] @ whitened
            added += by_error @ by_error.T
    return added


def _inliers(squared: Array, among: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Points within the gate, which widens with the typical residual of those that agree so far."""
    scale = np.median(squared[among]) / MEDIAN_CHI2 if among.any() else 1.0
    return np.asarray(squared < INLIER_GATE * np.clip(scale, 1.0, WIDEST_SCALE))


def _off_line(x: Array, sigma: float) -> int:
    """How many points (n, 2) lie off the line that most of them fit best."""
    near = x
    for _ in range(2):
        centre = near.mean(axis=0)
        (xx, xy), (_, yy) = (near - centre).T @ (near - centre)
        angle = 0.5 * np.arctan2(2 * xy, xx - yy)
        across = np.abs((x - centre) @ (-np.sin(angle), np.cos(angle)))
        near = x[across <= np.partition(across, int(0.8 * len(x)))[int(0.8 * len(x))]]
    return int(np.count_nonzero(across > COLLINEAR_SIGMAS * sigma))


def _require_points(n: int, of: int) -> None:
    if n < MINIMUM_POINTS:
        what = f"{n} points are seen by both" if n == of else f"only {n} of {of} points agree on one homography"
        raise DegenerateGeometry(f"{what}, at least {MINIMUM_POINTS} are needed: record for longer")


def _require_spread(pairs: PointPairs, sigma: float) -> None:
    # a few false pairs off a line must not pass for a spread: much of what decides has to be off it
    least = max(4, LEAST_OFF_LINE * len(pairs))
    if any(_off_line(x, sigma) < least for x in (pairs.x_i, pairs.x_j)):
        raise DegenerateGeometry("the tracks lie on one line (the moving robot drove a straight line): let it turn")


def _magsac(pairs: PointPairs, sigma: float) -> Array:
    # in units of the noise, and OpenCV's numerics like pixel-sized numbers
    H, _ = cv2.findHomography(pairs.x_i / sigma, pairs.x_j / sigma, cv2.USAC_MAGSAC, MAGSAC_SIGMAS)
    if H is None or not abs(np.linalg.det(H)) > 1e-12:
        raise DegenerateGeometry("no homography explains the tracks: let the moving robot turn and drive further")
    unit = np.array([1 / sigma, 1 / sigma, 1.0])
    return sl3_normalise(H * unit / unit[:, None])


@dataclass(frozen=True, eq=False)
class _Linearised:
    """pi(H z) against both images at each point, with the latent z eliminated and whitened.

    `e0`, `e1` (..., n) is the whitened residual; the whitening is (g0, -k g0 g1, g1). `b` are the six entries of
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
        b00, b01, _, b10, b11, _ = self.b
        return np.stack([np.stack([b00, b01], -1), np.stack([b10, b11], -1)], -2)


def _linearise(H: Array, z: Array, pairs: PointPairs) -> _Linearised:
    # component by component: numpy's stacks of 2x2 products cost more than all of this
    h = [[H[..., i, j, None] for j in range(3)] for i in range(3)]
    x, y = z[..., 0], z[..., 1]
    w = 1 / (h[2][0] * x + h[2][1] * y + h[2][2])
    p0 = (h[0][0] * x + h[0][1] * y + h[0][2]) * w
    p1 = (h[1][0] * x + h[1][1] * y + h[1][2]) * w
    b00, b01, b02 = ((h[0][j] - p0 * h[2][j]) * w for j in range(3))
    b10, b11, b12 = ((h[1][j] - p1 * h[2][j]) * w for j in range(3))
    r0, r1 = pairs.x_i[..., 0] - x, pairs.x_i[..., 1] - y
    c_i, c_j = pairs.covariance_i, pairs.covariance_j
    c00, c01, c11 = c_i[..., 0, 0], c_i[..., 0, 1], c_i[..., 1, 1]
    m00, m01 = b00 * c00 + b01 * c01, b00 * c01 + b01 * c11
    s00 = c_j[..., 0, 0] + m00 * b00 + m01 * b01
    s01 = c_j[..., 0, 1] + m00 * b10 + m01 * b11
    s11 = c_j[..., 1, 1] + b10 * (b10 * c00 + 2 * b11 * c01) + b11 * b11 * c11
    g0 = 1 / np.sqrt(s00)
    k = s01 * g0
    g1 = 1 / np.sqrt(s11 - k * k)
    e0 = (pairs.x_j[..., 0] - p0 - b00 * r0 - b01 * r1) * g0
    e1 = (pairs.x_j[..., 1] - p1 - b10 * r0 - b11 * r1 - k * e0) * g1
    return _Linearised((b00, b01, b02, b10, b11, b12), (r0, r1), e0, e1, g0, g1, k)


def _rows(at: _Linearised, z: Array, *, whiten: bool = True) -> Array:
    """d pi(H exp(h) z) / dh at h = 0, whitened, (..., 8, 2n): first all x, then all y. `lie.SL3_BASIS`'s order."""
    b00, b01, b02, b10, b11, b12 = at.b
    if whiten:
        b00, b01, b02 = b00 * at.g0, b01 * at.g0, b02 * at.g0
        b10, b11, b12 = (b10 - at.k * b00) * at.g1, (b11 - at.k * b01) * at.g1, (b12 - at.k * b02) * at.g1
    x, y = z[..., 0], z[..., 1]
    n = z.shape[-2]
    rows = np.empty((*z.shape[:-2], 8, 2 * n))
    for half, u, v, w in ((slice(0, n), b00, b01, b02), (slice(n, None), b10, b11, b12)):
        vy = v * y
        for index, entry in enumerate((u * y, u, v * x, v, w * x, w * y, u * x - vy, vy - w)):
            rows[..., index, half] = entry
    return rows


def _latent_step(at: _Linearised, left: Array, pairs: PointPairs) -> Array:
    """The best change (..., n, 2) of z, given what is left (..., 2n) of the whitened residual."""
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
    """A Gauss-Newton step; `DegenerateGeometry` where it leads nowhere (points beyond the horizon, wrong pairs)."""
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
    """The criterion's fit to all the points from a start H (..., 3, 3): H, its information (..., 8, 8), iterations.

    Vectorised over leading axes: m fits to n points each in one call. The information is that under both images'
    noise, whatever the criterion weighs.
    """
    return (_reprojection if criterion == "reprojection" else _transfer)(pairs, H, max_iterations)


def _reprojection(pairs: PointPairs, H: Array, max_iterations: int) -> tuple[Array, Array, int]:
    z = pairs.x_i
    for iteration in range(1, max_iterations + 1):
        at = _linearise(H, z, pairs)
        rows = _rows(at, z)
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
    limit = 1e-4 * pairs.sigma**2
    for iteration in range(1, max_iterations + 1):
        at = _linearise(H, pairs.x_i, pairs)
        rows = _rows(at, pairs.x_i, whiten=False)
        residual = np.concatenate([at.e0 / at.g0, at.e1 / at.g1 + at.k * at.e0], axis=-1)
        normal = rows @ rows.mT
        gradient = (rows @ residual[..., None])[..., 0]
        step = _solve(normal, gradient)
        H = H + H @ sl3_hat(step)
        if (step * gradient).sum(-1).max() < limit:
            break
    # unweighted least squares is not efficient: its covariance is the sandwich of the noise it did not weigh
    n = pairs.x_i.shape[-2]
    first, second = rows[..., :n], rows[..., n:]
    coloured = np.concatenate(
        [first / at.g0[..., None, :] + second * at.k[..., None, :], second / at.g1[..., None, :]], axis=-1
    )
    noise = coloured @ coloured.mT
    return sl3_normalise(H), np.asarray(normal @ np.linalg.solve(noise, normal), float), iteration


def squared_residuals(H: Array, pairs: PointPairs) -> Array:
    """Squared reprojection errors (..., n) of both images together, in units of the noise.

    To the first order in the noise (Sampson), which for points a thousandth of the image off is exact enough.
    """
    at = _linearise(H, pairs.x_i, pairs)
    return np.asarray(at.e0**2 + at.e1**2)


def direct(pairs: PointPairs) -> Array:
    """A start for `refine` where there are no outliers: the normalised direct linear transform, (..., 3, 3).

    Hartley, "In Defense of the Eight-Point Algorithm", 1997. Vectorised over leading axes.
    """
    S_i, S_j = _similarity(pairs.x_i), _similarity(pairs.x_j)
    u, v = np.moveaxis(pairs.x_i @ S_i[..., :2, :2].mT + S_i[..., None, :2, 2], -1, 0)
    x, y = np.moveaxis(pairs.x_j @ S_j[..., :2, :2].mT + S_j[..., None, :2, 2], -1, 0)
    zero, one = np.zeros_like(u), np.ones_like(u)
    rows = np.concatenate(
        [
            np.stack([u, v, one, zero, zero, zero, -x * u, -x * v, -x], axis=-1),
            np.stack([zero, zero, zero, u, v, one, -y * u, -y * v, -y], axis=-1),
        ],
        axis=-2,
    )
    H = np.linalg.eigh(rows.mT @ rows)[1][..., 0].reshape(*u.shape[:-1], 3, 3)
    return sl3_normalise(np.linalg.inv(S_j) @ H @ S_i)


def _similarity(x: Array) -> Array:
    """Moves points (..., n, 2) to the origin and to a spread of one, (..., 3, 3)."""
    middle = x.mean(axis=-2)
    scale = np.sqrt(2) / np.sqrt(((x - middle[..., None, :]) ** 2).sum(-1).mean(-1))
    S = np.zeros((*x.shape[:-2], 3, 3))
    S[..., 0, 0] = S[..., 1, 1] = scale
    S[..., :2, 2] = -scale[..., None] * middle
    S[..., 2, 2] = 1.0
    return S
