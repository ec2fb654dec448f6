"""Information that a planned stance brings on poses, mounts and markers; `StanceModel`.

The pixels of all markers at all instants are linearised about the plan with the camera model of the joint estimate
(`backend.camera_model`). The mover's pose at each instant is eliminated. What is left is the information of the
homography, whose latent points lie on the marker plane, and of the spans between the mover's markers. The floor's slope
under the mover lifts its markers off that plane, by the model of the estimator's front end
(`frontend.homography.floor_tilt`): what is estimated as if the floor there were even has a larger covariance.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coloc_graph.backend.camera_model import Mounts
from coloc_graph.errors import InputError
from coloc_graph.frontend.homography.floor_tilt import GRAIN, alike
from coloc_graph.geometry.lie import floor_pose, hat
from coloc_graph.planning.belief import MOUNT, OBSERVER, POSE
from coloc_graph.planning.floor_map import FloorMap
from coloc_graph.team import Team, fisheye
from coloc_graph.team.shared_view import hidden

Array = NDArray[np.float64]

MARGIN = 4.0  # least distance of a marker from the border of an image [px]
MAX_RANGE = 2.6  # largest distance at which a marker is measured [m]
WEAK = 1e-4  # information that keeps the mover's pose regular where one marker is seen [1/m^2, 1/rad^2]
NEGLIGIBLE = 1e-11  # information that keeps a sum regular, relative to its trace
MOVER = 3  # numbers of the mover's pose: x, y [m], yaw [rad]
SLOPE = 2  # numbers of the floor's slope [rad]
EVEN = GRAIN * math.sqrt(math.tau)  # way along a line over which slopes are alike as if they were one [m]


@dataclass(frozen=True, eq=False)
class Seen:
    """Information of one image of each camera from each of n places of the mover, its pose eliminated.

    The variables (k,) are the cameras' tangents and the markers, `StanceModel.by_variables` from those of a stance.

    Attributes
    ----------
    information
        Information (..., n, k, k) as on an even floor.
    lifted
        Covariance (..., n, k, k) that the floor's slope adds to the gradient of the pixels' likelihood, of each image
        of a drive along which slopes change.
    """

    information: Array
    lifted: Array

    def total(self, images: Array) -> Array:
        """Sum up the information (..., k, k) of numbers (..., n) of images."""
        return on_slopes(self._sum(self.information, images), self._sum(self.lifted, images))

    def mean_of(self, number: int) -> "Seen":
        """Return the mean of as many parts of the places: (..., number n, k, k) to (..., n, k, k)."""
        *lead, _, k, _ = self.information.shape
        return Seen(*(one.reshape(*lead, number, -1, k, k).mean(axis=-4) for one in (self.information, self.lifted)))

    def sensitivities(self, images: Array, rows: Array) -> Array:
        """Derivatives (n,) of the sum, over rows x of (q, k), of x total x^T by the numbers (n,) of images."""
        estimated = rows @ _estimated(self._sum(self.information, images), self._sum(self.lifted, images)).mT
        by_information = np.einsum("qi,nij,qj->n", 2 * rows - estimated, self.information, estimated, optimize=True)
        return np.asarray(by_information - np.einsum("qi,nij,qj->n", estimated, self.lifted, estimated, optimize=True))

    @staticmethod
    def _sum(each: Array, images: Array) -> Array:
        *lead, n, k, _ = each.shape
        return np.asarray((images[..., None, :] @ each.reshape(*lead, n, k * k)).reshape(*images.shape[:-1], k, k))


class StanceModel:
    """Observers and the mover of a stance, whose information is predicted for many stances at once.

    The variables are, of each observer in turn, its pose (6,) in GTSAM's tangent, rotation first, body frame, and its
    mount (6,): height [m], tilt, roll, yaw [rad], x, y [m]; at the end the mover's markers (2,): span (relative) and
    height [m].

    Parameters
    ----------
    team
        The robots; those that observe need a camera, the mover two markers.
    observers, mover
        Their names.
    noise_px
        Standard deviation of a marker centre per axis [px]; None for what was learnt or is stated of each camera.
    mounts
        Errors (r, 6) of the observers' mounts as they are estimated; None for mounts as stated.
    floor_map
        Walls that block the view; None where there are none.
    images_per_metre
        Images of each camera while the mover drives a metre, for what single images of a drive bring (`see`) [1/m].

    Raises
    ------
    InputError
        If the mover has fewer than two markers.
    """

    def __init__(
        self,
        team: Team,
        observers: Sequence[str],
        mover: str,
        noise_px: float | None = None,
        mounts: Array | None = None,
        floor_map: FloorMap | None = None,
        images_per_metre: float = 150.0,
    ) -> None:
        self._floor_map = floor_map
        self._slope_sigma = math.radians(team.floor.tilt_sigma_deg) if team.floor is not None else 0.0
        self._images_alike = max(images_per_metre * EVEN, 1.0)
        markers = team[mover].markers
        if markers is None or len(markers.positions) < 2:
            raise InputError(f"{mover} is to be watched and has fewer than two markers: give it two")
        self.observers, self.mover = tuple(observers), mover
        self.p_markers = markers.p_body[:2]
        self._cameras = [team[name].camera for name in observers]
        errors = np.zeros((len(observers), MOUNT)) if mounts is None else mounts
        cameras = Mounts([team[name].mount for name in observers]).at(errors)
        self._R, self._t = cameras.R, cameras.t
        r = len(observers)
        self.variables = OBSERVER * r + 2
        by = np.zeros((6 * r + 2, self.variables))
        for n in range(r):
            at = OBSERVER * n
            by[6 * n : 6 * n + 6, at : at + POSE] = cameras.by_body[n]
            by[6 * n : 6 * n + 6, at + POSE : at + OBSERVER] = cameras.by_errors[n]
        by[-2:, -2:] = np.eye(2)
        self.by_variables = by
        noise = np.array([noise_px or camera.typical_noise_px for camera in self._cameras])
        self._scale = np.array([[[c.fx], [c.fy]] for c in self._cameras]) / noise[:, None, None]
        self._bias = np.array([camera.bias_px for camera in self._cameras]) / noise
        self._clock_sigma = team.clock_sigma

    def camera(self, standing: Array) -> Array:
        """Place x, y [m] of the first observer, standing at a pose (3,), and the heading of its camera [rad]."""
        ahead = self._R[0] @ [0.0, 0.0, 1.0]
        return np.asarray(standing + np.array([0.0, 0.0, np.arctan2(ahead[1], ahead[0])]))

    def views(self, standing: Array) -> tuple[Array, Array]:
        """Return rotations (..., r, 3, 3) of the cameras in the world and their optical centres (..., r, 3) [m].

        `standing` (..., r, 3) are x, y [m], yaw [rad] of the observers.
        """
        T = floor_pose(*np.moveaxis(standing, -1, 0))
        return T[..., :3, :3] @ self._R, (T[..., :3, :3] @ self._t[..., None])[..., 0] + T[..., :3, 3]

    def in_view(self, standing: Array, points: Array, margin: float | Array = MARGIN) -> NDArray[np.bool_]:
        """Return which points (..., n, 3) [m] each camera sees, (..., r, n): in the image, near, and not hidden."""
        R, eyes = self.views(standing)
        p = (points[..., None, :, :] - eyes[..., None, :]) @ R
        return self._visible(standing, points, eyes, p, margin)

    def sees(self, standing: Array, drive: Array) -> NDArray[np.bool_]:
        """Return which observers at poses (r, 3) see all markers of a mover at poses (n, 3), (r, n)."""
        c, s = np.cos(drive[:, 2:]), np.sin(drive[:, 2:])
        (mx, my, _), height = self.p_markers.T, self.p_markers[:, 2]
        arm = np.stack([c * mx - s * my, s * mx + c * my], axis=-1)
        points = np.concatenate([drive[:, None, :2] + arm, np.broadcast_to(height[:, None], (*arm.shape[:2], 1))], -1)
        return np.asarray(self.in_view(standing, points.reshape(-1, 3)).reshape(len(standing), *arm.shape[:2]).all(-1))

    def _visible(
        self, standing: Array, points: Array, eyes: Array, p: Array, margin: float | Array
    ) -> NDArray[np.bool_]:
        seen = np.empty(p.shape[:-1], bool)
        edges = np.broadcast_to(margin, (*standing.shape[:-1], 2))
        for n, camera in enumerate(self._cameras):
            uv, inside = camera.project(p[..., n, :, :])
            size = np.array([camera.width, camera.height])
            with np.errstate(invalid="ignore"):
                edge = edges[..., n, None, :]
                seen[..., n, :] = inside & (uv >= edge - 0.5).all(-1) & (uv <= size - 0.5 - edge).all(-1)
            others = np.delete(standing[..., :2], n, axis=-2)
            seen[..., n, :] &= ~hidden(eyes[..., n, None, :], points, others[..., None, :, :])
            if self._floor_map is not None:
                which = np.nonzero(seen[..., n, :])
                shape = (*seen[..., n, :].shape, 3)
                from_eyes = np.broadcast_to(eyes[..., n, None, :], shape)[which]
                seen[..., n, :][which] = ~self._floor_map.blocked(from_eyes, np.broadcast_to(points, shape)[which])
        return np.asarray(seen & (np.linalg.norm(p, axis=-1) < MAX_RANGE))

    def see(self, standing: Array, drive: Array, watching: ArrayLike = True) -> Seen:
        """Linearise the pixels of a stance at places of the mover's drive.

        Parameters
        ----------
        standing
            Poses (..., r, 3) of the observers (x [m], y [m], yaw [rad]).
        drive
            Poses (..., n, 3) of the mover.
        watching
            Which observers' images count, (..., r).
        """
        information = _without_mover(self._pixels(standing, drive, watching)[0])
        by_slope = information[..., :-SLOPE, -SLOPE:]
        lifted = self._slope_sigma**2 * self._images_alike * by_slope @ by_slope.mT
        return Seen(information[..., :-SLOPE, :-SLOPE], lifted)

    def total(
        self,
        standing: Array,
        drive: Array,
        images: ArrayLike,
        velocity: Array,
        seconds: ArrayLike,
        watching: ArrayLike = True,
    ) -> tuple[Array, Array]:
        """Sum up stances (...) whose drives (..., n, 3) stand for `images` (...) images at each instant.

        Those of the observers count that are `watching` (..., r).
        Errors that all images share are unknowns: a bias of each marker's centre in each camera, and the offset of the
        cameras' clocks, by which the mover's `velocity` (..., n, 3) [m/s, rad/s] shifts what they see. The floor's
        slope is the same for all images near a place, however often the mover comes by; each instant stands for
        `seconds` (...) of the drive.

        Returns
        -------
        tuple
            Information (..., d, d) of the variables, and the number (...) of correspondences.
        """
        J, points = self._pixels(standing, drive, watching)
        r, rows = len(self.observers), J.shape[-2]
        own, shared = np.arange(rows).reshape(r, -1), []
        if self._bias.any():
            seen = np.abs(J).max(axis=-1, keepdims=True) > 0
            shared.append(np.repeat(self._bias, rows // r) * np.eye(rows) * seen)
        if self._clock_sigma:
            late = (J[..., -MOVER:] @ velocity[..., None])[..., 0] * self._clock_sigma
            by_clock = np.zeros((*late.shape, r - 1))
            for k in range(1, r):
                by_clock[..., own[k], k - 1] = late[..., own[k]]
            shared.append(by_clock)
        d = self.by_variables.shape[0]
        information = _without_mover(np.concatenate([J[..., :d], *shared, J[..., d:]], axis=-1))
        images, seconds = np.asarray(images, float), np.asarray(seconds, float)
        total = images[..., None, None] * information[..., :-SLOPE, :-SLOPE].sum(axis=-3)
        if self._slope_sigma:
            by_place = alike(drive[..., :2], velocity[..., :2] * seconds[..., None, None])
            by_slope = np.moveaxis(information[..., :-SLOPE, -SLOPE:], -1, -3)  # (..., 2, n, variables)
            by_slope = self._slope_sigma * images[..., None, None, None] * by_slope
            total = on_slopes(total, (by_slope.mT @ (by_place[..., None, :, :] @ by_slope)).sum(axis=-3))
        nuisance = total[..., d:, d:] + np.eye(total.shape[-1] - d)
        left = total[..., :d, :d] - total[..., :d, d:] @ np.linalg.solve(nuisance, total[..., d:, :d])
        return self.of_stance(left), images * points.sum(axis=-1)

    def of_stance(self, information: Array) -> Array:
        """Return the information (..., d, d) on a stance's variables of that on the cameras' tangents and markers."""
        return np.asarray(self.by_variables.T @ information @ self.by_variables)

    def _pixels(self, standing: Array, drive: Array, watching: ArrayLike) -> tuple[Array, Array]:
        """Whitened Jacobians (..., n, 2 r m, 6 r + 7) of pixels by cameras, markers, slope and the mover's pose.

        With the number of correspondences (..., n). Rows are ordered by camera, marker, axis; those of markers that
        fewer than two cameras see are 0.
        """
        R, eyes = self.views(standing)
        r, m, n = len(self.observers), len(self.p_markers), drive.shape[-2]
        lead = drive.shape[:-2]
        c, s = np.cos(drive[..., 2])[..., None], np.sin(drive[..., 2])[..., None]
        mx, my = self.p_markers[:, 0], self.p_markers[:, 1]
        arm = np.stack([c * mx - s * my, s * mx + c * my], axis=-1)
        points = np.empty((*lead, n, m, 3))
        points[..., :2] = drive[..., None, :2] + arm
        points[..., 2] = self.p_markers[:, 2]
        flat = points.reshape(*lead, n * m, 3)
        p = (flat[..., None, :, :] - eyes[..., None, :]) @ R
        seen = self._visible(standing, flat, eyes, p, MARGIN).reshape(*lead, r, n, m)
        seen &= np.broadcast_to(watching, (*lead, r))[..., None, None]
        p = p.reshape(*lead, r, n, m, 3)
        z = np.maximum(p[..., 2], 0.05)
        project = np.zeros((*p.shape[:-1], 2, 3))
        project[..., 0, 0] = project[..., 1, 1] = 1 / z
        project[..., 0, 2], project[..., 1, 2] = -p[..., 0] / z**2, -p[..., 1] / z**2
        for k, camera in enumerate(self._cameras):
            if camera.model == "fisheye":
                own = p[..., k, :, :, :]
                by_point = fisheye.derivative(camera.distortion, own.reshape(-1, 3))
                project[..., k, :, :, :, :] = by_point.reshape(*own.shape[:-1], 2, 3)
        project *= self._scale[:, None, None]
        to_world = project @ R.mT[..., None, None, :, :]  # by the marker in the world, (..., r, n, m, 2, 3)
        by_camera = np.concatenate([project @ hat(p), -project], axis=-1)
        across = np.stack([-arm[..., 1], arm[..., 0]], axis=-1)[..., None, :, :, :, None]
        by_yaw = to_world[..., :2] @ across
        by_span = to_world[..., :2] @ arm[..., None, :, :, :, None]
        lever = (arm - arm.mean(axis=-2, keepdims=True))[..., None, :, :, None, :]
        by_slope = to_world[..., 2:] * lever
        J = np.zeros((*lead, n, r, m, 2, 6 * r + 2 + SLOPE + MOVER))
        for k in range(r):
            J[..., k, :, :, 6 * k : 6 * k + 6] = by_camera[..., k, :, :, :, :]
        by_shared = np.concatenate([by_span, to_world[..., 2:], by_slope, to_world[..., :2], by_yaw], axis=-1)
        J[..., 6 * r :] = np.moveaxis(by_shared, -5, -4)
        seen &= seen.sum(axis=-3, keepdims=True) >= 2
        J *= np.moveaxis(seen, -3, -2)[..., None, None]
        shared = seen.sum(axis=-3)
        return J.reshape(*lead, n, r * m * 2, J.shape[-1]), (shared * (shared - 1) / 2).sum(axis=-1)


def on_slopes(information: Array, lifted: Array) -> Array:
    """Return the information (..., k, k) of pixels from which one estimates as if the floor under the mover were even.

    `information` (..., k, k) is theirs there, `lifted` (..., k, k) what slopes add to the covariance of the gradient of
    their likelihood.
    """
    return np.asarray(information @ _estimated(information, lifted))


def _estimated(M: Array, S: Array) -> Array:
    """Return (M + S)^-1 M (..., k, k) of M and S that may be singular."""
    weak = NEGLIGIBLE * np.trace(M, axis1=-2, axis2=-1)[..., None, None] + WEAK
    return np.asarray(np.linalg.solve(M + S + weak * np.eye(M.shape[-1]), M))


def _without_mover(J: Array) -> Array:
    """Information of all variables of Jacobians (..., rows, d + 3) but the mover's, which are eliminated."""
    H = J.mT @ J
    latent = H[..., -MOVER:, -MOVER:] + WEAK * np.eye(MOVER)
    cross = H[..., :-MOVER, -MOVER:]
    return np.asarray(H[..., :-MOVER, :-MOVER] - cross @ np.linalg.solve(latent, cross.mT))
