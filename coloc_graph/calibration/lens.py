"""Check lens models for folds in the image, and propagate intrinsics to the uncertainty of rays."""

import numpy as np
from numpy.typing import NDArray

from coloc_graph.calibration.projection import Model, project
from coloc_graph.team import Camera

Array = NDArray[np.float64]

LENS_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


FISHEYE_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")


def camera_of(intrinsics: Array, width: int, height: int, model: Model = "pinhole") -> Camera:
    """Make a camera from intrinsics (p,): fx, fy, cx, cy and the lens coefficients."""
    fx, fy, cx, cy = intrinsics[:4].tolist()
    lens = tuple(intrinsics[4:].tolist())
    return Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, model=model, distortion=lens)


def pixel_grid(width: int, height: int, columns: int, rows: int) -> Array:
    """Centres of the cells of a grid over an image, (rows, columns, 2) [px]."""
    u = (np.arange(columns) + 0.5) * width / columns - 0.5
    v = (np.arange(rows) + 0.5) * height / rows - 0.5
    return np.stack(np.meshgrid(u, v), axis=-1)


def folds(intrinsics: Array, width: int, height: int, model: Model = "pinhole") -> str | None:
    """Explain in words why a lens model is not invertible over the whole image, or return None."""
    if (intrinsics[:2] <= 0).any():
        return "has a focal length that is not positive"
    camera = camera_of(intrinsics, width, height, model)
    if (radius := camera.fold_radius()) is not None:
        return f"folds the image {radius:.0f} px from its middle: not every pixel has one ray"
    if model == "fisheye":
        return None  # pixels beyond its image circle have no ray
    corners = pixel_grid(width, height, 33, 33).reshape(-1, 2)
    x = camera.normalise(corners)
    if not np.isfinite(x).all():
        return "folds the image: not every pixel has a ray"
    back, seen = camera.project(np.column_stack([x, np.ones(len(x))]))
    if not seen.all() or np.abs(back - corners).max() > 1e-3:
        return "folds the image: not every pixel has one ray"
    return None


def ray_sigmas(
    intrinsics: Array, covariance: Array, uv: Array, at: Array | None = None, model: Model = "pinhole"
) -> Array:
    """Standard deviations (m,) of rays, for each axis [px].

    A small rotation of the camera compensates a part of an error in the intrinsics: the best rotation over the pixels
    `uv` is removed.

    Parameters
    ----------
    intrinsics, covariance
        Intrinsics, (p,), and their covariance, (p, p).
    uv
        Pixels of the rays, (n, 2).
    at
        Pixels of other rays to evaluate, (m, 2).
    model
        Lens model.

    Returns
    -------
    numpy.ndarray
        Standard deviations, infinite for pixels without a ray in the model.
    """
    size = np.concatenate([uv, uv if at is None else at]).max(axis=0) + 2
    camera = camera_of(intrinsics, int(size[0]), int(size[1]), model)
    A, B = _of_rays(camera, intrinsics, uv)
    turn = np.linalg.lstsq(B, A, rcond=None)[0]
    if at is not None:
        A, B = _of_rays(camera, intrinsics, at)
    A = (A - B @ turn).reshape(-1, 2, len(intrinsics))
    variance = np.einsum("mip,pq,miq->m", A, covariance, A) / 2
    return np.where(np.isfinite(variance), np.sqrt(variance.clip(min=0)), np.inf)


def _of_rays(camera: Camera, intrinsics: Array, uv: Array) -> tuple[Array, Array]:
    """Derivatives of pixels by intrinsics (2m, p) and by a rotation (2m, 3), at the rays of pixels (m, 2)."""
    _, A, B = project(intrinsics, np.array([1e-12, 0, 0, 0, 0, 0.0]), camera.rays(uv), camera.model)
    return A, B[:, :3]
