"""Hallway with ranges between the robots (UWB) beside their stances: the same worlds with and without the ranges.

Ranges alone are those with wheel odometry, from the first stance on: its relative poses are the start, and who stayed
put is known. They begin at the estimate with all measurements, which favours them.

python benchmarks/ranges.py [--seeds 12] [--stances 40] [--uwb-sigma 0.05] [--uwb-offset 0.1] [--uwb-nlos 0.05]
    [--mount-sigma 0.3] [--incremental] [--json]
"""

import argparse
import json
import sys
import time
from dataclasses import replace
from functools import partial

import numpy as np
from monte_carlo import compared, over_seeds, simulated, solved

from coloc_graph.backend import Estimate, joint
from coloc_graph.evaluation import Accuracy
from coloc_graph.measurements import Odometry, Range
from coloc_graph.pipeline.options import SolveOptions
from coloc_graph.simulation import Imperfections
from coloc_graph.simulation.uwb import with_ranged_landmarks


def one_seed(
    seed: int, wrong: Imperfections, stances: int, points: int, landmarks: int, incremental: bool
) -> dict[str, list[float]]:
    """Return, without and with ranges: end position error [cm] of A and B, heading [deg], NEES, chi2/dof, seconds."""
    figures = {}
    for name, sigma in (("stances alone", 0.0), ("stances and ranges", wrong.uwb_sigma)):
        of_uwb = {"uwb_sigma": sigma} if sigma else dict.fromkeys(("uwb_sigma", "uwb_offset_sigma", "uwb_nlos"), 0.0)
        world = simulated("hallway", seed, points=points, stances=stances,
                          imperfections=Imperfections(**{**vars(wrong), **of_uwb}))  # fmt: skip
        if sigma and landmarks:
            world = with_ranged_landmarks(world, landmarks)
        solution, accuracy = solved(world, SolveOptions(incremental=incremental))
        figures[name] = _figures(solution.estimate, accuracy, solution.seconds_backend)
    if not incremental:
        graph, began = solution.estimate.graph, time.process_time()
        first = graph.stances[0].index
        kept = tuple(one for one in graph.measurements if isinstance(one, Odometry | Range) or one.stance == first)
        alone = joint(replace(graph, measurements=kept), start=solution.estimate.values)
        figures["ranges alone"] = _figures(alone, compared(world, alone.trajectories), time.process_time() - began)
    return figures


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
        incremental=args.incremental,
    )  # fmt: skip
    every = over_seeds(work, range(args.first, args.first + args.seeds), args.processes)
    table = {}
    for name in every[0]:
        rows = np.array([figures[name] for figures in every])
        table[name] = {
            "end_position_error_cm_rms": float(np.sqrt((rows[:, :2] ** 2).mean())),
            "heading_error_deg_rms": float(np.sqrt((rows[:, 2] ** 2).mean())),
            "nees": float(rows[:, 3].mean()),
            "nees_standard_error": float(rows[:, 3].std() / np.sqrt(len(rows))),
            "chi2_per_dof": float(rows[:, 4].mean()),
            "seconds_backend": float(rows[:, 5].mean()),
            "rejected": float(rows[:, 6].mean()),
            "end_position_errors_cm": np.sqrt((rows[:, :2] ** 2).mean(axis=1)).round(3).tolist(),
        }
    if args.json:
        print(json.dumps(table, indent=2))
        return 0
    print(f"hallway, {args.stances} stances, {args.points} points a stance, {args.seeds} seeds, {wrong}")
    print(f"{'':20}{'end RMS':>10}{'heading':>11}{'NEES':>14}{'chi2/dof':>10}{'backend':>10}{'rejected':>10}")
    for name, row in table.items():
        print(
            f"{name:20}{row['end_position_error_cm_rms']:8.2f}cm{row['heading_error_deg_rms']:8.2f}deg"
            f"{row['nees']:7.2f} +-{row['nees_standard_error']:4.2f}{row['chi2_per_dof']:10.2f}"
            f"{row['seconds_backend']:9.2f}s{row['rejected']:10.1f}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
