"""When a homography that was fitted is none to be believed, and why."""

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend.homography.fit import HomographyFit
from coloc_graph.frontend.pairing.correspondence import Correspondences

#: A homography that fewer of the points than this share agree on is not believed.
LEAST_AGREEMENT = 0.5
#: Directions of a homography are open that points determine by less than this share of others (eigenvalues).
DETERMINED = 1e-10
#: From some instant on so much larger or smaller a share of the points agrees, so many at least are on either side,
#: and a marker goes so far through the image on either [px]: then it is neither noise nor a light that stands, but an
#: observer that moved.
BROKEN = 0.7
LEAST_SIDE = 12
FAR = 60.0
SMALL = 1.0  # px, below which points that disagree are of an uneven floor or a biased centroid, and of no movement


def require_agreement(fit: HomographyFit, found: Correspondences, who: str, pairing: str) -> None:
    """Raise `DegenerateGeometry` where the points do not agree on one homography; `pairing` is what paired them."""
    _require_still(fit.inliers | (_pixels_off(fit, found) < SMALL), found, who)
    if fit.inliers.mean() < LEAST_AGREEMENT:
        raise DegenerateGeometry(
            f"only {fit.inliers.sum()} of {len(found)} points agree on one homography: "
            f"look for wrong marker names, reflections, or clocks that differ by more than {pairing}"
        )


def _require_still(agree: NDArray[np.bool_], found: Correspondences, who: str) -> None:
    """Raise `DegenerateGeometry` where points agree (n,) until an instant and then no more, or the other way round."""
    times = found.times
    order = np.argsort(times, kind="stable")
    so_far, n = np.cumsum(agree[order]), len(agree)
    before = np.arange(LEAST_SIDE, n - LEAST_SIDE + 1)
    if not len(before):
        return
    step = so_far[before - 1] / before - (so_far[-1] - so_far[before - 1]) / (n - before)
    at = int(np.argmax(np.abs(step) * np.sqrt(before * (n - before))))
    if abs(step[at]) <= BROKEN:
        return
    agreeing, other = order[: before[at]], order[before[at] :]
    if step[at] < 0:
        agreeing, other = other, agreeing
    if _travel(found, other) <= FAR:
        return
    if _travel(found, agreeing) <= FAR:
        raise DegenerateGeometry(
            f"the {len(agreeing)} points that agree are of a moving robot that hardly moved, and determine nothing: "
            "let it drive further, or begin the stance when it sets off"
        )
    when = times[order[before[at]]] - times[order[0]]
    raise DegenerateGeometry(
        f"{when:.1f} s after the first points, others begin that agree on another homography: {who} was bumped, a "
        "clock stepped, or the tracks of two lights were swapped while the stance was taken; take it again"
    )


def _pixels_off(fit: HomographyFit, found: Correspondences) -> NDArray[np.float64]:
    """How far points (n,) are from where the homography has them [px], both images together."""
    pairs = found.pairs
    per_unit = np.ptp(found.uv_i, axis=0).max() / np.ptp(pairs.x_i, axis=0).max()
    return np.asarray(np.sqrt(fit.squared_residuals) * pairs.sigma * per_unit)


def _travel(found: Correspondences, which: NDArray[np.int64]) -> float:
    """How far the marker that goes furthest goes in image i, in some of the points [px]."""
    uv, markers = found.uv_i[which], found.markers[which]
    return max(float(np.ptp(uv[markers == one], axis=0).max()) for one in np.unique(markers))


def require_determined(fit: HomographyFit) -> None:
    """Raise `DegenerateGeometry` where points leave a direction of the homography open, to rounding."""
    scale = np.sqrt(np.diag(fit.information))
    least = np.linalg.eigvalsh(fit.information / np.outer(scale, scale))[0] if (scale > 0).all() else 0.0
    if not least > DETERMINED:
        raise DegenerateGeometry(
            f"{len(fit.inliers)} points do not determine the homography: let the moving robot drive further, and turn"
        )
