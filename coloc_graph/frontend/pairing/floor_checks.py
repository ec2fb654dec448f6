"""What two robots that stand on one floor can see of one robot's markers, and what they cannot.

A light and its mirror image in the floor move alike: a homography relates a marker in one image to a mirror image in
the other, exactly, and mirror images to mirror images. By the first, one of the robots would stand below the floor; by
the second the markers would be another distance apart than they are.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend.homography.decomposition import decompose_with_normal, metric_scale
from coloc_graph.frontend.homography.plane import on_plane
from coloc_graph.frontend.homography.plane_tilts import plausible_planes
from coloc_graph.frontend.pairing.correspondence import pair_by_time
from coloc_graph.frontend.tracks.marker_pairs import LEAST_SHARED
from coloc_graph.frontend.tracks.tracking import Track
from coloc_graph.geometry.lie import se3, se3_inverse
from coloc_graph.measurements import Plane, RelativePose
from coloc_graph.team import Floor, Robot

Array = NDArray[np.float64]

#: Two robots that stand on one floor are no further above each other than this [m], nor more tilted [rad], with mounts
#: that are some degrees and centimetres off.
HIGHER = 0.10
TILTED = np.deg2rad(12.0)
#: What a measured pose is allowed besides its own covariance and the floor's: roll, pitch [rad], height [m], since
#: mounts are not always as stated; and how improbable it may be then (chi2, 3 degrees of freedom).
SLACK = (np.deg2rad(2.0), np.deg2rad(2.0), 0.03)
IMPROBABLE = 40.0
#: Where two markers are seen they are their span apart to this share, at this share of the instants at least.
SPAN_TOLERANCE = 0.45
OFTEN = 0.5
OFTEN_TILTED = 0.75  # share of the instants in which they are their span apart by a tilt other than stated


def on_one_floor(H_j_i: Array, robot_i: Robot, robot_j: Robot, plane: Plane) -> bool:
    """Whether a homography has both robots stand on one floor, roughly."""
    try:
        R_cj_ci, t_cj_ci = decompose_with_normal(metric_scale(H_j_i), plane.N, plane.d)
    except (DegenerateGeometry, np.linalg.LinAlgError):
        return False
    T_ci_cj = se3_inverse(se3(R_cj_ci, t_cj_ci))
    T_i_j = robot_i.mount.T_body_camera @ T_ci_cj @ np.linalg.inv(robot_j.mount.T_body_camera)
    tilted = np.arccos(np.clip(T_i_j[2, 2], -1.0, 1.0))
    return bool(np.isfinite(T_i_j).all() and abs(T_i_j[2, 3]) < HIGHER and tilted < TILTED)


def require_on_floor(pose: RelativePose, floor: Floor) -> None:
    """Raise `DegenerateGeometry` where two robots that stand on one floor would not, by what was measured."""
    T_i_j, tangent = pose.T_i_j, [0, 1, 5]
    tilt = T_i_j[:3, :3].T @ np.array([0.0, 0.0, 1.0])  # the vertical of i in j
    off = np.array([-tilt[1], tilt[0], T_i_j[2, 3]])
    level = np.deg2rad(floor.tilt_sigma_deg)
    allowed = np.square(SLACK) + 2 * np.square([level, level, floor.height_sigma])
    C = pose.covariance[np.ix_(tangent, tangent)] + np.diag(allowed)
    if off @ np.linalg.solve(C, off) > IMPROBABLE:
        degrees = np.rad2deg(np.arccos(min(tilt[2], 1.0)))
        raise DegenerateGeometry(
            f"the homography would have {pose.robot_j} {abs(off[2]):.2f} m {'above' if off[2] > 0 else 'below'} "
            f"{pose.robot_i}, and tilted by {degrees:.1f} deg against it, and both stand on one "
            "floor: it is of reflections or other lights, or heights and mounts are not as stated"
        )


def of_some_span(tracks: Sequence[Track], robot: Robot, plane: Plane, spans: Sequence[float]) -> bool:
    """Whether two of some tracks of a camera are as far apart as a robot's markers; True where no two go on
    together."""
    if not spans:
        return True
    seen = [robot.camera.normalise(track.uv) for track in tracks]
    pairs = [
        (a, b, shared)
        for a in range(len(tracks))
        for b in range(a + 1, len(tracks))
        if len(shared := pair_by_time(tracks[a].times, tracks[b].times)) >= LEAST_SHARED
    ]
    for number, one in enumerate(plausible_planes(plane, robot.mount)):
        often = OFTEN if number == 0 else OFTEN_TILTED
        places = [on_plane(x, one) for x in seen]
        for a, b, shared in pairs:
            apart = np.linalg.norm(places[a][shared[:, 0]] - places[b][shared[:, 1]], axis=1)
            if any((np.abs(apart / span - 1) < SPAN_TOLERANCE).mean() > often for span in spans):
                return True
    return not pairs
