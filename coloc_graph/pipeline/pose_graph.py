"""Solving of a pose graph file of any program, from its initial poses."""

import time
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from coloc_graph.backend.solver import optimise, with_stack
from coloc_graph.errors import EstimationError
from coloc_graph.exchange.g2o import G2oGraph, read_g2o

MAX_GAUSS_NEWTON = 30  # iterations
CONVERGED = 1e-8  # change of half the squared error, relative and absolute
MAX_CHI2_PER_ROW = 4.0  # of a fit from the file's poses that is no local minimum; noise as stated has less than 1


@dataclass(frozen=True, eq=False)
class PoseGraphSolution:
    """Optimum of a pose graph.

    Attributes
    ----------
    path, graph
        The file and its graph.
    values
        Poses at the optimum, by the file's ids.
    chi2_before, chi2
        Sum of the edges' squared residuals, in units of their noise, at the poses of the file and at the optimum.
    dof
        Rows of the edges less unknowns.
    iterations
        Iterations of Levenberg-Marquardt.
    seconds
        Time of reading and solving [s].
    """

    path: Path
    graph: G2oGraph
    values: gtsam.Values
    chi2_before: float
    chi2: float
    dof: int
    iterations: int
    seconds: float


def solve_pose_graph(path: str | Path, *, lenient: bool = False) -> PoseGraphSolution:
    """Solve the pose graph in a g2o file.

    Parameters
    ----------
    path
        File with vertices and edges in 2D or in 3D.
    lenient
        Project information matrices that are not positive definite; see `read_g2o`.

    Raises
    ------
    InputError
        The file is no pose graph.
    EstimationError
        Vertices are disconnected from all fixed ones, or the optimiser did not converge.
    """
    path, began = Path(path), time.perf_counter()
    graph = read_g2o(path, lenient=lenient)
    _require_connected(path, graph)
    size = graph.values.size()
    values, iterations = with_stack(size, lambda: optimum_of(graph))
    rows = 3 if graph.planar else 6
    return PoseGraphSolution(
        path=path,
        graph=graph,
        values=values,
        chi2_before=2 * graph.edges.error(graph.values),
        chi2=2 * graph.edges.error(values),
        dof=rows * (len(graph.ends) - (size - len(graph.fixed))),
        iterations=iterations,
        seconds=time.perf_counter() - began,
    )


def optimum_of(graph: G2oGraph) -> tuple[gtsam.Values, int]:
    """Values at the optimum, and iterations.

    Gauss-Newton from the poses of the file; where it fails or leaves a poor fit, also from poses made of the edges by
    a linear estimate of the rotations, and by Levenberg-Marquardt. The lowest error wins.

    Source: Carlone, Aragues, Castellanos, Bona, "A Linear Approximation for Graph-Based Simultaneous Localization and
    Mapping", 2011 (2D); Carlone, Tron, Daniilidis, Dellaert, "Initialization Techniques for 3D SLAM", 2015 (3D).
    """
    good = MAX_CHI2_PER_ROW / 2 * (3 if graph.planar else 6) * len(graph.ends)
    starts = [graph.values]
    found = _gauss_newton(graph, graph.values)
    converged = [found] if found else []
    if found is None or found[0] > good:
        if (start := linear_start(graph)) is not None:
            starts.append(start)
            if found := _gauss_newton(graph, start):
                converged.append(found)
        if not converged or min(error for error, _, _ in converged) > good:
            start = min([*starts, *(values for _, values, _ in converged)], key=graph.factors.error)
            values, iterations = optimise(graph.factors, start, roughly_first=True)
            converged.append((graph.factors.error(values), values, iterations))
    _, values, iterations = min(converged, key=itemgetter(0))
    return values, iterations


def _gauss_newton(graph: G2oGraph, start: gtsam.Values) -> tuple[float, gtsam.Values, int] | None:
    """Error, values and iterations of Gauss-Newton with Cholesky; None where it does not converge."""
    parameters = gtsam.GaussNewtonParams()
    parameters.setMaxIterations(MAX_GAUSS_NEWTON)
    parameters.setRelativeErrorTol(CONVERGED)
    parameters.setAbsoluteErrorTol(CONVERGED)
    optimiser = gtsam.GaussNewtonOptimizer(graph.factors, start, parameters)
    before = optimiser.error()
    try:
        values = optimiser.optimize()
    except RuntimeError:  # of a linear system that is not positive definite
        return None
    error, iterations = optimiser.error(), int(optimiser.iterations())
    return (error, values, iterations) if error <= before and iterations < MAX_GAUSS_NEWTON else None


def linear_start(graph: G2oGraph) -> gtsam.Values | None:
    """Poses from the edges alone: rotations by a linear least squares problem, then translations.

    None where GTSAM has none for the graph.
    """
    try:
        if not graph.planar:
            return gtsam.InitializePose3.initialize(graph.factors)
        diagonal = gtsam.NonlinearFactorGraph()  # all that GTSAM's takes
        for number, (i, j) in enumerate(graph.ends):
            edge: Any = graph.edges.at(number)
            noise = gtsam.noiseModel.Diagonal.Precisions(np.diag(edge.noiseModel().information()))
            diagonal.add(gtsam.BetweenFactorPose2(i, j, edge.measured(), noise))
        key = graph.fixed[0]
        diagonal.add(gtsam.PriorFactorPose2(key, graph.values.atPose2(key), gtsam.noiseModel.Unit.Create(3)))
        return gtsam.lago.initialize(diagonal)
    except (RuntimeError, IndexError, ValueError):  # a singular system, an unreached vertex, or noise that it refuses
        return None


def _require_connected(path: Path, graph: G2oGraph) -> None:
    keys = sorted(graph.values.keys())
    pairs = np.searchsorted(np.array(keys, np.uint64), np.array(graph.ends, np.uint64).reshape(-1, 2))
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(keys), len(keys)))
    _, component = connected_components(links, directed=False)
    fixed = {component[keys.index(key)] for key in graph.fixed}
    disconnected = [key for key, one in zip(keys, component.tolist(), strict=True) if one not in fixed]
    if disconnected:
        raise EstimationError(
            f"{path}: {len(disconnected)} of {len(keys)} vertices, as {disconnected[0]}, are disconnected from vertex "
            f"{graph.fixed[0]}, which is fixed: give edges that connect them, or fix a vertex in each part (FIX ID)"
        )
