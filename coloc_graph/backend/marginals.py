"""Marginal covariances at the optimum, by multifrontal QR and selected inversion.

GTSAM's `Marginals` has no QR, and its ISAM2 traverses the tree once for each variable, which takes hours where fifty
robots' poses and mounts are in every clique. Sources: J. Liu, "The Multifrontal Method for Sparse Matrix Solution",
1992; A. Erisman and W. Tinney, "On Computing Certain Elements of the Inverse of a Sparse Matrix", 1975.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack, solve_triangular

from coloc_graph.backend.calibration import SIZES
from coloc_graph.errors import EstimationError

Array = NDArray[np.float64]
Index = NDArray[np.int64]

SINGULAR_TOLERANCE = 1e-14  # pivot relative to the largest below which a variable is undetermined


@dataclass(eq=False)
class _Clique:
    """Frontal variables `first`, eliminated together, and separator variables `rest`, by their indices in the order.

    Columns of each start at `begin`; `own` (f) is the number of frontal columns, `width` (f + s) of all. `R` (f, f) and
    `T` (f, s) are the rows that elimination leaves; `covariance` (f, f + s) is that of the frontal variables with all.
    """

    first: list[int]
    rest: list[int]
    parent: "_Clique | None"
    children: "list[_Clique]" = field(default_factory=list)
    begin: dict[int, int] = field(default_factory=dict)
    own: int = 0
    width: int = 0
    R: Array | None = None
    T: Array | None = None
    covariance: Array | None = None


class Marginals:
    """Marginal covariances of the variables of a graph at its optimum.

    Raises
    ------
    EstimationError
        The factors leave a variable undetermined.
    """

    def __init__(self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        linear = factors.linearize(values)
        ordering = gtsam.Ordering.ColamdGaussianFactorGraph(linear)
        keys = [int(ordering.at(n)) for n in range(ordering.size())]
        self._place = {key: n for n, key in enumerate(keys)}
        self._sizes = [SIZES.get(key >> 56, 6) for key in keys]
        rows: dict[int, list[tuple[list[int], Array]]] = defaultdict(list)
        for n in range(linear.size()):
            factor = linear.at(n)
            at = [self._place[int(key)] for key in factor.keys()]  # noqa: SIM118  GTSAM's own
            rows[min(at)].append((at, factor.jacobian()[0]))
        self._cliques = self._grown(rows)
        self._eliminate(rows)
        self._spread()

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

    def _grown(self, rows: dict[int, list[tuple[list[int], Array]]]) -> "list[_Clique]":
        """Return the clique of each variable."""
        count = len(self._sizes)
        later: list[set[int]] = [set() for _ in range(count)]
        for n in range(count):
            for at, _ in rows.get(n, ()):
                later[n].update(at)
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
            if parent >= 0:
                cliques[parent].children.append(cliques[n])
        for clique in {id(one): one for one in cliques.values()}.values():
            for n in (*clique.first, *clique.rest):
                clique.begin[n] = clique.width
                clique.width += self._sizes[n]
            clique.own = sum(self._sizes[n] for n in clique.first)
        return [cliques[n] for n in range(count)]

    def _span(self, clique: _Clique, variables: Sequence[int]) -> Index:
        """Return the columns of variables, one after the other."""
        return np.concatenate([clique.begin[n] + np.arange(self._sizes[n]) for n in variables])

    def _each(self) -> Iterator[_Clique]:
        """Iterate over the cliques, each before its parent."""
        return (clique for n, clique in enumerate(self._cliques) if clique.first[-1] == n)

    def _eliminate(self, rows: dict[int, list[tuple[list[int], Array]]]) -> None:
        left: dict[int, Array] = {}
        for clique in self._each():
            own = clique.own
            parts = [(self._span(clique, at), A) for n in clique.first for at, A in rows.get(n, ())]
            parts += [(self._span(clique, child.rest), left.pop(id(child))) for child in clique.children]
            stacked = np.zeros((sum(len(A) for _, A in parts), clique.width), order="F")
            top = 0
            for columns, A in parts:
                stacked[top : top + len(A), columns] = A
                top += len(A)
            R = np.triu(lapack.dgeqrf(stacked, overwrite_a=1)[0])[: clique.width]
            sizes = np.abs(np.diagonal(R)[:own])
            if len(R) < own or sizes.min(initial=np.inf) <= SINGULAR_TOLERANCE * sizes.max(initial=0.0):
                raise EstimationError("a variable of the graph is undetermined: it has neither measurement nor prior")
            clique.R, clique.T, left[id(clique)] = R[:own, :own], R[:own, own:], R[own:, own:]

    def _spread(self) -> None:
        """Compute the covariances, from the roots down."""
        # each clique with the covariance of its parent, kept until it is used
        ready: list[tuple[_Clique, Array]] = [(one, np.empty((0, 0))) for one in self._each() if one.parent is None]
        while ready:
            clique, above = ready.pop()
            assert clique.R is not None and clique.T is not None
            at = self._span(clique.parent, clique.rest) if clique.parent else np.empty(0, int)
            rest = above[np.ix_(at, at)]
            back = solve_triangular(clique.R, np.eye(clique.own), check_finite=False)
            gain = -back @ clique.T
            across = gain @ rest
            own = back @ back.T + across @ gain.T
            clique.covariance = np.concatenate([(own + own.T) / 2, across], axis=1)
            if clique.children:
                whole = np.concatenate([clique.covariance, np.concatenate([across.T, rest], axis=1)])
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
