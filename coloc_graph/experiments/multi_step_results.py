"""Results of Tables I and II: six steps, and two robots that leap-frog down a hallway."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.experiments.multi_step import Course, Outing, measure_outing
from coloc_graph.experiments.paper import TABLE1, TABLE1_FROM_A, TABLE1_STEPS, TABLE2, HallwayRow, Segment
from coloc_graph.experiments.pool import Progress, check, spread
from coloc_graph.simulation.world import Depth

CASES = 2  # runs shown as the two cases of Table II


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


@dataclass(frozen=True, eq=False)
class Table2:
    """Hallway runs of several seeds; the first two are the cases, all count in the means."""

    depth: Depth
    stances: int
    outings: tuple[Outing, ...]
    name: str = "table2"

    @property
    def cases(self) -> list[tuple[HallwayRow, Course]]:
        """Rows of the paper with the simulated course of the same case; fewer if there is one run only."""
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
        """Return RMS errors over all runs and robots, by `eq2` or `ours`.

        `rate_percent` and `error_cm` of the length, and `end_error_cm`, the distance of the last pose from truth.
        """
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
