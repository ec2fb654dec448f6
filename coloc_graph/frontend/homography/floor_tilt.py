"""Error of a homography because an uneven floor tilts the mover, which lifts one of its markers off their plane.

The floor's slope belongs to a place: a mover that goes back and forth on a short way shows the same error each time, so
that neither more images reduce it nor do residuals show it. It is a random field, normal with the floor's stated sigma
in both directions, and alike over `GRAIN`. Both cameras see the same lifted marker.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coloc_graph.frontend.homography.fit import HomographyFit
from coloc_graph.frontend.homography.plane import on_plane
from coloc_graph.frontend.homography.smooth_errors import Sensitivity
from coloc_graph.frontend.pairing.correspondence import Correspondences
from coloc_graph.measurements import Plane
from coloc_graph.team import Camera

Array = NDArray[np.float64]

GRAIN = 0.05  # standard deviation of the Gaussian by which slopes at two places are alike [m]
MAX_BLOCKS = 600  # points above which neighbouring ones of a track are taken together


@dataclass(frozen=True, eq=False)
class FloorTilt:
    """Effect of the floor's slope under a mover on the inliers of a fit.

    Attributes
    ----------
    sigma
        Standard deviation of the slope in each direction [rad].
    middle
        Places (n, 2) of the mover on the marker plane [m].
    arm
        From there to the marker (n, 2) [m], by which a slope lifts it.
    homography
        Derivatives (8, n) of the homography's sl(3) coordinates on the right by it [1/m].
    lifted
        Derivatives (2, n, 2) of the points in both images by it [1/m].
    """

    sigma: float
    middle: Array
    arm: Array
    homography: Array
    lifted: Array

    @classmethod
    def of(
        cls,
        fit: HomographyFit,
        found: Correspondences,
        planes: tuple[Plane, Plane],
        cameras: tuple[Camera, Camera],
        sigma: float,
    ) -> "FloorTilt":
        """Find where the mover was, from the correspondences of its markers and the marker plane in both cameras.

        At instants at which one marker alone is seen it has the arm that its track has nearest in time. Points that are
        not on the plane before the cameras are taken not to be lifted.
        """
        kept = fit.inliers
        views = [replace(plane, N=one.R_camera_view.T @ plane.N) for plane, one in zip(planes, cameras, strict=True)]
        sides = [(x[kept], plane) for x, plane in zip((found.pairs.x_i, found.pairs.x_j), views, strict=True)]
        middle, arm = _arms(_on_floor(*sides[0]), found.times[kept], found.markers[kept])
        shifts = [_lifted(*side) for side in sides]
        good = np.isfinite(np.concatenate([middle, *shifts], axis=1)).all(axis=1)
        middle, arm, in_i, in_j = (np.where(good[:, None], one, 0.0) for one in (middle, arm, *shifts))
        sensitivity = Sensitivity(fit, found.pairs)
        homography = sensitivity.by_points(sensitivity.whitened((in_i, in_j)))
        return cls(sigma, middle, arm, homography, np.stack([in_i, in_j]))

    def covariance(self, tracks: NDArray[np.int64], times: Array) -> Array:
        """Compute the covariance (8, 8) of the homography's coordinates by the slope.

        `tracks` and `times` (n,) are those of the points.
        """
        by_slope = self.homography[:, :, None] * self.arm
        middle, by_slope = _in_blocks(self.middle, by_slope, np.lexsort((times, tracks)))
        return np.asarray(self.sigma**2 * np.einsum("anc,nm,bmc->ab", by_slope, alike(middle), by_slope, optimize=True))

    def of_spans(self, both: NDArray[np.int64], by_j: Array, B: Array) -> Array:
        """Compute `MarkerSpan.uneven` (m, 2, 2) of pairs `both` (m, 2) of inliers, the two markers at m instants.

        `by_j` (n, 2, 2) are the derivatives of fused positions by those in image j, `B` (n, 2, 2) those of positions
        in image j by those in image i. Instants at one place have one slope: each has the variance of all of them. It
        lifts one marker as far as it lowers the other.
        """
        in_i, in_j = self.lifted[:, both]
        shift = in_i + (by_j[both] @ (in_j - (B[both] @ in_i[..., None])[..., 0])[..., None])[..., 0]
        repeats = alike(self.middle[both[:, 0]]).sum(axis=1)
        lift = np.hypot(*np.moveaxis(self.arm[both], -1, 0)) * np.array([1.0, -1.0])
        return np.asarray(self.sigma * (np.sqrt(repeats)[:, None] * lift)[..., None] * shift)

    def widened(self, fit: HomographyFit, found: Correspondences) -> HomographyFit:
        """Return the fit with the slope in its information."""
        covariance = self.covariance(found.markers[fit.inliers], found.times[fit.inliers])
        information = np.linalg.inv(np.linalg.inv(fit.information) + covariance)
        return replace(fit, information=np.asarray(information, float))


def alike(places: Array, stretches: Array | None = None) -> Array:
    """Correlation (..., n, n) of the slopes at places (..., n, 2) [m].

    With `stretches` (..., n, 2) [m], that of their means along straight stretches about the places.
    """
    apart = places[..., :, None, :] - places[..., None, :, :]
    if stretches is None:
        return np.asarray(np.exp(-(apart**2).sum(axis=-1) / (2 * GRAIN**2)))
    # a normal density as wide as a stretch, along it
    x, y = stretches[..., 0] / math.sqrt(12), stretches[..., 1] / math.sqrt(12)
    xx, yy, xy = (one[..., :, None] + one[..., None, :] for one in (x * x + GRAIN**2 / 2, y * y + GRAIN**2 / 2, x * y))
    dx, dy, det = apart[..., 0], apart[..., 1], xx * yy - xy**2
    squared = (yy * dx**2 - 2 * xy * dx * dy + xx * dy**2) / det
    return np.asarray(GRAIN**2 / np.sqrt(det) * np.exp(-squared / 2))


def _on_floor(x: Array, plane: Plane) -> Array:
    """Places (n, 2) on the marker plane [m] of normalised coordinates (n, 2)."""
    across = np.linalg.svd(plane.N[None])[2][1:]
    return np.asarray(on_plane(x, plane) @ across.T)


def _lifted(x: Array, plane: Plane) -> Array:
    """Derivatives (n, 2) of normalised coordinates by the height of their points above the plane [1/m]."""
    points = on_plane(x, plane)
    return np.asarray((-plane.N[:2] + x * plane.N[2]) / points[:, 2:])


def _arms(at: Array, times: Array, tracks: NDArray[np.int64]) -> tuple[Array, Array]:
    """Middle of the mover (n, 2), and the arm (n, 2) from there to its marker, of points at (n, 2) [m]."""
    _, instant, count = np.unique(times, return_inverse=True, return_counts=True)
    mean = np.stack([np.bincount(instant, axis) for axis in at.T], axis=1) / count[:, None]
    whole = count[instant] > 1
    arm = np.where(whole[:, None], at - mean[instant], np.nan)
    for track in np.unique(tracks):
        own = tracks == track
        known, lone = np.flatnonzero(own & whole), np.flatnonzero(own & ~whole)
        if len(known) and len(lone):
            arm[lone] = arm[known[np.abs(times[lone, None] - times[known]).argmin(axis=1)]]
    return at - arm, np.nan_to_num(arm)


def _in_blocks(middle: Array, by_slope: Array, order: NDArray[np.int64]) -> tuple[Array, Array]:
    """Take successive points of a track together where there are too many: their mean place and summed effect."""
    size = -(-len(middle) // MAX_BLOCKS)
    if size <= 1:
        return middle, by_slope
    starts = np.arange(0, len(order), size)
    counts = np.diff(np.append(starts, len(order)))
    places = np.add.reduceat(middle[order], starts, axis=0) / counts[:, None]
    return places, np.add.reduceat(by_slope[:, order], starts, axis=1)
