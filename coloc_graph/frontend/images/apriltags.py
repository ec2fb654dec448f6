"""Measure AprilTags as two markers at the height of the tag's centre: the midpoints of its left and right edge.

OpenCV finds a tag and decodes its number, but its corners scatter by half a pixel. Here each of the four edges is
located by several intensity profiles across it, and a line is fitted through them, in normalised coordinates, where
edges are straight whatever the lens distortion.
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

PROFILES = 15  # intensity profiles across each edge
END_MARGIN = 0.12  # share of an edge's length left out at either end
INWARDS = 0.5  # reach of a profile into the tag, in cells; white cells may follow
OUTWARDS = 0.8  # reach of a profile out of the tag, in cells
MAX_PROFILE_REACH = 4.0  # px, in either direction
SAMPLES_PER_PIXEL = 4  # along a profile
ROUNDS = 3  # times that the profiles are centred anew on the edges
BLACK_PERCENTILE = 10.0  # percentile of a tag's grey levels that is taken for its black
MIN_CONTRAST = 15.0  # grey levels, of an edge
MAX_SCATTER = 0.6  # px, of the profiles across an edge; more means that something occludes it
MAX_LEAN = np.deg2rad(30.0)  # rad, from upright; of a tag on its side the left edge would be on top


@dataclass(frozen=True, eq=False)
class FoundTag:
    """Tag in one image.

    Attributes
    ----------
    family, id
        AprilTag family, such as "36h11", and number.
    uv
        Midpoints of the right and of the left edge as the camera sees them, (2, 2) [px]. The right edge is at the
        tag's own left, +y of a landmark that faces the camera.
    covariance
        Image noise of both midpoints, (2, 2, 2) [px^2].
    """

    family: str
    id: int
    uv: Array
    covariance: Array


def find_tags(pixels: NDArray[np.uint8], camera: Camera, families: Collection[str]) -> list[FoundTag]:
    """Find the upright tags of the given families in an image, grey or BGR; faint or occluded ones are left out."""
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
    """Measure the midpoints of a tag's right and left edge.

    Parameters
    ----------
    grey
        Grey image.
    camera
        Camera that took it.
    corners
        Approximate corners, clockwise from the tag's top left, (4, 2) [px].
    cells
        Width of the tag, border included, in cells.

    Returns
    -------
    tuple of numpy.ndarray
        Both midpoints, (2, 2) [px], and the covariance of each, (2, 2, 2) [px^2].

    Raises
    ------
    DegenerateGeometry
        The tag hangs on its side, is partly occluded, or too faint.
    """
    down = (corners[3] + corners[2] - corners[0] - corners[1]) / 2
    if abs(np.arctan2(down[0], down[1])) > MAX_LEAN:
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
    if noise.max() > MAX_SCATTER:
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
    """Points where profiles cross the edges from `starts` to `ends`, (4, n, 2) [px], and their weights, 0 or 1, (4, n).

    The integral of a profile, from the black inside to the white outside, tells where a sharp edge would lie.
    """
    way = ends - starts
    length = np.linalg.norm(way, axis=1)
    outwards = np.stack([way[:, 1], -way[:, 0]], axis=1) / length[:, None]
    # what is across an edge is along its neighbours, and less of it the more a tag is turned away
    cell = (np.roll(length, 1) + np.roll(length, -1)) / 2 / cells
    inner, outer = (np.clip(share * cell, 1.0, MAX_PROFILE_REACH)[:, None] for share in (INWARDS, OUTWARDS))
    count = int(np.ceil((inner + outer).max() * SAMPLES_PER_PIXEL)) + 1
    offsets = -inner + (inner + outer) * np.linspace(0, 1, count)
    at = starts[:, None] + np.linspace(END_MARGIN, 1 - END_MARGIN, PROFILES)[:, None] * way[:, None]
    places = (at[:, :, None] + offsets[:, None, :, None] * outwards[:, None, None]).astype(np.float32)
    u, v = (places[..., k].reshape(4 * PROFILES, count) for k in range(2))
    light = cv2.remap(grey.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    light = light.reshape(4, PROFILES, count).astype(float)
    rim = max(count // 6, 1)
    # by edge, since a margin that is white is so along all of it; the black one is too narrow for a blur to leave it so
    inside = np.full(4, np.percentile(_across(grey, starts), BLACK_PERCENTILE))
    outside = np.median(light[..., -rim:].reshape(4, -1), axis=1)
    contrast = outside - inside
    if contrast.min() < MIN_CONTRAST:
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
    """Grey levels of a tag on a grid over it."""
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
    """Midpoints of the right and left edge, (2, 2) [px], of a square whose edges pass through points (4, n, 2) [px].

    The diagonals meet at the centre; the line of half height goes from there to the vanishing point of top and bottom.
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
