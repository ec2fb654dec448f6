"""Pose graphs of others, read and solved, beside GTSAM's own reader and solvers: error at the end and processor time.

    python benchmarks/pose_graphs.py DIR        all *.g2o in DIR

GTSAM's solvers are Gauss-Newton and Levenberg-Marquardt (its defaults and its Ceres defaults) from the file's poses,
and Gauss-Newton from its linear start; each converges to 1e-8. The fastest is the one that reaches the lowest error
within 1e-6 in the least time; the excess is our error over that, less 1. The programs take turns, `--repeat` times; the
least time of each counts.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import gtsam

from coloc_graph.backend.solver import with_stack
from coloc_graph.errors import ColocError
from coloc_graph.exchange.g2o import G2oGraph, read_g2o
from coloc_graph.pipeline.pose_graph import CONVERGED, linear_start, optimum_of

MAX_ITERATIONS = 100


def timed(work: Callable[[], object]) -> tuple[float, object]:
    """Processor time [s] of a piece of work, and its result; the failure's text where it fails."""
    began = time.process_time()
    try:
        result = work()
    except (RuntimeError, TypeError, ColocError) as failure:
        result = str(failure).strip().splitlines()[0]
    return time.process_time() - began, result


def prepared(parameters: gtsam.NonlinearOptimizerParams) -> gtsam.NonlinearOptimizerParams:
    """The parameters with the same end of the search for all."""
    parameters.setMaxIterations(MAX_ITERATIONS)
    parameters.setRelativeErrorTol(CONVERGED)
    parameters.setAbsoluteErrorTol(CONVERGED)
    return parameters


def solvers(graph: G2oGraph) -> dict[str, Callable[[], gtsam.Values]]:
    """GTSAM's solvers of a graph, by name."""
    factors, values = graph.factors, graph.values

    def lm(kind: Callable[[], gtsam.LevenbergMarquardtParams]) -> gtsam.Values:
        return gtsam.LevenbergMarquardtOptimizer(factors, values, prepared(kind())).optimize()

    def gauss_newton(start: gtsam.Values) -> gtsam.Values:
        return gtsam.GaussNewtonOptimizer(factors, start, prepared(gtsam.GaussNewtonParams())).optimize()

    return {
        "LM": lambda: lm(gtsam.LevenbergMarquardtParams),
        "LM Ceres": lambda: lm(gtsam.LevenbergMarquardtParams.CeresDefaults),
        "GN": lambda: gauss_newton(values),
        "linear, GN": lambda: gauss_newton(linear_start(graph)),
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path, metavar="DIR")
    parser.add_argument("--repeat", type=int, default=2, metavar="N", help="turns of each program (default: 2)")
    args = parser.parse_args()
    print(f"{'graph':26s} {'poses':>6s} {'edges':>6s} {'read':>6s} {'error':>12s} {'excess':>7s} {'by':>10s} time")
    for path in sorted(args.data.glob("*.g2o")):
        try:
            graph = read_g2o(path, lenient=True)
        except ColocError as refusal:
            print(refusal)
            continue
        ours: list[tuple[float, object]] = []
        theirs: dict[str, list[tuple[float, object]]] = {name: [] for name in solvers(graph)}
        reads: list[tuple[float, float]] = []
        for _ in range(args.repeat):
            reads.append(
                (
                    timed(lambda: read_g2o(path, lenient=True))[0],  # noqa: B023  called at once
                    timed(lambda: gtsam.readG2o(str(path), not graph.planar))[0],  # noqa: B023
                )
            )
            ours.append(timed(lambda: with_stack(graph.values.size(), lambda: optimum_of(graph))))  # noqa: B023
            for name, solve in solvers(graph).items():
                theirs[name].append(timed(lambda: with_stack(graph.values.size(), solve)))  # noqa: B023
        errors = {
            name: graph.factors.error(found[0][1])
            for name, found in theirs.items()
            if isinstance(found[0][1], gtsam.Values)
        }
        lowest = min(errors.values())
        times = {name: min(t for t, _ in theirs[name]) for name, e in errors.items() if e <= lowest * (1 + 1e-6)}
        fastest = min(times, key=times.__getitem__)
        found = ours[0][1]
        error = graph.factors.error(found[0]) if isinstance(found, tuple) else float("nan")
        read = min(a for a, _ in reads) / min(b for _, b in reads)
        print(
            f"{path.stem:26s} {graph.values.size():6d} {len(graph.ends):6d} {read:6.2f} {error:12.6g} "
            f"{error / lowest - 1:+7.0e} {fastest:>10s} {min(t for t, _ in ours):.2f} / {times[fastest]:.2f} s "
            f"= {min(t for t, _ in ours) / times[fastest]:.2f}" + ("" if isinstance(found, tuple) else f"  {found}"),
            flush=True,
        )


if __name__ == "__main__":
    main()
