"""Relative pose of two observers from a homography measurement by the paper's eq. (2), with a 6x6 covariance."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend.homography.decomposition import (
    choose_by_normal,
    decompose_svd,
    decompose_with_normal,
    metric_scale,
)
from coloc_graph.geometry.lie import (
    across,
    se3,
    se3_inverse,
    sl3_exp,
    so3_exp,
    so3_log,
)
from coloc_graph.measurements import HomographyMeasurement, Plane, RelativePose
from coloc_graph.team import Mount

Array = NDArray[np.float64]

# columns of the unknowns of a relative pose, (n, 17)
_H = slice(0, 8)  # sl(3) coordinates of the homography
_NORMAL = slice(8, 10)  # rad, rotation of the normal about two axes across it
_D = 10  # m, distance of the plane
_MOUNT_I = slice(11, 14)  # height [m], tilt, roll [rad]
_MOUNT_J = slice(14, 17)  # height [m], tilt, roll [rad]

SHORT_BASELINE = 0.2  # of the plane's distance; a baseline certainly shorter is called a pure rotation


def relative_pose(measurement: HomographyMeasurement, mount_i: Mount, mount_j: Mount, plane: Plane) -> RelativePose:
    """Compute the relative pose by eq. (2), with a first-order covariance.

    Parameters
    ----------
    measurement
        Homography from camera i to camera j.
    mount_i, mount_j
        Mounts of both cameras.
    plane
        Marker plane in camera i.

    Returns
    -------
    RelativePose
        T_i_j of the bodies. The covariance (6, 6), rotation first, body frame j, carries the homography's information,
        the uncertainty of the plane, and the tolerances of both mounts.

    Raises
    ------
    DegenerateGeometry
        There is no baseline between the cameras.
    """
    start = eq2_pose(measurement, mount_i, mount_j, plane)
    H = metric_scale(measurement.H_j_i)
    root = _root_covariance(measurement, mount_i, mount_j, plane)
    # central differences along each column of the root, all decompositions in one call
    scale = 0.1
    T_i_j, _ = _poses(
        np.concatenate([np.zeros((1, len(root))), scale * root.T, -scale * root.T]), H, mount_i, mount_j, plane
    )
    off = se3_inverse(T_i_j[0]) @ T_i_j[1:]
    xi = np.concatenate([so3_log(off[:, :3, :3]), off[:, :3, 3]], axis=1)
    columns = (xi[: len(root.T)] - xi[len(root.T) :]) / (2 * scale)
    covariance = columns.T @ columns
    return replace(start, covariance=(covariance + covariance.T) / 2)


def eq2_pose(measurement: HomographyMeasurement, mount_i: Mount, mount_j: Mount, plane: Plane) -> RelativePose:
    """Compute the relative pose by eq. (2) without a covariance (NaN)."""
    H = metric_scale(measurement.H_j_i)
    _require_baseline(measurement, H)
    _, _, N_both = decompose_svd(H)
    which, normal_error = choose_by_normal(N_both, plane.N)
    T_ci_cj = se3_inverse(se3(*decompose_with_normal(H, plane.N, plane.d)))
    return RelativePose(
        stance=measurement.stance,
        robot_i=measurement.robot_i,
        robot_j=measurement.robot_j,
        T_i_j=mount_i.T_body_camera @ T_ci_cj @ se3_inverse(mount_j.T_body_camera),
        covariance=np.full((6, 6), np.nan),
        T_ci_cj=T_ci_cj,
        solution=int(which),
        normal_error=float(normal_error),
    )


def _require_baseline(measurement: HomographyMeasurement, H: Array) -> None:
    """Raise `DegenerateGeometry` for the homography of a pure rotation, which leaves v2 and eq. (2) undetermined."""
    s = np.linalg.svd(H, compute_uv=False)
    baseline = s[0] - s[2]  # in units of the plane's distance d
    noise = 3 * np.sqrt(np.linalg.eigvalsh(np.linalg.inv(measurement.information)).max())
    if baseline >= noise:
        return
    pair = f"the homography between {measurement.robot_i} and {measurement.robot_j}"
    if baseline + noise < SHORT_BASELINE:
        raise DegenerateGeometry(
            f"{pair} is that of a pure rotation: there is no baseline; place the two observers further apart"
        )
    raise DegenerateGeometry(
        f"{pair}, fitted to {measurement.points} points, is too noisy to determine the baseline ({baseline:.2g} +- "
        f"{noise:.2g} of the camera's distance from the marker plane): record more points, spread over the plane, "
        "detect them better, or place the observers further apart"
    )


def _root_covariance(measurement: HomographyMeasurement, mount_i: Mount, mount_j: Mount, plane: Plane) -> Array:
    """Square root (17, 17) of the unknowns' covariance."""
    root = np.zeros((17, 17))
    root[_H, _H] = np.linalg.inv(np.linalg.cholesky(measurement.information)).T
    root[_NORMAL, _NORMAL] = plane.normal_sigma * np.eye(2)
    root[_D, _D] = plane.d_sigma
    for block, mount in ((_MOUNT_I, mount_i), (_MOUNT_J, mount_j)):
        tilts = np.deg2rad([mount.tilt_sigma_deg, mount.roll_sigma_deg])
        root[block, block] = np.diag([mount.height_sigma, *tilts])
    return root


def _poses(unknowns: Array, H: Array, mount_i: Mount, mount_j: Mount, plane: Plane) -> tuple[Array, Array]:
    """T_i_j and T_ci_cj, (m, 4, 4) each, for errors (m, 17) of the unknowns."""
    T_bi_ci, T_bj_cj = mount_i.off_by(unknowns[:, _MOUNT_I]), mount_j.off_by(unknowns[:, _MOUNT_J])
    N = turned_normal(plane, mount_i, T_bi_ci)
    sides = across(plane.N)
    N = (so3_exp(unknowns[:, _NORMAL] @ sides) @ N[..., None])[..., 0]
    d = plane.d + unknowns[:, _D] + (unknowns[:, _MOUNT_I][:, 0] if plane.d_from_mount else 0.0)
    R_cj_ci, t_cj_ci = decompose_with_normal(H @ sl3_exp(unknowns[:, _H]), N, d)
    T_ci_cj = se3_inverse(se3(R_cj_ci, t_cj_ci))
    return T_bi_ci @ T_ci_cj @ se3_inverse(T_bj_cj), T_ci_cj


def turned_normal(plane: Plane, mount: Mount, T_body_camera: Array) -> Array:
    """Normal of the plane (m, 3) in cameras mounted as `T_body_camera` (m, 4, 4) instead of as `mount` says.

    A normal that was computed from the mount stays vertical in the body; a stated one stays fixed in the camera.
    """
    if not plane.normal_from_mount:
        return np.broadcast_to(plane.N, (len(T_body_camera), 3))
    return np.asarray(T_body_camera[:, :3, :3].mT @ mount.R_body_camera @ plane.N)
