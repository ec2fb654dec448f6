"""Kinds of measurements that a graph contradicts, in words, with causes to look for."""

from collections import defaultdict

import numpy as np

from coloc_graph.backend import Estimate, PoseGraph
from coloc_graph.geometry.lie import se3_inverse, se3_log
from coloc_graph.measurements import Odometry, Range, RelativePose, Sighting
from coloc_graph.run import Run

MIN_MEAN_SQUARE = 3.0  # mean square of residuals in sigmas from which a kind of measurements is named
SHARE_OF_LARGEST = 0.5  # and share of the largest mean square
MOVED_SIGMAS = 8.0  # anchors whose relative pose changed by more sigmas moved against each other
MAX_NAMED = 3  # kinds of measurements that are named

CAUSES = {
    "odometry": "check its wheels, its clock, its covariances, and of which point of the body it is",
    "sightings": "check the positions and heights of its markers",
    "ranges": "check the antennas' positions, what stood in their way, and the sensor's noise",
    "homographies": "an anchor moved, or mounts, heights, the floor or the noise are not as stated",
}


def worst_kinds(estimate: Estimate) -> str:
    """Return where most of the disagreement is and what to check.

    Parameters
    ----------
    estimate : Estimate
        Of a run with stances.

    Returns
    -------
    str
        Measurements by kind and robot with their mean squared residuals in units of their noise.
    """
    squares: dict[tuple[str, str], list[float]] = defaultdict(list)
    rejected = {id(one.measurement) for one in estimate.rejected}
    for one in estimate.graph.measurements:
        square = estimate.residual(one) ** 2
        if id(one) in rejected or not np.isfinite(square):
            continue
        if isinstance(one, Odometry):
            squares["odometry", one.robot].append(square)
        elif isinstance(one, Sighting):
            squares["sightings", one.seen].append(square)
        elif isinstance(one, Range):
            squares["ranges", f"{one.target} by {one.robot}"].append(square)
        elif isinstance(one, RelativePose):
            squares["homographies", " and ".join(sorted((one.robot_i, one.robot_j)))].append(square)
    means = {key: float(np.mean(every)) for key, every in squares.items()}
    largest = max(means.values(), default=0.0)
    named = sorted(
        (key for key, mean in means.items() if mean > max(MIN_MEAN_SQUARE, SHARE_OF_LARGEST * largest)),
        key=lambda key: -means[key],
    )[:MAX_NAMED]
    if not named:
        return CAUSES["homographies"]
    where = ", ".join(f"the {kind} of {robot} ({means[kind, robot]:.0f})" for kind, robot in named)
    causes = "; ".join(CAUSES[kind] for kind in dict.fromkeys(kind for kind, _ in named))
    return f"largest in {where}: {causes}"


def moves_unstated(run: Run) -> bool:
    """Return whether nothing in a run of several stances states which robots moved between them."""
    kinds = {topic.rpartition("/")[2] for topic, count in run.topics.items() if count}
    return len(run.stances) > 1 and bool(kinds) and not kinds & {"motion", "odometry"}


def unstated_moves(graph: PoseGraph) -> str | None:
    """Return the sentence on a run in which nobody said who moved, and anchors did not stay put; None if they did.

    Two anchors moved against each other where their relative poses at two stances differ by far.
    """
    last: dict[tuple[str, str], RelativePose] = {}
    found: list[tuple[RelativePose, RelativePose, float]] = []
    for one in sorted(graph.relative_poses, key=lambda one: one.stance):
        pair = min(one.robot_i, one.robot_j), max(one.robot_i, one.robot_j)
        before = last.get(pair)
        if before is not None and set(pair) <= set(graph.by_index[one.stance].anchors):
            was = before.T_i_j if before.robot_i == one.robot_i else se3_inverse(before.T_i_j)
            off = se3_log(se3_inverse(was) @ one.T_i_j)
            sigmas = np.sqrt(np.diag(one.covariance + before.covariance))
            if np.abs(off / sigmas).max() > MOVED_SIGMAS:
                found.append((before, one, float(np.linalg.norm(off[3:]))))
        last[pair] = one
    if not found:
        return None
    before, one, far = found[0]
    more = f" (and {len(found) - 1} times more later)" if len(found) > 1 else ""
    return (
        "nothing in the run states who moved between stances, so that all observers are taken to have stayed put; yet "
        f"{one.robot_i} or {one.robot_j} moved by about {100 * far:.0f} cm between stances {before.stance} and "
        f"{one.stance}{more}, and the result is wrong: list who moved in a CSV and give it to `coloc import "
        "tracks` with --moves, or record wheel odometry"
    )
