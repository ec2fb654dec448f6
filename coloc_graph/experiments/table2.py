"""Table II and Fig. 6: two robots leap-frog down a hallway, and how long they think their way was."""

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from coloc_graph.errors import InputError
from coloc_graph.experiments.multi_step import Course, Outing, measure_outing
from coloc_graph.experiments.paper import TABLE2, HallwayRow
from coloc_graph.experiments.pool import Progress, check, spread
from coloc_graph.simulation.world import Depth

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: How many of the runs are shown as the paper's cases.
CASES = 2


@dataclass(frozen=True, eq=False)
class Table2:
    """Hallway runs of several seeds; the first two are the cases, all count in the means."""

    depth: Depth
    stances: int
    outings: tuple[Outing, ...]
    name: str = "table2"

    @property
    def cases(self) -> list[tuple[HallwayRow, Course]]:
        """The paper's rows, each with the course of our run of that case; fewer where there is but one run."""
        return [(row, self.outings[row.case - 1].courses[row.robot]) for row in TABLE2 if row.case <= len(self.outings)]

    @property
    def header(self) -> list[str]:
        """The table's columns."""
        each = ["est", "error", "rate"]
        return ["case", "robot", "paper: true", *each, "simulated: true", "eq. (2)", *each[1:], "ours", *each[1:]]

    @property
    def rows(self) -> list[list[str]]:
        """One row a case and robot, lengths in cm, rates in % of the true length."""
        rows = []
        for row, course in self.cases:
            paper = [
                f"{row.true_cm:.0f}",
                f"{row.estimated_cm:.1f}",
                f"{row.error_cm:.1f}",
                f"{row.rate_percent:.2f} %",
            ]
            ours = [f"{100 * course.length(course.true):.1f}"]
            for places in (course.eq2, course.ours):
                ours += [f"{100 * course.length(places):.1f}", f"{course.error_cm(places):.2f}"]
                ours += [f"{course.rate_percent(places):.2f} %"]
            rows.append([f"{row.case} (seed {self.outings[row.case - 1].seed})", row.robot, *paper, *ours])
        return rows

    def rms(self, method: str) -> dict[str, float]:
        """RMS over all runs and robots, by `eq2` or `ours`: `rate_percent` and `error_cm` of the length, and
        `end_error_cm`, the distance of the last place from the true one."""
        every = [(course, getattr(course, method)) for one in self.outings for course in one.courses.values()]
        figures = {
            "rate_percent": [course.rate_percent(places) for course, places in every],
            "error_cm": [course.error_cm(places) for course, places in every],
            "end_error_cm": [course.end_error_cm(places) for course, places in every],
        }
        return {name: float(np.sqrt(np.square(values).mean())) for name, values in figures.items()}

    @property
    def summary(self) -> str:
        """The result in a sentence."""
        eq2, ours, n = self.rms("eq2"), self.rms("ours"), len(self.outings)
        return (
            f"RMS over {n} run{'s' * (n > 1)} from seed {self.outings[0].seed} on, depth {self.depth}, {self.stances} "
            f"stances: length error eq. (2) {eq2['rate_percent']:.2f} %, ours {ours['rate_percent']:.2f} % (paper: "
            f"0.20 to 0.34 %); end position eq. (2) {eq2['end_error_cm']:.1f} cm, ours {ours['end_error_cm']:.1f} cm."
        )

    def numbers(self) -> dict[str, Any]:
        """Everything that figure and table show, for JSON; lengths in cm, places in m."""
        return {
            "depth": self.depth,
            "stances": self.stances,
            "seeds": [outing.seed for outing in self.outings],
            "paper": [
                {"case": row.case, "robot": row.robot, "true_cm": row.true_cm, "est_cm": row.estimated_cm,
                 "error_cm": row.error_cm, "rate_percent": row.rate_percent} for row in TABLE2
            ],
            "rms": {method: self.rms(method) for method in ("eq2", "ours")},
            "runs": [
                {"seed": outing.seed, "robot": course.robot, "true_cm": 100 * course.length(course.true)}
                | {method: _course_json(course, method) for method in ("eq2", "ours")}
                | {"places_m": {name: getattr(course, name).round(5).tolist() for name in ("true", "eq2", "ours")}}
                for outing in self.outings
                for course in outing.courses.values()
            ],
        }  # fmt: skip

    def figure(self) -> "Figure":
        """The trajectories, as in Fig. 6, and the error rates."""
        from coloc_graph.experiments.figures_multi_step import table2_figure

        return table2_figure(self)


def _course_json(course: Course, method: str) -> dict[str, float | None]:
    places = getattr(course, method)
    rate = course.rate_percent(places)
    return {
        "est_cm": 100 * course.length(places),
        "error_cm": course.error_cm(places),
        "rate_percent": None if np.isnan(rate) else rate,
        "end_error_cm": course.end_error_cm(places),
    }


def table2(
    *,
    depth: Depth = "tracks",
    seed: int = 0,
    runs: int = CASES,
    stances: int = 40,
    processes: int = 1,
    cluster: str | None = None,
    progress: Progress | None = None,
) -> Table2:
    """Simulate the hallway in `runs` runs of seeds from `seed` on; the first two are the paper's cases.

    Raises `InputError` where an argument is wrong.
    """
    check(depth, seed, runs, processes)
    if stances < 2:
        raise InputError(f"`stances` is {stances}; give at least 2, so that both robots get somewhere")
    work = partial(measure_outing, scenario="hallway", depth=depth, stances=stances)
    return Table2(depth, stances, tuple(spread(work, range(seed, seed + runs), processes, cluster, progress)))
