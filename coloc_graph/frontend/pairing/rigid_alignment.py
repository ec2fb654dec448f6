"""Order a body's two equal lights consistently with two cameras, if one camera alone cannot.

Both cameras see the same body on the same plane, where their views differ by a rotation and a shift. The directions of
the line through both lights give the rotation modulo half a turn; the path of its midpoint decides the half. Then each
pair of images taken at one instant ties the order of the lights in one camera to that in the other, and pieces of a
path that were cut in one camera are joined by what the other saw meanwhile.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.frontend.pairing.correspondence import pair_by_time
from coloc_graph.frontend.tracks.rigid_path import RigidPath

Array = NDArray[np.float64]

MIN_SHARED = 5  # instants at which both cameras see both lights
MIN_COHERENCE = 0.8  # length of the mean direction, modulo half a turn, of samples of one rotation
MIN_CONTRAST = 3.0  # ratio of the misfits of both halves above which the smaller one is accepted
UNANIMOUS = 0.9  # share of the instants of two pieces that must agree
OUTLIER = 6.0  # median residuals of one homography beyond which a sample is another light
MIN_RESIDUAL = 0.01  # m, residual below which no sample is an outlier
MIN_INLIERS = 0.7  # share of the samples that the homography must explain to judge the others


def align_paths(path_i: RigidPath, path_j: RigidPath, window: float) -> tuple[RigidPath, RigidPath]:
    """Order the lights of two paths of one body consistently, and join their pieces.

    Samples that contradict the common order are rejected.

    Parameters
    ----------
    path_i, path_j
        The paths that two cameras saw.
    window
        Time difference up to which two images are of one instant [s].

    Returns
    -------
    tuple of RigidPath
        Both paths; unchanged if the rotation between the views is undetermined, as for a body that turns on the spot.
    """
    shared = pair_by_time(path_i.times, path_j.times, window)
    if len(shared) < MIN_SHARED:
        return path_i, path_j
    m, n = shared.T
    turned = _direction(path_j)[n] - _direction(path_i)[m]
    turn = _turn(turned, path_i.places[m].mean(axis=1), path_j.places[n].mean(axis=1))
    if turn is None:
        return path_i, path_j
    agree = np.cos(turned - turn)  # near 1 where both have the same order, near -1 where not
    count = path_i.pieces
    parity, root = np.zeros(count + path_j.pieces, bool), np.arange(count + path_j.pieces)
    ties = []
    for p, q in np.unique(np.stack([path_i.piece[m], path_j.piece[n]], axis=1), axis=0).tolist():
        own = (path_i.piece[m] == p) & (path_j.piece[n] == q)
        same = float((agree[own] > 0).mean())
        if max(same, 1 - same) >= UNANIMOUS:
            ties.append((float(np.abs(agree[own]).sum()), p, count + q, same < 0.5))
    for _, p, q, exchanged in sorted(ties, reverse=True):
        if root[p] != root[q]:
            other = root == root[q]
            parity[other] ^= bool(parity[p] ^ parity[q] ^ exchanged)
            root[other] = root[p]
    of_i, of_j = path_i.piece, count + path_j.piece
    made = path_i.swapped(parity[of_i], root[of_i]), path_j.swapped(parity[of_j], root[of_j])
    wrong = (root[of_i[m]] == root[of_j[n]]) & ((agree > 0) == (parity[of_i[m]] ^ parity[of_j[n]]))
    wrong |= _outliers(made[0].places[m], made[1].places[n], root[of_i[m]] == root[of_j[n]])
    return made[0].without(m[wrong]), made[1].without(n[wrong])


def _outliers(places_i: Array, places_j: Array, tied: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask (n,) of `tied` samples with a light that the homography between the views (n, 2, 2) does not explain."""
    none = np.zeros(len(tied), bool)
    if 2 * tied.sum() < 2 * MIN_SHARED:
        return none
    a, b = places_i.reshape(-1, 2), places_j.reshape(-1, 2)
    own = np.repeat(tied, 2)
    H, _ = cv2.findHomography(a[own], b[own], cv2.USAC_MAGSAC, MIN_RESIDUAL)
    if H is None:
        return none
    moved = np.column_stack([a, np.ones(len(a))]) @ np.asarray(H, float).T
    with np.errstate(all="ignore"):
        off = np.linalg.norm(moved[:, :2] / moved[:, 2:] - b, axis=1)
    far = ~(off <= max(OUTLIER * float(np.median(off[own])), MIN_RESIDUAL))
    return tied & far.reshape(-1, 2).any(axis=1) if (~far[own]).mean() >= MIN_INLIERS else none


def _direction(path: RigidPath) -> Array:
    arm = path.places[:, 1] - path.places[:, 0]
    return np.asarray(np.arctan2(arm[:, 1], arm[:, 0]))


def _turn(turned: Array, middle_i: Array, middle_j: Array) -> float | None:
    """Rotation [rad] from i's view to j's; None if it is undetermined."""
    kept = np.ones(len(turned), bool)
    for _ in range(3):
        mean = np.exp(2j * turned[kept]).mean()
        half = float(np.angle(mean)) / 2
        kept = np.abs(np.sin(turned - half)) < 0.5
        if kept.sum() < MIN_SHARED:
            return None
    if abs(mean) < MIN_COHERENCE or kept.mean() < 0.5:
        return None
    misfit = []
    for turn in (half, half + np.pi):
        c, s = np.cos(turn), np.sin(turn)
        off = middle_j[kept] - middle_i[kept] @ np.array([[c, s], [-s, c]])
        misfit.append(float(np.median(np.linalg.norm(off - np.median(off, axis=0), axis=1))))
    if max(misfit) < MIN_CONTRAST * min(misfit):
        return None
    return float(half + np.pi * int(np.argmin(misfit)))
