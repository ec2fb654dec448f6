"""Maximum-likelihood relative pose of two observers from a homography and the tolerances of mounts, plane and floor.

Eq. (2) takes the rotation from two columns of H and the translation from a third. Here all eight coordinates of H
count, weighted by their information, against the few unknowns that remain if mounts and floor are known.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend.homography.eq2_pose import eq2_pose, turned_normal
from coloc_graph.geometry.lie import (
    across,
    floor_pose,
    se3,
    se3_exp,
    se3_inverse,
    sl3_log,
    sl3_normalise,
    so3_exp,
    so3_log,
    yaw,
)  # fmt: skip
from coloc_graph.measurements import HomographyMeasurement, Plane, RelativePose
from coloc_graph.team import Floor, Mount

Array = NDArray[np.float64]

MIN_SIGMA = 1e-5  # rad and m, of a floor that is stated as exact
MAX_ITERATIONS = 20
CONVERGED = 1e-2  # sigmas, length of a step below which the search ends; the remaining error is about its square


@dataclass(frozen=True, eq=False)
class _Model:
    """Unknowns with standard deviations of their priors (inf: none), and the map from them to T_i_j, T_ci_cj, N, d."""

    sigmas: Array
    build: Callable[[Array], tuple[Array, Array, Array, Array]]


def most_likely_pose(
    measurement: HomographyMeasurement, mount_i: Mount, mount_j: Mount, plane: Plane, floor: Floor | None = None
) -> RelativePose:
    """Estimate the relative pose by maximum likelihood.

    Parameters
    ----------
    measurement
        Homography from camera i to camera j.
    mount_i, mount_j
        Mounts of both cameras; their tolerances are priors of unknowns that are estimated too.
    plane
        Marker plane in camera i, with its tolerances.
    floor
        Floor that both robots stand on, which leaves x, y and heading free and keeps roll, pitch and height within its
        tolerances. Without it all six are free, which is the form for a graph that has its own floor factors.

    Returns
    -------
    RelativePose
        T_i_j of the bodies, with its covariance (6, 6), rotation first, body frame j.

    Raises
    ------
    DegenerateGeometry
        There is no baseline, or the search does not converge.
    """
    start = eq2_pose(measurement, mount_i, mount_j, plane)
    model = (
        _on_floor(start, mount_i, mount_j, plane, floor)
        if floor is not None and plane.normal_from_mount
        else _free(start, mount_i, mount_j, plane)
    )
    root = np.linalg.cholesky(measurement.information).T
    H_inverse = np.linalg.inv(measurement.H_j_i)
    free = model.sigmas > 0
    precision = np.where(np.isinf(model.sigmas), 0.0, 1 / np.where(free, model.sigmas, 1.0))[free]
    width = 1e-4 * np.where(np.isinf(model.sigmas), 1.0, np.minimum(np.maximum(model.sigmas, 1e-3), 1.0))[free]

    unknowns = np.zeros(len(free))
    # central differences, all in one call
    steps = np.zeros((1 + 2 * len(width), len(free)))
    steps[1:, free] = np.concatenate([np.diag(width), -np.diag(width)])
    for _ in range(MAX_ITERATIONS):
        _, T_ci_cj, N, d = model.build(unknowns + steps)
        T_cj_ci = se3_inverse(T_ci_cj)
        H = T_cj_ci[:, :3, :3] + T_cj_ci[:, :3, 3:] * (N / d[:, None])[:, None, :]
        residuals = sl3_log(sl3_normalise(H_inverse @ H)) @ root.T
        J = (residuals[1 : 1 + len(width)] - residuals[1 + len(width) :]).T / (2 * width)
        A = np.concatenate([J, np.diag(precision)])
        r = np.concatenate([residuals[0], precision * unknowns[free]])
        if not (np.isfinite(A).all() and np.isfinite(r).all()):
            break  # too far for a logarithm
        step = -np.linalg.lstsq(A, r, rcond=None)[0]
        if not np.abs(step).max() < 1.0:
            break
        unknowns[free] += step
        if np.linalg.norm(A @ step) < CONVERGED:
            return _result(measurement, start, model, unknowns, steps, width, A)
    raise DegenerateGeometry(
        f"the search for the pose between {measurement.robot_i} and {measurement.robot_j} does not converge: "
        "the homography does not fit the mounts and the marker plane as stated"
    )


def _result(
    measurement: HomographyMeasurement,
    start: RelativePose,
    model: _Model,
    unknowns: Array,
    steps: Array,
    width: Array,
    A: Array,
) -> RelativePose:
    T_i_j, T_ci_cj, _, _ = model.build(unknowns + steps)
    off = se3_inverse(T_i_j[0]) @ T_i_j[1:]
    xi = np.concatenate([so3_log(off[:, :3, :3]), off[:, :3, 3]], axis=1)
    J = (xi[: len(width)] - xi[len(width) :]).T / (2 * width)
    half = J @ np.linalg.pinv(A)
    return RelativePose(
        stance=measurement.stance,
        robot_i=measurement.robot_i,
        robot_j=measurement.robot_j,
        T_i_j=T_i_j[0],
        covariance=half @ half.T,
        T_ci_cj=T_ci_cj[0],
        solution=start.solution,
        normal_error=start.normal_error,
    )


def _mount_sigmas(mount: Mount) -> list[float]:
    return [mount.height_sigma, *np.deg2rad([mount.tilt_sigma_deg, mount.roll_sigma_deg])]


def _free(start: RelativePose, mount_i: Mount, mount_j: Mount, plane: Plane) -> _Model:
    """Model with unknowns: tangent of the pose (6), rotation of the normal (2), d (1), both mounts (3 + 3)."""
    T_start = start.T_i_j
    sides = across(plane.N)

    def build(u: Array) -> tuple[Array, Array, Array, Array]:
        T_i_j = T_start @ se3_exp(u[:, :6])
        T_bi_ci, T_bj_cj = mount_i.off_by(u[:, 9:12]), mount_j.off_by(u[:, 12:15])
        N = turned_normal(plane, mount_i, T_bi_ci)
        N = (so3_exp(u[:, 6:8] @ sides) @ N[..., None])[..., 0]
        d = plane.d + u[:, 8] + (u[:, 9] if plane.d_from_mount else 0.0)
        return T_i_j, se3_inverse(T_bi_ci) @ T_i_j @ T_bj_cj, N, d

    sigmas = [np.inf] * 6 + [plane.normal_sigma] * 2 + [plane.d_sigma]
    return _Model(np.array([*sigmas, *_mount_sigmas(mount_i), *_mount_sigmas(mount_j)]), build)


def _on_floor(start: RelativePose, mount_i: Mount, mount_j: Mount, plane: Plane, floor: Floor) -> _Model:
    """Model with unknowns: x, y, heading (3), tilts of i and j on the floor (2 + 2), height of j over i, d, mounts."""
    T_start = start.T_i_j
    x, y, heading = T_start[0, 3], T_start[1, 3], float(yaw(T_start))
    down = np.array([0.0, 0.0, -1.0])

    def tilt(angles: Array) -> Array:
        w = np.concatenate([angles, np.zeros((len(angles), 1))], axis=1)
        return se3(so3_exp(w), np.zeros(3))

    def build(u: Array) -> tuple[Array, Array, Array, Array]:
        T_fi_fj = floor_pose(x + u[:, 0], y + u[:, 1], heading + u[:, 2])
        T_fi_fj[:, 2, 3] = u[:, 7]
        T_fi_bi, T_fj_bj = tilt(u[:, 3:5]), tilt(u[:, 5:7])
        T_i_j = se3_inverse(T_fi_bi) @ T_fi_fj @ T_fj_bj
        T_bi_ci, T_bj_cj = mount_i.off_by(u[:, 9:12]), mount_j.off_by(u[:, 12:15])
        N = (T_fi_bi @ T_bi_ci)[:, :3, :3].mT @ down
        d = plane.d + u[:, 8] + (u[:, 9] if plane.d_from_mount else 0.0)
        return T_i_j, se3_inverse(T_bi_ci) @ T_i_j @ T_bj_cj, N, d

    level = max(float(np.deg2rad(floor.tilt_sigma_deg)), MIN_SIGMA)
    height = max(np.sqrt(2) * floor.height_sigma, MIN_SIGMA)
    sigmas = [np.inf] * 3 + [level] * 4 + [height, plane.d_sigma]
    return _Model(np.array([*sigmas, *_mount_sigmas(mount_i), *_mount_sigmas(mount_j)]), build)
