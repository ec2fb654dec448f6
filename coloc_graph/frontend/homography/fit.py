"""Fit the homography between two images of points on a plane: robustly first, then on SL(3) to the inliers.

Two criteria (Hartley and Zisserman, "Multiple View Geometry", section 4.2):

- "transfer" is the paper's, and OpenCV's: least squares in image j, with image i taken as exact.
- "reprojection" is maximum likelihood: x_i = z + noise, x_j = pi(H z) + noise with z the true position of each
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
)
from coloc_graph.frontend.homography.scatter import variance_factor
from coloc_graph.geometry.lie import sl3_normalise

Array = NDArray[np.float64]

INLIER_GATE = 13.8  # squared residual of a point; 99.9 % of chi-square with 2 degrees of freedom
MEDIAN_CHI2 = 1.386  # median of chi-square with 2 degrees of freedom
MAX_VARIANCE_SCALE = 25.0  # factor by which the points' variance may exceed the stated one
COLLINEAR_SIGMAS = 5.0  # standard deviations from a line within which points count as collinear
MIN_OFF_LINE = 0.15  # share of the points that must lie off the line
STRAIGHT = 0.03  # ratio of the spreads across and along below which a track is straight, whatever the noise
MIN_POINTS = 6  # two equations a point for eight unknowns, and some to check
MIN_AGREEING_SHARE = 0.9  # share of the points that agree on a homography where hardly any is wrong
MAGSAC_SIGMAS = 10.0  # standard deviations up to which MAGSAC++ marginalises the noise
CORRELATION_SIGMAS = 3.5  # standard deviations, 1 / sqrt(n), above which n residuals count as correlated


@dataclass(frozen=True, eq=False)
class HomographyFit:
    """Fitted homography.

    Attributes
    ----------
    H
        Homography, x_j ~ H x_i in normalised coordinates, determinant 1, (3, 3).
    information
        Information of its sl(3) coordinates on the right, (8, 8).
    inliers
        Mask of the points that it explains, (n,).
    squared_residuals
        Squared reprojection errors of both images together, in units of the noise, (n,).
    chi2, dof
        Their sum over the inliers, and its degrees of freedom.
    iterations
        Number of Gauss-Newton steps.
    persistence
        Number of successive points that count as one, since their errors are correlated (`persisting`).
    """

    H: Array
    information: Array
    inliers: NDArray[np.bool_]
    squared_residuals: Array
    chi2: float
    dof: int
    iterations: int
    persistence: float = 1.0


def fit_homography(pairs: PointPairs, criterion: Criterion = "reprojection", spread: float = 0.0) -> HomographyFit:
    """Fit a homography to point pairs that may contain outliers.

    Parameters
    ----------
    pairs
        The same points in two images, with covariances.
    criterion
        "reprojection" (maximum likelihood) or "transfer" (the paper's).
    spread
        Standard deviation of the logarithms of single fits' variances about the stated one (`scatter`).

    Returns
    -------
    HomographyFit
        The fit. Its information is divided by the factor by which its residuals exceed the stated covariances beyond
        chance, or differ from them as those of other fits do (`scatter.variance_factor`); its `chi2` is not scaled.

    Raises
    ------
    DegenerateGeometry
        The points do not determine a homography; the message names the remedy.

    Notes
    -----
    MAGSAC++ (Barath et al., 2020) gives the start; the criterion is then minimised over the inliers until their set no
    longer changes.
    """
    _require_points(len(pairs), len(pairs))
    sigma = pairs.sigma
    _require_spread(pairs, sigma)
    H = _magsac(pairs, sigma)
    inliers = _inliers(squared_residuals(H, pairs), np.ones(len(pairs), bool))
    by_all = None
    agree = int(inliers.sum())
    if MIN_POINTS <= agree < MIN_AGREEING_SHARE * len(pairs) and _on_a_line(_spread(pairs.x_i[inliers], sigma), agree):
        # it ended at the straight track of one marker, which many homographies fit: all points tell if another is wrong
        by_all = _by_opencv(pairs, sigma, 0)
    if by_all is not None:
        among = _inliers(squared_residuals(by_all, pairs), np.ones(len(pairs), bool))
        H, inliers = (by_all, among) if among.sum() > inliers.sum() else (H, inliers)
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
    if len(agreeing) < MIN_AGREEING_SHARE * len(pairs):
        _require_spread(agreeing, sigma)
    chi2, dof = float(squared[before].sum()), 2 * int(before.sum()) - 8
    information = information / variance_factor(chi2, dof, spread)
    return HomographyFit(sl3_normalise(H), information, before, squared, chi2, dof, iterations)


def persisting(fit: HomographyFit, pairs: PointPairs, groups: NDArray[np.int64], times: Array) -> HomographyFit:
    """Reduce the information of a fit by the autocorrelation of its residuals.

    A mover that tilts on an uneven floor lifts its markers while it stands there; a bright background biases a marker
    while it passes.

    Parameters
    ----------
    fit, pairs
        Fit, and the points that it was made of.
    groups
        Track of each point, (n,).
    times
        Time of each point, (n,) [s].

    Returns
    -------
    HomographyFit
        The fit with its information divided by `persistence`.

    Notes
    -----
    The integrated autocorrelation time, summed while it exceeds chance, is the number of points that count as one:
    A. Sokal, "Monte Carlo Methods in Statistical Mechanics", 1989.
    """
    kept = np.flatnonzero(fit.inliers)
    kept = kept[np.lexsort((times[kept], groups[kept]))]
    at = linearise(fit.H, pairs.x_i[kept], pairs[kept])
    e, group = np.stack([at.e0, at.e1], axis=1), groups[kept]
    # lags up to a third of a group; longer ones have too few pairs
    most = int(np.bincount(np.unique(group, return_inverse=True)[1]).max()) // 3
    variance, total = float((e**2).mean()), 1.0
    for lag in range(1, most + 1):
        alike = group[lag:] == group[:-lag]
        n = 2 * int(alike.sum())
        rho = float((e[lag:][alike] * e[:-lag][alike]).sum()) / (n * variance) if n and variance > 0 else 0.0
        if rho < CORRELATION_SIGMAS / math.sqrt(max(n, 1)):
            break
        total += 2 * rho
    return replace(fit, information=fit.information / total, persistence=total)


def _inliers(squared: Array, among: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask of points within the gate, which widens if residuals `among` the inliers exceed noise and chance."""
    own = squared[among]
    scale = np.partition(own, len(own) // 2)[len(own) // 2] / MEDIAN_CHI2 if len(own) else 1.0
    # a median of n has a relative spread of about 1.4 / sqrt(n); three times that is no longer chance
    scale = min(scale, MAX_VARIANCE_SCALE) if scale > 1 + 4.3 / math.sqrt(len(own) + 1) else 1.0
    return np.asarray(squared < INLIER_GATE * scale)


@dataclass(frozen=True)
class _Spread:
    """Spread of points about the line that fits 80 % of them best.

    `off` is the number of points off it; `across` and `along` are the RMS spreads of those that fit.
    """

    off: int
    across: float
    along: float


def _spread(x: Array, sigma: float) -> _Spread:
    """Measure the spread of points (n, 2) with noise `sigma` about a line."""
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


def _least_off(n: int) -> int:
    """Number of n points off a line below which they are on it: a few false pairs must not pass for a spread."""
    return max(4, math.ceil(MIN_OFF_LINE * n))


def _on_a_line(spread: _Spread, n: int) -> bool:
    return spread.off < _least_off(n)


def _require_points(n: int, of: int) -> None:
    if n < MIN_POINTS:
        what = f"{n} points are seen by both" if n == of else f"only {n} of {of} points agree on one homography"
        raise DegenerateGeometry(f"{what}, at least {MIN_POINTS} are needed: record for longer")


def _require_spread(pairs: PointPairs, sigma: float) -> None:
    # points on a line in one image are on a line in the other
    spread = _spread(pairs.x_i, sigma)
    if _on_a_line(spread, len(pairs)):
        if spread.along < COLLINEAR_SIGMAS * sigma:
            raise DegenerateGeometry(
                f"the markers hardly moved (their spread is {spread.along / sigma:.1f} sigma of their noise): "
                "let the moving robot drive further, and turn, or detect them better"
            )
        if spread.across < STRAIGHT * spread.along:
            raise DegenerateGeometry("the tracks lie on one line (the moving robot drove a straight line): let it turn")
        raise DegenerateGeometry(
            f"{len(pairs)} points are too few or too noisy for a homography: their spread across the best line is "
            f"{spread.across / sigma:.1f} sigma of their noise, and {spread.off} of them lie more than "
            f"{COLLINEAR_SIGMAS:.0f} sigma off it, where {_least_off(len(pairs))} are needed: record more points, "
            "spread on the plane, or detect them better"
        )


def _magsac(pairs: PointPairs, sigma: float) -> Array:
    H = _by_opencv(pairs, sigma, cv2.USAC_MAGSAC)
    if H is None:
        raise DegenerateGeometry("no homography explains the tracks: let the moving robot turn and drive further")
    return H


def _by_opencv(pairs: PointPairs, sigma: float, method: int) -> Array | None:
    """Homography by OpenCV's `method`, 0 for least squares over all points; None if there is none."""
    # in units of the noise: OpenCV's numerics want coordinates of the size of pixels
    H, _ = cv2.findHomography(pairs.x_i / sigma, pairs.x_j / sigma, method, MAGSAC_SIGMAS)
    if H is None or not abs(np.linalg.det(H)) > 1e-12:
        return None
    unit = np.array([1 / sigma, 1 / sigma, 1.0])
    return sl3_normalise(H * unit / unit[:, None])
