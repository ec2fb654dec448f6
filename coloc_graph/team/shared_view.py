"""Shared field of view of cameras at rest: `View`, and positions where a robot's markers are in all of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coloc_graph.geometry.lie import se3_inverse
from coloc_graph.team import Camera

Array = NDArray[np.float64]

GRID = 0.05  # m, distance between tried positions
WIDE = 1.5  # m, range of positions to either side
BODY_RADIUS = 0.17  # m, of an iRobot Create
BODY_HEIGHT = 0.30  # m, up to the lid of the laptop that it carries


@dataclass(frozen=True, eq=False)
class View:
    """A camera at rest, with its pose T_world_camera (4, 4)."""

    camera: Camera
    T_world_camera: Array

    def project(self, points_world: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Return the pixels (..., 2) of points (..., 3) [m] in the world, and a mask of those in the image."""
        T_camera_world = se3_inverse(self.T_world_camera)
        return self.camera.project(np.asarray(points_world, float) @ T_camera_world[:3, :3].T + T_camera_world[:3, 3])

    def sees(self, points_world: ArrayLike, margin: float) -> NDArray[np.bool_]:
        """Return whether points (..., 3) [m] are in the image, `margin` [px] from its border."""
        uv, inside = self.project(points_world)
        size = np.array([self.camera.width, self.camera.height])
        with np.errstate(invalid="ignore"):
            return np.asarray(inside & (uv >= margin - 0.5).all(-1) & (uv <= size - 0.5 - margin).all(-1))


def positions_in_view(
    views: Sequence[View],
    p_markers: Array,
    middle: tuple[float, float],
    ahead: tuple[float, float],
    margin: float,
    heading: float = 0.0,
) -> Array:
    """Return positions (n, 2) [m] of a body where all cameras see all its markers (m, 3) at any yaw.

    They lie on a grid, row by row, from `ahead[0]` to `ahead[1]` [m] beyond the `middle` along the `heading` [rad].
    """
    x, y = np.meshgrid(np.arange(ahead[0], ahead[1] + 1e-9, GRID), np.arange(-WIDE, WIDE + 1e-9, GRID), indexing="ij")
    c, s = np.cos(heading), np.sin(heading)
    xy = np.column_stack([c * x.ravel() - s * y.ravel() + middle[0], s * x.ravel() + c * y.ravel() + middle[1]])
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    rim = np.hypot(*p_markers[:, :2].T).max() * np.column_stack([np.cos(angles), np.sin(angles)])
    points = np.concatenate([xy[:, None] + rim, np.full((len(xy), len(rim), 1), p_markers[0, 2])], axis=-1)
    seen = np.all([view.sees(points, margin).all(axis=1) for view in views], axis=0)
    return np.asarray(xy[seen])


def hidden(eyes: ArrayLike, points: ArrayLike, bodies: ArrayLike) -> NDArray[np.bool_]:
    """Return whether a robot's body hides points from cameras.

    Parameters
    ----------
    eyes, points
        Optical centres and points (..., 3) [m] in the world; their leading axes are broadcast.
    bodies
        Positions (..., b, 2) [m] of the robots in between: upright cylinders.

    Returns
    -------
    ndarray of bool
        True (...) for points behind or in a body.
    """
    eyes, points = np.broadcast_arrays(np.asarray(eyes, float), np.asarray(points, float))
    at = np.asarray(bodies, float)
    ray = (points - eyes)[..., None, :2]
    toward = at - eyes[..., None, :2]
    along = (toward * ray).sum(-1) / np.maximum((ray * ray).sum(-1), 1e-12)
    along = np.clip(along, 0.0, 1.0)
    aside = np.hypot(*np.moveaxis(toward - along[..., None] * ray, -1, 0))
    height = eyes[..., None, 2] + along * (points - eyes)[..., None, 2]
    return np.asarray(((aside < BODY_RADIUS) & (height < BODY_HEIGHT)).any(-1))
