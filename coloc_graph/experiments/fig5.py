"""Fig. 5: the error of the distance against the number of pixels that both cameras see."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import spearmanr

from coloc_graph.experiments.pool import Progress
from coloc_graph.experiments.single_step import CELLS, Cell, Estimates, measure_cells
from coloc_graph.experiments.single_step_results import estimates_json
from coloc_graph.simulation.world import Depth

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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

    def figure(self) -> "Figure":
        """The scatter plot, with the cells' means."""
        from coloc_graph.experiments.figures_single_step import fig5_figure

        return fig5_figure(self)


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
