"""Table of the clocks of a run: what an import found, and what motion that two sensors saw tells."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend import StanceTracks
from coloc_graph.frontend.clock_evidence import ClockEvidence, clock_evidence
from coloc_graph.pipeline.clock_model import estimated_clocks
from coloc_graph.run import Run, Stance

STANCES_COMPARED = 4  # stances whose motion is compared, evenly spread


@dataclass(frozen=True)
class ClockRow:
    """One line of the table: numbers are in words, "" where nothing is known."""

    robot: str
    offset: str
    drift: str
    steps: str
    jitter: str
    known: str


HEADER = ("clock", "offset", "drift", "steps", "jitter", "known by")


def clock_table(run: Run) -> list[ClockRow]:
    """Return the clocks of a run, in the order of the team.

    Parameters
    ----------
    run : Run
        Detections are compared between observers, and with the movers' wheels; images are not looked into.

    Returns
    -------
    list of ClockRow
        What stamps against reception said when a bag was imported (already corrected), then what motion says of the
        stamps as they are; a robot of which nothing is known has a row that says so.
    """
    rows = [
        ClockRow(
            one.robot,
            _seconds(one.offset),
            f"{1e6 * one.drift:+.0f} ppm" if one.drift else "none",
            "; ".join(f"{change:+.3f} s at {time:.0f} s" for time, change in one.steps) or "none",
            f"{1e3 * one.jitter:.1f} ms",
            f"{one.known}{' (corrected)' if one.offset or one.drift or one.steps else ''}",
        )
        for one in run.clocks()
    ]
    rows += _by_motion(run)
    known = {row.robot for row in rows}
    sigma = run.team.clock_sigma
    stated = f"stated: {1e3 * sigma:g} ms (clock_sigma)" if sigma else "taken for right (clock_sigma = 0)"
    for name in run.team.names:
        if name not in known and any(run.topics.get(f"/{name}/{kind}") for kind in ("image", "detections", "odometry")):
            rows.append(ClockRow(name, "", "", "", "", stated))
    return sorted(rows, key=lambda row: run.team.names.index(row.robot))


def _by_motion(run: Run) -> list[ClockRow]:
    evidence = [one for stance in _compared(run) for one in _evidence(run, stance)]
    if not evidence:
        return []
    found = estimated_clocks(run.team, run.stances, evidence)
    rows = []
    for (robot, kind), clock in found.items():
        first = clock.segments[0]
        jumps = [b.error(b.start) - a.error(b.start) for a, b in itertools.pairwise(clock.segments)]
        rows.append(
            ClockRow(
                robot,
                f"{first.measured:+.4f} s +- {1e3 * first.sigma:.1f} ms",
                f"{1e6 * first.drift:+.0f} ppm" if first.drift else "none",
                "; ".join(f"{jump:+.3f} s" for jump in jumps if jump) or "none",
                "",
                f"motion, {kind}, {clock.stances} stance{'s' * (clock.stances != 1)}",
            )
        )
    return rows


def _compared(run: Run) -> Sequence[Stance]:
    stances = [one for one in run.stances if sum(map(run.has_detections, one.observers)) >= 2]
    picked = np.unique(np.linspace(0, len(stances) - 1, min(STANCES_COMPARED, len(stances))).round().astype(int))
    return [stances[k] for k in picked.tolist()]


def _evidence(run: Run, stance: Stance) -> list[ClockEvidence]:
    seen = {}
    try:
        tracks = StanceTracks(run, stance)
        for i, j in itertools.pairwise([name for name in stance.observers if run.has_detections(name)]):
            seen[i, j] = tracks.of(i), tracks.of(j)
    except DegenerateGeometry:
        return []
    return list(clock_evidence(run, stance, seen))


def _seconds(value: float) -> str:
    return f"{value:+.4f} s" if value else "none"
