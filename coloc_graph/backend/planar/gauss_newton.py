"""Gauss-Newton over a graph of tens of thousands of variables, which starts near its optimum."""

import gtsam

from coloc_graph.errors import EstimationError

#: The search ends where a step gains less than this much of half chi2 a variable, of which one has about 2.
NOISE = 1e-4
MOST_ITERATIONS, MOST_HALVINGS = 40, 6


def gauss_newton(factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> tuple[gtsam.Values, int]:
    """The optimum near some values, and the steps to it; `EstimationError` where the search does not end, or nothing
    determines a variable.

    Levenberg-Marquardt gains nothing here, and tries out dampings of graphs that take seconds to linearise.
    """
    error = factors.error(values)
    enough = NOISE * values.size()
    for iteration in range(1, MOST_ITERATIONS + 1):
        try:
            step = factors.linearize(values).optimize()
        except RuntimeError as failure:
            raise EstimationError(
                "what was measured does not determine where everything is: let the robots see more landmarks, or each "
                "other more often"
            ) from failure
        for halving in range(MOST_HALVINGS):
            tried = values.retract(step)
            after = factors.error(tried)
            if after <= error + enough:
                break
            step = step.scale(0.5)
        else:
            raise EstimationError(f"the search leads nowhere after {iteration} steps (error {error:.6g})")
        gained, values, error = error - after, tried, after
        if abs(gained) < enough and not halving:
            return values, iteration
    raise EstimationError(f"the search did not end in {MOST_ITERATIONS} steps (error {error:.6g})")
