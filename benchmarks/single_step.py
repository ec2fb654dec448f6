"""Fig. 4's pattern at depth tracks: mean |l_est - l| of eq. (2) in 20 cells, beside DESIGN's reference table.

Each cell: several worlds, in each many draws of 50 of 250 points, as the paper did with its 250 recordings.

    python benchmarks/single_step.py [--worlds 8] [--draws 50] [--json]
"""

import argparse
import json
import sys
from functools import partial
from itertools import product

import numpy as np
from monte_carlo import MemoryRun, over_seeds, simulated

from coloc_graph.frontend import FrontendOptions, fit_homography, measure_pair
from coloc_graph.frontend.homography.decomposition import decompose_with_normal
from coloc_graph.frontend.stance_tracks import stance_plane

BASELINES = (0.6, 0.8, 1.0, 1.2)
ANGLES = (0, 10, 20, 30, 40)
CELLS = list(product(BASELINES, ANGLES))

#: Mean |l_est - l| [cm] on the reference rig, from an independent exploration of the same geometry.
REFERENCE = dict(
    zip(CELLS, [.54, .40, .31, .29, .27, 1.34, .97, .87, .64, .51, 2.6, 1.8, 1.3, 1.0, .94, 4.7, 3.4, 2.1, 1.6, 1.3],
        strict=True)
)  # fmt: skip


def one_cell(index: int, worlds: int, draws: int) -> list[float]:
    """Errors |l_est - l| [cm] of all draws of a cell."""
    baseline, theta = CELLS[index]
    errors = []
    for seed in range(worlds):
        run = MemoryRun(simulated("single-step", seed, points=250, l=baseline, theta_deg=float(theta)))
        found = measure_pair(run, run.stances[0], "A", "B", FrontendOptions(criterion="transfer"))
        plane = stance_plane(run, run.stances[0], "A")
        rng = np.random.default_rng((seed, index))
        for _ in range(draws):
            few = rng.choice(len(found.correspondences), 50, replace=False)
            fit = fit_homography(found.correspondences.pairs[few], "transfer")
            _, T = decompose_with_normal(fit.H, plane.N, plane.d)
            errors.append(100 * abs(np.linalg.norm(T) - baseline))
    return errors


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=8)
    parser.add_argument("--draws", type=int, default=50)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    every = over_seeds(partial(one_cell, worlds=args.worlds, draws=args.draws), range(len(CELLS)))
    means = dict(zip(CELLS, map(np.mean, every), strict=True))
    # draws of one world share its points, so that the worlds are what is independent
    spread = [np.std(np.reshape(errors, (args.worlds, -1)).mean(axis=1)) / np.sqrt(args.worlds) for errors in every]
    sigmas = dict(zip(CELLS, spread, strict=True))
    if args.json:
        rows = [
            {"l": cell[0], "theta_deg": cell[1], "mean_cm": means[cell], "sigma_cm": sigmas[cell],
             "reference_cm": REFERENCE[cell]} for cell in CELLS
        ]  # fmt: skip
        print(json.dumps(rows, indent=2))
        return 0
    print("mean |l_est - l| of eq. (2) [cm] +- its standard error (reference), 50 of 250 points, 0.3 px")
    print(f"{'l':>7}" + "".join(f"{angle:>19} deg" for angle in ANGLES))
    for row in (CELLS[start : start + len(ANGLES)] for start in range(0, len(CELLS), len(ANGLES))):
        cells = (f"{means[cell]:8.2f} +-{sigmas[cell]:5.2f} ({REFERENCE[cell]:.2f})" for cell in row)
        print(f"{100 * row[0][0]:4.0f} cm" + "".join(cells))
    ratio = [means[cell] / REFERENCE[cell] for cell in CELLS]
    print(f"ratio to the reference: {min(ratio):.2f} to {max(ratio):.2f}, mean {np.mean(ratio):.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
