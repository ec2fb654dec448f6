"""A simulated team leads itself down the hallway: how accurate, how fast after each stance, how long it takes.

    python benchmarks/online.py [--stances 40] [--seed 0] [--json]

Three robots' programs, emulated Creates, rendered images at 30 fps, zenoh on loopback, all on this machine and in real
time: about ten seconds a stance.
"""

import argparse
import json
import os
import statistics
import tempfile
import threading
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as `coloc` does, before numpy is there

import numpy as np

from coloc_graph.evaluation import Accuracy
from coloc_graph.online.coordinator import Coordinator
from coloc_graph.online.mission import MissionOptions
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.results.writer import assess
from coloc_graph.run import open_run
from coloc_graph.simulation.simulated_team import SimulatedTeam, field_team, free_address


def figures(stances: int, seed: int, folder: Path) -> dict[str, object]:
    """One mission: its latencies, and its accuracy as it was known at the end, and in batch."""
    team, address = field_team(), free_address()
    options = MissionOptions(goals=((100.0, 0.0),), stances=stances, speed=0.4)
    with SimulatedTeam(team, folder / "field", connect=address, seed=seed) as field:
        field.start()
        began = time.monotonic()
        with Coordinator(team, folder / "mission", options, listen=address) as coordinator:
            state = coordinator.run(threading.Event())
        seconds = time.monotonic() - began
    run = open_run(folder / "mission" / "run.mcap")
    out: dict[str, object] = {
        "ended": str(state),
        "stances": coordinator.stances,
        "seconds_a_stance": seconds / max(coordinator.stances, 1),
        "latency_median_s": statistics.median(coordinator.latencies),
        "latency_p99_s": float(np.percentile(coordinator.latencies, 99)),
        "lost_for_good": coordinator.link.counts.missed,
    }
    for name, incremental in (("online", True), ("batch", False)):
        solution = solve(run, SolveOptions(incremental=incremental))
        assessed = assess(solution, field.truth_path)
        assert assessed is not None
        out[name] = _accuracy(assessed[0]) | {"chi2_per_dof": solution.estimate.chi2 / solution.estimate.dof}
    return out


def _accuracy(accuracy: Accuracy) -> dict[str, object]:
    return {
        "length_error_percent": {row.robot: row.length_error_percent for row in accuracy.robots},
        "true_length_m": {row.robot: row.true_length for row in accuracy.robots},
        "heading_error_deg": {row.robot: row.heading_error_deg for row in accuracy.robots},
        "ate_m": accuracy.ate,
        "anees": accuracy.anees,
    }


def main() -> None:
    """Run it, print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stances", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = figures(options.stances, options.seed, Path(folder))
    if options.json:
        print(json.dumps(found, indent=2))
        return
    for name, value in found.items():
        print(f"{name:20} {value}")


if __name__ == "__main__":
    main()
