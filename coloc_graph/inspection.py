"""What is in a run, and what is wrong with it: every reason for which a solve would use less than all of it."""

import itertools
from dataclasses import dataclass

import numpy as np

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend.correspondence import PAIRING_WINDOW, pair_by_time
from coloc_graph.frontend.stance import stance_plane
from coloc_graph.run import Run, Stance


@dataclass(frozen=True)
class Finding:
    """Something wrong with a run: `where` (a stance, a robot), and `what` with its remedy in words."""

    where: str
    what: str


def inspect(run: Run) -> list[Finding]:
    """Everything that is wrong with a run, without looking into its images."""
    findings = [Finding("file", warning) for warning in run.warnings]
    if not run.stances:
        findings.append(Finding("run", "it holds no stance, so that there is nothing to solve: record one"))
    elif run.team.reference not in run.stances[0].observers:
        findings.append(
            Finding("stance 0", f"the reference {run.team.reference} does not observe: name an observer as reference")
        )
    for before, stance in zip((None, *run.stances), run.stances, strict=False):
        findings += _stance_findings(run, before, stance)
    return findings


def _stance_findings(run: Run, before: Stance | None, stance: Stance) -> list[Finding]:
    where = f"stance {stance.index}"
    findings = []
    if len(stance.observers) < 2:
        findings.append(Finding(where, "one observer only: at least two robots must stand and watch"))
    if before is not None:
        if not stance.anchors:
            findings.append(Finding(where, "no anchor: nothing ties it to the stance before; let one robot stay put"))
        findings += [
            Finding(where, f"{robot} is called an anchor, yet it moved since stance {before.index}")
            for robot in stance.anchors
            if any(motion.moving for motion in run.motions(robot, before.end, stance.start))
        ]
    times = {}
    for robot in stance.observers:
        if run.has_detections(robot):
            times[robot] = np.array([d.time for d in run.detections(robot, stance.start, stance.end)])
        else:
            times[robot] = np.array([image.time for image in run.images(robot, stance.start, stance.end)])
        if not len(times[robot]):
            findings.append(Finding(where, f"{robot} recorded neither detections nor images: check its camera"))
        try:
            stance_plane(run, stance, robot)
        except DegenerateGeometry as why:
            findings.append(Finding(where, f"{robot}: {why}"))
    for i, j in itertools.combinations(stance.observers, 2):
        if len(times[i]) and len(times[j]) and not len(pair_by_time(times[i], times[j])):
            nearest = np.abs(times[i][:, None] - times[j][None]).min()
            findings.append(
                Finding(
                    where,
                    f"{i} and {j} share no instant within {1e3 * PAIRING_WINDOW:.0f} ms (the nearest are "
                    f"{1e3 * nearest:.1f} ms apart): synchronise their clocks",
                )
            )
    return findings
