"""The homography between two images of points on a plane: robust first, then a fit on SL(3) to the inliers.

Two criteria (Hartley and Zisserman, "Multiple View Geometry", section 4.2):

- "transfer" is the paper's, and OpenCV's: least squares in image j, which takes image i for exact.
- "reprojection" is maximum likelihood: x_i = z + noise, x_j = pi(H z) + noise with z the true place of each
  point in image i. Both images' noise counts; z is eliminated in closed form at each Gauss-Newton step.

The coordinates of a homography are those of sl(3) on the right: H exp(h), `lie.SL3_BASIS`.
"""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend.homography.refinement import (
    Criterion,
    PointPairs,
    linearise,
    refine,
    squared_residuals,
    whitened_rows,
)
from coloc_graph.geometry.lie import sl3_normalise

Array = NDArray[np.float64]

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
#: A spread across that is less than this share of the spread along is a straight line, whatever the noise.
STRAIGHT = 0.03
#: Fewer points give no homography worth the name: eight unknowns, two equations a point.
MINIMUM_POINTS = 6
#: MAGSAC++ marginalises over noise up to this many times the stated one.
MAGSAC_SIGMAS = 10.0
#: A correlation of n residuals stands out of chance above so many times 1 / sqrt(n).
CHANCE = 3.5


@dataclass(frozen=True, eq=False)
class HomographyFit:
    """A fitted homography: `H` (3, 3) with x_j ~ H x_i and determinant 1.

    `information` (8, 8) is that of the sl(3) coordinates on the right. `squared_residuals` (n,) are both
    images' reprojection errors in units of the noise; `chi2` sums them over the `inliers` (n,) and has `dof`
    degrees of freedom. `persistence` is how many points on end err alike (`persisting`): so much less the points say.
    """

    H: Array
    information: Array
    inliers: NDArray[np.bool_]
    squared_residuals: Array
    chi2: float
    dof: int
    iterations: int
    persistence: float = 1.0


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


def persisting(fit: HomographyFit, pairs: PointPairs, groups: NDArray[np.int64], times: Array) -> HomographyFit:
    """The fit with its information as points allow whose errors last, along each group's (n,) points in time (n,) [s].

    A mover that tilts on an uneven floor lifts its markers for as long as it stands there; a background pulls a marker
    for as long as it passes. The integrated autocorrelation of the residuals, as far as it stands out of chance, says
    how many points are as good as one. Source: A. Sokal, "Monte Carlo Methods in Statistical Mechanics", 1989.
    """
    kept = np.flatnonzero(fit.inliers)
    kept = kept[np.lexsort((times[kept], groups[kept]))]
    at = linearise(fit.H, pairs.x_i[kept], pairs[kept])
    e, group = np.stack([at.e0, at.e1], axis=1), groups[kept]
    # lags reach a third of a group at most: of longer ones there are too few pairs to tell
    most = int(np.bincount(np.unique(group, return_inverse=True)[1]).max()) // 3
    variance, total = float((e**2).mean()), 1.0
    for lag in range(1, most + 1):
        alike = group[lag:] == group[:-lag]
        n = 2 * int(alike.sum())
        rho = float((e[lag:][alike] * e[:-lag][alike]).sum()) / (n * variance) if n and variance > 0 else 0.0
        if rho < CHANCE / math.sqrt(max(n, 1)):
            break
        total += 2 * rho
    return replace(fit, information=fit.information / total, persistence=total)


def shared_error(fit: HomographyFit, pairs: PointPairs, groups: NDArray[np.int64], roots: tuple[Array, Array]) -> Array:
    """Covariance (8, 8) that errors add which all points of a group (n,) share, in each image.

    `roots` (n, 2, q) are square roots of such an error's covariance in image i and j at each point, normalised
    coordinates. Many points average noise away, but not this: a lens that is calibrated to 0.02 px, a marker
    whose background pulls it.
    """
    added = np.zeros((8, 8))
    if not any(root.shape[2] for root in roots):
        return added
    among, groups = pairs[fit.inliers], groups[fit.inliers]
    at = linearise(fit.H, among.x_i, among)
    rows = whitened_rows(at, among.x_i)
    weighted = np.linalg.inv(rows @ rows.mT) @ rows
    in_i, in_j = (root[fit.inliers] for root in roots)
    for group in np.unique(groups):
        own = groups == group
        for moved in (-(at.by_z[own] @ in_i[own]), in_j[own]):
            whitened = np.concatenate([at.g0[own, None] * moved[:, 0], np.zeros_like(moved[:, 1])])
            whitened[len(moved) :] = at.g1[own, None] * (moved[:, 1] - at.k[own, None] * whitened[: len(moved)])
            by_error = weighted[:, np.tile(own, 2)] @ whitened
            added += by_error @ by_error.T
    return added


def _inliers(squared: Array, among: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Points within the gate, which widens where those that agree so far are off by more than noise and chance."""
    own = squared[among]
    scale = np.partition(own, len(own) // 2)[len(own) // 2] / MEDIAN_CHI2 if len(own) else 1.0
    # a median of n has a relative spread of about 1.4 / sqrt(n); three times that is no longer chance
    scale = min(scale, WIDEST_SCALE) if scale > 1 + 4.3 / math.sqrt(len(own) + 1) else 1.0
    return np.asarray(squared < INLIER_GATE * scale)


@dataclass(frozen=True)
class _Spread:
    """How points lie about the line that most of them fit best.

    `off` counts those off it, `across` and `along` are the RMS spreads of the most.
    """

    off: int
    across: float
    along: float


def _spread(x: Array, sigma: float) -> _Spread:
    """The spread of points (n, 2) about a line, `sigma` being their noise."""
    near = x
    for _ in range(2):
        centre = near.mean(axis=0)
        (xx, xy), (_, yy) = (near - centre).T @ (near - centre)
        angle = 0.5 * np.arctan2(2 * xy, xx - yy)
        across = np.abs((x - centre) @ (-np.sin(angle), np.cos(angle)))
        close = across <= np.partition(across, int(0.8 * len(x)))[int(0.8 * len(x))]
        near = x[close]
    along = (near - centre) @ (np.cos(angle), np.sin(angle))
    return _Spread(
        off=int(np.count_nonzero(across > COLLINEAR_SIGMAS * sigma)),
        across=float(np.sqrt((across[close] ** 2).mean())),
        along=float(along.std()),
    )


def _require_points(n: int, of: int) -> None:
    if n < MINIMUM_POINTS:
        what = f"{n} points are seen by both" if n == of else f"only {n} of {of} points agree on one homography"
        raise DegenerateGeometry(f"{what}, at least {MINIMUM_POINTS} are needed: record for longer")


def _require_spread(pairs: PointPairs, sigma: float) -> None:
    # a few false pairs off a line must not pass for a spread: much of what decides has to be off it
    least = max(4, math.ceil(LEAST_OFF_LINE * len(pairs)))
    # points on a line in one image are on a line in the other
    spread = _spread(pairs.x_i, sigma)
    if spread.off < least:
        if spread.along < COLLINEAR_SIGMAS * sigma:
            raise DegenerateGeometry(
                f"the markers hardly moved (they spread by {spread.along / sigma:.1f} sigma of their noise): "
                "let the moving robot drive further, and turn, or detect them better"
            )
        if spread.across < STRAIGHT * spread.along:
            raise DegenerateGeometry("the tracks lie on one line (the moving robot drove a straight line): let it turn")
        raise DegenerateGeometry(
            f"{len(pairs)} points are too few or too noisy for a homography: they spread by "
            f"{spread.across / sigma:.1f} sigma of their noise across the line that most fit best, and {spread.off} "
            f"of them lie more than {COLLINEAR_SIGMAS:.0f} sigma off it, where {least} must: record more points, "
            "spread over the plane, or detect them better"
        )


def _magsac(pairs: PointPairs, sigma: float) -> Array:
    # in units of the noise, and OpenCV's numerics like pixel-sized numbers
    H, _ = cv2.findHomography(pairs.x_i / sigma, pairs.x_j / sigma, cv2.USAC_MAGSAC, MAGSAC_SIGMAS)
    if H is None or not abs(np.linalg.det(H)) > 1e-12:
        raise DegenerateGeometry("no homography explains the tracks: let the moving robot turn and drive further")
    unit = np.array([1 / sigma, 1 / sigma, 1.0])
    return sl3_normalise(H * unit / unit[:, None])
