"""Shapes of a layer that are the same at any time, computed once; a frame selects from them."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from coloc_graph.viewer import palette
from coloc_graph.viewer.scene import Array, Edges, Index, Layer, Links, Mask, Scene

Float32 = NDArray[np.float32]

Z_EDGE = 0.13  # m over the floor
Z_SIGHTING = 0.15  # m over the floor
Z_ODOMETRY = 0.05  # m over the floor


class CovarianceShapes:
    """Ellipses and wedges of a layer for one sigma.

    Attributes
    ----------
    known
        (r, s), True for a pose with a covariance that differs from the pose before.
    axes
        (r, s, 2), semi-axes of the ellipses [m].
    position_wxyz, heading_wxyz
        (r, s, 4), quaternions of ellipses and wedges, w first.
    """

    def __init__(self, layer: Layer) -> None:
        finite = np.isfinite(layer.covariance).all(axis=(2, 3)) & np.isfinite(layer.yaw_sigma)
        self.known = layer.arrived & finite
        covariance = np.where(finite[..., None, None], layer.covariance, 0.0)
        axes, direction = ellipse_axes(covariance)
        self.axes = axes.astype(np.float32)
        self.position_wxyz, self.heading_wxyz = about_z(direction), about_z(np.nan_to_num(layer.yaw))


class DrawnEdges:
    """Edges between the poses of a layer: `ends` (m, 2, 3) [m], `there` (m,) if both exist, colours (m, 3)."""

    def __init__(self, layer: Layer, edges: Edges, dark: bool) -> None:
        self.ends = _ends(layer, edges.i, edges.rows, edges.j, edges.rows, Z_EDGE)
        self.there: Mask = np.asarray(np.isfinite(self.ends).all(axis=(1, 2)))
        self.now = palette.residual_colours(edges.sigmas, dark)
        self.past = palette.faded(self.now, dark, 0.25)


@lru_cache(maxsize=8)
def covariance_shapes(layer: Layer) -> CovarianceShapes:
    """Ellipses and wedges of a layer."""
    return CovarianceShapes(layer)


@lru_cache(maxsize=8)
def edges_of(layer: Layer, edges: Edges, dark: bool) -> DrawnEdges:
    """Ends and colours of edges."""
    return DrawnEdges(layer, edges, dark)


@lru_cache(maxsize=8)
def links_of(layer: Layer, links: Links, z: float) -> Float32:
    """Ends (m, 2, 3) [m] of links, NaN for a robot without a pose."""
    return _ends(layer, links.i, links.rows_i, links.j, links.rows_j, z)


def _ends(layer: Layer, i: Index, rows_i: Index, j: Index, rows_j: Index, z: float) -> Float32:
    ends = np.stack([layer.xyz[i, rows_i], layer.xyz[j, rows_j]], axis=1).astype(np.float32)
    ends[..., 2] = np.where(np.isfinite(ends[..., 2]), z, np.nan)
    return ends


def ellipse_axes(covariance: Array) -> tuple[Array, Array]:
    """Semi-axes (..., 2) [m], the longer first, and its direction (...) [rad] of covariances (..., 2, 2)."""
    a, b, c = covariance[..., 0, 0], covariance[..., 1, 1], covariance[..., 0, 1]
    middle, spread = (a + b) / 2, np.hypot((a - b) / 2, c)
    axes = np.sqrt(np.stack([middle + spread, middle - spread], axis=-1).clip(min=0))
    return axes, np.arctan2(c, (a - b) / 2) / 2


def about_z(angle: Array) -> Float32:
    """Quaternions (..., 4), w first, of turns (...) [rad] about z."""
    out = np.zeros((*np.shape(angle), 4), np.float32)
    out[..., 0], out[..., 3] = np.cos(angle / 2), np.sin(angle / 2)
    return out


def readable_sigma(scene: Scene) -> float:
    """Number of sigmas, 3 to 100, at which the largest ellipse is visible but not larger than its surroundings."""
    if not scene.layers or not scene.layers[0].there.any():
        return 3.0
    covariance = scene.layers[0].covariance[scene.layers[0].there]
    largest = float(np.sqrt(np.nanmax(covariance.trace(axis1=1, axis2=2), initial=0.0)))
    return next((k for k in (100.0, 30.0, 10.0) if k * largest < 0.3), 3.0) if largest > 0 else 3.0
