"""Search for missions in which a promise is broken: many seeds, on all cores; faults of what fails are shrunk.

python -m coloc_graph.missions.search --missions 1000
"""

import argparse
import math
import os
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import replace
from itertools import islice
from multiprocessing import get_context

import numpy as np
from scipy.stats import chi2

from coloc_graph.missions.mission import Outcome, Scenario, run_mission, scenario_of

PROGRESS = 5  # missions between two lines of progress
PER_PROCESS = 25  # missions that a process runs before another takes its place


def shrunk(scenario: Scenario, violation: str) -> Scenario:
    """Leave out faults of a scenario as long as a promise is broken in the same way; return what is left."""
    left, n = scenario, 0
    while n < len(left.faults):
        fewer = replace(left, faults=left.faults[:n] + left.faults[n + 1 :])
        if any(_kind(one) == _kind(violation) for one in run_mission(fewer).violations):
            left = fewer
        else:
            n += 1
    return left


def _kind(violation: str) -> str:
    """Kind of a violation: its words without the time, numbers and names."""
    text = violation.partition(" s: ")[2]
    return " ".join(word for word in text.split() if word.isalpha() and len(word) > 1)[:60]


def outcomes(scenarios: Sequence[Scenario], processes: int, seconds: float) -> Iterator[Outcome]:
    """Run missions in worker processes for `seconds` [s] at most; yield their outcomes as they come."""
    os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")  # the missions are what is parallel
    until, waiting = time.monotonic() + seconds, iter(scenarios)
    with ProcessPoolExecutor(processes, get_context("spawn"), max_tasks_per_child=PER_PROCESS) as pool:
        running = {pool.submit(run_mission, one) for one in islice(waiting, 2 * processes)}
        while running:
            done, running = wait(running, return_when=FIRST_COMPLETED)
            if time.monotonic() < until:
                running |= {pool.submit(run_mission, one) for one in islice(waiting, len(done))}
            yield from (one.result() for one in done)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the search; return 1 if a promise was broken."""
    parser = argparse.ArgumentParser(
        prog="python -m coloc_graph.missions.search", description="Search for missions in which a promise is broken."
    )
    parser.add_argument("--missions", type=int, default=100, help="number of missions (default: 100)")
    parser.add_argument("--first", type=int, default=0, help="seed of the first one (default: 0)")
    parser.add_argument("--stances", type=int, default=6, help="stances of each (default: 6)")
    parser.add_argument("--faults", type=int, help="faults of each (default: as the seed draws)")
    parser.add_argument("--formation", choices=("paper", "plan"), default="paper", help="as in `coloc coordinate`")
    parser.add_argument("--way", type=float, default=0.0, metavar="M", help="go to a goal M metres ahead, as the demo")
    parser.add_argument("--robots", type=int, default=3, choices=(3, 4), help="of the team (default: 3)")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, help="(default: CPU count)")
    parser.add_argument("--seconds", type=float, default=1e9, help="begin no more missions after this time")
    parser.add_argument("--no-shrink", action="store_true", help="do not shrink the faults of what fails")
    options = parser.parse_args(arguments)
    seeds = range(options.first, options.first + options.missions)
    each = options.stances, options.formation, options.faults, options.way, options.robots
    scenarios = [scenario_of(seed, *each) for seed in seeds]
    began, simulated, cpu, failed = time.monotonic(), 0.0, 0.0, []
    states: dict[str, int] = {}
    nees, freedom, attempts, entered = 0.0, 0, 0, 0
    ends: list[tuple[float, float]] = []
    for one in outcomes(scenarios, options.processes, options.seconds):
        simulated, cpu = simulated + one.seconds, cpu + one.cpu
        states[one.state] = states.get(one.state, 0) + 1
        if sum(states.values()) % PROGRESS == 0:
            print(f"{sum(states.values())} missions, {simulated:.0f} s simulated", file=sys.stderr, flush=True)
        nees, freedom = nees + one.nees[0], freedom + one.nees[1]
        attempts, entered, ends = attempts + one.attempts, entered + one.entered, [*ends, *one.ends]
        if one.violations:
            failed.append(one)
            print(f"seed {one.scenario.seed}: {one.violations[0]}", flush=True)
    print(f"{sum(states.values())} missions, {len(failed)} break a promise; states {states}")
    rate, took = simulated / max(cpu, 1e-9), time.monotonic() - began
    print(f"{simulated:.0f} s simulated in {took:.0f} s; {rate:.1f} s in a second of one core")
    print(f"{attempts} attempts at stances, of which {entered} entered the estimate")
    if ends:
        position, heading = np.sqrt(np.mean(np.square(ends), axis=0))
        print(f"RMS of the last poses: {1e3 * position:.1f} mm, {math.degrees(heading):.2f} deg")
    if freedom:
        low, high = (float(chi2.ppf(p, freedom)) / freedom for p in (0.0005, 0.9995))
        print(f"NEES per degree of freedom at the end: {nees / freedom:.3f}, in [{low:.3f}, {high:.3f}] if honest")
    for one in [] if options.no_shrink else failed[:5]:
        less = shrunk(one.scenario, one.violations[0])
        print(f"seed {less.seed}, of {len(one.scenario.faults)} faults these matter:")
        print("\n".join(f"  {fault}" for fault in less.faults) or "  none")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
