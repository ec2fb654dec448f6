"""Which tracks of one camera are which of another, by what they do alone; and how sure that is.

Spatio-temporal features (paper, section III): all tracks that are one marker in both cameras obey one homography. A
wrong pairing that obeys one too exists where robots move in lock-step, turn on the spot, or hardly move. It leaves
robots unpaired that stand where the other camera would see them; how likely that is, and how well each homography
explains what it pairs, makes the chance of each pairing.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend.homography.fit import INLIER_GATE, fit_homography
from coloc_graph.frontend.homography.refinement import PointPairs, squared_residuals

Array = NDArray[np.float64]
#: A track of camera i and one of camera j, by their numbers.
Pair = tuple[int, int]

#: Pairs of tracks with fewer common samples are no start, and so many samples of each are looked at first.
LEAST = 8
FEW = 24
#: So many pairs, and couples of them, may be starts; so many that lead elsewhere are followed.
SINGLES = 200
COUPLES = 300
TRIED = 16
#: How likely a robot that is in a camera's view is not seen by it; where it is known to be the one that is seen; and
#: one of its markers alone.
HIDDEN = 0.1
HIDDEN_ALONE = 1e-4
HIDDEN_MARKER = 0.003
#: A robot counts as unseen for as much of the stance as it is, up to this share.
LONG = 0.25
#: Of the lights that go on in a camera while one robot moves, that robot's are at least this share.
LEAST_ALONE = 0.3
#: A pairing whose chance is less than this is not believed.
SURE = 0.995
#: A pairing that is so much less likely than the best is not worth a word (logarithm).
HOPELESS = 20.0
#: Noise may be larger than stated: the mean squared residual of a point that is noise yet, two coordinates together.
LARGEST_NOISE = 8.0
#: Gates of a track's median squared residual, in units of its noise: of what a start is made of, of what it may
#: explain, and of a fit to all.
START = 400.0
WIDE = 2500.0
CLOSE = 100.0


@dataclass(frozen=True)
class Association:
    """Tracks of both cameras that are the same markers: `chosen`, right with the chance `posterior`; `rivals` are the
    other pairings that one homography explains too, with their chances."""

    chosen: tuple[Pair, ...]
    posterior: float
    rivals: tuple[tuple[tuple[Pair, ...], float], ...] = ()


class Tracks(Protocol):
    """The tracks of two cameras i and j, numbered; all pairs of them that share samples."""

    #: The samples (n, 2) that a pair shares.
    indices: dict[Pair, NDArray[np.int64]]
    #: How likely a robot that is in a camera's view is not seen by it; and which share of a camera's samples a pairing
    #: has to be of.
    hidden: float
    least: float
    #: The robot that each track of i, and of j, is a marker of; no two of -1 are one.
    bodies: tuple[list[int], list[int]]

    def points(self, chosen: Sequence[Pair]) -> PointPairs:
        """All samples that some pairs share."""

    def claimed(self, residuals: dict[Pair, float]) -> list[Pair]:
        """Of some pairs those that do not claim a sample that one with a smaller residual has."""

    def visible(self, H_j_i: Array) -> tuple[list[NDArray[np.bool_]], list[NDArray[np.bool_]]]:
        """Of each sample of each track of i whether j would have seen it, and of those of j whether i would."""

    def plausible(self, H_j_i: Array, chosen: Sequence[Pair]) -> bool:
        """Whether a homography, and what it pairs, can be what it would have to be, by all that is known besides."""

    def covered(self, chosen: Sequence[Pair]) -> tuple[list[NDArray[np.bool_]], list[NDArray[np.bool_]]]:
        """Of each sample of each track of i, and of j, whether it lies between those that a chosen pair shares."""


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    H: Array
    chosen: tuple[Pair, ...]
    weight: float  # logarithm of what is for it


def associate(tracks: Tracks) -> Association | None:
    """The likeliest pairing, and what else may be; None where no homography explains any."""
    by_size = sorted(tracks.indices, key=lambda ab: -len(tracks.indices[ab]))
    some = _Some(by_size, {ab: tracks.points([ab]) for ab in by_size})
    found = _refined(tracks, some, _starts(tracks, some))
    if not found:
        return None
    best = max(found, key=lambda one: one.weight)
    if _explained(tracks, best.chosen) < tracks.least:
        return None
    rivals = [one for one in found if one.weight > best.weight - HOPELESS and not some.alike(one, best)]
    shares = np.exp([one.weight - best.weight for one in rivals])
    whole = 1 + float(shares.sum())
    ranked = sorted(zip(rivals, shares / whole, strict=True), key=lambda row: -row[1])
    return Association(best.chosen, 1 / whole, tuple((one.chosen, float(share)) for one, share in ranked))


class _Some:
    """Pairs of tracks, the largest first, with `FEW` samples (p, `FEW`, 2) of each of the `large` ones."""

    def __init__(self, order: Sequence[Pair], pairs: dict[Pair, PointPairs]) -> None:
        self.pairs = pairs
        self.large = [ab for ab in order if len(pairs[ab]) >= LEAST][:SINGLES]
        rest = set(self.large)
        self._small = {ab: pairs[ab] for ab in order if ab not in rest}
        rows = [np.round(np.linspace(0, len(pairs[ab]) - 1, FEW)).astype(np.int64) for ab in self.large]
        few = [pairs[ab][row] for ab, row in zip(self.large, rows, strict=True)]
        if few:
            self.few = PointPairs(
                np.stack([one.x_i for one in few]),
                np.stack([one.x_j for one in few]),
                np.stack([one.covariance_i for one in few]),
                np.stack([one.covariance_j for one in few]),
            )

    def medians(self, H: Array) -> Array:
        """The median squared residual (s, p) of each large pair by homographies (s, 3, 3); infinite where a point comes
        to lie behind camera j."""
        few = PointPairs(
            self.few.x_i[None], self.few.x_j[None], self.few.covariance_i[None], self.few.covariance_j[None]
        )
        with np.errstate(all="ignore"):
            squared = squared_residuals(H[:, None], few)
            depth = np.einsum("sk,pnk->spn", H[:, 2, :2], self.few.x_i) + H[:, 2, 2][:, None, None]
        found = np.nan_to_num(np.median(squared, axis=2), nan=np.inf)
        return np.where((depth > 0).all(axis=2), found, np.inf)

    def near(self, H: Array, gate: float) -> dict[Pair, float]:
        """The pairs that a homography explains within a gate, and their median squared residuals."""
        medians = dict(zip(self.large, self.medians(H[None])[0].tolist(), strict=True))
        with np.errstate(all="ignore"):
            medians |= {ab: float(np.median(squared_residuals(H, pair))) for ab, pair in self._small.items()}
        return {ab: median for ab, median in medians.items() if median < gate}

    def alike(self, one: "_Hypothesis", other: "_Hypothesis") -> bool:
        """Whether all that one homography explains another does too."""
        return all(float(np.median(squared_residuals(other.H, self.pairs[ab]))) < CLOSE for ab in one.chosen)


def _starts(tracks: Tracks, some: _Some) -> list[tuple[Array, set[Pair]]]:
    """Homographies of single pairs, and of couples of them, and of which; those that explain most come first."""
    large = some.large
    if not large:
        return []
    couples = np.array(_couples(tracks, large), np.int64).reshape(-1, 2)
    both_i, both_j = (x[couples].reshape(len(couples), 2 * FEW, 2) for x in (some.few.x_i, some.few.x_j))
    H = np.concatenate([_direct(some.few.x_i, some.few.x_j), _direct(both_i, both_j)])
    of = [[n] for n in range(len(large))] + couples.tolist()
    medians = some.medians(H)
    sizes = np.array([len(some.pairs[ab]) for ab in large])
    good = [n for n, own in enumerate(of) if np.linalg.det(H[n]) > 0 and medians[n, own].max() < START]
    explained = (medians < CLOSE) @ sizes
    good.sort(key=lambda n: (-int(explained[n]), float(medians[n, of[n]].max())))
    return [(H[n], {large[m] for m in of[n]}) for n in good]


def _couples(tracks: Tracks, large: Sequence[Pair]) -> list[Pair]:
    """Two pairs, of two tracks each, to start from: both markers of a robot before any others."""
    bodies_i, bodies_j = tracks.bodies

    def whole(p: Pair, q: Pair) -> bool:
        return bodies_i[p[0]] == bodies_i[q[0]] >= 0 and bodies_j[p[1]] == bodies_j[q[1]] >= 0

    numbers = range(min(len(large), 60))
    couples = [(m, n) for m, n in combinations(numbers, 2) if large[m][0] != large[n][0] and large[m][1] != large[n][1]]
    couples.sort(key=lambda mn: not whole(large[mn[0]], large[mn[1]]))
    return couples[:COUPLES]


def _direct(x_i: Array, x_j: Array) -> Array:
    """The direct linear transform (s, 3, 3) of points (s, n, 2), whatever they are; without determinant 1 where it is
    singular."""
    if not len(x_i):
        return np.zeros((0, 3, 3))
    moved, T = zip(*(_centred(x) for x in (x_i, x_j)), strict=True)
    (u, v), (x, y) = ((m[..., 0], m[..., 1]) for m in moved)
    one, zero = np.ones_like(u), np.zeros_like(u)
    first = np.stack([u, v, one, zero, zero, zero, -x * u, -x * v, -x], axis=-1)
    second = np.stack([zero, zero, zero, u, v, one, -y * u, -y * v, -y], axis=-1)
    A = np.concatenate([first, second], axis=1)
    H = np.linalg.eigh(A.mT @ A)[1][..., 0].reshape(-1, 3, 3)
    H = np.linalg.inv(T[1]) @ H @ T[0]
    H = np.where(np.linalg.det(H)[:, None, None] < 0, -H, H)
    size = np.cbrt(np.maximum(np.linalg.det(H), 1e-30))
    return np.asarray(H / size[:, None, None])


def _centred(x: Array) -> tuple[Array, Array]:
    """Points (s, n, 2) moved to the origin and a spread of one, and what did it (s, 3, 3)."""
    middle = x.mean(axis=1, keepdims=True)
    scale = np.sqrt(2 / np.maximum(((x - middle) ** 2).sum(axis=2).mean(axis=1), 1e-18))
    T = np.zeros((len(x), 3, 3))
    T[:, 0, 0] = T[:, 1, 1] = scale
    T[:, :2, 2] = -scale[:, None] * middle[:, 0]
    T[:, 2, 2] = 1.0
    return (x - middle) * scale[:, None, None], T


def _refined(tracks: Tracks, some: _Some, starts: Sequence[tuple[Array, set[Pair]]]) -> list[_Hypothesis]:
    """What starts lead to: fits to all the tracks that they explain."""
    seen: dict[tuple[Pair, ...], tuple[Array, float] | None] = {}
    tried = 0
    for start, own in starts:
        if any(one is not None and own <= set(chosen) for chosen, one in seen.items()):
            continue  # leads there again
        tried += 1
        if tried > TRIED:
            break
        chosen = tuple(tracks.claimed(some.near(start, WIDE)))
        for _ in range(4):
            if not chosen or chosen in seen:
                break
            seen[chosen] = None  # what does not stay is no pairing
            try:
                fit = fit_homography(tracks.points(chosen))
            except DegenerateGeometry:
                break
            again = tuple(tracks.claimed(some.near(fit.H, CLOSE)))
            if again == chosen:
                seen[chosen] = fit.H, float(np.minimum(fit.squared_residuals, INLIER_GATE).mean())
                break
            chosen = again
    found = {chosen: one for chosen, one in seen.items() if one is not None and tracks.plausible(one[0], chosen)}
    against = {chosen: _unseen(tracks, H, chosen) for chosen, (H, _) in found.items()}
    sizes = {chosen: sum(len(some.pairs[ab]) for ab in chosen) for chosen in found}
    # noise that is larger than stated is so for all: taken from what leaves least unpaired
    noise = 2.0
    if found:
        noise = min(max(noise, found[max(found, key=lambda one: (against[one], sizes[one]))][1]), LARGEST_NOISE)
    return [
        _Hypothesis(H, one, against[one] - max(0.0, sizes[one] * (cost / noise - 1) - 3 * math.sqrt(sizes[one])))
        for one, (H, cost) in found.items()
    ]


def _unseen(tracks: Tracks, H: Array, chosen: Sequence[Pair]) -> float:
    """Logarithm of how likely robots go unpaired where the other camera would see them."""
    total = 0.0
    for bodies, seen, paired in zip(tracks.bodies, tracks.visible(H), tracks.covered(chosen), strict=True):
        whole = LONG * max((len(one) for one in seen), default=1)
        groups: dict[int, list[int]] = {}
        for track, body in enumerate(bodies):
            groups.setdefault(body if body >= 0 else -1 - track, []).append(track)
        for members in groups.values():
            there, lost = (np.array([int(one[n].sum()) for n in members]) for one in (seen, _without(seen, paired)))
            share = np.minimum(1.0, lost / whole)
            if there.sum():
                missed = np.clip((lost.sum() / there.sum() - 0.2) / 0.6, 0.0, 1.0)
                total += math.log(tracks.hidden) * float(missed * share.max())
            if (lost < there).any():
                total += math.log(HIDDEN_MARKER) * float(share[lost == there].sum())
    return total


def _explained(tracks: Tracks, chosen: Sequence[Pair]) -> float:
    """The share of the samples that are of paired tracks, in the camera that has the larger one."""
    sides = tracks.covered(chosen)
    return max(sum(int(one.sum()) for one in side) / max(sum(map(len, side)), 1) for side in sides)


def _without(seen: list[NDArray[np.bool_]], paired: list[NDArray[np.bool_]]) -> list[NDArray[np.bool_]]:
    return [one & ~other for one, other in zip(seen, paired, strict=True)]
