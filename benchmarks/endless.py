"""A mission without an end: the joint estimate stance by stance, with what is older than the lag forgotten.

    python benchmarks/endless.py [--stances 100000] [--json FILE]

The paper's hallway is simulated once (`--block` stances) and its measurements come again and again. Where one round
ends and the next begins both observers move, one of them known by odometry, so that no measurement contradicts another.
One homography in 200 is replaced by a wrong one, also between two rounds, where it alone ties an observer. Times are of
the thread's processor.
"""

import argparse
import gc
import json
import resource
import statistics
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from monte_carlo import simulated, solved

from coloc_graph.backend import Estimator, PoseGraph
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.measurements import Measurement, Odometry, RelativePose, Sighting
from coloc_graph.pipeline.batch import SolveOptions
from coloc_graph.run import Stance
from coloc_graph.simulation import Imperfections

WRONG = Imperfections(mount_sigma_deg=1.0, height_sigma=0.005, span_sigma=1e-4, floor_sigma_deg=0.1)
WRONG_SHARE = 0.005  # of the homographies
WINDOW = 1000  # stances that a row of the table sums up
JOIN_COVARIANCE = np.diag([0.02, 0.02, 0.02]) ** 2  # rad, m, m: odometry between two rounds


def block_of(stances: int) -> PoseGraph:
    """Graph of one simulated hallway."""
    solution, _ = solved(
        simulated("hallway", 0, points=250, stances=stances, imperfections=WRONG), SolveOptions("smooth")
    )
    return solution.estimate.graph


def later(measured: Measurement, stances: int, seconds: float) -> Measurement:
    """A measurement, some stances later."""
    if isinstance(measured, Odometry):
        return replace(measured, before=measured.before + stances, after=measured.after + stances)
    if isinstance(measured, Sighting):
        return replace(measured, stance=measured.stance + stances, time=measured.time + seconds)
    assert isinstance(measured, RelativePose)
    return replace(measured, stance=measured.stance + stances)


def endless(graph: PoseGraph) -> Iterator[tuple[Stance, list[Measurement], int]]:
    """Yield each stance with its measurements and the number of wrong ones among them."""
    rng = np.random.default_rng(0)
    by_stance: dict[int, list[Measurement]] = defaultdict(list)
    for measured in graph.measurements:
        by_stance[max(index for _, index in measured.ends)].append(measured)
    first, last = graph.stances[0], graph.stances[-1]
    passed, seconds = 0, 0.0
    while True:
        for stance in graph.stances:
            here = replace(stance, index=stance.index + passed, start=stance.start + seconds, end=stance.end + seconds)
            taken = [later(one, passed, seconds) for one in by_stance[stance.index]]
            if stance is first:
                here = replace(here, anchors=())
                if passed:
                    step = floor_pose(1.0, 0.0, 0.0)
                    taken.append(Odometry(stance.observers[0], here.index - 1, here.index, step, JOIN_COVARIANCE))
            wrong = 0
            for n, one in enumerate(taken):
                if not isinstance(one, RelativePose) or one.homography is None:
                    continue
                if rng.uniform() < WRONG_SHARE:
                    H = one.homography.H_j_i @ (np.eye(3) + 0.05 * rng.standard_normal((3, 3)))
                    homography = replace(one.homography, H_j_i=H / np.cbrt(np.linalg.det(H)))
                    taken[n], wrong = replace(one, homography=homography), wrong + 1
            yield here, taken, wrong
        passed += last.index - first.index + 1
        seconds += last.end - first.start + 1.0


def main() -> None:
    """Print a row for each thousand stances."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stances", type=int, default=100_000)
    parser.add_argument("--block", type=int, default=300, help="stances of a simulated round (default: 300)")
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    graph = block_of(args.block)
    gc.collect()
    gc.freeze()  # the simulation is no part of what is timed
    estimator = Estimator(graph.reference, graph.robots, graph.floor, robot_models=graph.robot_models, forgets=True)
    rows: list[dict[str, float]] = []
    times: list[float] = []
    rejected = wrong = 0
    for number, (stance, taken, bad) in enumerate(endless(graph), start=1):
        began = time.thread_time()
        said = estimator.add(stance, taken)
        times.append(time.thread_time() - began)
        rejected, wrong = rejected + len(said.rejected), wrong + bad
        if number % WINDOW == 0 or number == args.stances:
            pages = int(Path("/proc/self/statm").read_text().split()[1])  # of Linux
            rows.append(
                {
                    "stance": number,
                    "median_ms": 1000 * statistics.median(times),
                    "longest_ms": 1000 * max(times),
                    "rss_mib": pages * resource.getpagesize() / 2**20,
                    "rejected": rejected,
                    "wrong": wrong,
                }
            )
            times = []
            print("  ".join(f"{name} {value:.5g}" for name, value in rows[-1].items()), flush=True)
        if number == args.stances:
            break
    if args.json:
        args.json.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
