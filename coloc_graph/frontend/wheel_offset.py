"""Offset of a mover's wheels from a camera's clock by maximum likelihood, with the noise of both.

The markers' path by wheel odometry is seen through one homography. Errors of odometry add up along the way, so that
those of all points are correlated; what the samples of odometry leave open between them is noise of each point. The
inverse of the information, with the homography eliminated, is the Cramer-Rao bound of the offset.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, cho_solve, cholesky

from coloc_graph.frontend.homography.refinement import projection
from coloc_graph.frontend.odometry import WheelTrack
from coloc_graph.frontend.pairing.clock_offset import ClockOffset
from coloc_graph.frontend.tracks.track import Track
from coloc_graph.geometry.lie import sl3_exp, sl3_normalise
from coloc_graph.team import Camera

Array = NDArray[np.float64]

MAX_POINTS = 100  # points of each marker that are compared, at most
MIN_POINTS = 20  # points of all markers at least
STEPS = 12  # iterations at most
WEIGHED = 2  # iterations after which the covariance changes no more
MAX_MISFIT = 9.0  # chi2 by degree of freedom above which it is not one motion that both saw
MIN_SIGMA = 1e-3  # an offset is known no better: stamps are of no exact instant [s]
STEP = 0.05  # half the time between two positions that tell a speed [s]
MAX_H_STEP = 1.0  # change of a coordinate of the homography in one iteration beyond which the points leave it open
MAX_CHANGE = 0.15  # change of the offset beyond which the search before was wrong [s]


def refine_wheel_offset(
    pairs: Sequence[tuple[Track, Array]], wheels: WheelTrack, camera: Camera, start: float
) -> ClockOffset | None:
    """Refine an offset, clock of the wheels minus clock of the camera.

    Parameters
    ----------
    pairs : sequence of (Track, (2,) float)
        Tracks of markers, and where these are on the body [m].
    wheels : WheelTrack
        Odometry of the body.
    camera : Camera
        The camera, a pinhole.
    start : float
        Initial offset [s].

    Returns
    -------
    ClockOffset or None
        None where too few points are within the odometry, or no homography explains them.
    """
    times, x, covariance, points = (np.concatenate(each) for each in zip(*_samples(pairs, camera), strict=True))
    known = (times + start - MAX_CHANGE > wheels.times[0]) & (times + start + MAX_CHANGE < wheels.times[-1])
    times, x, covariance, points = times[known], x[known], covariance[known], points[known]
    if len(times) < MIN_POINTS:
        return None
    middle = np.full(len(times), np.median(times) + start)

    def driven(offset: float) -> Array:
        return _placed(wheels.moved(middle, times + offset), points)

    H, _ = cv2.findHomography(driven(start), x)
    if H is None:
        return None
    offset, H = start, sl3_normalise(H)
    for number in range(STEPS):
        z = driven(offset)
        predicted, by_z, by_h = projection(H, z)
        speed = (driven(offset + STEP) - driven(offset - STEP)) / (2 * STEP)
        J = np.hstack([by_h.reshape(-1, 8), (by_z @ speed[..., None]).reshape(-1, 1)])
        residual = (x - predicted).ravel()
        try:
            if number < WEIGHED:
                errors = (by_z @ wheels.place_errors(middle, times + offset, points)).reshape(2 * len(z), -1)
                between = by_z @ _between(wheels, times + offset, points)[..., None]
                factor = cholesky(errors @ errors.T + block_diag(*(covariance + between @ between.mT)), lower=True)
            weighted = cho_solve((factor, True), np.column_stack([J, residual]))
            normal = J.T @ weighted[:, :9]
            step = np.linalg.solve(normal, J.T @ weighted[:, 9])
            variance = float(np.linalg.inv(normal)[8, 8])
        except np.linalg.LinAlgError:
            return None
        if not (variance > 0 and np.abs(step[:8]).max() < MAX_H_STEP and abs(offset + step[8] - start) < MAX_CHANGE):
            return None
        sigma = float(np.sqrt(variance))
        H, offset = H @ sl3_exp(step[:8]), offset + float(step[8])
        if number >= WEIGHED and abs(step[8]) < 0.01 * sigma:
            break
    misfit = float(residual @ weighted[:, 9]) / (len(residual) - 9)
    if misfit > MAX_MISFIT:
        return None
    return ClockOffset(offset, float(np.hypot(sigma * np.sqrt(max(1.0, misfit)), MIN_SIGMA)))


def _samples(pairs: Sequence[tuple[Track, Array]], camera: Camera) -> list[tuple[Array, Array, Array, Array]]:
    """Times, normalised positions, their covariances, and points of the body of evenly spread samples."""
    made = []
    for track, point in pairs:
        rows = np.unique(np.linspace(0, len(track.times) - 1, min(MAX_POINTS, len(track.times))).round().astype(int))
        x = camera.normalise(track.uv[rows])
        J = camera.per_pixel(x)
        covariance = J @ (track.covariance[rows] + camera.bias_px**2 * np.eye(2)) @ J.mT
        made.append((track.times[rows], x, covariance, np.broadcast_to(point, (len(rows), 2))))
    return made


def _placed(pose: Array, points: Array) -> Array:
    """Points (n, 2) of bodies at poses (n, 3)."""
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    px, py = points.T
    return np.stack([pose[:, 0] + c * px - s * py, pose[:, 1] + s * px + c * py], axis=1)


def _between(wheels: WheelTrack, times: Array, points: Array) -> Array:
    """Standard deviation (n, 2) [m] of points between samples of odometry, where speed and turning may have changed."""
    after = np.clip(np.searchsorted(wheels.times, times), 2, len(wheels) - 2)
    nodes = [wheels.times[after + k] for k in (-2, -1, 0, 1)]
    at = [_placed(wheels.moved(times, node), points) for node in nodes]
    curved = [np.abs(a - 2 * b + c) for a, b, c in (at[:3], at[1:])]
    return np.asarray(np.maximum(*curved) / 8)
