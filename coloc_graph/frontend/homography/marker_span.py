"""Two markers of a robot at the same instants in both images: what the joint estimate takes scale and tilt from."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from coloc_graph.frontend.homography.fit import HomographyFit
from coloc_graph.frontend.homography.refinement import PointPairs, linearise, point_rows
from coloc_graph.frontend.pairing.correspondence import Correspondences
from coloc_graph.measurements import MarkerSpan

Array = NDArray[np.float64]


def marker_spans(
    couples: Mapping[str, tuple[int, int]], found: Correspondences, fit: HomographyFit, bias: Array
) -> tuple[MarkerSpan, ...]:
    """The spans of the markers of movers, by name, which are two of camera i's tracks; of those that some instant shows
    both of.

    `bias` (n, 2, q) is the square root of the covariance of what all points of one track share in camera i.
    """
    instants = {mover: _same_instants(found, fit, tracks) for mover, tracks in couples.items()}
    x, C, by_h = _from_both_images(found.pairs, fit)
    return tuple(
        MarkerSpan(mover, x[both], C[both], by_h[both], bias[both]) for mover, both in instants.items() if len(both)
    )


def _same_instants(found: Correspondences, fit: HomographyFit, tracks: Sequence[int]) -> NDArray[np.int64]:
    """Which points (n, 2) are the two tracks' at the same instants."""
    first, second = (np.flatnonzero(fit.inliers & (found.markers == track)) for track in tracks)
    _, a, b = np.intersect1d(found.times[first], found.times[second], return_indices=True)
    return np.stack([first[a], second[b]], axis=1)


def _from_both_images(pairs: PointPairs, fit: HomographyFit) -> tuple[Array, Array, Array]:
    """Where points are in image i by both images, x (n, 2), covariance (n, 2, 2), and what h adds to x (n, 2, 8).

    The homography's own error comes from what the two images say differently, and this from what they say alike: at
    the true h the two are independent.
    """
    C_i, C_j = pairs.covariance_i, pairs.covariance_j
    if fit.dof > 0 and fit.chi2 > fit.dof + 3 * np.sqrt(2 * fit.dof):  # as the fit did with its information
        C_i, C_j = C_i * (fit.chi2 / fit.dof), C_j * (fit.chi2 / fit.dof)
    C_i, C_j = C_i * fit.persistence, C_j * fit.persistence
    at = linearise(fit.H, pairs.x_i, pairs)
    B = at.by_z
    gain = C_i @ B.mT @ np.linalg.inv(C_j + B @ C_i @ B.mT)
    x = pairs.x_i + (gain @ at.residual_j[..., None])[..., 0]
    C = C_i - gain @ B @ C_i
    return x, (C + C.mT) / 2, -gain @ point_rows(at, pairs.x_i)
