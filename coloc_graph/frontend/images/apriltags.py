"""AprilTags in images, as two markers at the height of their centre: the middles of their left and right edge.

OpenCV finds a tag and reads its number; its corners scatter by half a pixel. Here the four edges are measured, each by
many profiles across it, and lines are laid through them: these are straight in normalised coordinates, whatever the
lens.
"""

from collections.abc import Collection
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.team import Camera

Array = NDArray[np.float64]

#: An edge is measured by so many profiles, between these shares of its length.
PROFILES = 15
ENDS = 0.12
#: A profile reaches this share of a cell inwards, where white cells may follow, and outwards; no further than so [px].
INWARDS = 0.5
OUTWARDS = 0.8
FARTHEST = 4.0
#: A profile is sampled this often in a pixel, and centred on the edge so many times.
STEPS = 4
ROUNDS = 3
#: So many percent of a tag are darker than what is called its black.
DARKEST = 10.0
#: An edge that is fainter than this is none [grey levels].
LEAST_CONTRAST = 15.0
#: An edge's profiles scatter by more than noise makes them where something is in front of it [px].
MOST_SCATTER = 0.6
#: A tag leans by no more than this [rad]: one that hangs on its side has its left edge above.
MOST_LEAN = np.deg2rad(30.0)


@dataclass(frozen=True, eq=False)
class FoundTag:
    """A tag in one image: the middles of its right and of its left edge, as seen, `uv` (2, 2) [px], with the noise of
    this image in them, `covariance` (2, 2, 2) [px^2].

    The right edge is at the tag's own left, +y of a landmark that faces the camera.
    """

    family: str
    id: int
    uv: Array
    covariance: Array


def find_tags(pixels: NDArray[np.uint8], camera: Camera, families: Collection[str]) -> list[FoundTag]:
    """The upright tags of some families in an image, grey or BGR; what is too faint or hidden in part is left out."""
    grey = pixels if pixels.ndim == 2 else np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), np.uint8)
    found = []
    for family in sorted(families):
        detector, cells = _detector(family)
        corners, ids, _ = detector.detectMarkers(grey)
        for quad, number in zip(corners, [] if ids is None else ids.ravel().tolist(), strict=True):
            try:
                uv, covariance = measure_tag(grey, camera, np.asarray(quad, float).reshape(4, 2), cells)
            except DegenerateGeometry:
                continue
            found.append(FoundTag(family, int(number), uv, covariance))
    return found


def measure_tag(grey: NDArray[np.uint8], camera: Camera, corners: Array, cells: int) -> tuple[Array, Array]:
    """The middles of a tag's right and left edge (2, 2) [px], and the covariance (2, 2, 2) that noise gives each.

    `corners` (4, 2) [px] are roughly those from its top left on, clockwise as it is read; it is so many `cells` wide.
    Raises `DegenerateGeometry` where it hangs on its side, is hidden in part, or too faint.
    """
    down = (corners[3] + corners[2] - corners[0] - corners[1]) / 2
    if abs(np.arctan2(down[0], down[1])) > MOST_LEAN:
        raise DegenerateGeometry("the tag does not hang upright: turn it")
    starts, ends = corners, np.roll(corners, -1, axis=0)  # top, right, bottom, left
    for _ in range(ROUNDS):
        points, weights = _edge_points(grey, starts, ends, cells)
        lines, scatter = _lines(points, weights)
        meet = np.cross(np.roll(lines, 1, axis=0), lines)
        starts = meet[:, :2] / meet[:, 2:]
        ends = np.roll(starts, -1, axis=0)
        if not (np.abs(starts - corners).max() < 0.2 * np.linalg.norm(down)):
            raise DegenerateGeometry("the tag's edges are not where its corners are: something is in front of it")
    noise = np.maximum(scatter, 0.02)
    if noise.max() > MOST_SCATTER:
        raise DegenerateGeometry("an edge of the tag is not straight: something is in front of it, or it is bent")
    middles = _middles(camera, points, weights)
    # each edge moves and turns by itself, by what its profiles scatter; they are independent
    way = ends - starts
    across = np.stack([way[:, 1], -way[:, 0]], axis=1) / np.linalg.norm(way, axis=1, keepdims=True)
    along = np.linspace(-1, 1, PROFILES) / np.sqrt((np.linspace(-1, 1, PROFILES) ** 2).mean())
    columns = []
    for edge in range(4):
        sigma = noise[edge] / np.sqrt(max(weights[edge].sum(), 1.0))
        for mode in (np.ones(PROFILES), along):
            moved = points.copy()
            moved[edge] += sigma * mode[:, None] * across[edge]
            columns.append((_middles(camera, moved, weights) - middles).ravel())
    root = np.array(columns).T
    C = root @ root.T
    return middles, np.stack([C[:2, :2], C[2:, 2:]])


@lru_cache(maxsize=8)
def _detector(family: str) -> "tuple[cv2.aruco.ArucoDetector, int]":
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_APRILTAG_{family}"))
    return cv2.aruco.ArucoDetector(dictionary, cv2.aruco.DetectorParameters()), int(dictionary.markerSize) + 2


def _edge_points(grey: NDArray[np.uint8], starts: Array, ends: Array, cells: int) -> tuple[Array, Array]:
    """Where the edges (4) from `starts` to `ends` are crossed: (4, n, 2) [px], and which crossings count (4, n).

    The light of a profile, from the black inside to the white outside, tells where it would change if it did at once.
    """
    way = ends - starts
    length = np.linalg.norm(way, axis=1)
    outwards = np.stack([way[:, 1], -way[:, 0]], axis=1) / length[:, None]
    # what is across an edge is along its neighbours, and less of it the more a tag is turned away
    cell = (np.roll(length, 1) + np.roll(length, -1)) / 2 / cells
    inner, outer = (np.clip(share * cell, 1.0, FARTHEST)[:, None] for share in (INWARDS, OUTWARDS))
    count = int(np.ceil((inner + outer).max() * STEPS)) + 1
    offsets = -inner + (inner + outer) * np.linspace(0, 1, count)
    at = starts[:, None] + np.linspace(ENDS, 1 - ENDS, PROFILES)[:, None] * way[:, None]
    places = (at[:, :, None] + offsets[:, None, :, None] * outwards[:, None, None]).astype(np.float32)
    u, v = (places[..., k].reshape(4 * PROFILES, count) for k in range(2))
    light = cv2.remap(grey.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    light = light.reshape(4, PROFILES, count).astype(float)
    rim = max(count // 6, 1)
    # by edge, since a margin that is white is so along all of it; the black one is too narrow for a blur to leave it so
    inside = np.full(4, np.percentile(_across(grey, starts), DARKEST))
    outside = np.median(light[..., -rim:].reshape(4, -1), axis=1)
    contrast = outside - inside
    if contrast.min() < LEAST_CONTRAST:
        raise DegenerateGeometry("an edge of the tag is too faint: give it a white margin, and light")
    share = (light - inside[:, None, None]) / contrast[:, None, None]
    area = (share[..., 1:] + share[..., :-1]).sum(axis=-1) / 2 * (inner + outer) / (count - 1)
    crossed = outer - area
    weights = ((crossed > -0.9 * inner) & (crossed < 0.9 * outer)).astype(float)
    height, width = grey.shape
    weights *= ((places > 0) & (places < (width - 1, height - 1))).all(axis=(2, 3))
    if (weights.sum(axis=1) < PROFILES / 2).any():
        raise DegenerateGeometry("an edge of the tag is hidden, or beyond the border of the image")
    return at + crossed[..., None] * outwards[:, None], weights


def _across(grey: NDArray[np.uint8], corners: Array) -> Array:
    """The light of a tag at many places of it."""
    s, t = (axis.ravel()[:, None] for axis in np.meshgrid(*[np.linspace(0.05, 0.95, 24)] * 2))
    places = (1 - t) * ((1 - s) * corners[0] + s * corners[1]) + t * ((1 - s) * corners[3] + s * corners[2])
    u, v = places.astype(np.float32).T
    light = cv2.remap(grey.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(light, float).ravel()


def _lines(points: Array, weights: Array) -> tuple[Array, Array]:
    """Lines (4, 3), homogeneous, through points (4, n, 2) by least squares, and their scatter (4,) across them."""
    total = weights.sum(axis=1)
    middle = np.einsum("en,enk->ek", weights, points) / total[:, None]
    off = (points - middle[:, None]) * np.sqrt(weights)[..., None]
    values, vectors = np.linalg.eigh(np.einsum("enk,enl->ekl", off, off))
    normal = vectors[..., 0]
    scatter = np.sqrt(values[:, 0].clip(min=0) / np.maximum(total - 2, 1.0))
    return np.column_stack([normal, -(normal * middle).sum(axis=1)]), scatter


def _middles(camera: Camera, points: Array, weights: Array) -> Array:
    """The middles of the right and of the left edge (2, 2) [px] of a square whose edges go through points (4, n, 2).

    The middle of its height is where the diagonals meet, and the line from there goes where top and bottom edge meet.
    """
    x = camera.normalise(points.reshape(-1, 2)).reshape(points.shape)
    lines, _ = _lines(x, weights)
    top, right, bottom, left = lines
    corners = np.cross(np.roll(lines, 1, axis=0), lines)
    centre = np.cross(np.cross(corners[0], corners[2]), np.cross(corners[1], corners[3]))
    level = np.cross(centre, np.cross(top, bottom))
    found = np.stack([np.cross(level, right), np.cross(level, left)])
    uv, _ = camera.project(np.column_stack([found[:, :2] / found[:, 2:], np.ones(2)]))
    return uv
