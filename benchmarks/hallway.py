"""Length error on the hallway (Table II) at depth tracks, over seeds: eq. (2) chained, smoothed, joint.

python benchmarks/hallway.py [--seeds 20] [--points 100] [--json]
"""

import argparse
import json
import sys
from functools import partial

import numpy as np
from monte_carlo import over_seeds, rms_interval, simulated, solved

from coloc_graph.frontend import FrontendOptions
from coloc_graph.pipeline.batch import SolveOptions

METHODS = {
    "eq. (2), chained (the paper)": SolveOptions("chain"),
    "eq. (2), ML homographies, chained": SolveOptions("chain", FrontendOptions(pose="eq2")),
    "eq. (2), ML homographies, smoothed": SolveOptions("smooth", FrontendOptions(pose="eq2"), odometry=False),
    "ML poses, smoothed without odometry": SolveOptions("smooth", odometry=False),
    "ML poses, smoothed": SolveOptions("smooth"),
    "joint (the default)": SolveOptions("joint"),
}


def one_seed(seed: int, points: int, stances: int) -> dict[str, list[float]]:
    """Return by method errors of A and B: length [%], end position [cm], heading [deg]; NEES, chi2/dof."""
    world = simulated("hallway", seed, points=points, stances=stances)
    figures = {}
    for name, options in METHODS.items():
        solution, accuracy = solved(world, options)
        lengths = [100 * row.length_error / row.true_length for row in accuracy.robots if row.robot != "C"]
        chi2 = solution.estimate.chi2 / solution.estimate.dof if solution.estimate.dof else float("nan")
        observers = [row for row in accuracy.robots if row.robot != "C"]
        end, heading = (
            max(getattr(row, of) for row in observers) for of in ("end_position_error", "heading_error_deg")
        )
        figures[name] = [*lengths, 100 * end, heading, accuracy.anees or 0.0, chi2]
    return figures


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--points", type=int, default=100)
    parser.add_argument("--stances", type=int, default=40)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    every = over_seeds(partial(one_seed, points=args.points, stances=args.stances), range(args.seeds))
    table = {}
    for name in METHODS:
        rows = np.array([figures[name] for figures in every])
        rms, low, high = rms_interval(rows[:, :2].ravel())
        table[name] = {
            "length_error_percent_rms": rms,
            "length_error_percent_95": [low, high],
            "end_position_error_cm_rms": float(np.sqrt((rows[:, 2] ** 2).mean())),
            "heading_error_deg_rms": float(np.sqrt((rows[:, 3] ** 2).mean())),
            "anees": float(rows[:, 4].mean()),
            "chi2_per_dof": float(rows[:, 5].mean()),
        }
    if args.json:
        print(json.dumps(table, indent=2))
        return 0
    print(f"hallway, {args.stances} stances, {args.points} points a stance, 0.3 px, {args.seeds} seeds")
    print(f"{'':36}{'length error RMS (95 %)':>28}{'end':>10}{'heading':>10}{'NEES':>7}{'chi2/dof':>9}")
    for name, row in table.items():
        low, high = row["length_error_percent_95"]
        print(
            f"{name:36}{row['length_error_percent_rms']:11.3f} % ({low:.3f}-{high:.3f})"
            f"{row['end_position_error_cm_rms']:8.1f}cm{row['heading_error_deg_rms']:7.2f}deg"
            f"{row['anees']:7.2f}{row['chi2_per_dof']:9.2f}"
        )
    print("the paper reports 0.20-0.34 % over 7.25-7.69 m")
    return 0


if __name__ == "__main__":
    sys.exit(main())
