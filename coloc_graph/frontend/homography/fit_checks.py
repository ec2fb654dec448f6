"""Reject fitted homographies that few points agree on, or that the points do not determine."""

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend.homography.fit import HomographyFit
from coloc_graph.frontend.pairing.correspondence import Correspondences

MIN_AGREEMENT = 0.5  # share of the points that must agree on a homography
MIN_EIGENVALUE = 1e-10  # of the scaled information; below, a direction of the homography is undetermined
# an observer that moves during a stance: the share of agreeing points steps at one instant
MIN_STEP = 0.7  # step of that share
MIN_SIDE = 12  # points on either side of the step
MIN_TRAVEL = 60.0  # px that a marker moves through the image on either side
SMALL = 1.0  # px; points that disagree by less are of an uneven floor or a biased centroid, not of a movement


def require_agreement(fit: HomographyFit, found: Correspondences, who: str, pairing: str) -> None:
    """Raise `DegenerateGeometry` if too few points agree on one homography.

    Parameters
    ----------
    fit, found
        Fit, and the correspondences that it was made of.
    who
        The observers, in words, for the message.
    pairing
        The bound within which samples were paired in time, in words.

    Raises
    ------
    DegenerateGeometry
        Points disagree throughout, or from one instant on.
    """
    _require_still(fit.inliers | (_pixels_off(fit, found) < SMALL), found, who)
    if fit.inliers.mean() < MIN_AGREEMENT:
        raise DegenerateGeometry(
            f"only {fit.inliers.sum()} of {len(found)} points agree on one homography: "
            f"look for wrong marker names, reflections, or clocks that differ by more than {pairing}"
        )


def _require_still(agree: NDArray[np.bool_], found: Correspondences, who: str) -> None:
    """Raise `DegenerateGeometry` if points agree (n,) until one instant only, or from it on only."""
    times = found.times
    order = np.argsort(times, kind="stable")
    agreed, n = np.cumsum(agree[order]), len(agree)
    before = np.arange(MIN_SIDE, n - MIN_SIDE + 1)
    if not len(before):
        return
    step = agreed[before - 1] / before - (agreed[-1] - agreed[before - 1]) / (n - before)
    at = int(np.argmax(np.abs(step) * np.sqrt(before * (n - before))))
    if abs(step[at]) <= MIN_STEP:
        return
    agreeing, other = order[: before[at]], order[before[at] :]
    if step[at] < 0:
        agreeing, other = other, agreeing
    if _travel(found, other) <= MIN_TRAVEL:
        return
    if _travel(found, agreeing) <= MIN_TRAVEL:
        raise DegenerateGeometry(
            f"the moving robot hardly moved while the {len(agreeing)} points that agree were taken: let it drive "
            "further, or begin the stance when it sets off"
        )
    when = times[order[before[at]]] - times[order[0]]
    raise DegenerateGeometry(
        f"from {when:.1f} s after the first point on, points agree on another homography: {who} was bumped, a clock "
        "stepped, or the tracks of two lights were swapped during the stance; record the stance again"
    )


def _pixels_off(fit: HomographyFit, found: Correspondences) -> NDArray[np.float64]:
    """Reprojection errors of points (n,) in both images together [px]."""
    pairs = found.pairs
    per_unit = np.ptp(found.uv_i, axis=0).max() / np.ptp(pairs.x_i, axis=0).max()
    return np.asarray(np.sqrt(fit.squared_residuals) * pairs.sigma * per_unit)


def _travel(found: Correspondences, which: NDArray[np.int64]) -> float:
    """Largest extent of one marker's points of index `which` in image i [px]."""
    uv, markers = found.uv_i[which], found.markers[which]
    return max(float(np.ptp(uv[markers == one], axis=0).max()) for one in np.unique(markers))


def require_determined(fit: HomographyFit) -> None:
    """Raise `DegenerateGeometry` if points leave a direction of the homography undetermined."""
    scale = np.sqrt(np.diag(fit.information))
    least = np.linalg.eigvalsh(fit.information / np.outer(scale, scale))[0] if (scale > 0).all() else 0.0
    if not least > MIN_EIGENVALUE:
        raise DegenerateGeometry(
            f"{len(fit.inliers)} points do not determine the homography: let the moving robot drive further, and turn"
        )
