"""Choice of the number of lens coefficients, and the intrinsics without each part of the images."""

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
    """A number of lens coefficients that was tried: RMS of the fit, and of images that were held out of it [px].

    `why_not` says why it was not taken.
    """

    coefficients: int
    rms: float
    held_out_rms: float
    why_not: str | None = None


@dataclass(frozen=True, eq=False)
class Fit:
    """A bundle of all images, the intrinsics without each part (parts, p), and each part's mean square residual under
    the intrinsics without it (parts,) [px^2]."""

    bundle: Bundle
    without: Array
    held_out: Array

    @property
    def covariance(self) -> Array:
        """Of the intrinsics (p, p), by the jackknife."""
        off, parts = self.without - self.without.mean(axis=0), len(self.without)
        return np.asarray((parts - 1) / parts * off.T @ off)


def choose_lens(
    views: Views,
    start: Bundle,
    parts: NDArray[np.int64],
    wanted: Sequence[int],
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Fit, tuple[Trial, ...]]:
    """The fit with as few lens coefficients as will do, of the numbers `wanted` in rising order, and all trials.

    More are taken where images that were held out are predicted better, on average over the `parts` (n,) of the images
    by more than the standard error of that. One number alone is taken as it is.
    """
    count = int(parts.max()) + 1
    fits: dict[int, Fit] = {}
    unusable: dict[int, tuple[float, str]] = {}
    best = wanted[0]
    for done, coefficients in enumerate(wanted):
        bundle = adjust(views.views, _resized(start.intrinsics, coefficients), start.poses)
        why_not = folds(bundle.intrinsics, views.width, views.height)
        if why_not and coefficients != wanted[0]:
            unusable[coefficients] = bundle.rms, f"the lens {why_not}"
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
            off, why_not = unusable[coefficients]
            trials.append(Trial(coefficients, off, math.nan, why_not))
            continue
        fit = fits[coefficients]
        held_out = math.sqrt(np.average(fit.held_out, weights=weights))
        trials.append(Trial(coefficients, fit.bundle.rms, held_out, _why_not(coefficients, best)))
    return fits[best], tuple(trials)


def _why_not(coefficients: int, best: int) -> str | None:
    if coefficients == best:
        return None
    if coefficients < best:
        return "predicts images that were held out worse than more coefficients do"
    return "predicts images that were held out no better than fewer coefficients do"


def _held_out(views: Views, bundle: Bundle, parts: NDArray[np.int64]) -> Fit:
    without, squares = [], []
    for part in range(int(parts.max()) + 1):
        here = parts == part
        others = [view for view, held in zip(views.views, here, strict=True) if not held]
        intrinsics = adjust(others, bundle.intrinsics, bundle.poses[~here]).intrinsics
        residuals = [adjust_pose(views.views[i], intrinsics, bundle.poses[i])[1] for i in np.flatnonzero(here)]
        without.append(intrinsics)
        squares.append(rms(residuals) ** 2)
    return Fit(bundle, np.array(without), np.array(squares))


def _resized(intrinsics: Array, coefficients: int) -> Array:
    out = np.zeros(4 + coefficients)
    common = min(len(out), len(intrinsics))
    out[:common] = intrinsics[:common]
    return out
