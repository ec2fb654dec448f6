"""Reject associations and poses that contradict two robots on one floor, such as those of reflections.

A light and its mirror image in the floor move alike: a homography relates a marker in one image to a mirror image in
the other, exactly, and mirror images to mirror images. The first would place one of the robots below the floor; the
second would place the markers at another distance from each other.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend.homography.decomposition import decompose_with_normal, metric_scale
from coloc_graph.frontend.homography.plane import on_plane
from coloc_graph.frontend.homography.plane_tilts import plausible_planes
from coloc_graph.frontend.pairing.correspondence import pair_by_time
from coloc_graph.frontend.tracks.marker_pairs import MIN_SHARED_SAMPLES
from coloc_graph.frontend.tracks.track import Track
from coloc_graph.geometry.lie import se3, se3_inverse
from coloc_graph.measurements import Plane, RelativePose
from coloc_graph.team import Floor, Mount, Robot

Array = NDArray[np.float64]

# bounds between two robots on one floor, with mounts that are off by some degrees and centimetres more than stated
MAX_HEIGHT = 0.10  # m, of one above the other
MAX_TILT = np.deg2rad(12.0)  # rad, of one against the other
# beyond these bounds only errors of both mounts within their tolerances explain a tilt and a height, both at once
MOUNT_GATE = 16.0  # squared Mahalanobis distance, 3 degrees of freedom
UNEVEN = (0.01, 0.01, 0.01)  # roll, pitch [rad], height [m]: floors and noise
SLACK = (np.deg2rad(2.0), np.deg2rad(2.0), 0.03)  # roll, pitch [rad], height [m]: errors of mounts beyond tolerances
FLOOR_GATE = 40.0  # squared Mahalanobis distance of a pose from the floor, 3 degrees of freedom
SPAN_TOLERANCE = 0.45  # relative error of the markers' distance on their plane
MIN_SHARE = 0.5  # of the instants at which that distance must be the span
MIN_SHARE_TILTED = 0.75  # of the instants, on a plane other than stated


def on_one_floor(H_j_i: Array, robot_i: Robot, robot_j: Robot, plane: Plane) -> bool:
    """Return whether a homography has both robots approximately on one floor, within the tolerances of their mounts.

    Parameters
    ----------
    H_j_i
        Homography of the marker plane between the normalised coordinates of both cameras, (3, 3).
    robot_i, robot_j
        Robots with their mounts.
    plane
        Marker plane in camera i, by the mount of robot i.
    """
    sigmas = np.concatenate([_mount_sigmas(robot_i.mount), _mount_sigmas(robot_j.mount)])
    errors = np.concatenate([np.zeros((1, 6)), np.diag(sigmas)[sigmas > 0]])
    try:
        off = _off_floor(H_j_i, robot_i.mount, robot_j.mount, plane, errors)
    except (DegenerateGeometry, np.linalg.LinAlgError):
        return False
    if not np.isfinite(off).all():
        return False
    if abs(off[0, 2]) < MAX_HEIGHT and np.hypot(*off[0, :2]) < np.sin(MAX_TILT):
        return True
    J = off[1:] - off[0]  # by one standard deviation of each tolerance
    C = J.T @ J + np.diag(np.square(UNEVEN))
    return bool(off[0] @ np.linalg.solve(C, off[0]) < MOUNT_GATE)


def _mount_sigmas(mount: Mount) -> Array:
    """Tolerances of height [m], tilt and roll [rad], (3,)."""
    return np.array([mount.height_sigma, *np.deg2rad([mount.tilt_sigma_deg, mount.roll_sigma_deg])])


def _off_floor(H_j_i: Array, mount_i: Mount, mount_j: Mount, plane: Plane, errors: Array) -> Array:
    """Tilt (x, y) of robot j against robot i [rad] and its height above it [m], (m, 3), for errors of mounts (m, 6)."""
    T_i_ci, T_j_cj = mount_i.off_by(errors[:, :3]), mount_j.off_by(errors[:, 3:])
    R_cj_ci, t_cj_ci = decompose_with_normal(
        np.broadcast_to(metric_scale(H_j_i), (len(errors), 3, 3)), -T_i_ci[:, 2, :3], plane.d + errors[:, 0]
    )
    T_i_j = T_i_ci @ se3_inverse(se3(R_cj_ci, t_cj_ci)) @ se3_inverse(T_j_cj)
    return np.asarray(T_i_j[:, [0, 1, 2], [2, 2, 3]])


def require_on_floor(pose: RelativePose, floor: Floor) -> None:
    """Raise `DegenerateGeometry` if a measured pose contradicts that both robots stand on one floor."""
    T_i_j, tangent = pose.T_i_j, [0, 1, 5]
    tilt = T_i_j[:3, :3].T @ np.array([0.0, 0.0, 1.0])  # the vertical of i in j
    off = np.array([-tilt[1], tilt[0], T_i_j[2, 3]])
    level = np.deg2rad(floor.tilt_sigma_deg)
    allowed = np.square(SLACK) + 2 * np.square([level, level, floor.height_sigma])
    C = pose.covariance[np.ix_(tangent, tangent)] + np.diag(allowed)
    if off @ np.linalg.solve(C, off) > FLOOR_GATE:
        degrees = np.rad2deg(np.arccos(min(tilt[2], 1.0)))
        raise DegenerateGeometry(
            f"the homography places {pose.robot_j} {abs(off[2]):.2f} m {'above' if off[2] > 0 else 'below'} "
            f"{pose.robot_i} and tilted by {degrees:.1f} deg against it, although both stand on one floor: it shows "
            "reflections or other lights, or heights and mounts are not as stated"
        )


def of_some_span(tracks: Sequence[Track], robot: Robot, plane: Plane, spans: Sequence[float]) -> bool:
    """Return whether two tracks of a camera are a marker span apart, or no two tracks overlap in time."""
    if not spans:
        return True
    seen = [robot.camera.rays(track.uv) for track in tracks]
    pairs = [
        (a, b, shared)
        for a in range(len(tracks))
        for b in range(a + 1, len(tracks))
        if len(shared := pair_by_time(tracks[a].times, tracks[b].times)) >= MIN_SHARED_SAMPLES
    ]
    for number, one in enumerate(plausible_planes(plane, robot.mount)):
        least = MIN_SHARE if number == 0 else MIN_SHARE_TILTED
        places = [on_plane(rays, one) for rays in seen]
        for a, b, shared in pairs:
            apart = np.linalg.norm(places[a][shared[:, 0]] - places[b][shared[:, 1]], axis=1)
            if any((np.abs(apart / span - 1) < SPAN_TOLERANCE).mean() > least for span in spans):
                return True
    return not pairs
