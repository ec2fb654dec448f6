"""Results of Figs. 4 and 5: the error of the distance between two robots in 20 cells of distance and angle."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coloc_graph.experiments.paper import BIN_CM, FIG4_MEAN_CM, fig4_within_1cm
from coloc_graph.experiments.pool import Progress
from coloc_graph.experiments.single_step import CELLS, Cell, Estimates, measure_cells
from coloc_graph.simulation.world import Depth


@dataclass(frozen=True, eq=False)
class Fig4:
    """The cells and what they were measured with."""

    depth: Depth
    seed: int
    runs: int
    draws: int
    cells: tuple[Cell, ...]
    name: str = "fig4"

    @property
    def header(self) -> list[str]:
        """The table's columns."""
        return ["l", "theta", "overlap", "paper's mean", "eq. (2) mean", "ours mean", "eq. (2) / ours"]

    @property
    def rows(self) -> list[list[str]]:
        """One row a cell; means of |l_est - l|."""
        return [
            [
                f"{100 * cell.baseline:.0f} cm",
                f"{cell.theta_deg:.0f} deg",
                f"{cell.overlap_px / 1000:.1f} kpx",
                paper_says(cell),
                f"{cell.mean_cm(cell.eq2):.2f} cm",
                f"{cell.mean_cm(cell.ours):.2f} cm",
                f"{cell.mean_cm(cell.eq2) / cell.mean_cm(cell.ours):.1f}",
            ]
            for cell in self.cells
        ]

    @property
    def summary(self) -> str:
        """The result in a sentence."""
        ratios = [cell.mean_cm(cell.eq2) / cell.mean_cm(cell.ours) for cell in self.cells]
        return (
            f"Mean |l_est - l| of {self.runs} runs of {self.draws} points a cell, depth {self.depth}, seed {self.seed}"
            f": ours is {min(ratios):.1f} to {max(ratios):.1f} times smaller than eq. (2), {np.median(ratios):.1f} in "
            "the median."
        )

    def numbers(self) -> dict[str, Any]:
        """Everything that the figure shows, for JSON; lengths in cm."""
        return {
            "depth": self.depth,
            "seed": self.seed,
            "runs": self.runs,
            "draws": self.draws,
            "bin_cm": BIN_CM,
            "cells": [
                {
                    "l_cm": 100 * cell.baseline,
                    "theta_deg": cell.theta_deg,
                    "recorded_points": cell.recorded,
                    "overlap_px": cell.overlap_px,
                    "paper_mean_cm": FIG4_MEAN_CM.get((cell.baseline, cell.theta_deg)),
                    "paper_mean_within_1cm": fig4_within_1cm(cell.baseline, cell.theta_deg),
                    "eq2": estimates_json(cell, cell.eq2),
                    "ours": estimates_json(cell, cell.ours),
                }
                for cell in self.cells
            ],
        }


def fig4(
    *,
    depth: Depth = "tracks",
    seed: int = 0,
    runs: int = 500,
    draws: int = 50,
    cells: Sequence[tuple[float, float]] = CELLS,
    processes: int = 1,
    cluster: str | None = None,
    progress: Progress | None = None,
) -> Fig4:
    """Measure Fig. 4; arguments and errors are those of `measure_cells`."""
    measured = measure_cells(
        cells, depth=depth, seed=seed, runs=runs, draws=draws, processes=processes, cluster=cluster, progress=progress
    )
    return Fig4(depth, seed, runs, draws, measured)


@dataclass(frozen=True, eq=False)
class Fig5:
    """The cells and what they were measured with."""

    depth: Depth
    seed: int
    runs: int
    draws: int
    cells: tuple[Cell, ...]
    name: str = "fig5"

    @property
    def header(self) -> list[str]:
        """The table's columns."""
        return ["overlap", "l", "theta", "eq. (2) mean", "ours mean"]

    @property
    def rows(self) -> list[list[str]]:
        """One row a cell, the smallest overlap first; means of |l_est - l|."""
        return [
            [
                f"{cell.overlap_px:.0f} px",
                f"{100 * cell.baseline:.0f} cm",
                f"{cell.theta_deg:.0f} deg",
                f"{cell.mean_cm(cell.eq2):.2f} cm",
                f"{cell.mean_cm(cell.ours):.2f} cm",
            ]
            for cell in sorted(self.cells, key=lambda cell: cell.overlap_px)
        ]

    @property
    def summary(self) -> str:
        """The result in a sentence."""
        return (
            f"Rank correlation of error and overlap over {len(self.cells)} cells, depth {self.depth}, seed "
            f"{self.seed}: {self.rank_correlation('eq2'):.2f} for eq. (2), {self.rank_correlation('ours'):.2f} for "
            "ours; the paper shows that the error falls as the overlap grows."
        )

    def rank_correlation(self, method: str) -> float:
        """Spearman's, of a method's (`eq2` or `ours`) mean error and the overlap, over the cells."""
        if len(self.cells) < 3:
            return float("nan")
        overlaps = [cell.overlap_px for cell in self.cells]
        from scipy.stats import spearmanr  # half a second, which every process of an experiment would take

        return float(spearmanr(overlaps, [cell.mean_cm(estimates_of(cell, method)) for cell in self.cells]).statistic)

    def numbers(self) -> dict[str, Any]:
        """Everything that the figure shows, for JSON; lengths in cm."""
        correlations = {method: self.rank_correlation(method) for method in ("eq2", "ours")}
        return {
            "depth": self.depth,
            "seed": self.seed,
            "runs": self.runs,
            "draws": self.draws,
            "rank_correlation": {key: None if np.isnan(one) else one for key, one in correlations.items()},
            "cells": [
                {
                    "overlap_px": cell.overlap_px,
                    "l_cm": 100 * cell.baseline,
                    "theta_deg": cell.theta_deg,
                    **{
                        method: estimates_json(cell, estimates_of(cell, method))
                        | {"overlap_px": [None if np.isnan(one) else one for one in overlap_px]}
                        for method in ("eq2", "ours")
                        for overlap_px in [estimates_of(cell, method).overlap_px.tolist()]
                    },
                }
                for cell in self.cells
            ],
        }


def fig5(
    *,
    depth: Depth = "tracks",
    seed: int = 0,
    runs: int = 500,
    draws: int = 50,
    cells: Sequence[tuple[float, float]] = CELLS,
    processes: int = 1,
    cluster: str | None = None,
    progress: Progress | None = None,
) -> Fig5:
    """Measure Fig. 5; arguments and errors are those of `measure_cells`."""
    measured = measure_cells(
        cells, depth=depth, seed=seed, runs=runs, draws=draws, processes=processes, cluster=cluster, progress=progress
    )
    return Fig5(depth, seed, runs, draws, measured)


def estimates_of(cell: Cell, method: str) -> Estimates:
    """A cell's estimates by a method, `eq2` or `ours`."""
    return cell.eq2 if method == "eq2" else cell.ours


def paper_says(cell: Cell) -> str:
    """Statement of the paper's text about the mean error of a cell."""
    mean = FIG4_MEAN_CM.get((cell.baseline, cell.theta_deg))
    if mean is not None:
        return f"{mean:.1f} cm"
    return {True: "< 1 cm", False: "> 1 cm", None: "-"}[fig4_within_1cm(cell.baseline, cell.theta_deg)]


def histogram(errors_cm: NDArray[np.float64]) -> NDArray[np.int64]:
    """Counts of errors (n,) [cm] in bins of 0.5 cm from 0 to the largest; NaN are in none."""
    finite = errors_cm[np.isfinite(errors_cm)]
    return np.bincount((finite / BIN_CM).astype(np.int64), minlength=1)


def estimates_json(cell: Cell, estimates: Estimates) -> dict[str, Any]:
    """A method's figures in one cell, for JSON; lengths in cm."""
    errors = cell.errors_cm(estimates)
    finite = errors[np.isfinite(errors)]
    if not len(finite):
        return {"without_pose": len(errors)}
    return {
        "mean_cm": float(finite.mean()),
        "median_cm": float(np.median(finite)),
        "rms_cm": float(np.sqrt((finite**2).mean())),
        "bias_cm": float(100 * (np.nanmean(estimates.lengths) - cell.baseline)),
        "without_pose": len(errors) - len(finite),
        "histogram": histogram(errors).tolist(),
        "l_est_cm": [None if np.isnan(one) else round(100 * one, 4) for one in estimates.lengths.tolist()],
    }
