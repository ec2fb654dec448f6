"""Measure the span between two markers of a mover, which gives the joint estimate its scale and tilts."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from coloc_graph.frontend.homography.fit import HomographyFit
from coloc_graph.frontend.homography.floor_tilt import FloorTilt
from coloc_graph.frontend.homography.refinement import PointPairs, linearise, projection
from coloc_graph.frontend.pairing.correspondence import Correspondences
from coloc_graph.measurements import MarkerSpan

Array = NDArray[np.float64]


def marker_spans(
    couples: Mapping[str, tuple[int, int]],
    found: Correspondences,
    fit: HomographyFit,
    bias: Array,
    tilt: FloorTilt | None = None,
) -> tuple[MarkerSpan, ...]:
    """Measure marker spans of movers whose two markers are seen at the same instants.

    Parameters
    ----------
    couples
        Tracks of camera i of each mover's first and second marker, by the mover's name.
    found, fit
        Correspondences, and the homography fitted to them.
    bias
        Square root (n, 2, q) of the covariance of the error that all points of one track share in camera i.
    tilt
        Effect of the floor's slope under the mover; None where it is not known.

    Returns
    -------
    tuple of MarkerSpan
        Spans, of those movers only that some instant shows with both markers.
    """
    instants = {mover: _same_instants(found, fit, tracks) for mover, tracks in couples.items()}
    x, C, by_h, by_j, B = _from_both_images(found.pairs, fit)
    inlier = np.cumsum(fit.inliers) - 1  # number of a point among the inliers
    return tuple(
        MarkerSpan(
            mover, x[both], C[both], by_h[both], bias[both],
            uneven=None if tilt is None else tilt.of_spans(inlier[both], by_j[fit.inliers], B[fit.inliers]),
        )
        for mover, both in instants.items() if len(both)
    )  # fmt: skip


def _same_instants(found: Correspondences, fit: HomographyFit, tracks: Sequence[int]) -> NDArray[np.int64]:
    """Indices (n, 2) of the two tracks' points at the same instants."""
    first, second = (np.flatnonzero(fit.inliers & (found.markers == track)) for track in tracks)
    _, a, b = np.intersect1d(found.times[first], found.times[second], return_indices=True)
    return np.stack([first[a], second[b]], axis=1)


def _from_both_images(pairs: PointPairs, fit: HomographyFit) -> tuple[Array, Array, Array, Array, Array]:
    """Positions x (n, 2) in image i fused from both images, covariances (n, 2, 2), and derivatives by h (n, 2, 8).

    Besides, the derivatives (n, 2, 2) of x by positions in image j, and of these by those in image i.

    The error of the homography comes from the difference of the two images and the error of x from their weighted mean:
    at the true h the two are independent.
    """
    C_i, C_j = pairs.covariance_i, pairs.covariance_j
    if fit.dof > 0 and fit.chi2 > fit.dof + 3 * np.sqrt(2 * fit.dof):  # as the fit did with its information
        C_i, C_j = C_i * (fit.chi2 / fit.dof), C_j * (fit.chi2 / fit.dof)
    C_i, C_j = C_i * fit.persistence, C_j * fit.persistence
    at = linearise(fit.H, pairs.x_i, pairs)
    _, B, by_h = projection(fit.H, pairs.x_i)
    gain = C_i @ B.mT @ np.linalg.inv(C_j + B @ C_i @ B.mT)
    x = pairs.x_i + (gain @ at.residual_j[..., None])[..., 0]
    C = C_i - gain @ B @ C_i
    return x, (C + C.mT) / 2, -gain @ by_h, gain, B
