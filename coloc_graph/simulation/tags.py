"""AprilTags in rendered images: drawn pixel by pixel through the lens."""

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.lie import se3_inverse
from coloc_graph.simulation.rendering import Field
from coloc_graph.team import Camera, Tag

Array = NDArray[np.float64]

#: Grey levels of a tag's black and white as they are lit, and how wide its white margin is [its side].
BLACK = 12.0
WHITE = 110.0
MARGIN = 0.2
SAMPLES = 4  # samples across a pixel, averaged
BLUR = 0.8  # px, blur of the lens
#: A tag is drawn where its rim is off the image by no more than this [px].
REACH = 40.0


def paint_tag(field: Field, camera: Camera, T_world_camera: Array, T_world_landmark: Array, tag: Tag) -> None:
    """Paint a tag over what is behind it, in place. It stands upright at the landmark, its face along x."""
    half = tag.size * (0.5 + MARGIN)
    side = np.linspace(-half, half, 9)
    rim = np.concatenate([[(y, z) for y in side for z in (-half, half)], [(y, z) for z in side for y in (-half, half)]])
    T_camera_landmark = se3_inverse(T_world_camera) @ T_world_landmark
    R, t = T_camera_landmark[:3, :3], T_camera_landmark[:3, 3] + T_camera_landmark[:3, 2] * tag.height
    n, d = R[:, 0], float(R[:, 0] @ t)
    points = rim @ R[:, 1:].T + t
    if d >= 0 or points[:, 2].min() < 0.05:
        return  # from behind, or not before the camera
    uv, _ = camera.project(points)
    if not np.isfinite(uv).all():
        return
    low = np.maximum(np.floor(uv.min(axis=0)) - 3, -REACH).astype(int)
    high = np.minimum(np.ceil(uv.max(axis=0)) + 4, (camera.width + REACH, camera.height + REACH)).astype(int)
    if (high <= low).any():
        return
    width, height = high - low
    steps = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    u, v = ((low[k] + np.arange(size)[:, None] + steps).ravel() for k, size in enumerate((width, height)))
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    x = camera.normalise(grid)
    rays = np.column_stack([x, np.ones(len(x))])
    with np.errstate(all="ignore"):
        p = rays * (d / (rays @ n))[:, None] - t
    y, z = p @ R[:, 1], p @ R[:, 2]
    inside = (np.abs(y) <= half) & (np.abs(z) <= half) & (rays @ n < 0)
    cells = _cells(tag.family, tag.id)
    size = len(cells)
    column = np.floor((0.5 + y / tag.size) * size).astype(int)  # the landmark's left is to the right of who sees it
    row = np.floor((0.5 - z / tag.size) * size).astype(int)
    black = (column >= 0) & (column < size) & (row >= 0) & (row < size)
    level = np.full(len(x), WHITE)
    level[black] = np.where(cells[row[black], column[black]], WHITE, BLACK)

    def pixels(values: Array) -> Array:
        means = values.reshape(height, SAMPLES, width, SAMPLES).mean(axis=(1, 3))
        return np.asarray(cv2.GaussianBlur(means, (0, 0), BLUR), float)

    light, share = pixels(np.where(inside, level, 0.0)), pixels(inside.astype(float))
    first, last = np.maximum(low, 0), np.minimum(high, (camera.width, camera.height))
    if (last <= first).any():
        return
    own = slice(first[1] - low[1], last[1] - low[1]), slice(first[0] - low[0], last[0] - low[0])
    patch = field[first[1] : last[1], first[0] : last[0]]
    patch += (light[own] - share[own] * patch).astype(np.float32)


@lru_cache(maxsize=64)
def _cells(family: str, number: int) -> NDArray[np.bool_]:
    """White cells of a tag, from the top left as it is seen."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_APRILTAG_{family}"))
    size = dictionary.markerSize + 2
    return np.asarray(cv2.aruco.generateImageMarker(dictionary, number, size) > 127)
