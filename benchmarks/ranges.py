"""Hallway with ranges between the robots (UWB) beside their stances: the same worlds with and without the ranges.

Ranges alone are those with wheel odometry, from the first stance on: its relative poses are the start, and who stayed
put is known. They are averaged at the poses of the estimate with all measurements, and in batch begin there, which
favours them.

python benchmarks/ranges.py [--seeds 12] [--stances 40] [--uwb-sigma 0.05] [--uwb-offset 0.1] [--uwb-nlos 0.05]
    [--mount-sigma 0.3] [--incremental] [--rows FILE] [--json]
"""

import argparse
import json
import sys
import time
from collections import defaultdict
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from monte_carlo import compared, over_seeds, simulated, solved
from numpy.typing import NDArray

from coloc_graph.backend import Estimate, Estimator, PoseGraph, joint
from coloc_graph.evaluation import Accuracy
from coloc_graph.measurements import Measurement, Odometry, Range
from coloc_graph.pipeline.options import SolveOptions
from coloc_graph.simulation import Imperfections
from coloc_graph.simulation.uwb import with_ranged_landmarks
from coloc_graph.team import Team

DRAWS = 20000  # of the bootstrap


def one_seed(
    seed: int, wrong: Imperfections, stances: int, points: int, landmarks: int, incremental: bool, rows: str | None
) -> dict[str, list[float]]:
    """Return, by what is used: end position error [cm] of A and B, heading [deg], NEES, chi2/dof, seconds.

    They are also added to the file `rows`, a line of JSON for each seed.
    """
    figures = {}
    for name, sigma in (("stances alone", 0.0), ("stances and ranges", wrong.uwb_sigma)):
        of_uwb = {"uwb_sigma": sigma} if sigma else dict.fromkeys(("uwb_sigma", "uwb_offset_sigma", "uwb_nlos"), 0.0)
        world = simulated("hallway", seed, points=points, stances=stances,
                          imperfections=Imperfections(**{**vars(wrong), **of_uwb}))  # fmt: skip
        if sigma and landmarks:
            world = with_ranged_landmarks(world, landmarks)
        solution, accuracy = solved(world, SolveOptions(incremental=incremental))
        figures[name] = _figures(solution.estimate, accuracy, solution.seconds_backend)
    graph, began = solution.estimate.graph, time.process_time()
    first = graph.stances[0].index
    kept = tuple(one for one in graph.measurements if isinstance(one, Odometry | Range) or one.stance == first)
    alone = replace(graph, measurements=kept)
    start = solution.estimate.values
    estimate = by_stance(alone, world.team).estimate() if incremental else joint(alone, start=start)
    accuracy = compared(world, estimate.trajectories)
    figures["ranges alone"] = _figures(estimate, accuracy, time.process_time() - began)
    if rows is not None:
        with Path(rows).open("a", encoding="utf-8") as file:
            file.write(json.dumps({"seed": seed, **figures}) + "\n")
    return figures


def by_stance(graph: PoseGraph, team: Team) -> Estimator:
    """Return an estimator that took the measurements of a graph stance by stance."""
    of_stance: dict[int, list[Measurement]] = defaultdict(list)
    for one in graph.measurements:
        of_stance[max(stance for _, stance in one.ends)].append(one)
    estimator, before = Estimator.of(team), None
    for stance in graph.stances:
        measured = of_stance[stance.index]
        estimator.add(stance, [one for one in measured if not isinstance(one, Range)], after=before)
        if ranges := [one for one in measured if isinstance(one, Range)]:
            estimator.insert(*ranges)
        before = stance.index
    return estimator


def _figures(estimate: Estimate, accuracy: Accuracy, seconds: float) -> list[float]:
    rows = [row for row in accuracy.robots if row.robot != "C"]
    return [
        *(100 * row.end_position_error for row in rows),
        max(row.heading_error_deg for row in rows),
        float(np.mean([row.nees.mean for row in rows if row.nees is not None])),
        estimate.chi2 / max(estimate.dof, 1),
        seconds,
        float(len(estimate.rejected)),
    ]


def summarised(every: list[dict[str, list[float]]]) -> dict[str, dict[str, Any]]:
    """Return RMS and means over seeds, by what is used, with 95 % intervals by a bootstrap of seeds.

    "both" compares stances and ranges together with each of these.
    """
    drawn = np.random.default_rng(0).integers(0, len(every), (DRAWS, len(every)))
    squares = {name: (np.array([one[name][:2] for one in every]) ** 2).mean(axis=1) for name in every[0]}
    both, table = squares["stances and ranges"], {}
    for name, square in squares.items():
        rows = np.array([figures[name] for figures in every])
        table[name] = {
            "end_position_error_cm_rms": float(np.sqrt(square.mean())),
            "end_position_error_cm_rms_95": _interval(np.sqrt(square[drawn].mean(axis=1))),
            "both_better_in": int((both < square).sum()),
            "both_over_this": float(np.sqrt(both.mean() / square.mean())),
            "both_over_this_95": _interval(np.sqrt(both[drawn].mean(axis=1) / square[drawn].mean(axis=1))),
            "heading_error_deg_rms": float(np.sqrt((rows[:, 2] ** 2).mean())),
            "nees": float(rows[:, 3].mean()),
            "nees_95": _interval(rows[:, 3][drawn].mean(axis=1)),
            "chi2_per_dof": float(rows[:, 4].mean()),
            "seconds_backend": float(rows[:, 5].mean()),
            "rejected": float(rows[:, 6].mean()),
            "end_position_errors_cm": np.sqrt(square).round(3).tolist(),
        }
    return table


def _interval(drawn: NDArray[np.float64]) -> tuple[float, float]:
    low, high = np.quantile(drawn, (0.025, 0.975)).tolist()
    return low, high


def _shown(row: dict[str, Any], name: str) -> str:
    low, high = row[f"{name}_95"]
    return f"{row[name]:.2f} ({low:.2f}-{high:.2f})"


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--stances", type=int, default=40)
    parser.add_argument("--points", type=int, default=100)
    parser.add_argument("--uwb-sigma", type=float, default=0.05)
    parser.add_argument("--uwb-offset", type=float, default=0.1)
    parser.add_argument("--uwb-nlos", type=float, default=0.05)
    parser.add_argument("--mount-sigma", type=float, default=0.0, help="tilt and roll of the mounts [deg]")
    parser.add_argument("--height-sigma", type=float, default=0.0, help="height of the mounts [m]")
    parser.add_argument("--landmarks", type=int, default=0, help="landmarks that are ranged on the way")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--incremental", action="store_true")
    parser.add_argument("--rows", metavar="FILE", help="add the figures of each seed to this file as they come")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    wrong = Imperfections(
        mount_sigma_deg=args.mount_sigma,
        height_sigma=args.height_sigma,
        uwb_sigma=args.uwb_sigma,
        uwb_offset_sigma=args.uwb_offset,
        uwb_nlos=args.uwb_nlos,
    )
    work = partial(
        one_seed, wrong=wrong, stances=args.stances, points=args.points, landmarks=args.landmarks,
        incremental=args.incremental, rows=args.rows,
    )  # fmt: skip
    table = summarised(over_seeds(work, range(args.first, args.first + args.seeds), args.processes))
    if args.json:
        print(json.dumps(table, indent=2))
        return 0
    print(f"hallway, {args.stances} stances, {args.points} points a stance, {args.seeds} seeds, {wrong}")
    print(f"{'':20}{'end RMS [cm]':>20}{'both better, both / this':>32}{'heading':>11}{'NEES':>18}")
    for name, row in table.items():
        print(
            f"{name:20}{_shown(row, 'end_position_error_cm_rms'):>20}"
            f"{row['both_better_in']:>8}/{args.seeds}{_shown(row, 'both_over_this'):>20}"
            f"{row['heading_error_deg_rms']:8.2f}deg{_shown(row, 'nees'):>18}; chi2/dof {row['chi2_per_dof']:.2f}, "
            f"backend {row['seconds_backend']:.2f} s, rejected {row['rejected']:.1f}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
