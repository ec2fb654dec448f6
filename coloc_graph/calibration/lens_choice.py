"""Choose the number of lens coefficients by cross-validation, which also gives the jackknife covariance."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coloc_graph.calibration.bundle import Bundle, adjust, adjust_pose, rms
from coloc_graph.calibration.corners import Views
from coloc_graph.calibration.lens import folds

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Trial:
    """Number of lens coefficients that was tried, with RMS of the fit and of held-out images [px].

    `rejected` is the reason why it was not chosen.
    """

    coefficients: int
    rms: float
    held_out_rms: float
    rejected: str | None = None


@dataclass(frozen=True, eq=False)
class Fit:
    """Cross-validated fit.

    Attributes
    ----------
    bundle
        Adjustment of all images.
    without
        Intrinsics without each part of the images, (parts, p).
    held_out
        Mean squared residual of each part under the intrinsics without it, (parts,) [px^2].
    """

    bundle: Bundle
    without: Array
    held_out: Array

    @property
    def covariance(self) -> Array:
        """Jackknife covariance of the intrinsics, (p, p)."""
        off, parts = self.without - self.without.mean(axis=0), len(self.without)
        return np.asarray((parts - 1) / parts * off.T @ off)


def choose_lens(
    views: Views,
    start: Bundle,
    parts: NDArray[np.int64],
    wanted: Sequence[int],
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Fit, tuple[Trial, ...]]:
    """Fit with the fewest lens coefficients that suffice.

    More are chosen if they predict held-out images better, on average over the parts, by more than the standard error.

    Parameters
    ----------
    views, start
        Boards in images, and an adjustment to start from.
    parts
        Number of the part of each image, (n,).
    wanted
        Numbers of lens coefficients to try, ascending; a single one is taken as it is.
    progress
        Called with (done, total).

    Returns
    -------
    tuple
        The chosen fit, and all trials.
    """
    count = int(parts.max()) + 1
    fits: dict[int, Fit] = {}
    unusable: dict[int, tuple[float, str]] = {}
    best = wanted[0]
    for done, coefficients in enumerate(wanted):
        bundle = adjust(views.views, _resized(start.intrinsics, coefficients), start.poses, start.model)
        fold = folds(bundle.intrinsics, views.width, views.height, bundle.model)
        if fold and coefficients != wanted[0]:
            unusable[coefficients] = bundle.rms, f"the lens {fold}"
        else:
            fits[coefficients] = _held_out(views, bundle, parts)
            better = fits[best].held_out - fits[coefficients].held_out
            if better.mean() > better.std(ddof=1) / math.sqrt(count):
                best = coefficients
        if progress is not None:
            progress(done + 1, len(wanted))
    weights = np.bincount(parts, weights=[len(view.uv) for view in views.views])
    trials = []
    for coefficients in wanted:
        if coefficients in unusable:
            off, reason = unusable[coefficients]
            trials.append(Trial(coefficients, off, math.nan, reason))
            continue
        fit = fits[coefficients]
        held_out = math.sqrt(np.average(fit.held_out, weights=weights))
        trials.append(Trial(coefficients, fit.bundle.rms, held_out, _rejected(coefficients, best)))
    return fits[best], tuple(trials)


def _rejected(coefficients: int, best: int) -> str | None:
    if coefficients == best:
        return None
    if coefficients < best:
        return "predicts held-out images worse than more coefficients do"
    return "predicts held-out images no better than fewer coefficients do"


def _held_out(views: Views, bundle: Bundle, parts: NDArray[np.int64]) -> Fit:
    without, squares = [], []
    for part in range(int(parts.max()) + 1):
        here = parts == part
        others = [view for view, held in zip(views.views, here, strict=True) if not held]
        intrinsics = adjust(others, bundle.intrinsics, bundle.poses[~here], bundle.model).intrinsics
        residuals = [
            adjust_pose(views.views[i], intrinsics, bundle.poses[i], bundle.model)[1] for i in np.flatnonzero(here)
        ]
        without.append(intrinsics)
        squares.append(rms(residuals) ** 2)
    return Fit(bundle, np.array(without), np.array(squares))


def _resized(intrinsics: Array, coefficients: int) -> Array:
    out = np.zeros(4 + coefficients)
    common = min(len(out), len(intrinsics))
    out[:common] = intrinsics[:common]
    return out
