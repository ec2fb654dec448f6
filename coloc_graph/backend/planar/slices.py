"""A linear problem over poses in time, solved second by second: `Slices`.

Factors tie poses that are next to each other in time, and what all share. Cut into slices as long as the longest step,
poses of a slice are tied to those of the next, and to no other: the matrix of the problem is block-tridiagonal with a
border (of what is shared), and is eliminated from the first slice to the last. It takes as long as there are slices.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from coloc_graph.backend.planar.factors import DriveFactors, Rows
from coloc_graph.errors import EstimationError
from coloc_graph.measurements import MAX_KEYFRAME_INTERVAL

Array = NDArray[np.float64]
Index = NDArray[np.int64]

#: A little more than the longest step [s], which then ends in the next slice at the latest.
SLICE = 1.01 * MAX_KEYFRAME_INTERVAL


def slices_of(factors: DriveFactors) -> Index:
    """In which slice each pose is (n,)."""
    times = factors.times
    slices: Index = np.floor((times - times.min(initial=np.inf)) / SLICE).astype(int)
    return slices


@dataclass(frozen=True, eq=False)
class Summary:
    """What eliminated slices say of the rest: of some `poses` (n,) and what is shared, as a quadratic form:
    `information` (3 n + m, 3 n + m) and `gradient` (3 n + m,) where they were `at` (3 n + m,) when it was made."""

    poses: Index
    information: Array
    gradient: Array
    at: Array


class Slices:
    """Where the numbers of some poses' problem are, in one flat array: of each slice a block (rows of its variables;
    columns of these, of the next slice's, of the shared, and the gradient), then one of the shared.

    `poses` (n,) are in the order of slices, `first` (count + 1,) says which of them is the first of each; `base` is the
    number of the first slice."""

    def __init__(self, factors: DriveFactors, slices: Index, poses: Index) -> None:
        order = np.lexsort((poses, slices[poses]))
        self.poses: Index = poses[order]
        own = slices[self.poses]
        self.base = int(own[0])
        self.count = int(own[-1]) - self.base + 1
        own = own - self.base
        sizes = np.bincount(own, minlength=self.count)
        self.first: Index = np.cumsum([0, *sizes])
        self._shared = int(factors.free.sum())
        self._rows: Index = 3 * sizes
        self._next: Index = np.append(self._rows[1:], 0)
        self._width: Index = self._rows + self._next + self._shared + 1
        self._start: Index = np.cumsum([0, *(self._rows * self._width)])
        # of each variable: its slice (that of the shared after all others), and its place among those of its slice
        variables = 3 * len(factors) + len(factors.free)
        self._slice, self._place = np.full(variables, -1), np.full(variables, -1)
        at = (3 * self.poses[:, None] + np.arange(3)).ravel()
        self._slice[at] = np.repeat(own, 3)
        self._place[at] = np.arange(len(at)) - 3 * np.repeat(self.first[own], 3)
        shared = 3 * len(factors) + np.flatnonzero(factors.free)
        self._slice[shared], self._place[shared] = self.count, np.arange(self._shared)

    def problem(self, rows: Iterable[Rows]) -> Array:
        """The problem that factors make together, flat. Variables that are not in it stay what they are."""
        flat = np.zeros(int(self._start[-1]) + self._shared * (self._shared + 1) + 1)
        for one in rows:
            products = one.jacobians[:, :, :-1].transpose(0, 2, 1) @ one.jacobians
            flat += np.bincount(self._places(one.columns).ravel(), products.ravel(), minlength=len(flat))
        return flat[:-1]

    def _places(self, columns: Index) -> Index:
        """Where the products of factors' columns (n, k) with each other and with residuals belong (n, k, k + 1); the
        place after the last is for what is in the lower half, or of no variable."""
        own, place = self._slice[columns], self._place[columns]
        rows, width = np.append(self._rows, 0)[own], np.append(self._width, self._shared + 1)[own]
        start = self._start[own] + place * width
        # where the columns of the same slice, of the next one, and of the shared begin
        ahead = own[:, None, :] - own[:, :, None]
        is_shared = own == self.count
        begin = np.where(ahead == 1, rows[:, :, None], 0)
        begin = np.where(is_shared[:, None, :], (width - self._shared - 1)[:, :, None], begin)
        inside = (own >= 0)[:, None, :] & (own >= 0)[:, :, None]
        wanted = inside & ((ahead == 0) | (ahead == 1) | is_shared[:, None, :])
        if (inside & (ahead > 1) & ~is_shared[:, None, :]).any():
            raise ValueError("a factor ties poses that are more than a slice apart")
        places = np.empty((*columns.shape, columns.shape[1] + 1), int)
        places[:, :, :-1] = np.where(wanted, start[:, :, None] + begin + place[:, None, :], -1)
        places[:, :, -1] = np.where(own >= 0, start + width - 1, -1)
        places[places < 0] = int(self._start[-1]) + self._shared * (self._shared + 1)
        return places

    def block(self, problem: Array, n: int) -> Array:
        """The block of a slice, or, after the last, of the shared."""
        if n == self.count:
            return problem[self._start[n] :].reshape(self._shared, self._shared + 1)
        return problem[self._start[n] : self._start[n + 1]].reshape(self._rows[n], self._width[n])

    def add_known(self, problem: Array, weights: Array, off: Array) -> None:
        """Add what is known of what is shared, one by one: weights (m,), and how far it is off (m,)."""
        shared = self.block(problem, self.count)
        shared[np.arange(len(off)), np.arange(len(off))] += weights
        shared[:, -1] += weights * off

    def add_summary(self, problem: Array, summary: Summary, at: Array) -> None:
        """Add what slices before say of the first slice and the shared, which are at some place (3 n + m,) now."""
        gradient = summary.gradient + summary.information @ (at - summary.at)
        place = self._place[(3 * summary.poses[:, None] + np.arange(3)).ravel()]
        n, border = len(place), self._shared
        first, shared = self.block(problem, 0), self.block(problem, self.count)
        first[np.ix_(place, place)] += summary.information[:n, :n]
        first[place, -border - 1 : -1] += summary.information[:n, n:]
        first[place, -1] += gradient[:n]
        shared[:, :-1] += summary.information[n:, n:]
        shared[:, -1] += gradient[n:]

    def eliminate(self, problem: Array, until: int | None = None) -> list[tuple[Array, Array]]:
        """Eliminate slices from the first until one, or all; of each the Cholesky factor L, and L^-1 of the other
        columns. The problem is changed: what remains of it is what they say of the rest."""
        shared, eliminated = self.block(problem, self.count), []
        for n in range(self.count if until is None else until):
            block, rows, after = self.block(problem, n), int(self._rows[n]), int(self._next[n])
            if not rows:
                eliminated.append((np.zeros((0, 0)), np.zeros((0, self._width[n]))))
                continue
            L, failed = lapack.dpotrf(block[:, :rows], lower=1, clean=1)
            if failed:
                raise _undetermined()
            V, _ = lapack.dtrtrs(L, block[:, rows:], lower=1)
            taken = V[:, :-1].T @ V
            if after:
                following = self.block(problem, n + 1)
                following[:, :after] -= taken[:after, :after]
                following[:, -self._shared - 1 :] -= taken[:after, after:]
            shared -= taken[after:, after:]
            eliminated.append((L, V))
        return eliminated

    def remaining(self, problem: Array) -> tuple[Index, Array, Array]:
        """What a problem says of the poses (n,) of the last slice and of what is shared, where all before the last are
        eliminated: these poses, information (3 n + m, 3 n + m), and gradient."""
        last, shared = self.block(problem, self.count - 1), self.block(problem, self.count)
        across = last[:, len(last) : -1]
        information = np.block([[last[:, : len(last)], across], [across.T, shared[:, :-1]]])
        return self.poses[self.first[-2] :], information, np.concatenate([last[:, -1], shared[:, -1]])

    def shared(self, problem: Array) -> tuple[Array, Array]:
        """The step (m,) of what is shared, and its covariance (m, m), of a problem whose slices are eliminated."""
        block = self.block(problem, self.count)
        if not len(block):
            return np.zeros(0), np.zeros((0, 0))
        try:
            np.linalg.cholesky(block[:, :-1])
        except np.linalg.LinAlgError as failure:
            raise _undetermined() from failure
        C = np.linalg.inv(block[:, :-1])
        C = (C + C.T) / 2
        return -C @ block[:, -1], C

    def steps(self, eliminated: Sequence[tuple[Array, Array]], shared: Array) -> Array:
        """The steps (n, 3) of `poses`, given that of the shared."""
        steps, following = [], np.zeros(0)
        for L, V in reversed(eliminated):
            after = V.shape[1] - len(shared) - 1
            following = V[:, :-1] @ np.concatenate([following[:after], shared]) + V[:, -1]
            if len(L):
                following, _ = lapack.dtrtrs(L, -following, lower=1, trans=1)
            steps.append(following)
        return np.concatenate(steps[::-1]).reshape(-1, 3)

    def covariances(self, eliminated: Sequence[tuple[Array, Array]], shared: Array) -> Iterator[tuple[int, Array]]:
        """Of each slice, from the last to the first, its number from 0, and the covariance of its poses, those of the
        next slice, and what is shared together, given that of the shared."""
        joint, border = shared, len(shared)
        for n in range(self.count - 1, -1, -1):
            L, V = eliminated[n]
            keep = np.r_[: int(self._next[n]), len(joint) - border : len(joint)]
            joint = joint[np.ix_(keep, keep)]
            if len(L):
                K, _ = lapack.dtrtrs(L, V[:, :-1], lower=1, trans=1)
                own, _ = lapack.dpotri(L, lower=1)
                own = np.tril(own) + np.tril(own, -1).T
                across = -K @ joint
                joint = np.block([[own - across @ K.T, across], [across.T, joint]])
            yield n, joint

    def within(self, columns: Index, n: int) -> Index:
        """Where variables (k, ...) are in the joint covariance of a slice; 0 for those that are nowhere."""
        own = self._slice[columns]
        begin = np.where(own == n + 1, self._rows[n], 0)
        begin = np.where(own == self.count, self._rows[n] + self._next[n], begin)
        place: Index = np.where(own >= 0, begin + self._place[columns], 0)
        return place

    def is_free(self, columns: Index) -> NDArray[np.bool_]:
        """Which variables are in the problem."""
        return np.asarray(self._slice[columns] >= 0)

    def slices(self, columns: Index) -> Index:
        """The first slice (n,) that has a part in factors of some variables (n, k), from 0."""
        own = self._slice[columns]
        first: Index = np.where(own >= 0, own, self.count).min(axis=1)
        return first


def _undetermined() -> EstimationError:
    return EstimationError(
        "what was measured does not determine where everything is: let the robots see more landmarks, or each other "
        "more often"
    )
