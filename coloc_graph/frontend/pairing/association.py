"""Associate the unnamed tracks of two cameras by their motion alone, with the probability of each association.

Spatio-temporal features (paper, section III): all true pairs of tracks obey one homography. Wrong pairings obey one too
if robots move in lock-step, turn on the spot, or hardly move. Such a pairing leaves robots unpaired where the other
camera would see them. The probability of that, and the fit of each homography, give the posterior of each pairing.
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
Pair = tuple[int, int]  # indices of a track of camera i and of a track of camera j

MIN_SHARED = 8  # samples that a pair of tracks must share to start from
SUBSAMPLES = 24  # samples of each pair on which starts are compared
MAX_SINGLES = 200  # pairs of tracks to start from
MAX_COUPLES = 300  # combinations of two pairs to start from
MAX_FOLLOWED = 16  # starts that are refined
HIDDEN = 0.1  # probability that a camera misses a robot in its view
HIDDEN_ALONE = 1e-4  # the same of the only robot that moves
HIDDEN_MARKER = 0.003  # probability that a camera misses one marker of a robot that it sees
MAX_UNSEEN_SHARE = 0.25  # of the stance, from which on a robot counts as not seen at all
MIN_SHARE_ALONE = 0.3  # share of a camera's samples that are of the only robot that moves
MIN_POSTERIOR = 0.995  # of an association that is accepted
MAX_LOG_ODDS = 20.0  # of the best association against a rival that is reported
MAX_NOISE = 8.0  # mean squared residual of a point, two coordinates, up to which the noise may exceed its stated 2
# gates of a pair's median squared residual, in units of the noise
START_GATE = 400.0  # of the pairs that a start is made of
WIDE_GATE = 2500.0  # of the pairs that a start may explain
FIT_GATE = 100.0  # of the pairs that a fit explains


@dataclass(frozen=True)
class Association:
    """Most probable pairing of tracks, its posterior, and rival pairings with theirs."""

    chosen: tuple[Pair, ...]
    posterior: float
    rivals: tuple[tuple[tuple[Pair, ...], float], ...] = ()


@dataclass(frozen=True)
class Unassociated:
    """Reason why no pairing of tracks is certain, and its remedy."""

    what: str
    remedy: str


NO_HOMOGRAPHY = Unassociated(
    "no homography takes one of them to another", "look for reflections and other lights, and calibrate the lenses"
)
IMPLAUSIBLE = Unassociated(
    "what fits has the observers on no common floor, or lights that are not a span apart",
    "let the moving robot turn and drive further; if it does, look for reflections, and check heights, tilts and spans",
)


class Tracks(Protocol):
    """Tracks of two cameras i and j by index, and the pairs of them that share samples."""

    indices: dict[Pair, NDArray[np.int64]]  # samples (n, 2) that a pair shares
    hidden: float  # probability that a camera misses a robot in its view
    least: float  # share of a camera's samples that a pairing must cover
    bodies: tuple[list[int], list[int]]  # body of each track of i and of j, -1 if unknown

    def points(self, chosen: Sequence[Pair]) -> PointPairs:
        """All samples that the chosen pairs share."""

    def claimed(self, residuals: dict[Pair, float]) -> list[Pair]:
        """Select pairs, smallest residual first, that share no sample with one selected before."""

    def visible(self, H_j_i: Array) -> tuple[list[NDArray[np.bool_]], list[NDArray[np.bool_]]]:
        """Masks of each track's samples, of i and of j, that the other camera would see."""

    def plausible(self, H_j_i: Array, chosen: Sequence[Pair]) -> bool:
        """Return whether a homography and its pairs agree with everything else that is known."""

    def covered(self, chosen: Sequence[Pair]) -> tuple[list[NDArray[np.bool_]], list[NDArray[np.bool_]]]:
        """Masks of each track's samples, of i and of j, between the first and last that a chosen pair shares."""


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    H: Array
    chosen: tuple[Pair, ...]
    weight: float  # log posterior, unnormalised


def associate(tracks: Tracks) -> Association | Unassociated:
    """Find the most probable pairing of tracks and its rivals, or why no homography explains any."""
    by_size = sorted(tracks.indices, key=lambda ab: -len(tracks.indices[ab]))
    some = _Subsampled(by_size, {ab: tracks.points([ab]) for ab in by_size})
    if not some.large:
        return Unassociated(
            f"no two of them share {MIN_SHARED} images", "keep the mover in both fields of view, or record for longer"
        )
    why: list[tuple[int, Unassociated]] = []
    found = _refined(tracks, some, _starts(tracks, some), why)
    if not found:
        return max(why, key=lambda one: one[0])[1] if why else NO_HOMOGRAPHY
    best = max(found, key=lambda one: one.weight)
    if (share := _explained(tracks, best.chosen)) < tracks.least:
        return Unassociated(
            f"the best one explains {100 * share:.0f} % of what a camera saw",
            "look for reflections and other lights, or let the moving robot turn and drive further",
        )
    rivals = [one for one in found if one.weight > best.weight - MAX_LOG_ODDS and not some.alike(one, best)]
    shares = np.exp([one.weight - best.weight for one in rivals])
    whole = 1 + float(shares.sum())
    ranked = sorted(zip(rivals, shares / whole, strict=True), key=lambda row: -row[1])
    return Association(best.chosen, 1 / whole, tuple((one.chosen, float(share)) for one, share in ranked))


class _Subsampled:
    """Pairs of tracks, largest first, with `SUBSAMPLES` samples (p, `SUBSAMPLES`, 2) of each of the `large` ones."""

    def __init__(self, order: Sequence[Pair], pairs: dict[Pair, PointPairs]) -> None:
        self.pairs = pairs
        self.large = [ab for ab in order if len(pairs[ab]) >= MIN_SHARED][:MAX_SINGLES]
        rest = set(self.large)
        self._small = {ab: pairs[ab] for ab in order if ab not in rest}
        rows = [np.round(np.linspace(0, len(pairs[ab]) - 1, SUBSAMPLES)).astype(np.int64) for ab in self.large]
        few = [pairs[ab][row] for ab, row in zip(self.large, rows, strict=True)]
        if few:
            self.few = PointPairs(
                np.stack([one.x_i for one in few]),
                np.stack([one.x_j for one in few]),
                np.stack([one.covariance_i for one in few]),
                np.stack([one.covariance_j for one in few]),
            )

    def size(self, chosen: Sequence[Pair]) -> int:
        """Number of samples that the chosen pairs share."""
        return sum(len(self.pairs[ab]) for ab in chosen)

    def medians(self, H: Array) -> Array:
        """Median squared residuals (s, p) of the large pairs by homographies (s, 3, 3); inf behind camera j."""
        few = PointPairs(
            self.few.x_i[None], self.few.x_j[None], self.few.covariance_i[None], self.few.covariance_j[None]
        )
        with np.errstate(all="ignore"):
            squared = squared_residuals(H[:, None], few)
            depth = np.einsum("sk,pnk->spn", H[:, 2, :2], self.few.x_i) + H[:, 2, 2][:, None, None]
        found = np.nan_to_num(np.median(squared, axis=2), nan=np.inf)
        return np.where((depth > 0).all(axis=2), found, np.inf)

    def near(self, H: Array, gate: float) -> dict[Pair, float]:
        """Pairs that a homography explains within a gate, with their median squared residuals."""
        medians = dict(zip(self.large, self.medians(H[None])[0].tolist(), strict=True))
        with np.errstate(all="ignore"):
            medians |= {ab: float(np.median(squared_residuals(H, pair))) for ab, pair in self._small.items()}
        return {ab: median for ab, median in medians.items() if median < gate}

    def alike(self, one: "_Hypothesis", other: "_Hypothesis") -> bool:
        """Return whether another homography explains all pairs of the first."""
        return all(float(np.median(squared_residuals(other.H, self.pairs[ab]))) < FIT_GATE for ab in one.chosen)


def _starts(tracks: Tracks, some: _Subsampled) -> list[tuple[Array, set[Pair]]]:
    """Homographies of single pairs and of couples of pairs, with these pairs; those that explain most come first."""
    large = some.large
    couples = np.array(_couples(tracks, large), np.int64).reshape(-1, 2)
    both_i, both_j = (x[couples].reshape(len(couples), 2 * SUBSAMPLES, 2) for x in (some.few.x_i, some.few.x_j))
    H = np.concatenate([_direct(some.few.x_i, some.few.x_j), _direct(both_i, both_j)])
    of = [[n] for n in range(len(large))] + couples.tolist()
    medians = some.medians(H)
    sizes = np.array([len(some.pairs[ab]) for ab in large])
    good = [n for n, own in enumerate(of) if np.linalg.det(H[n]) > 0 and medians[n, own].max() < START_GATE]
    explained = (medians < FIT_GATE) @ sizes
    good.sort(key=lambda n: (-int(explained[n]), float(medians[n, of[n]].max())))
    return [(H[n], {large[m] for m in of[n]}) for n in good]


def _couples(tracks: Tracks, large: Sequence[Pair]) -> list[Pair]:
    """Couples of pairs to start from, those of both markers of one robot first."""
    bodies_i, bodies_j = tracks.bodies

    def whole(p: Pair, q: Pair) -> bool:
        return bodies_i[p[0]] == bodies_i[q[0]] >= 0 and bodies_j[p[1]] == bodies_j[q[1]] >= 0

    numbers = range(min(len(large), 60))
    couples = [(m, n) for m, n in combinations(numbers, 2) if large[m][0] != large[n][0] and large[m][1] != large[n][1]]
    couples.sort(key=lambda mn: not whole(large[mn[0]], large[mn[1]]))
    return couples[:MAX_COUPLES]


def _direct(x_i: Array, x_j: Array) -> Array:
    """Direct linear transforms (s, 3, 3) of points (s, n, 2), right or wrong; of determinant 1 unless singular."""
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
    """Normalise points (s, n, 2) to zero mean and unit spread, and return the similarity too, (s, 3, 3)."""
    middle = x.mean(axis=1, keepdims=True)
    scale = np.sqrt(2 / np.maximum(((x - middle) ** 2).sum(axis=2).mean(axis=1), 1e-18))
    T = np.zeros((len(x), 3, 3))
    T[:, 0, 0] = T[:, 1, 1] = scale
    T[:, :2, 2] = -scale[:, None] * middle[:, 0]
    T[:, 2, 2] = 1.0
    return (x - middle) * scale[:, None, None], T


def _refined(
    tracks: Tracks, some: _Subsampled, starts: Sequence[tuple[Array, set[Pair]]], why: list[tuple[int, Unassociated]]
) -> list[_Hypothesis]:
    """Refine starts to fits to all the tracks that they explain.

    `why` gets the reasons of those that fail, each with the number of samples that it paired.
    """
    seen: dict[tuple[Pair, ...], tuple[Array, float] | None] = {}
    tried = 0
    for start, own in starts:
        if any(one is not None and own <= set(chosen) for chosen, one in seen.items()):
            continue  # leads to the same
        tried += 1
        if tried > MAX_FOLLOWED:
            break
        chosen = tuple(tracks.claimed(some.near(start, WIDE_GATE)))
        for _ in range(4):
            if not chosen or chosen in seen:
                break
            seen[chosen] = None  # until it proves stable
            try:
                fit = fit_homography(tracks.points(chosen))
            except DegenerateGeometry as error:
                what, _, remedy = str(error).partition(": ")
                why.append((some.size(chosen), Unassociated(what, remedy or IMPLAUSIBLE.remedy)))
                break
            again = tuple(tracks.claimed(some.near(fit.H, FIT_GATE)))
            if again == chosen:
                seen[chosen] = fit.H, float(np.minimum(fit.squared_residuals, INLIER_GATE).mean())
                break
            chosen = again
    found = {chosen: one for chosen, one in seen.items() if one is not None and tracks.plausible(one[0], chosen)}
    why += [(some.size(chosen), IMPLAUSIBLE) for chosen, one in seen.items() if one is not None and chosen not in found]
    against = {chosen: _unseen(tracks, H, chosen) for chosen, (H, _) in found.items()}
    sizes = {chosen: some.size(chosen) for chosen in found}
    # noise larger than stated is so for all hypotheses: estimate it from the one that leaves least unpaired
    noise = 2.0
    if found:
        noise = min(max(noise, found[max(found, key=lambda one: (against[one], sizes[one]))][1]), MAX_NOISE)
    return [
        _Hypothesis(H, one, against[one] - max(0.0, sizes[one] * (cost / noise - 1) - 3 * math.sqrt(sizes[one])))
        for one, (H, cost) in found.items()
    ]


def _unseen(tracks: Tracks, H: Array, chosen: Sequence[Pair]) -> float:
    """Log probability that robots go unpaired although the other camera would see them."""
    total = 0.0
    for bodies, seen, paired in zip(tracks.bodies, tracks.visible(H), tracks.covered(chosen), strict=True):
        whole = MAX_UNSEEN_SHARE * max((len(one) for one in seen), default=1)
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
    """Share of the samples that are of paired tracks, in the camera with the larger one."""
    sides = tracks.covered(chosen)
    return max(sum(int(one.sum()) for one in side) / max(sum(map(len, side)), 1) for side in sides)


def _without(seen: list[NDArray[np.bool_]], paired: list[NDArray[np.bool_]]) -> list[NDArray[np.bool_]]:
    return [one & ~other for one, other in zip(seen, paired, strict=True)]
