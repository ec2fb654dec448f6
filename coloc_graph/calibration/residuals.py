"""Separate the residuals of corners into independent errors and errors that neighbours share."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from coloc_graph.calibration.bundle import Bundle
from coloc_graph.calibration.corners import View, neighbours
from coloc_graph.calibration.projection import project

Array = NDArray[np.float64]


def noise_and_shared(
    views: Sequence[View], residuals: Sequence[Array], fitted: Sequence[Array], square: float
) -> tuple[float, float]:
    """Estimate the standard deviations of independent and of shared corner errors.

    Parameters
    ----------
    views, residuals
        Boards in images, and their residuals, (n, 2) [px].
    fitted
        Orthonormal directions of the residuals that the fit absorbed, (2n, k).
    square
        Side of a square [m].

    Returns
    -------
    tuple of float
        Standard deviations of the independent and of the shared error, for each axis [px].

    Notes
    -----
    Both come from the mean square of residuals and the mean product of those one square apart, corrected for the fit.
    A product below twice its standard deviation under independence counts as 0.
    """
    squares = products = taken = taken_products = 0.0
    numbers = pairs = 0
    for view, r, E in zip(views, residuals, fitted, strict=True):
        E = E.reshape(len(r), 2, -1)
        first, second = neighbours(view.points, square).T
        squares += float((r**2).sum())
        taken += float((E**2).sum())
        products += float((r[first] * r[second]).sum())
        taken_products += float((E[first] * E[second]).sum())
        numbers += 2 * len(r)
        pairs += 2 * len(first)
    variance = squares / max(numbers - taken, 1.0)
    shared = (products + variance * taken_products) / max(pairs, 1)
    if shared < 2 * variance / math.sqrt(max(pairs, 1)):
        shared = 0.0
    return math.sqrt(max(variance - shared, 0.0)), math.sqrt(shared)


def fitted_directions(views: Sequence[View], bundle: Bundle) -> list[Array]:
    """Directions (2n, 6 + p) in which poses and intrinsics absorb each image's residuals."""
    directions = []
    for view, pose in zip(views, bundle.poses, strict=True):
        _, A, B = project(bundle.intrinsics, pose, view.points, bundle.model)
        Q = np.linalg.qr(B)[0]
        A = A - Q @ (Q.T @ A)
        # all images share the intrinsics, which absorb a part of each image's residuals
        of_intrinsics = np.linalg.solve(np.linalg.cholesky(bundle.information), A.T).T
        directions.append(np.hstack([Q, of_intrinsics]))
    return directions
