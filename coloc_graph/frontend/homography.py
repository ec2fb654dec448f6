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
from coloc_graph.lie import SL3_BASIS, sl3_exp, sl3_normalise

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
        traces = np.trace(self.covariance_i + self.covariance_j, axis1=-2, axis2=-1)
        return float(np.sqrt(np.median(traces) / 4))


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
    _require_spread(pairs, len(pairs))
    H = _magsac(pairs)
    inliers = _inliers(squared_residuals(H, pairs), np.ones(len(pairs), bool))
    iterations = 0
    for _ in range(6):
        _require_spread(pairs[inliers], len(pairs))
        H, information, used = (_reprojection if criterion == "reprojection" else _transfer)(pairs[inliers], H)
        iterations += used
        squared = squared_residuals(H, pairs)
        before, inliers = inliers, _inliers(squared, inliers)
        if (before == inliers).all():
            break
    chi2, dof = float(squared[before].sum()), 2 * int(before.sum()) - 8
    if chi2 > dof + 3 * np.sqrt(2 * dof):
        information = information * (dof / chi2)
    return HomographyFit(H, information, before, squared, chi2, dof, iterations)


def shared_error(fit: HomographyFit, pairs: PointPairs, groups: NDArray[np.int64], roots: tuple[Array, Array]) -> Array:
    """Covariance (8, 8) that errors add which all points of a group (n,) share, in each image.

    `roots` (n, 2, q) are square roots of such an error's covariance in image i and j at each point, normalised
    coordinates. Many points average noise away, but not this: a lens that is calibrated to 0.02 px, a marker
    whose background pulls it.
    """
    among = pairs[fit.inliers]
    _, S_inverse, _, by_z, A = _eliminated(fit.H, among.x_i, among)
    weighted = np.linalg.solve(np.einsum("nka,nkl,nlb->ab", A, S_inverse, A), np.eye(8)) @ (
        A.swapaxes(1, 2) @ S_inverse
    )
    added = np.zeros((8, 8))
    for group in np.unique(groups[fit.inliers]):
        own = groups[fit.inliers] == group
        for moved in (-by_z[own] @ roots[0][fit.inliers][own], roots[1][fit.inliers][own]):
            by_error = (weighted[own] @ moved).sum(axis=0)
            added += by_error @ by_error.T
    return added


def _inliers(squared: Array, among: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Points within the gate, which widens with the typical residual of those that agree so far."""
    scale = np.median(squared[among]) / MEDIAN_CHI2 if among.any() else 1.0
    return np.asarray(squared < INLIER_GATE * np.clip(scale, 1.0, WIDEST_SCALE))


def _off_line(x: Array, sigma: float) -> int:
    """How many points (n, 2) lie off the line that most of them fit best."""
    near = np.ones(len(x), bool)
    for _ in range(3):
        centre = x[near].mean(axis=0)
        normal = np.linalg.svd(x[near] - centre, full_matrices=False)[2][1]
        across = np.abs((x - centre) @ normal)
        near = across <= np.quantile(across, 0.8)
    return int((across > COLLINEAR_SIGMAS * sigma).sum())


def _require_spread(pairs: PointPairs, of: int) -> None:
    n = len(pairs)
    if n < MINIMUM_POINTS:
        what = f"{n} points are seen by both" if n == of else f"only {n} of {of} points agree on one homography"
        raise DegenerateGeometry(f"{what}, at least {MINIMUM_POINTS} are needed: record for longer")
    # a few false pairs off a line must not pass for a spread: most of what decides has to be off it
    if min(_off_line(pairs.x_i, pairs.sigma), _off_line(pairs.x_j, pairs.sigma)) < max(4, LEAST_OFF_LINE * n):
        raise DegenerateGeometry("the tracks lie on one line (the moving robot drove a straight line): let it turn")


def _magsac(pairs: PointPairs) -> Array:
    unit = 1 / pairs.sigma  # the threshold is in units of the noise, and OpenCV's numerics like pixel-sized numbers
    H, _ = cv2.findHomography(
        pairs.x_i * unit, pairs.x_j * unit, cv2.USAC_MAGSAC, 10.0, maxIters=2000, confidence=0.9999
    )
    if H is None:
        raise DegenerateGeometry("no homography explains the tracks: let the moving robot turn and drive further")
    S = np.diag([unit, unit, 1.0])
    return sl3_normalise(np.linalg.inv(S) @ H @ S)


def transfer(H: Array, z: Array) -> tuple[Array, Array]:
    """pi(H z) (n, 2) of points z (n, 2), and its derivative by the homogeneous point's image H z (n, 2, 3)."""
    Y = z @ H[:, :2].T + H[:, 2]
    w = 1 / Y[:, 2]
    p = Y[:, :2] * w[:, None]
    J = np.zeros((len(z), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = w
    J[:, :, 2] = -p * w[:, None]
    return p, J


def _derivative_by_h(H: Array, z: Array, J: Array) -> Array:
    """d pi(H exp(h) z) / dh at h = 0, (n, 2, 8)."""
    z1 = np.concatenate([z, np.ones((len(z), 1))], axis=1)
    entries = ((J @ H)[..., None] * z1[:, None, None, :]).reshape(len(z), 2, 9)
    return np.asarray(entries @ SL3_BASIS.reshape(8, 9).T)


def _inverse_2x2(S: Array) -> Array:
    out = np.empty_like(S)
    a, b, c, d = S[:, 0, 0], S[:, 0, 1], S[:, 1, 0], S[:, 1, 1]
    out[:, 0, 0], out[:, 0, 1], out[:, 1, 0], out[:, 1, 1] = d, -b, -c, a
    return np.asarray(out / (a * d - b * c)[:, None, None])


def _eliminated(H: Array, z: Array, pairs: PointPairs) -> tuple[Array, Array, Array, Array, Array]:
    """With z eliminated: image j's residual, its inverse covariance, image i's residual, d pi/dz, d pi/dh."""
    p, J = transfer(H, z)
    by_z = J @ H[:, :2]
    r_i = pairs.x_i - z
    residual = pairs.x_j - p - (by_z @ r_i[..., None])[..., 0]
    S = pairs.covariance_j + by_z @ pairs.covariance_i @ by_z.swapaxes(1, 2)
    return residual, _inverse_2x2(S), r_i, by_z, _derivative_by_h(H, z, J)


def _latent_step(residual: Array, S_inverse: Array, r_i: Array, by_z: Array, pairs: PointPairs) -> Array:
    """The best change of z, given what is left of the eliminated residual."""
    back = by_z.swapaxes(1, 2) @ (S_inverse @ residual[..., None])
    return np.asarray(r_i + (pairs.covariance_i @ back)[..., 0])


def _solve(normal: Array, right: Array) -> Array:
    """A Gauss-Newton step; `DegenerateGeometry` where it leads nowhere (points beyond the horizon, wrong pairs)."""
    try:
        step = np.linalg.solve(normal, right)
    except np.linalg.LinAlgError:
        step = np.full(8, np.nan)
    if not np.abs(step).max() < 10.0:
        raise DegenerateGeometry("no homography explains the tracks: look for wrong pairs, let the moving robot turn")
    return np.asarray(step, float)


def _reprojection(pairs: PointPairs, H: Array, max_iterations: int = 20) -> tuple[Array, Array, int]:
    """Maximum likelihood: H, its information (8, 8), iterations."""
    z = pairs.x_i
    for iteration in range(1, max_iterations + 1):
        residual, S_inverse, r_i, by_z, A = _eliminated(H, z, pairs)
        weighted = S_inverse @ A
        information = np.einsum("nka,nkb->ab", A, weighted)
        step = _solve(information, np.einsum("nka,nk->a", weighted, residual))
        z = z + _latent_step(residual - A @ step, S_inverse, r_i, by_z, pairs)
        H = H @ sl3_exp(step)
        if step @ information @ step < 1e-12:
            break
    return H, information, iteration


def _transfer(pairs: PointPairs, H: Array, max_iterations: int = 20) -> tuple[Array, Array, int]:
    """Least squares in image j: H, its information (8, 8) under both images' noise, iterations."""
    for iteration in range(1, max_iterations + 1):
        p, J = transfer(H, pairs.x_i)
        A = _derivative_by_h(H, pairs.x_i, J)
        normal = np.einsum("nka,nkb->ab", A, A)
        step = _solve(normal, np.einsum("nka,nk->a", A, pairs.x_j - p))
        H = H @ sl3_exp(step)
        if step @ normal @ step < 1e-12 * pairs.sigma**2:
            break
    # unweighted least squares is not efficient: its covariance is the sandwich of the noise it did not weigh
    by_z = J @ H[:, :2]
    S = pairs.covariance_j + by_z @ pairs.covariance_i @ by_z.swapaxes(1, 2)
    half = np.linalg.solve(normal, np.einsum("nka,nkl,nlb->ab", A, S, A))
    return H, np.asarray(np.linalg.inv(np.linalg.solve(normal, half.T))), iteration


def squared_residuals(H: Array, pairs: PointPairs, iterations: int = 3) -> Array:
    """Squared reprojection errors (n,) of both images together, in units of the noise."""
    z = pairs.x_i
    for _ in range(iterations):
        residual, S_inverse, r_i, by_z, _A = _eliminated(H, z, pairs)
        z = z + _latent_step(residual, S_inverse, r_i, by_z, pairs)
    residual, S_inverse, *_ = _eliminated(H, z, pairs)
    return np.asarray(np.einsum("nk,nkl,nl->n", residual, S_inverse, residual))
