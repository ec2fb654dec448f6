"""A folder of runs on one process, on two, and on a Dask cluster of two workers on this machine.

    python benchmarks/many_runs.py [--runs 40] [--stances 12] [--json]

The processes' start is in the times; what it would be without is the ideal, twice as fast as one.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path

from distributed import LocalCluster

from coloc_graph.results.executors import workers
from coloc_graph.results.many_runs import result_folders, runs_in, solve_runs
from coloc_graph.simulation import simulate


def seconds(folder: Path, out: Path, executors: Callable[[], AbstractContextManager[Executor]]) -> float:
    """Time all runs of a folder."""
    runs = runs_in(folder)
    started = time.perf_counter()
    outcomes = solve_runs(runs, result_folders(runs, folder, out), executors=executors)
    assert not any(one.failed for one in outcomes)
    return time.perf_counter() - started


def measure(runs: int, stances: int, work: Path) -> dict[str, float]:
    """Seconds of each, and how many times as fast as one process."""
    folder = work / "runs"
    folder.mkdir()
    for seed in range(runs):
        simulate("hallway", folder / f"{seed}.mcap", seed=seed, stances=stances)
    found = {f"{n}_s": seconds(folder, work / str(n), partial(workers, n)) for n in (1, 2)}
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0", host="127.0.0.1") as cluster:
        found["dask_2_s"] = seconds(folder, work / "dask", partial(workers, cluster=cluster.scheduler_address))
    return found | {f"speedup_{name}": found["1_s"] / found[f"{name}_s"] for name in ("2", "dask_2")}


def main() -> None:
    """Run it, print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--stances", type=int, default=12)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = measure(options.runs, options.stances, Path(folder))
    if options.json:
        print(json.dumps(found, indent=2))
        return
    for name, value in found.items():
        print(f"{name:16} {value:8.2f}")


if __name__ == "__main__":
    main()
