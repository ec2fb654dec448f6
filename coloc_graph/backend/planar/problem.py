"""Least squares problem of keyframes: those of a whole run, or of a window with what those before it say."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.linear_system import Rows
from coloc_graph.backend.planar.factors import KeyframeFactors, State, robust

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(eq=False)
class KeyframeProblem:
    """Factors of keyframes that have poses, for `gauss_newton`.

    Parameters
    ----------
    factors : KeyframeFactors
        Factors of all keyframes and measurements.
    steps, measured : (n,) and (m,) int
        Poses from which there are steps, and measurements, by index.
    gauge : (int, (3,) float) or None
        Pose that defines the world, and its value, where no landmark does.
    past : gtsam.LinearContainerFactor or None
        What keyframes that were marginalised say, priors and gauge included.
    """

    factors: KeyframeFactors
    steps: Index
    measured: Index
    gauge: tuple[int, Array] | None = None
    past: gtsam.LinearContainerFactor | None = None
    _names: Sequence[int] = field(default=(), init=False)  # GTSAM's keys of the variables
    _last: tuple[State, list[Rows], float] | None = field(default=None, init=False)  # evaluated last

    def cost(self, state: State) -> float:
        """Return half chi2 of all factors but those of the past, with their robust loss."""
        return self._evaluated(state)[1]

    def linear(self, state: State) -> gtsam.GaussianFactorGraph:
        """Return all factors, linearised."""
        graph = self.factors.linear(state, self._evaluated(state)[0], priors=self.past is None)
        if self.past is not None:
            graph.push_back(self.past.linearize(self.factors.values(state, self.past.keys())))
        self._names = graph.keyVector()
        return graph

    def moved(self, state: State, step: gtsam.VectorValues) -> State:
        """Return the state after a step from where it was linearised last."""
        return self.factors.moved(state, step, self._names)

    def _evaluated(self, state: State) -> tuple[list[Rows], float]:
        if self._last is None or self._last[0] is not state:
            steps = self.factors.steps(state, self.steps)
            measured, cost = robust(self.factors.measured(state, self.measured))
            cost += 0.5 * float((steps.residuals**2).sum()) + self.factors.cost_before(state)
            rows = [steps, measured]
            if self.gauge is not None and self.past is None:
                rows.append(self.factors.gauge(state, *self.gauge))
            self._last = state, rows, cost
        return self._last[1:]
