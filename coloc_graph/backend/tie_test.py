"""Test of the links that tie new poses, before they enter: by their rows beyond the unknowns of those poses."""

from collections.abc import Callable, Iterable, Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.calibration import size_of
from coloc_graph.backend.chi2_test import (
    REJECTION_P_VALUE,
    Agreement,
    innovation,
    keys_of,
)
from coloc_graph.backend.graph import Link
from coloc_graph.backend.insertion import InsertionPlan
from coloc_graph.backend.solver import optimise
from coloc_graph.errors import EstimationError
from coloc_graph.measurements import RelativePose, Sighting

Array = NDArray[np.float64]
_Test = Callable[[Sequence[gtsam.NonlinearFactor], gtsam.Values, Array, Sequence[int]], Agreement]


class TieTest:
    """Test of ties against what a graph knows of their other ends, of the calibration and of the floor.

    Parameters
    ----------
    known : callable
        True if a variable is one of the graph, by its key.
    origin : int or None
        Key of a new pose that defines the world.
    value : callable
        Estimate of such a variable, initial value of any other, by its key.
    root : callable
        Root of the joint covariance of variables of the graph, by their keys.
    priors : callable
        Prior factors of a variable that the graph lacks, by its key.
    """

    def __init__(
        self,
        known: Callable[[int], bool],
        origin: int | None,
        value: Callable[[int], gtsam.Pose3 | Array],
        root: Callable[[Sequence[int]], Array],
        priors: Callable[[int], Iterable[gtsam.NonlinearFactor]],
    ) -> None:
        self._known, self._origin, self._value, self._root, self._priors = known, origin, value, root, priors

    def outliers(self, plan: InsertionPlan, factors: Sequence[gtsam.NonlinearFactor]) -> list[tuple[Link, Agreement]]:
        """Return the homographies and sightings among the ties of a plan, with their `factors`, that are outliers.

        A tie of a pose that an outlier has placed is not tested: it is to be planned anew.
        """
        found = list[tuple[Link, Agreement]]()
        leading = dict[int, list[gtsam.NonlinearFactor]]()  # factors that have placed a new pose, by its key
        placed_wrong = set[int]()
        for (link, i, j), factor in zip(plan.ties, factors, strict=False):
            new = [key for key in (i, j) if key in plan.start and key not in leading and key != self._origin]
            if len(new) != 1:
                continue
            other = j if new[0] == i else i
            before = leading.get(other, [])
            leading[new[0]] = [*before, factor]
            if other in placed_wrong:
                placed_wrong.add(new[0])
            elif isinstance(link, RelativePose | Sighting):
                off = self._of(before, factor)
                if off.p_value() < REJECTION_P_VALUE:
                    found.append((link, off))
                    placed_wrong.add(new[0])
        return found

    def _of(self, before: list[gtsam.NonlinearFactor], factor: gtsam.NonlinearFactor) -> Agreement:
        """Test a factor against the graph and the factors `before` it, which have placed its other end."""
        linear = self._beyond(before, factor, innovation)
        return linear if linear.p_value() >= REJECTION_P_VALUE else self._beyond(before, factor, _innovation_at_optimum)

    def _beyond(self, before: list[gtsam.NonlinearFactor], factor: gtsam.NonlinearFactor, test: _Test) -> Agreement:
        off = self._together([*before, factor], test)
        if not before:
            return off
        without = self._together(before, test)
        return Agreement(max(off.chi2 - without.chi2, 0.0), off.dof - without.dof)

    def _together(
        self,
        factors: list[gtsam.NonlinearFactor],
        test: _Test,
    ) -> Agreement:
        keys = keys_of(factors)
        known, new = list(filter(self._known, keys)), [key for key in keys if not self._known(key)]
        values = gtsam.Values()
        for key in keys:
            values.insert(key, self._value(key))
        root = self._root(known) if known else np.zeros((0, 0))
        return test([*factors, *(one for key in new for one in self._priors(key))], values, root, [*known, *new])


def _innovation_at_optimum(
    factors: Sequence[gtsam.NonlinearFactor], values: gtsam.Values, root: Array, keys: Sequence[int]
) -> Agreement:
    """Test as `innovation`, which is the least sum of squares, of factors that are far from linear."""
    linear = innovation(factors, values, root, keys)
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    if len(root):
        graph.add(_known_factor(values, root, keys))
    try:
        optimum, _ = optimise(graph, values)
    except EstimationError:  # it is not found, as of a homography that no camera on the floor can have
        return linear
    return Agreement(2.0 * graph.error(optimum), linear.dof)


def _known_factor(values: gtsam.Values, root: Array, keys: Sequence[int]) -> gtsam.LinearContainerFactor:
    """Return what a graph says of the first of some variables: a root of their joint covariance, at `values`."""
    R, terms, begin = np.linalg.qr(np.linalg.inv(root))[1], list[tuple[int, Array]](), 0
    for key in keys:
        if begin == len(root):
            break
        terms.append((key, R[:, begin : begin + size_of(key)]))
        begin += size_of(key)
    unit = gtsam.noiseModel.Unit.Create(len(root))
    return gtsam.LinearContainerFactor(gtsam.GaussianConditional(terms, len(terms), np.zeros(len(root)), unit), values)
