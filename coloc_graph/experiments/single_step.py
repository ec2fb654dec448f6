"""The single step of section V-A: two observers, one mover, and many draws of 50 of 250 recorded points.

The distance between the robots is that between their cameras, which are mounted alike: the length of T.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry, InputError
from coloc_graph.experiments.paper import ANGLES, BASELINES, RECORDED
from coloc_graph.experiments.pool import Progress, check, spread
from coloc_graph.frontend import FrontendOptions, decompose_with_normal, fit_homography, measure_pair
from coloc_graph.frontend.homography.ml_pose import most_likely_pose
from coloc_graph.frontend.homography.overlap import overlap
from coloc_graph.frontend.stance_tracks import stance_plane
from coloc_graph.run import open_run
from coloc_graph.simulation import simulate
from coloc_graph.simulation.world import Depth

Array = NDArray[np.float64]

#: The paper's 20 cells: l [m], theta [deg].
CELLS: tuple[tuple[float, float], ...] = tuple(product(BASELINES, ANGLES))

#: Fewer points than this are no use to a homography with outliers among them.
MIN_DRAWN = 8


@dataclass(frozen=True, eq=False)
class Estimates:
    """Estimates of one method in the runs of a cell.

    `lengths` (runs,) [m], NaN where the points did not determine a pose, and `overlap_px` (runs,), the pixels of image
    i that see the part of the plane that image j sees, by its H.
    """

    lengths: Array
    overlap_px: Array


@dataclass(frozen=True, eq=False)
class Cell:
    """One cell of Fig. 4: a world in which `recorded` points were seen by both, and the runs drawn of them.

    `baseline` [m] and `theta_deg` are the truth; `overlap_px` is by the homography of all points.
    """

    baseline: float
    theta_deg: float
    recorded: int
    overlap_px: float
    eq2: Estimates
    ours: Estimates

    def errors_cm(self, estimates: Estimates) -> Array:
        """|l_est - l| (runs,) [cm]."""
        return np.asarray(100 * np.abs(estimates.lengths - self.baseline))

    def mean_cm(self, estimates: Estimates) -> float:
        """Mean of |l_est - l| [cm] over the runs that gave a pose: the paper's white circle."""
        errors = self.errors_cm(estimates)
        return float(errors[np.isfinite(errors)].mean()) if np.isfinite(errors).any() else float("nan")


def measure_cells(
    cells: Sequence[tuple[float, float]] = CELLS,
    *,
    depth: Depth = "tracks",
    seed: int = 0,
    runs: int = 500,
    draws: int = 50,
    processes: int = 1,
    cluster: str | None = None,
    progress: Progress | None = None,
) -> tuple[Cell, ...]:
    """Simulate each cell (l [m], theta [deg]) once, and estimate l from `draws` of its 250 points, `runs` times.

    Eq. (2) takes least-squares homographies in one image, as the paper; ours takes maximum-likelihood ones of
    the same points, and the most likely pose on the floor. Raises `InputError` where an argument is wrong or a
    cell has no common view, and `DegenerateGeometry` where a cell cannot be measured.
    """
    check(depth, seed, runs, processes)
    if not MIN_DRAWN <= draws <= RECORDED:
        raise InputError(f"`draws` is {draws}; give {MIN_DRAWN} to {RECORDED} points a run")
    work = partial(_measure_cell, depth=depth, seed=seed, runs=runs, draws=draws)
    return tuple(spread(work, list(cells), processes, cluster, progress))


def _measure_cell(cell: tuple[float, float], depth: Depth, seed: int, runs: int, draws: int) -> Cell:
    baseline, theta_deg = cell
    with TemporaryDirectory(prefix="coloc-") as folder:
        path = Path(folder) / "run.mcap"
        simulate("single-step", path, depth=depth, seed=seed, points=RECORDED, l=baseline, theta_deg=theta_deg)
        run = open_run(path)
        stance = run.stances[0]
        robot_i, robot_j = (run.team[name] for name in stance.observers)
        measured = measure_pair(run, stance, robot_i.name, robot_j.name, FrontendOptions())
        plane = stance_plane(run, stance, robot_i.name)
    found = measured.correspondences
    if found is None or measured.homography.unusable or len(found) < draws:
        why = measured.homography.unusable or f"both see only {len(found or ())} points, fewer than are drawn"
        raise DegenerateGeometry(f"l = {100 * baseline:g} cm, theta = {theta_deg:g} deg: {why}")

    # a cell's draws are its own, whichever others are measured
    rng = np.random.default_rng((seed, round(1000 * baseline), round(1000 * theta_deg) % 360_000))
    H = np.full((runs, 3, 3), np.nan)
    lengths, overlaps = np.full((2, runs), np.nan), np.full((2, runs), np.nan)
    for n in range(runs):
        pairs = found.pairs[rng.choice(len(found), draws, replace=False)]
        try:
            H[n] = fit_homography(pairs, "transfer").H
            overlaps[0, n] = overlap(H[n], robot_i.camera, robot_j.camera)
        except DegenerateGeometry:
            H[n] = np.nan
        try:
            fit = fit_homography(pairs, "reprojection")
            overlaps[1, n] = overlap(fit.H, robot_i.camera, robot_j.camera)
            measurement = replace(
                measured.homography,
                H_j_i=fit.H,
                information=fit.information,
                points=len(pairs),
                inliers=int(fit.inliers.sum()),
                chi2=fit.chi2,
                dof=fit.dof,
                overlap_px=overlaps[1, n],
            )
            pose = most_likely_pose(measurement, robot_i.mount, robot_j.mount, plane, run.team.floor)
            assert pose.T_ci_cj is not None
            lengths[1, n] = np.linalg.norm(pose.T_ci_cj[:3, 3])
        except DegenerateGeometry:
            pass
    usable = np.isfinite(H).all(axis=(1, 2))
    lengths[0, usable] = np.linalg.norm(decompose_with_normal(H[usable], plane.N, plane.d)[1], axis=-1)
    return Cell(
        baseline=baseline,
        theta_deg=theta_deg,
        recorded=len(found),
        overlap_px=measured.homography.overlap_px,
        eq2=Estimates(lengths[0], overlaps[0]),
        ours=Estimates(lengths[1], overlaps[1]),
    )
