"""Residuals taken apart: the error of a corner of its own, and the error that neighbours share."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from coloc_graph.calibration.bundle import Bundle, project
from coloc_graph.calibration.corners import View, neighbours

Array = NDArray[np.float64]


def noise_and_shared(
    views: Sequence[View], residuals: Sequence[Array], fitted: Sequence[Array], square: float
) -> tuple[float, float]:
    """Standard deviations per axis [px] of the error a corner has alone, and of what it shares with its neighbours.

    From the mean square of `residuals` (n, 2) and the mean product of those of corners one square apart, both freed of
    what was fitted: of errors that are independent the second is then 0 on average, and where it is less than twice as
    much as chance makes of them, it counts as 0. `fitted` are (2n, k), orthonormal: the directions that the fit took.
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
    """Directions in which a bundle's poses and intrinsics absorb each image's residuals: (2n, 6 + p)."""
    directions = []
    for view, pose in zip(views, bundle.poses, strict=True):
        _, A, B = project(bundle.intrinsics, pose, view.points)
        Q = np.linalg.qr(B)[0]
        A = A - Q @ (Q.T @ A)
        # the intrinsics are one for all images, so that each bears a part of what they take
        of_intrinsics = np.linalg.solve(np.linalg.cholesky(bundle.information), A.T).T
        directions.append(np.hstack([Q, of_intrinsics]))
    return directions
