"""Table I: six steps, and the distances between the standing points a to g."""

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from coloc_graph.experiments.multi_step import Outing, measure_outing
from coloc_graph.experiments.paper import TABLE1, TABLE1_FROM_A, TABLE1_STEPS, Segment
from coloc_graph.experiments.pool import Progress, check, spread
from coloc_graph.simulation.world import Depth

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Table1:
    """Six-step runs of several seeds; the first is the one that is shown."""

    depth: Depth
    outings: tuple[Outing, ...]
    name: str = "table1"

    def lengths_cm(self, segment: Segment, method: str) -> NDArray[np.float64]:
        """A segment's length in each run (n,) [cm]: `true`, or by `eq2` or `ours`."""
        first, last = segment.ends
        places = np.array([outing.standing(method) for outing in self.outings])
        return np.asarray(100 * np.linalg.norm(places[:, last] - places[:, first], axis=-1))

    def errors_cm(self, segment: Segment, method: str) -> NDArray[np.float64]:
        """Size of a segment's error in each run (n,) [cm], by `eq2` or `ours`."""
        return np.abs(self.lengths_cm(segment, method) - self.lengths_cm(segment, "true"))

    @property
    def header(self) -> list[str]:
        """The table's columns: the paper's, then those of the run that is shown, then means over all runs."""
        shown = f"seed {self.outings[0].seed}"
        means = [f"{label} mean error" for label in ("eq. (2)", "ours")]
        paper = ["paper: true", "est", "error"]
        return ["seg", *paper, f"{shown}: true", "eq. (2)", "error", "ours", "error", *means]

    @property
    def rows(self) -> list[list[str]]:
        """One row a segment, in cm: the paper's left half, then its right half."""
        rows = []
        for segment in TABLE1_STEPS + TABLE1_FROM_A:
            paper = [f"{segment.true_cm:.2f}", f"{segment.estimated_cm:.2f}", f"{abs(segment.error_cm):.2f}"]
            shown = [f"{self.lengths_cm(segment, 'true')[0]:.2f}"]
            for method in ("eq2", "ours"):
                shown += [f"{self.lengths_cm(segment, method)[0]:.2f}", f"{self.errors_cm(segment, method)[0]:.2f}"]
            means = [f"{self.errors_cm(segment, method).mean():.2f}" for method in ("eq2", "ours")]
            rows.append([segment.name, *paper, *shown, *means])
        return rows

    def mean_error_cm(self, method: str) -> float:
        """Mean size of the error over the 11 segments and all runs [cm], by `paper`, `eq2` or `ours`."""
        if method == "paper":
            return float(np.mean([abs(segment.error_cm) for segment in TABLE1]))
        return float(np.mean([self.errors_cm(segment, method) for segment in TABLE1]))

    @property
    def summary(self) -> str:
        """The result in a sentence."""
        n = len(self.outings)
        return (
            f"All lengths in cm. Mean error of the 11 segments: paper {self.mean_error_cm('paper'):.2f}, eq. (2) "
            f"{self.mean_error_cm('eq2'):.2f}, ours {self.mean_error_cm('ours'):.2f}, over {n} run{'s' * (n > 1)} from "
            f"seed {self.outings[0].seed} on, depth {self.depth}."
        )

    def numbers(self) -> dict[str, Any]:
        """Everything that figure and table show, for JSON; lengths in cm."""
        return {
            "depth": self.depth,
            "seeds": [outing.seed for outing in self.outings],
            "mean_error_cm": {method: self.mean_error_cm(method) for method in ("paper", "eq2", "ours")},
            "segments": [
                {
                    "segment": segment.name,
                    "paper": {"true_cm": segment.true_cm, "est_cm": segment.estimated_cm},
                    "true_cm": self.lengths_cm(segment, "true").tolist(),
                    **{
                        method: {
                            "est_cm": self.lengths_cm(segment, method).tolist(),
                            "mean_error_cm": float(self.errors_cm(segment, method).mean()),
                        }
                        for method in ("eq2", "ours")
                    },
                }
                for segment in TABLE1
            ],
        }

    def figure(self) -> "Figure":
        """Where the robots stood, and the error of each segment."""
        from coloc_graph.experiments.figures_multi_step import table1_figure

        return table1_figure(self)


def table1(
    *,
    depth: Depth = "tracks",
    seed: int = 0,
    runs: int = 10,
    processes: int = 1,
    cluster: str | None = None,
    progress: Progress | None = None,
) -> Table1:
    """Simulate six steps in `runs` runs of seeds from `seed` on. Raises `InputError` where an argument is wrong."""
    check(depth, seed, runs, processes)
    work = partial(measure_outing, scenario="six-step", depth=depth, stances=None)
    return Table1(depth, tuple(spread(work, range(seed, seed + runs), processes, cluster, progress)))
