"""Marker centres in one image: white LEDs by brightness, coloured markers by hue, sub-pixel with covariance.

The centre is the fixed point of a Gaussian window that takes the blob's own shape (adaptive moments; Bernstein
and Jarvis, "Shapes and Shears, Stars and Smears", 2002). For a Gaussian spot this is the matched filter, so it
loses little against the Cramer-Rao bound, and being centred on the blob it has no bias from cut-off tails.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.run.messages import Flag
from coloc_graph.team import Markers

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Blobs:
    """Blobs of one image: `uv` (n, 2) [px], `covariance` (n, 2, 2) [px^2], `flags`, `peak`, `area` (n,)."""

    uv: Array
    covariance: Array
    flags: NDArray[np.uint8]
    peak: Array
    area: Array

    def __len__(self) -> int:
        return len(self.uv)

    def __getitem__(self, which: NDArray[np.bool_]) -> "Blobs":
        return Blobs(*(getattr(self, name)[which] for name in ("uv", "covariance", "flags", "peak", "area")))


#: Finds blobs in an image, or in a rectangle of it (u0, v0, u1, v1), u1 and v1 not included.
Detector = Callable[[Pixels, tuple[int, int, int, int] | None], Blobs]


@dataclass(frozen=True)
class Threshold:
    """What counts as a blob: so many grey levels above the background, so many pixels above that."""

    levels: float = 35.0
    min_area: int = 2
    max_area: int = 600
    saturation: int = 250
    elongation: float = 2.5  # longer than this many times its width: blurred
    shot_gain: float = 0.03  # variance in grey levels^2 that one grey level of light adds


def detector_for(markers: Markers | None, threshold: Threshold | None = None) -> Detector:
    """The detector of a kind of marker: by brightness, or by hue where the markers have one."""
    if markers is None or markers.hue_deg is None:
        return partial(detect_leds, threshold=threshold)
    return partial(detect_hue, hue_deg=markers.hue_deg, threshold=threshold)


def detect_leds(
    image: Pixels, box: tuple[int, int, int, int] | None = None, threshold: Threshold | None = None
) -> Blobs:
    """Bright blobs in a grey (or BGR) image, optionally only in a box of it."""
    u0, v0, u1, v1 = box or (0, 0, image.shape[1], image.shape[0])
    part = image[v0:v1, u0:u1]
    grey = part if part.ndim == 2 else part.max(axis=2)
    return _blobs(grey.astype(np.float32), (u0, v0), image.shape[:2], threshold or Threshold())


def detect_hue(
    image: Pixels,
    box: tuple[int, int, int, int] | None = None,
    *,
    hue_deg: float,
    threshold: Threshold | None = None,
    tolerance_deg: float = 18.0,
) -> Blobs:
    """Blobs of one hue in a BGR image: the light in pixels whose hue is within the tolerance and is not pale.

    A grey image holds no hue, and so no blob.
    """
    u0, v0, u1, v1 = box or (0, 0, image.shape[1], image.shape[0])
    part = image[v0:v1, u0:u1]
    if part.ndim == 2:
        return _none()
    hsv = cv2.cvtColor(np.ascontiguousarray(part), cv2.COLOR_BGR2HSV).astype(np.float32)
    off = np.abs((2 * hsv[..., 0] - hue_deg + 180) % 360 - 180)
    # chroma is linear in the light, and noise in a dark pixel, whose hue is random, has little of it
    chroma = hsv[..., 1] * hsv[..., 2] / 255
    light = np.where(off <= tolerance_deg, chroma, 0.0).astype(np.float32)
    return _blobs(light, (u0, v0), image.shape[:2], threshold or Threshold())


def _none() -> Blobs:
    return Blobs(np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0, np.uint8), np.empty(0), np.empty(0))


def _blobs(light: NDArray[np.float32], origin: tuple[int, int], shape: tuple[int, ...], t: Threshold) -> Blobs:
    background = float(np.median(light[::2, ::2]))
    above = (light > background + t.levels).astype(np.uint8)
    n, labels, stats, _ = cv2.connectedComponentsWithStats(above, connectivity=8)
    found = []
    for label in range(1, n):
        left, top, width, height, area = (int(value) for value in stats[label])
        if t.min_area <= area <= t.max_area:
            found.append(_measure(light, labels == label, (left, top, width, height), origin, shape, t))
    kept = [one for one in found if one is not None]
    if not kept:
        return _none()
    uv, covariance, flags, peak, area_ = zip(*kept, strict=True)
    return Blobs(np.array(uv), np.array(covariance), np.array(flags, np.uint8), np.array(peak), np.array(area_, float))


def _measure(
    light: NDArray[np.float32],
    mask: NDArray[np.bool_],
    box: tuple[int, int, int, int],
    origin: tuple[int, int],
    shape: tuple[int, ...],
    t: Threshold,
) -> tuple[Array, Array, int, float, int] | None:
    left, top, width, height = box
    margin = 4 + max(width, height) // 2
    x0, y0 = max(left - margin, 0), max(top - margin, 0)
    x1, y1 = min(left + width + margin, light.shape[1]), min(top + height + margin, light.shape[0])
    window = light[y0:y1, x0:x1].astype(float)
    inner = mask[y0:y1, x0:x1]
    ring = np.concatenate([window[[0, -1]].ravel(), window[1:-1, [0, -1]].ravel()])
    background = float(np.median(ring))
    noise = max(1.4826 * float(np.median(np.abs(ring - background))), 12**-0.5)
    signal = window - background
    X, Y = np.meshgrid(np.arange(x0, x1, dtype=float), np.arange(y0, y1, dtype=float))

    first = np.where(inner, signal, 0.0)
    total = first.sum()
    if total <= 0:
        return None
    centre = np.array([(first * X).sum(), (first * Y).sum()]) / total
    shape_2x2 = np.array([[1.0, 0.0], [0.0, 1.0]]) * max(inner.sum() / (2 * np.pi), 0.6)
    for _ in range(12):
        dx, dy = X - centre[0], Y - centre[1]
        P = np.linalg.inv(shape_2x2)
        w = np.exp(-0.5 * (P[0, 0] * dx * dx + 2 * P[0, 1] * dx * dy + P[1, 1] * dy * dy))
        ws = w * signal
        total = ws.sum()
        if total <= 0:
            return None
        # a Gaussian spot in a window of its own shape: half its shift and half its moments are seen
        step = 2 * np.array([(ws * dx).sum(), (ws * dy).sum()]) / total
        xx, xy, yy = (ws * dx * dx).sum() / total, (ws * dx * dy).sum() / total, (ws * dy * dy).sum() / total
        shape_2x2 = 2 * np.array([[xx, xy], [xy, yy]])
        eigenvalues = np.linalg.eigvalsh(shape_2x2)
        if eigenvalues[0] < 0.1 or not np.isfinite(eigenvalues).all():
            shape_2x2 = np.eye(2) * max(inner.sum() / (2 * np.pi), 0.6)
        centre = centre + np.clip(step, -1.0, 1.0)
        if np.abs(step).max() < 1e-3:
            break
    if not inner[
        np.clip(round(centre[1]) - y0, 0, inner.shape[0] - 1), np.clip(round(centre[0]) - x0, 0, inner.shape[1] - 1)
    ]:
        return None  # the window slid off the blob: there is no spot here

    variance = noise**2 + t.shot_gain * np.maximum(signal, 0.0)
    weight = w * w * variance
    spread = np.array(
        [[(weight * dx * dx).sum(), (weight * dx * dy).sum()], [(weight * dx * dy).sum(), (weight * dy * dy).sum()]]
    )
    covariance = 4 * spread / total**2

    short, long = np.sqrt(np.maximum(np.linalg.eigvalsh(shape_2x2), 1e-6))
    flags = Flag.NONE
    if (window[inner] >= t.saturation).any():
        flags |= Flag.SATURATED
    u, v = left + origin[0], top + origin[1]
    if u <= 0 or v <= 0 or u + width >= shape[1] or v + height >= shape[0]:
        flags |= Flag.CLIPPED
    if long > t.elongation * short:
        flags |= Flag.BLURRED
    # a spot fills the ellipse of its own moments; two that touch leave a waist
    if inner.sum() < 0.6 * width * height * np.pi / 4 and inner.sum() > 12:
        flags |= Flag.MERGED
    return centre + origin, covariance, int(flags), float(signal[inner].max()), int(inner.sum())
