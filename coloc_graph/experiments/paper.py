"""Figures of the paper (section V, Tables I and II) as printed there, lengths in centimetres."""

from dataclasses import dataclass

#: Fig. 4: distances between the two observers [m] and angles between them [deg].
BASELINES = (0.6, 0.8, 1.0, 1.2)
ANGLES = (0.0, 10.0, 20.0, 30.0, 40.0)
#: Fig. 4: points recorded in each cell, points drawn in each run, runs a cell, width of a bin [cm].
RECORDED = 250
DRAWN = 50
RUNS = 500
BIN_CM = 0.5

#: Fig. 4: mean error [cm] of the one cell (l [m], theta [deg]) whose mean the text gives.
FIG4_MEAN_CM = {(0.6, 0.0): 0.5}
#: Fig. 4: the cells whose mean error the text calls larger than 1 cm; all others at 60 and 80 cm are within.
FIG4_ABOVE_1CM = frozenset({(0.8, 0.0), (0.8, 10.0)})
#: Fig. 4: the cell of which the text says that more than 200 of its 500 runs are off by 0.5 to 1.0 cm.
FIG4_MORE_THAN_200 = (0.6, 0.0)


def fig4_within_1cm(baseline: float, theta_deg: float) -> bool | None:
    """Return whether the text puts a cell's mean error within 1 cm; None where it says nothing."""
    if baseline not in (0.6, 0.8) or theta_deg not in ANGLES:
        return None
    return (baseline, theta_deg) not in FIG4_ABOVE_1CM


@dataclass(frozen=True)
class Segment:
    """A row of Table I: two standing points, the distance by motion capture and by the paper's estimate [cm]."""

    name: str
    true_cm: float
    estimated_cm: float

    @property
    def error_cm(self) -> float:
        """Estimated less true [cm]."""
        return self.estimated_cm - self.true_cm

    @property
    def ends(self) -> tuple[int, int]:
        """The numbers of the two standing points, a = 0 to g = 6."""
        first, last = self.name.split("-")
        return "abcdefg".index(first), "abcdefg".index(last)


#: Table I, left half (one step each) and right half (from a); a-b is in both.
TABLE1_STEPS = (
    Segment("a-b", 77.14, 77.12),
    Segment("b-c", 85.76, 85.72),
    Segment("c-d", 78.29, 78.42),
    Segment("d-e", 88.16, 87.82),
    Segment("e-f", 80.47, 80.05),
    Segment("f-g", 89.82, 89.53),
)
TABLE1_FROM_A = (
    Segment("a-b", 77.14, 77.12),
    Segment("a-c", 36.22, 36.23),
    Segment("a-d", 85.73, 85.21),
    Segment("a-e", 74.01, 73.98),
    Segment("a-f", 107.82, 107.4),
    Segment("a-g", 109.73, 109.36),
)
#: All segments of Table I, each once.
TABLE1 = TABLE1_STEPS + TABLE1_FROM_A[1:]


@dataclass(frozen=True)
class HallwayRow:
    """A row of Table II: the straight way a robot made in one case, its error [cm] and error rate [%]."""

    case: int
    robot: str
    true_cm: float
    estimated_cm: float
    error_cm: float
    rate_percent: float


TABLE2 = (
    HallwayRow(1, "B", 769.0, 771.6, 2.6, 0.34),
    HallwayRow(1, "A", 730.0, 728.1, 1.9, 0.26),
    HallwayRow(2, "B", 725.0, 723.2, 1.8, 0.25),
    HallwayRow(2, "A", 732.0, 733.5, 1.5, 0.20),
)
