"""One step at the statistical limit: 20 cells, depth tracks, mounts known.

Per cell and over many draws of noise on the same points: mean |l_est - l| of eq. (2) and of the most likely pose,
the latter's RMSE over the Cramer-Rao bound of these points, its NEES, and chi2/dof of the homographies.

    python benchmarks/relative_pose.py [--runs 1000] [--outliers] [--json]

With --outliers the RMSE with so many bad points added that 30 % of all are gross outliers and 5 % are swapped
markers, over the RMSE without them.
"""

import argparse
import json
import sys
from functools import partial
from itertools import product

import gtsam
import numpy as np
from monte_carlo import anees_interval, over_seeds, simulated
from scipy.stats import chi2

from coloc_graph.frontend import PointPairs, fit_homography, plane_from_mount
from coloc_graph.frontend.homography.eq2_pose import relative_pose
from coloc_graph.frontend.homography.ml_pose import most_likely_pose
from coloc_graph.geometry.lie import se3_inverse
from coloc_graph.measurements import HomographyMeasurement, RelativePose
from coloc_graph.simulation.world import World

CELLS = list(product((0.6, 0.8, 1.0, 1.2), (0, 10, 20, 30, 40)))
NOISE = 0.3
POINTS = 50


def exact_points(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Noise-free pixels (n, 2) of the markers that both observers record."""
    i, j = world.captures[0]
    uv_i, in_i = i.view.project(world.markers_world("C", i.times))
    uv_j, in_j = j.view.project(world.markers_world("C", j.times))
    both = i.recorded & j.recorded & in_i & in_j
    return uv_i[both], uv_j[both]


def poses_of(
    world: World, uv_i: np.ndarray, uv_j: np.ndarray, *, eq2: bool = True
) -> tuple[RelativePose | None, RelativePose, float]:
    """Eq. (2) on the least-squares homography, the most likely pose, and chi2/dof of its homography."""
    team = world.team
    camera, mount, n = team["A"].camera, team["A"].mount, len(uv_i)
    C = np.broadcast_to(np.eye(2) * (NOISE / camera.fx) ** 2, (n, 2, 2))
    pairs = PointPairs(camera.normalise(uv_i), camera.normalise(uv_j), C, C)
    plane = plane_from_mount(mount, team["C"].markers, team.floor)
    paper = None
    if eq2:
        paper = relative_pose(_measurement(fit_homography(pairs, "transfer"), n), mount, mount, plane)
    fit = fit_homography(pairs)
    ours = most_likely_pose(_measurement(fit, n), mount, mount, plane, team.floor)
    return paper, ours, fit.chi2 / fit.dof


def _measurement(fit, n: int) -> HomographyMeasurement:
    inliers = int(fit.inliers.sum())
    return HomographyMeasurement(0, "A", "B", fit.H, fit.information, n, inliers, fit.chi2, fit.dof, 0.0)


def spoiled(
    rng: np.random.Generator, good: tuple[np.ndarray, np.ndarray], more: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Add bad points: 30 % of all lie anywhere in image j, and 5 % are swapped markers."""
    gross = round(0.30 / 0.65 * len(good[0]))
    swapped = round(0.05 / 0.65 * len(good[0]))
    bad_i, bad_j = more[0][: gross + swapped], more[1][: gross + swapped].copy()
    bad_j[:gross] = rng.uniform((0, 0), (320, 240), (gross, 2))
    bad_j[gross:] = np.roll(bad_j[gross:], 1, axis=0)
    return np.concatenate([good[0], bad_i]), np.concatenate([good[1], bad_j])


def one_cell(index: int, runs: int, outliers: bool) -> dict[str, float]:
    """The figures of a cell."""
    baseline, theta = CELLS[index]
    world = simulated("single-step", index, points=250, l=baseline, theta_deg=float(theta))
    true_i, true_j = exact_points(world)
    order = np.random.default_rng(index).permutation(len(true_i))
    more = true_i[order[POINTS:]], true_j[order[POINTS:]]
    true_i, true_j = true_i[order[:POINTS]], true_j[order[:POINTS]]
    stance = world.stances[0].start
    T_i, T_j = (world.paths[robot].pose_at(np.array([stance]))[0] for robot in "AB")
    T_i_j = gtsam.Pose3(se3_inverse(T_i) @ T_j)

    _, exact, _ = poses_of(world, true_i, true_j, eq2=False)
    along = exact.T_i_j[:3, 3] / baseline
    bound = float(np.sqrt(along @ exact.covariance[3:, 3:] @ along))
    rng = np.random.default_rng((1, index))
    eq2, ours, nees, ratio, dirty = [], [], [], [], []
    planar = [2, 3, 4]  # heading, x, y: the floor decides the rest
    for _ in range(runs):
        uv_i = true_i + NOISE * rng.standard_normal(true_i.shape)
        uv_j = true_j + NOISE * rng.standard_normal(true_j.shape)
        paper, pose, per_dof = poses_of(world, uv_i, uv_j)
        eq2.append(np.linalg.norm(paper.T_i_j[:3, 3]) - baseline)
        ours.append(np.linalg.norm(pose.T_i_j[:3, 3]) - baseline)
        xi = gtsam.Pose3(pose.T_i_j).localCoordinates(T_i_j)[planar]
        nees.append(xi @ np.linalg.solve(pose.covariance[np.ix_(planar, planar)], xi) / 3)
        ratio.append(per_dof)
        if outliers:
            _, pose, _ = poses_of(world, *spoiled(rng, (uv_i, uv_j), more), eq2=False)
            dirty.append(np.linalg.norm(pose.T_i_j[:3, 3]) - baseline)
    rmse = float(np.sqrt(np.mean(np.square(ours))))
    figures = {
        "l": baseline, "theta_deg": theta, "eq2_cm": 100 * float(np.mean(np.abs(eq2))),
        "ours_cm": 100 * float(np.mean(np.abs(ours))), "rmse_over_bound": rmse / bound,
        "nees": float(np.mean(nees)), "chi2_per_dof": float(np.mean(ratio)),
    }  # fmt: skip
    if outliers:
        figures["outlier_rmse_ratio"] = float(np.sqrt(np.mean(np.square(dirty)))) / rmse
    return figures


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--cells", type=int, default=len(CELLS), help="first cells only (default: all)")
    parser.add_argument("--outliers", action="store_true")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    rows = over_seeds(partial(one_cell, runs=args.runs, outliers=args.outliers), range(args.cells))
    if args.json:
        print(json.dumps(rows, indent=2))
        return 0
    print(f"{args.runs} runs a cell, the same {POINTS} points in each, {NOISE} px, mounts known, level floor")
    low, high = anees_interval(args.runs, 3)
    limit = np.sqrt(chi2.ppf(0.975, args.runs) / args.runs)
    print(f"NEES interval {low:.3f} to {high:.3f}; RMSE over the bound may be {limit:.3f} by chance (97.5 %)")
    print(f"{'l':>7}{'theta':>7}{'eq. (2)':>10}{'ours':>9}{'ratio':>7}{'RMSE/bound':>12}{'NEES':>8}{'chi2/dof':>10}"
          + ("  outliers" if args.outliers else ""))  # fmt: skip
    for row in rows:
        print(
            f"{100 * row['l']:4.0f} cm{row['theta_deg']:5d} deg{row['eq2_cm']:7.2f} cm{row['ours_cm']:6.2f} cm"
            f"{row['ours_cm'] / row['eq2_cm']:6.2f}{row['rmse_over_bound']:11.3f}{row['nees']:10.3f}"
            f"{row['chi2_per_dof']:9.3f}" + (f"{row['outlier_rmse_ratio']:10.2f}" if args.outliers else "")
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
