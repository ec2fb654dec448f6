"""Linear factors of whole batches of residuals, eliminated by GTSAM.

Residuals and Jacobians of all factors of a kind are evaluated at once in numpy. Scalar variables are numbered; what is
estimated together (a pose, the errors of a sensor) is one key of GTSAM's.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import EstimationError

Array = NDArray[np.float64]
Index = NDArray[np.int64]
State = TypeVar("State")

MAX_ITERATIONS = 40  # of Gauss-Newton
MAX_HALVINGS = 6  # of a step that does not lower the cost
CHECK = (
    "the measurements contradict each other, and it is not known which are wrong; check each robot's clock and "
    "odometry, who is called who, and the positions of the landmarks"
)


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
    sizes : (keys,) int
        Number of variables of each key; they are numbered key after key.
    free : (variables,) bool
        Variables that are estimated; a key without any is in no factor.
    """

    def __init__(self, sizes: Index, free: NDArray[np.bool_]) -> None:
        self.sizes, self.free = sizes, free
        self.first: Index = np.cumsum([0, *sizes])
        self.of: Index = np.repeat(np.arange(len(sizes)), sizes)
        self._is_free = np.bincount(self.of[free], minlength=len(sizes)) > 0

    def size(self, key: int) -> int:
        """Return the number of variables of a key."""
        return int(self.sizes[key])

    def span(self, key: int) -> slice:
        """Return the variables of a key."""
        return slice(int(self.first[key]), int(self.first[key + 1]))

    def variables(self, keys: Index) -> Index:
        """Return the variables of some keys, key after key."""
        sizes = self.sizes[keys]
        ends = np.cumsum(sizes)
        begins: Index = np.repeat(self.first[keys] - (ends - sizes), sizes)
        return begins + np.arange(len(begins))

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
        sizes = np.where(self._is_free[keys], self.sizes[keys], 0)
        code = sizes @ (1 + self.sizes.max(initial=0)) ** np.arange(sizes.shape[1])
        for one in np.unique(code).tolist():
            index = np.flatnonzero(code == one)
            wanted = sizes[index[0]].tolist()
            parts = []
            for slot, (begin, end, size) in enumerate(zip(rows.begins, ends, wanted, strict=True)):
                if size:
                    block = np.zeros((len(index), J.shape[1], size))
                    offset = int(columns[index[0], begin] - self.first[keys[index[0], slot]])
                    block[:, :, offset : offset + end - begin] = J[index, :, begin:end]
                    parts.append((keys[index, slot], block))
            yield index, parts


@dataclass(frozen=True, eq=False)
class Summary:
    """Marginal of eliminated factors on the keys that are left.

    Parameters
    ----------
    factors
        Linear factors on these keys.
    keys
        The keys.
    columns : (k,) int
        Their scalar variables, key after key.
    information : (k, k) float
        Information of these variables.
    """

    factors: gtsam.GaussianFactorGraph
    keys: tuple[int, ...]
    columns: Index
    information: Array


class LinearSystem:
    """Linear least squares over `keys`: `add` factors, then `solve`."""

    def __init__(self, keys: Keys) -> None:
        self.keys, self.graph = keys, gtsam.GaussianFactorGraph()
        # of linear terms alone, which have no covariance
        self._gradient = gtsam.GaussianFactorGraph()

    def add(self, rows: Rows) -> None:
        """Add factors of one kind."""
        make: Callable[..., gtsam.JacobianFactor] = gtsam.JacobianFactor
        push = self.graph.push_back
        noise = gtsam.noiseModel.Unit.Create(rows.jacobians.shape[1])
        for index, parts in self.keys.blocks(rows):
            b = -rows.residuals[index]
            columns = [column for keys, block in parts for column in (keys.tolist(), block)]
            if parts:
                for one in zip(*columns, b, strict=True):
                    push(make(*one, noise))

    def add_prior(self, key: int, sigmas: Array, off: Array) -> None:
        """Add the prior of a key: standard deviations (size,) of its variables, and their errors `off` (size,)."""
        free = self.keys.free[self.keys.span(key)]
        if free.any():
            weights = np.where(free, 1 / np.where(free, sigmas, 1.0), 1.0)
            noise = gtsam.noiseModel.Unit.Create(len(free))
            self.graph.push_back(gtsam.JacobianFactor(key, np.diag(weights), -weights * free * off, noise))

    def solve(self, ordering: gtsam.Ordering) -> Array:
        """Return the step (variables,) to the optimum, 0 of variables that are in no factor.

        Raises
        ------
        EstimationError
            The factors leave a variable open.
        """
        try:
            return self._step(self._whole().optimize(ordering), ordering)
        except RuntimeError as failure:  # GTSAM's indeterminate system
            raise undetermined() from failure

    def eliminated(self, ordering: gtsam.Ordering) -> gtsam.GaussianBayesTree:
        """Return the Bayes tree of the factors; raises as `solve` does."""
        try:
            return self._whole().eliminateMultifrontal(ordering)
        except RuntimeError as failure:
            raise undetermined() from failure

    def _whole(self) -> gtsam.GaussianFactorGraph:
        if not self._gradient.size():
            return self.graph
        whole = gtsam.GaussianFactorGraph()
        whole.push_back(self.graph)
        whole.push_back(self._gradient)
        return whole

    def step(self, tree: gtsam.GaussianBayesTree, ordering: gtsam.Ordering) -> Array:
        """Return the step (variables,) to the optimum of a Bayes tree."""
        return self._step(tree.optimize(), ordering)

    def _step(self, found: gtsam.VectorValues, ordering: gtsam.Ordering) -> Array:
        step = np.zeros(len(self.keys.free))
        keys = np.sort(np.array([ordering.at(n) for n in range(ordering.size())], int))
        step[self.keys.variables(keys)] = found.vector()  # in the order of the keys
        return np.where(self.keys.free, step, 0.0)

    def summed_up(self, gone: Index) -> "Summary":
        """Eliminate some keys and return their marginal on the others.

        They are in the order of the whole graph: one robot after the other would tie all poses of the others.
        """
        whole, ordering, some = self.ordering(), gtsam.Ordering(), set(gone.tolist())
        for key in (int(whole.at(n)) for n in range(whole.size())):
            if key in some:
                ordering.push_back(key)
        try:
            _, rest = self._whole().eliminatePartialMultifrontal(ordering)
        except RuntimeError as failure:
            raise undetermined() from failure
        kept, left = [int(key) for key in rest.keyVector()], gtsam.Ordering()
        for key in kept:
            left.push_back(key)
        columns = self.keys.variables(np.array(kept, int))
        information = rest.augmentedHessian(left)[:-1, :-1] if kept else np.empty((0, 0))
        one = gtsam.GaussianFactorGraph()
        if kept:  # as one factor: those on kept keys alone would become more each time
            one.push_back(gtsam.HessianFactor(rest))
        return Summary(one, tuple(kept), columns, information)

    def add_summary(self, summary: "Summary", moved: Array) -> None:
        """Add the marginal of eliminated factors, whose variables (k,) have `moved` since these were linearised."""
        self.graph.push_back(summary.factors)
        gradient, begin = -summary.information @ moved, 0
        for key in summary.keys:
            size = self.keys.size(key)
            own = gradient[begin : begin + size]
            self._gradient.push_back(gtsam.HessianFactor(key, np.zeros((size, size)), own, 0.0))
            begin += size

    def ordering(self, last: Sequence[int] = ()) -> gtsam.Ordering:
        """Return an order of elimination, for all systems of the same factors; GTSAM's METIS segfaults on some.

        Keys that are `last` are at the root, where covariances cost least.
        """
        if not len(last):
            return gtsam.Ordering.ColamdGaussianFactorGraph(self.graph)
        return gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(self.graph, list(last))


@dataclass(frozen=True, eq=False)
class Optimum(Generic[State]):
    """Optimum of a least-squares problem: its state, its last system with the order of elimination, and iterations."""

    state: State
    system: LinearSystem
    ordering: gtsam.Ordering
    iterations: int


def gauss_newton(
    start: State,
    linearise: Callable[[State], tuple[list[Rows], float]],
    system: Callable[[State, list[Rows]], LinearSystem],
    moved: Callable[[State, Array], State],
    tolerance: float,
) -> Optimum[State]:
    """Find the optimum near a state.

    Parameters
    ----------
    start
        Initial state.
    linearise
        Gives the factors at a state, and their cost (half chi2).
    system
        Makes a linear system of a state and its factors.
    moved
        Gives the state after a step (variables,).
    tolerance
        Half chi2 by which an iteration must lower the cost; the search ends where one does not.

    Raises
    ------
    EstimationError
        The search does not end, or the factors leave a variable open.
    """
    state, ordering = start, None
    rows, cost = linearise(state)
    for iteration in range(1, MAX_ITERATIONS + 1):
        linear = system(state, rows)
        ordering = ordering or linear.ordering()
        step = linear.solve(ordering)
        for halving in range(MAX_HALVINGS):
            tried = moved(state, 0.5**halving * step)
            rows, after = linearise(tried)
            if after <= cost + tolerance:
                break
        else:
            raise EstimationError(
                f"the optimisation does not converge (half chi2 {cost:.6g} after {iteration} steps): {CHECK}"
            )
        gained, state, cost = cost - after, tried, after
        if abs(gained) < tolerance and not halving:
            return Optimum(state, linear, ordering, iteration)
    raise EstimationError(f"the optimisation did not end in {MAX_ITERATIONS} steps (half chi2 {cost:.6g}): {CHECK}")


def undetermined() -> EstimationError:
    """Return the error of factors that leave a variable open."""
    return EstimationError(
        "what was measured does not determine where everything is: let the robots see more landmarks, or each other "
        "more often"
    )
