"""Solving of a pose graph file of any program, from its initial poses."""

import time
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from coloc_graph.backend.solver import optimise, with_stack
from coloc_graph.errors import EstimationError
from coloc_graph.exchange.g2o import G2oGraph, read_g2o


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
    edges = gtsam.NonlinearFactorGraph()
    for number in range(len(graph.fixed), graph.factors.size()):
        edges.add(graph.factors.at(number))
    size = graph.values.size()
    values, iterations = with_stack(size, lambda: optimise(graph.factors, graph.values))
    rows = 3 if graph.planar else 6
    return PoseGraphSolution(
        path=path,
        graph=graph,
        values=values,
        chi2_before=2 * edges.error(graph.values),
        chi2=2 * edges.error(values),
        dof=rows * (edges.size() - (size - len(graph.fixed))),
        iterations=iterations,
        seconds=time.perf_counter() - began,
    )


def _require_connected(path: Path, graph: G2oGraph) -> None:
    keys = list(graph.values.keys())
    index = {key: n for n, key in enumerate(keys)}
    ends = [list(map(index.__getitem__, graph.factors.at(n).keys())) for n in range(graph.factors.size())]
    pairs = np.array([pair for pair in ends if len(pair) == 2], np.int64).reshape(-1, 2)
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(keys), len(keys)))
    _, component = connected_components(links, directed=False)
    fixed = {component[index[key]] for key in graph.fixed}
    disconnected = [key for key, one in zip(keys, component.tolist(), strict=True) if one not in fixed]
    if disconnected:
        raise EstimationError(
            f"{path}: {len(disconnected)} of {len(keys)} vertices, as {disconnected[0]}, are disconnected from vertex "
            f"{graph.fixed[0]}, which is fixed: give edges that connect them, or fix a vertex in each part (FIX ID)"
        )
