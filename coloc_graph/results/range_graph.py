"""Result of a range graph on disk: graph.pyfg with the optimum as its vertices, and summary.json."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from coloc_graph._version import __version__
from coloc_graph.exchange.pyfg import write_pyfg
from coloc_graph.pipeline.range_graph import RangeGraphSolution
from coloc_graph.results.folder import SUMMARY, atomic_result

KIND = "range graph"  # `kind` in summary.json, which results of runs do not have


def write_range_graph_result(solution: RangeGraphSolution, out: str | Path) -> None:
    """Write a solved range graph to the folder `out`; an earlier result there is replaced."""
    with atomic_result(out) as part:
        (part / "trajectories").rmdir()
        write_pyfg(replace(solution.graph, truth=solution.values, bearings=()), part / "graph.pyfg")
        (part / SUMMARY).write_text(json.dumps(summarise_range_graph(solution), indent=2) + "\n", encoding="utf-8")


def summarise_range_graph(solution: RangeGraphSolution) -> dict[str, Any]:
    """Return the content of summary.json."""
    graph, outliers = solution.graph, solution.rejected
    return {
        "version": __version__,
        "kind": KIND,
        "graph": str(solution.path),
        "variables": len(solution.values),
        "relatives": len(graph.relatives),
        "ranges": len(graph.ranges),
        "bearings": len(graph.bearings),
        "outliers": [{"time": one.time, "first": one.first, "second": one.second, "sigmas": s} for one, s in outliers],
        "chi2": solution.chi2,
        "dof": solution.dof,
        "iterations": solution.iterations,
        "seconds": round(solution.seconds, 3),
        "errors": None if solution.errors is None else asdict(solution.errors),
    }
