"""Kinds of measurements that a graph contradicts, in words, with causes to look for."""

from collections import defaultdict

import numpy as np

from coloc_graph.backend import Estimate
from coloc_graph.measurements import Odometry, Range, RelativePose, Sighting

MIN_MEAN_SQUARE = 3.0  # mean square of residuals in sigmas from which a kind of measurements is named
SHARE_OF_LARGEST = 0.5  # and share of the largest mean square
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
