"""Errors of marker centres that are smooth over the image, and their effect on a homography.

What all samples of a marker share in a stance is part of the homography's covariance. What a lens model leaves is the
same in all stances: its terms are variables of the joint estimate.
"""

import numpy as np
from numpy.typing import NDArray

from coloc_graph.frontend.homography.fit import HomographyFit
from coloc_graph.frontend.homography.refinement import PointPairs, linearise, whitened_rows
from coloc_graph.frontend.pairing.correspondence import Correspondences
from coloc_graph.team import Camera

Array = NDArray[np.float64]


def shared_error(fit: HomographyFit, pairs: PointPairs, groups: NDArray[np.int64], roots: tuple[Array, Array]) -> Array:
    """Covariance (8, 8) of the homography due to errors that all points of a group share in each image.

    Averaging over points does not reduce such errors: a lens calibrated to 0.02 px, a bias by a marker's background.

    Parameters
    ----------
    fit, pairs
        Fit, and the points that it was made of.
    groups
        Track of each point, (n,).
    roots
        Square roots (n, 2, q) of the shared error's covariance in image i and in image j, normalised coordinates.
    """
    added = np.zeros((8, 8))
    if not any(root.shape[2] for root in roots):
        return added
    sensitivity = Sensitivity(fit, pairs)
    among = groups[fit.inliers]
    for group in np.unique(among):
        for by_error in sensitivity.of(roots, among == group):
            added += by_error @ by_error.T
    return added


class Sensitivity:
    """Effect of shifts of its points on a homography."""

    def __init__(self, fit: HomographyFit, pairs: PointPairs) -> None:
        self._inliers = fit.inliers
        among = pairs[fit.inliers]
        self._at = linearise(fit.H, among.x_i, among)
        rows = whitened_rows(self._at, among.x_i)
        self._weighted = np.linalg.inv(rows @ rows.mT) @ rows

    def of(self, shifts: tuple[Array, Array], own: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Derivatives (8, q) by shifts (n, 2, q) in image i and in image j, of the inliers in a mask."""
        at = self._at
        in_i, in_j = (shift[self._inliers][own] for shift in shifts)
        made = []
        for moved in (-(at.by_z[own] @ in_i), in_j):
            whitened = np.concatenate([at.g0[own, None] * moved[:, 0], np.zeros_like(moved[:, 1])])
            whitened[len(moved) :] = at.g1[own, None] * (moved[:, 1] - at.k[own, None] * whitened[: len(moved)])
            made.append(self._weighted[:, np.tile(own, 2)] @ whitened)
        return made[0], made[1]

    def whitened(self, shifts: tuple[Array, Array]) -> Array:
        """Changes (m, 2) of the whitened residuals of the m inliers by shifts (m, 2) in image i and in image j."""
        at = self._at
        moved = shifts[1] - (at.by_z @ shifts[0][..., None])[..., 0]
        along = at.g0 * moved[:, 0]
        return np.stack([along, at.g1 * (moved[:, 1] - at.k * along)], axis=1)

    def by_points(self, whitened: Array) -> Array:
        """Derivatives (8, m) by numbers each of which changes the whitened residuals of one inlier by (m, 2)."""
        first, second = np.split(self._weighted, 2, axis=1)
        return np.asarray(first * whitened[:, 0] + second * whitened[:, 1])


def by_lenses(fit: HomographyFit, found: Correspondences, camera_i: Camera, camera_j: Camera) -> Array | None:
    """Derivatives (2, 8, q) of a homography by the terms that its cameras' lens models leave; None of exact lenses.

    A mount takes up what a lens does to all planes at its height; nothing takes it up of planes that are stated.
    """
    if not (camera_i.lens_px or camera_j.lens_px):
        return None
    sides = (camera_i, found.uv_i, found.pairs.x_i), (camera_j, found.uv_j, found.pairs.x_j)
    in_i, in_j = (camera.per_pixel(x) @ camera.lens_terms(uv) for camera, uv, x in sides)
    every = np.ones(int(fit.inliers.sum()), bool)
    return np.array(Sensitivity(fit, found.pairs).of((in_i, in_j), every))


def bias_root(uv: Array, x: Array, camera: Camera) -> Array:
    """Square root (n, 2, 6) of the covariance of a camera's bias at points, or (n, 2, 0) if it has none.

    The bias is an error that is smooth over the image, with a constant part and parts that grow across the points, each
    with standard deviation `bias_px`. `uv` are pixels, `x` normalised coordinates, (n, 2).
    """
    if not camera.bias_px:
        return np.empty((len(x), 2, 0))
    across = (uv - uv.mean(axis=0)) / np.maximum(uv.std(axis=0), 1.0)
    root = camera.bias_px * camera.per_pixel(x)
    return np.concatenate([root, across[:, :1, None] * root, across[:, 1:, None] * root], axis=2)
