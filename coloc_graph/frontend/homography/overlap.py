"""Part of an image that shows what another image shows: `overlap`."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from coloc_graph.team import Camera

Array = NDArray[np.float64]


def overlap(H_j_i: Array, camera_i: Camera, camera_j: Camera, step: int = 4) -> float:
    """Number of pixels of image i that show a part of the plane that image j shows too, sampled every `step` [px]."""
    # beyond the plane's horizon the third coordinate changes sign, and `project` says behind
    _, inside = camera_j.project(_rays(camera_i, step) @ H_j_i.T)
    return float(inside.sum() * step**2)


@lru_cache(maxsize=100)
def _rays(camera: Camera, step: int) -> Array:
    """Rays (x, y, 1) of a grid of pixels, (n, 3)."""
    u, v = np.meshgrid(np.arange(step / 2, camera.width, step), np.arange(step / 2, camera.height, step))
    x = camera.normalise(np.stack([u.ravel(), v.ravel()], axis=1))
    return np.concatenate([x, np.ones((len(x), 1))], axis=1)
