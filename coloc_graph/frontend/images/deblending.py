"""Measure light spots that share image windows, each without the light of the others."""

import numpy as np
from numpy.typing import NDArray

from coloc_graph.frontend.images.centroid import Spots, matrices, measure_spots, rough_centre, rough_shape

Array = NDArray[np.float64]
Counts = NDArray[np.int64]

DEBLENDING_ROUNDS = 6  # at most, when several spots of a window are measured in turn
DEBLENDED = 4e-3  # px, step of a centre from round to round below which deblending ends


def measure_lights(
    light: Array,
    size: Counts,
    inner: NDArray[np.bool_],
    window: Counts,
    wanted: Counts,
    levels: float,
    shot_gain: float,
) -> tuple[Spots, NDArray[np.bool_]]:
    """Measure spots, deblending those that share a window.

    Each of several spots is measured in what remains of the light when Gaussian models of the others are subtracted,
    in turns, until the centres converge.

    Parameters
    ----------
    light
        Windows, (n, s, s) [grey levels], padded at the right and at the bottom.
    size
        Size of each window without padding, (n, 2) [px: u, v].
    inner
        Bright pixels of each of m spots, (m, s, s).
    window
        Index of the window in which each spot lies, (m,), ascending.
    wanted
        Indices of the spots to measure, (k,).
    levels, shot_gain
        As in `centroid.measure_spots`.

    Returns
    -------
    tuple
        The `Spots`, and a mask (k,) of those that overlap others too much to converge.
    """
    touching = np.zeros(len(light), bool)
    own = window[wanted]
    alone = light[own]
    shared = np.flatnonzero(np.bincount(window)[window] > 1)
    if len(shared):
        others, unsettled = _deblended(light, size, inner[shared], window[shared], levels, shot_gain)
        touching[unsettled] = True
        row = np.full(len(window), -1)
        row[shared] = np.arange(len(shared))
        row = row[wanted]
        alone[row >= 0] -= others[row[row >= 0]]
    return measure_spots(alone, size[own], inner[wanted], levels, shot_gain), touching[own]


def _deblended(
    light: Array, size: Counts, inner: NDArray[np.bool_], window: Counts, levels: float, shot_gain: float
) -> tuple[Array, Counts]:
    """Light of the other spots in each spot's window (m, s, s), and the windows whose spots do not converge."""
    centre, shape, models = _rough_models(light[window], size[window], inner)
    others = _of_others(models, window)
    begin, going = None, np.arange(len(window))
    for _ in range(DEBLENDING_ROUNDS):
        own = window[going]
        found = measure_spots(light[own] - others[going], size[own], inner[going], levels, shot_gain, begin)
        flux = np.where(found.found, found.flux, 0.0)
        others[going] = _of_others(gaussians(found.centre, found.shape, flux, light.shape[1:]), own)
        moved = np.zeros(len(light))
        np.maximum.at(moved, own, np.abs(found.centre - centre[going]).max(axis=1))
        centre[going], shape[going] = found.centre, found.shape
        going = going[moved[own] >= DEBLENDED]
        if not len(going):
            break
        begin = centre[going], shape[going]
    return others, window[going]


def _of_others(models: Array, window: Counts) -> Array:
    """Sum of the models (m, s, s) of the other spots in each spot's window, given as indices (m,), ascending."""
    begins = np.flatnonzero(np.diff(window, prepend=-1))
    counts = np.diff(begins, append=len(window))
    return np.asarray(np.repeat(np.add.reduceat(models, begins, axis=0), counts, axis=0) - models)


def _rough_models(light: Array, size: Counts, inner: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
    """Approximate centres (m, 2), shapes (m, 2, 2) and light (m, s, s) of spots from their bright pixels."""
    side = np.arange(light.shape[2])
    real = (side < size[:, 1:])[:, :, None] & (side < size[:, :1])[:, None, :]
    ordered = np.sort(np.where(real, light, np.inf).reshape(len(light), -1), axis=1)
    rows, counts = np.arange(len(light)), size.prod(axis=1)
    dark = (ordered[rows, (counts - 1) // 2] + ordered[rows, counts // 2]) / 2
    lit = np.where(inner, light - dark[:, None, None], 0.0)
    shape, centre = matrices(rough_shape(inner)), rough_centre(lit).T.copy()
    flux = lit.max(axis=(1, 2)) * 2 * np.pi * np.sqrt(np.linalg.det(shape))
    return centre, shape, gaussians(centre, shape, flux, light.shape[1:])


def gaussians(centre: Array, shape: Array, flux: Array, size: tuple[int, ...]) -> Array:
    """Render n Gaussian spots, each in a window of `size` (h, w): (n, h, w) [grey levels]."""
    dx = (np.arange(size[1]) - centre[:, :1])[:, None, :]
    dy = (np.arange(size[0]) - centre[:, 1:])[:, :, None]
    a, b, c = (shape[:, i, j, None, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    det = a * c - b * b
    square = (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / det
    return np.asarray(flux[:, None, None] / (2 * np.pi * np.sqrt(det)) * np.exp(-0.5 * square))
