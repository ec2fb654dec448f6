"""Linear factors of whole batches of residuals, eliminated by GTSAM.

Residuals and Jacobians of all factors of a kind are evaluated at once in numpy. Scalar variables are numbered; what is
estimated together (a pose, the errors of a sensor) is one key of GTSAM's.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class Rows(NamedTuple):
    """Linearised factors of one kind.

    Parameters
    ----------
    jacobians : (n, rows, k + 1) float
        Whitened Jacobians; the last column are the residuals.
    columns : (n, k) int
        Scalar variables of the other columns.
    begins : tuple of int
        Columns at which the k variables of another key begin, 0 first.
    """

    jacobians: Array
    columns: Index
    begins: tuple[int, ...]

    @property
    def residuals(self) -> Array:
        """Whitened residuals (n, rows)."""
        return self.jacobians[:, :, -1]

    def of(self, index: Index) -> "Rows":
        """Return some of the factors."""
        return self._replace(jacobians=self.jacobians[index], columns=self.columns[index])


class Keys:
    """Keys of a problem's scalar variables.

    Parameters
    ----------
    names : (keys,) int
        GTSAM's key of each, by which it is the same in problems of other variables.
    sizes : (keys,) int
        Number of variables of each key; they are numbered key after key.
    free : (variables,) bool
        Variables that are estimated; a key without any is in no factor.
    """

    def __init__(self, names: Index, sizes: Index, free: NDArray[np.bool_]) -> None:
        self.names, self.sizes, self.free = names, sizes, free
        self.first: Index = np.cumsum([0, *sizes])
        self.of: Index = np.repeat(np.arange(len(sizes)), sizes)
        self.is_free: NDArray[np.bool_] = np.bincount(self.of[free], minlength=len(sizes)) > 0
        self._order: Index = np.argsort(names)

    def numbers(self, names: Sequence[int] | Index) -> Index:
        """Return the numbers of keys by GTSAM's names."""
        found: Index = self._order[np.searchsorted(self.names[self._order], names)]
        return found

    @cached_property
    def _size_of(self) -> dict[int, int]:
        return dict(zip(self.names.tolist(), self.sizes.tolist(), strict=True))

    def size(self, name: int) -> int:
        """Return the number of variables of a key, by GTSAM's name."""
        return self._size_of[name]

    def span(self, key: int) -> slice:
        """Return the variables of a key."""
        return slice(int(self.first[key]), int(self.first[key + 1]))

    def variables(self, keys: Index) -> Index:
        """Return the variables of some keys, key after key."""
        sizes = self.sizes[keys]
        ends = np.cumsum(sizes)
        begins: Index = np.repeat(self.first[keys] - (ends - sizes), sizes)
        return begins + np.arange(len(begins))

    def step(self, found: gtsam.VectorValues, names: Sequence[int]) -> Array:
        """Return a step (variables,) in the variables of some keys, in ascending order of GTSAM's, 0 of all others."""
        step = np.zeros(len(self.free))
        step[self.variables(self.numbers(names))] = found.vector()
        return np.where(self.free, step, 0.0)

    def blocks(self, rows: Rows) -> Iterator[tuple[Index, list[tuple[Index, Array]]]]:
        """Group factors by the sizes of their keys.

        Yields
        ------
        (m,) int
            Indices of factors whose keys have the same sizes.
        list of ((m,) int, (m, rows, size) float)
            Their keys with the Jacobian by each; keys that are not free are left out.
        """
        J, columns = rows.jacobians[:, :, :-1] * self.free[rows.columns][:, None, :], rows.columns
        ends = (*rows.begins[1:], columns.shape[1])
        keys = self.of[columns[:, list(rows.begins)]]
        sizes = np.where(self.is_free[keys], self.sizes[keys], 0)
        code = sizes @ (1 + self.sizes.max(initial=0)) ** np.arange(sizes.shape[1])
        for one in np.unique(code).tolist():
            index = np.flatnonzero(code == one)
            wanted = sizes[index[0]].tolist()
            parts = []
            for slot, (begin, end, size) in enumerate(zip(rows.begins, ends, wanted, strict=True)):
                if size:
                    block = np.zeros((len(index), J.shape[1], size))
                    offset = int(columns[index[0], begin] - self.first[keys[index[0], slot]])
                    width = min(end - begin, size - offset)  # a key may have fewer, as a landmark has no heading
                    block[:, :, offset : offset + width] = J[index, :, begin : begin + width]
                    parts.append((keys[index, slot], block))
            yield index, parts

    def add(self, graph: gtsam.GaussianFactorGraph, rows: Rows) -> None:
        """Add factors of one kind to a graph."""
        add: Callable[..., None] = graph.add
        noise = gtsam.noiseModel.Unit.Create(rows.jacobians.shape[1])
        for index, parts in self.blocks(rows):
            columns = [column for keys, block in parts for column in (self.names[keys].tolist(), block)]
            if parts:
                for one in zip(*columns, -rows.residuals[index], strict=True):
                    add(*one, noise)

    def add_prior(self, graph: gtsam.GaussianFactorGraph, key: int, sigmas: Array, off: Array) -> None:
        """Add the prior of a key: standard deviations (size,) of its variables, and their errors `off` (size,)."""
        free = self.free[self.span(key)]
        if free.any():
            weights, noise = (
                np.where(free, 1 / np.where(free, sigmas, 1.0), 1.0),
                gtsam.noiseModel.Unit.Create(len(free)),
            )
            name = int(self.names[key])
            graph.push_back(gtsam.JacobianFactor(name, np.diag(weights), -weights * free * off, noise))
