"""Marginal covariances at the optimum, by multifrontal QR and selected inversion.

GTSAM's `Marginals` has no QR, and its ISAM2 traverses the tree once for each variable, which takes hours where fifty
robots' poses and mounts are in every clique. Sources: J. Liu, "The Multifrontal Method for Sparse Matrix Solution",
1992; A. Erisman and W. Tinney, "On Computing Certain Elements of the Inverse of a Sparse Matrix", 1975.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack, solve_triangular

from coloc_graph.errors import EstimationError

Array = NDArray[np.float64]
Index = NDArray[np.int64]

SINGULAR_TOLERANCE = 1e-14  # pivot relative to the largest below which a variable is undetermined
MAX_PARALLEL = 4  # factors on the same variables, more of which are summed up first
MERGED_WIDTH = 100  # columns up to which a clique is merged into its parent: numpy takes as long for fewer


def _summed_up(several: Sequence[tuple[Index, Array]]) -> tuple[Index, Array]:
    """Return factors on the same variables as one, of no more rows than columns: columns and Jacobian of each."""
    stacked = np.concatenate([A[:, np.argsort(columns)] for columns, A in several])
    return np.sort(several[0][0]), np.triu(lapack.dgeqrf(stacked)[0][: stacked.shape[1]])


def _joint_covariance(R: Array, T: Array, rest: Array) -> Array:
    """Return the covariance of a clique (f + s), from the rows that elimination left and that of its separator (s)."""
    own = len(R)
    back = solve_triangular(R, np.eye(own), check_finite=False)
    gain = -back @ T
    across = gain @ rest
    first = back @ back.T + across @ gain.T
    whole = np.empty((own + len(rest),) * 2)
    whole[:own, :own] = (first + first.T) / 2
    whole[:own, own:] = across
    whole[own:, :own] = across.T
    whole[own:, own:] = rest
    return whole


def tree_covariances(tree: gtsam.GaussianBayesTree, keys: Sequence[int], size: Callable[[int], int]) -> list[Array]:
    """Return the covariances of some variables of a Bayes tree, by the cliques from theirs up to the root.

    GTSAM's `marginalCovariance` of each takes 3.7 times as long (131 of 682 planar poses: 26 against 7 ms).

    Parameters
    ----------
    tree
        Linear graph, eliminated.
    keys
        Keys of the variables.
    size
        Dimension of a variable, by its key.
    """
    known: dict[int, tuple[dict[int, slice], Array]] = {}  # columns and covariance of cliques, by their first key
    found = []
    for key in keys:
        path, clique = [], tree[key]
        while clique is not None and clique.conditional().firstFrontalKey() not in known:
            path.append(clique.conditional())
            clique = clique.parent()
        above = known[clique.conditional().firstFrontalKey()] if clique is not None else ({}, np.empty((0, 0)))
        for conditional in reversed(path):
            R, variables = conditional.R(), list(conditional.keys())
            ends = np.cumsum([size(one) for one in variables]).tolist()
            columns = dict(zip(variables, map(slice, [0, *ends], ends), strict=False))
            rest = [one for one in variables if columns[one].start >= len(R)]
            at = np.array([n for one in rest for n in range(above[0][one].start, above[0][one].stop)], int)
            above = columns, _joint_covariance(R, conditional.S(), above[1][at[:, None], at])
            known[conditional.firstFrontalKey()] = above
        columns, C = above
        found.append(C[columns[key], columns[key]])
    return found


@dataclass(eq=False)
class _Clique:
    """Frontal variables `first`, eliminated together, and separator variables `rest`, by their indices in the order.

    Columns of each start at `begin`, and are `columns` among those of all; `own` (f) is the number of frontal columns,
    `width` (f + s) of all. `R` (f, f) and `T` (f, s) are the rows that elimination leaves; `covariance` (f, f + s) is
    that of the frontal variables with all.
    """

    first: list[int]
    rest: list[int]
    parent: "_Clique | None"
    children: "list[_Clique]" = field(default_factory=list)
    begin: dict[int, int] = field(default_factory=dict)
    columns: Index = field(default_factory=lambda: np.empty(0, int))
    own: int = 0
    width: int = 0
    R: Array | None = None
    T: Array | None = None
    covariance: Array | None = None


class Marginals:
    """Marginal covariances of the variables of a linear graph.

    Parameters
    ----------
    linear
        Graph, linearised at its optimum.
    size
        Dimension of a variable, by its key.
    ordering
        Order of elimination; COLAMD's by default.

    Raises
    ------
    EstimationError
        Factors leave a variable open.
    """

    def __init__(
        self, linear: gtsam.GaussianFactorGraph, size: Callable[[int], int], ordering: gtsam.Ordering | None = None
    ) -> None:
        ordering = ordering or gtsam.Ordering.ColamdGaussianFactorGraph(linear)
        keys = [int(ordering.at(n)) for n in range(ordering.size())]
        self._place = {key: n for n, key in enumerate(keys)}
        self._sizes = list(map(size, keys))
        self._begin: Index = np.cumsum([0, *self._sizes])  # first scalar column of each variable
        self._at = np.zeros(int(self._begin[-1]), int)  # scratch: where the columns of one clique are in it
        factors = [linear.at(n) for n in range(linear.size())]
        at = [tuple(self._place[int(key)] for key in factor.keys()) for factor in factors]  # noqa: SIM118  GTSAM's own
        distinct = list(dict.fromkeys(at))  # many factors are on the same variables
        split = np.split(self._columns([n for some in distinct for n in some]), self._ends(distinct))
        columns = dict(zip(distinct, split, strict=False))
        parallel: dict[tuple[int, ...], list[tuple[Index, Array]]] = defaultdict(list)
        for some, factor in zip(at, factors, strict=True):
            parallel[tuple(sorted(some))].append((columns[some], factor.jacobian()[0]))
        rows: dict[int, list[tuple[Index, Array]]] = defaultdict(list)
        for variables, several in parallel.items():
            rows[variables[0]] += several if len(several) <= MAX_PARALLEL else [_summed_up(several)]
        self._cliques = self._grown(list(parallel))
        self._eliminate(rows)
        for clique, whole in self._spread():
            clique.covariance = whole[: clique.own]

    def _columns(self, variables: Sequence[int]) -> Index:
        """The scalar columns of variables, one after the other."""
        sizes = np.array([self._sizes[n] for n in variables], int)
        ends = np.cumsum(sizes)
        first: Index = np.repeat(self._begin[np.array(variables, int)] - (ends - sizes), sizes)
        return first + np.arange(len(first))

    def _ends(self, groups: Sequence[Sequence[int]]) -> Index:
        """Return the index of the column after the last of each group of variables, none of which is empty."""
        sizes = np.array([self._sizes[n] for group in groups for n in group], int)
        ends: Index = np.cumsum(sizes)[np.cumsum([len(group) for group in groups]) - 1]
        return ends

    def has(self, key: int) -> bool:
        """Return whether a variable is in the graph."""
        return key in self._place

    def covariance(self, key: int) -> Array:
        """Return the covariance of one variable: of a pose (6, 6), rotation first, body frame."""
        return self.joint([key])

    def covariances(self) -> dict[int, Array]:
        """Return the covariances of all variables, by key."""
        return {key: self.joint([key]) for key in self._place}

    def joint(self, keys: Sequence[int]) -> Array:
        """Return the joint covariance of different variables, in the order given: (6 n, 6 n) of n poses."""
        at = [self._place[int(key)] for key in keys]
        known = self._known(at)
        return self._swept(at) if known is None else known

    def variances(self, keys: Sequence[Index], jacobians: Sequence[Array]) -> Array:
        """Return the variances (n, rows) of n linear functions of variables that share a factor.

        Parameters
        ----------
        keys : sequence of (n,) int
            Keys of the variables, by slot.
        jacobians : sequence of (n, rows, size) float
            Jacobians by the variables of each slot.
        """
        place = np.array([[self._place[key] for key in slot.tolist()] for slot in keys])
        by_clique: dict[int, list[int]] = defaultdict(list)
        for n, first in enumerate(place.min(axis=0).tolist()):
            by_clique[id(self._cliques[first])].append(n)
        A = np.concatenate(jacobians, axis=2)
        out = np.empty(A.shape[:2])
        columns = np.concatenate(
            [self._begin[one][:, None] + np.arange(J.shape[2]) for one, J in zip(place, jacobians, strict=True)], axis=1
        )
        for clique, whole in self._spread():
            some = by_clique.get(id(clique))
            if some:
                self._at[clique.columns] = np.arange(clique.width)
                at = self._at[columns[some]]
                C = whole[at[:, :, None], at[:, None, :]]
                out[some] = np.einsum("nij,njk,nik->ni", A[some], C, A[some])
        return out

    def _grown(self, factors: Sequence[Sequence[int]]) -> "list[_Clique]":
        """Return the clique of each variable."""
        count = len(self._sizes)
        later: list[set[int]] = [set() for _ in range(count)]
        for at in factors:
            later[min(at)].update(at)
        for n in range(count):
            later[n].discard(n)
            if later[n]:
                parent = min(later[n])
                later[parent] |= later[n]
                later[parent].discard(parent)
        cliques: dict[int, _Clique] = {}
        for n in reversed(range(count)):
            parent = min(later[n], default=-1)
            if parent >= 0 and len(later[n]) == len(later[parent]) + 1:
                cliques[n] = cliques[parent]
                cliques[n].first.insert(0, n)
                continue
            cliques[n] = _Clique([n], sorted(later[n]), cliques[parent] if parent >= 0 else None)
        # children before their parents, which are then as they were
        for clique in reversed(list({id(one): one for one in cliques.values()}.values())):
            self._merge(clique, cliques)
        for clique in {id(one): one for one in cliques.values()}.values():
            if clique.parent is not None:
                clique.parent = cliques[clique.parent.first[-1]]
                clique.parent.children.append(clique)
            variables = (*clique.first, *clique.rest)
            clique.columns = self._columns(variables)
            clique.begin = dict(zip(variables, [0, *self._ends([[n] for n in variables]).tolist()], strict=False))
            clique.width, clique.own = len(clique.columns), sum(self._sizes[n] for n in clique.first)
        return [cliques[n] for n in range(count)]

    def _merge(self, clique: _Clique, cliques: dict[int, _Clique]) -> None:
        """Merge a clique into its parent where both together are small."""
        parent = clique.parent
        if parent is None:
            return
        width = sum(self._sizes[n] for n in (*clique.first, *parent.first, *parent.rest))
        if width <= MERGED_WIDTH:
            parent.first = sorted((*clique.first, *parent.first))
            cliques.update(dict.fromkeys(clique.first, parent))

    def _each(self) -> Iterator[_Clique]:
        """Iterate over the cliques, each before its parent."""
        return (clique for n, clique in enumerate(self._cliques) if clique.first[-1] == n)

    def _eliminate(self, rows: dict[int, list[tuple[Index, Array]]]) -> None:
        left: dict[int, Array] = {}
        for clique in self._each():
            own = clique.own
            parts = [part for n in clique.first for part in rows.get(n, ())]
            parts += [(child.columns[child.own :], left.pop(id(child))) for child in clique.children]
            self._at[clique.columns] = np.arange(clique.width)
            stacked = np.zeros((sum(len(A) for _, A in parts), clique.width), order="F")
            top = 0
            for columns, A in parts:
                stacked[top : top + len(A), self._at[columns]] = A
                top += len(A)
            R = np.triu(lapack.dgeqrf(stacked, overwrite_a=1)[0][: clique.width])
            sizes = np.abs(np.diagonal(R)[:own])
            if len(R) < own or sizes.min(initial=np.inf) <= SINGULAR_TOLERANCE * sizes.max(initial=0.0):
                raise EstimationError("a variable of the graph is undetermined: it has neither measurement nor prior")
            clique.R, clique.T, left[id(clique)] = R[:own, :own], R[:own, own:], R[own:, own:]

    def _spread(self) -> Iterator[tuple[_Clique, Array]]:
        """Iterate over the cliques with the joint covariance of their variables, from the roots down."""
        # each clique with the covariance of its parent, kept until it is used
        ready: list[tuple[_Clique, Array]] = [(one, np.empty((0, 0))) for one in self._each() if one.parent is None]
        while ready:
            clique, above = ready.pop()
            assert clique.R is not None and clique.T is not None
            rest = above
            if clique.parent is not None:
                self._at[clique.parent.columns] = np.arange(clique.parent.width)
                at = self._at[clique.columns[clique.own :]]
                rest = above[at[:, None], at]
            whole = _joint_covariance(clique.R, clique.T, rest)
            yield clique, whole
            ready += [(child, whole) for child in clique.children]

    def _known(self, at: Sequence[int]) -> Array | None:
        """Return the joint covariance of variables of which any two share a clique; None where two do not."""
        sizes = [self._sizes[n] for n in at]
        begins = np.concatenate([[0], np.cumsum(sizes)])
        out = np.empty((begins[-1], begins[-1]))
        for i, a in enumerate(at):
            clique, begin = self._cliques[a], self._cliques[a].begin
            row = slice(begin[a], begin[a] + sizes[i])
            for j, b in enumerate(at):
                if b < a and b not in begin:
                    continue
                if b not in begin:
                    return None
                assert clique.covariance is not None
                block = clique.covariance[row, begin[b] : begin[b] + sizes[j]]
                out[begins[i] : begins[i + 1], begins[j] : begins[j + 1]] = block
                out[begins[j] : begins[j + 1], begins[i] : begins[i + 1]] = block.T
        return out

    def _swept(self, at: Sequence[int]) -> Array:
        """Return the joint covariance of any variables: E^T R^-1 R^-T E, along their paths to the root."""
        wide = sum(self._sizes[n] for n in at)
        path: dict[int, _Clique] = {}
        right: dict[int, Array] = {}
        done = 0
        for n in at:
            size = self._sizes[n]
            right[n] = np.zeros((size, wide))
            right[n][:, done : done + size] = np.eye(size)
            done += size
            above: _Clique | None = self._cliques[n]
            while above is not None:
                path[above.first[-1]] = above
                above = above.parent
        solved = []
        for _, clique in sorted(path.items()):
            assert clique.R is not None and clique.T is not None
            e = np.concatenate([right.get(n, np.zeros((self._sizes[n], wide))) for n in clique.first])
            y = solve_triangular(clique.R, e, trans="T", check_finite=False)
            solved.append(y)
            if clique.rest:
                passed, begin = clique.T.T @ y, 0
                for n in clique.rest:
                    part = passed[begin : begin + self._sizes[n]]
                    right[n] = right[n] - part if n in right else -part
                    begin += self._sizes[n]
        Y = np.concatenate(solved)
        return np.asarray(Y.T @ Y)
