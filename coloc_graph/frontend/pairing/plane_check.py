"""Check a camera's stated marker plane against what it saw of the movers."""

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend.homography.plane import on_plane
from coloc_graph.frontend.homography.plane_tilts import plausible_planes
from coloc_graph.frontend.pairing.correspondence import Correspondences
from coloc_graph.frontend.stance_tracks import stance_plane
from coloc_graph.measurements import Plane
from coloc_graph.run import Recorded, Stance
from coloc_graph.team import Camera

MAX_RANGE = 20.0  # m, at which an LED can be detected
SPAN_TOLERANCE = 0.30  # relative error of the markers' span; a tilt that is off by 1 deg makes 0.15 at 2 m


def implausible(run: Recorded, stance: Stance, robot: str, found: Correspondences) -> str | None:
    """Explain in words how an observer's marker plane contradicts what it saw, or return None.

    On the plane the markers must be in front of the camera and near, and the two of a mover their known span apart.

    Parameters
    ----------
    run, stance
        Run and stance.
    robot
        Name of the observer.
    found
        Correspondences with the observer as robot i.
    """
    camera = run.team[robot].camera
    try:
        plane = stance_plane(run, stance, robot)
    except DegenerateGeometry:
        return None  # reported elsewhere
    stated = stance.index in run.planes and robot in run.planes[stance.index].planes
    remedy = "correct the stated plane (metres?)" if stated else "correct heights, tilt or units (metres?) in the team"
    distance = np.linalg.norm(on_plane(camera.rays(found.uv_i), plane), axis=1)
    if not np.isfinite(distance).mean() > 0.5:
        return f"{robot} saw the markers above the horizon of the marker plane: {remedy}"
    if np.nanmedian(distance) > MAX_RANGE:
        return f"on the marker plane the markers would be {np.nanmedian(distance):.0f} m away from {robot}: {remedy}"
    span = _known_span(run, stance)
    # another tilt of the camera within its tolerance may explain the span
    for one in () if stated else plausible_planes(plane, run.team[robot].mount):
        other = _seen_span(found, camera, one)
        if span is not None and other is not None and abs(other[0] - span) <= SPAN_TOLERANCE * span + other[1]:
            return None
    seen = _seen_span(found, camera, plane)
    if span is not None and seen is not None and abs(seen[0] - span) > SPAN_TOLERANCE * span + seen[1]:
        return (
            f"on the marker plane of {robot} the two markers would be {seen[0]:.2f} m apart, and the team says "
            f"{span:.2f} m: {remedy}, or the markers' positions"
        )
    return None


def _known_span(run: Recorded, stance: Stance) -> float | None:
    """Distance between the two markers that move [m]; None unless exactly two do."""
    carried = [markers for name in stance.movers if (markers := run.team[name].markers) is not None]
    return carried[0].span if len(carried) == 1 and len(carried[0].positions) == 2 else None


def _seen_span(found: Correspondences, camera: Camera, plane: Plane) -> tuple[float, float] | None:
    """Distance on the plane between two points seen at once [m], median and scatter; None if hardly any are."""
    order: NDArray[np.int64] = np.argsort(found.times, kind="stable")
    _, first, count = np.unique(found.times[order], return_index=True, return_counts=True)
    a = order[first[count == 2]]
    b = order[first[count == 2] + 1]
    rays = camera.rays(found.uv_i)
    apart = np.linalg.norm(on_plane(rays[a], plane) - on_plane(rays[b], plane), axis=1)
    apart = apart[np.isfinite(apart)]
    if len(apart) < 3:
        return None
    middle = np.median(apart)
    return float(middle), float(1.4826 * np.median(np.abs(apart - middle)))
