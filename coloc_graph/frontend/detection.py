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
from scipy.ndimage import map_coordinates

from coloc_graph.run.messages import Flag
from coloc_graph.team import Camera, Markers

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

#: How far around a box is looked at [px]: more than the radius of the largest blob, and its margin.
BORDER = 20
#: A blob's peak is at least this many times the noise around it.
LEAST_CONTRAST = 4.0
#: Two spots touch where the middle is darker than this part of the darker side.
DIP = 0.8


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
    shot_gain: float = 0.1  # variance in grey levels^2 that one grey level of light adds


def detector_for(markers: Markers | None, camera: Camera | None = None) -> Detector:
    """The detector of a kind of marker: by brightness, or by hue where the markers have one."""
    threshold = Threshold(shot_gain=camera.shot_gain) if camera is not None else Threshold()
    if markers is None or markers.hue_deg is None:
        return partial(detect_leds, threshold=threshold)
    return partial(detect_hue, hue_deg=markers.hue_deg, threshold=threshold)


def detect_leds(
    image: Pixels, box: tuple[int, int, int, int] | None = None, threshold: Threshold | None = None
) -> Blobs:
    """Bright blobs in a grey (or BGR) image, optionally only in a box of it."""
    part, origin = _around(image, box)
    grey = part if part.ndim == 2 else part.max(axis=2)
    return _inside(_blobs(grey.astype(np.float32), origin, image.shape[:2], threshold or Threshold()), box)


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
    part, origin = _around(image, box)
    if part.ndim == 2:
        return _none()
    hsv = cv2.cvtColor(np.ascontiguousarray(part), cv2.COLOR_BGR2HSV).astype(np.float32)
    off = np.abs((2 * hsv[..., 0] - hue_deg + 180) % 360 - 180)
    # chroma is linear in the light, and noise in a dark pixel, whose hue is random, has little of it
    chroma = hsv[..., 1] * hsv[..., 2] / 255
    light = np.where(off <= tolerance_deg, chroma, 0.0).astype(np.float32)
    return _inside(_blobs(light, origin, image.shape[:2], threshold or Threshold()), box)


def _around(image: Pixels, box: tuple[int, int, int, int] | None) -> tuple[Pixels, tuple[int, int]]:
    """The box with what is around it, so that a blob on its border is measured whole, and where that begins."""
    if box is None:
        return image, (0, 0)
    u0, v0 = max(box[0] - BORDER, 0), max(box[1] - BORDER, 0)
    return image[v0 : box[3] + BORDER, u0 : box[2] + BORDER], (u0, v0)


def _inside(blobs: Blobs, box: tuple[int, int, int, int] | None) -> Blobs:
    if box is None:
        return blobs
    u, v = blobs.uv.T
    return blobs[(u >= box[0] - 0.5) & (v >= box[1] - 0.5) & (u < box[2] - 0.5) & (v < box[3] - 0.5)]


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
            found.append(
                _measure(light, np.asarray(labels, np.int32), label, (left, top, width, height), origin, shape, t)
            )
    kept = [one for one in found if one is not None]
    if not kept:
        return _none()
    uv, covariance, flags, peak, area_ = zip(*kept, strict=True)
    return Blobs(np.array(uv), np.array(covariance), np.array(flags, np.uint8), np.array(peak), np.array(area_, float))


def _background(window: Array, levels: float) -> tuple[Array, float]:
    """The light that would be there without the blob, (h, w), and the noise of a pixel [grey levels].

    Between the window's borders (two pixels wide) rows and columns are interpolated (a Coons patch), which is
    exact for whatever is a sum of a profile in x and one in y. A marker stands on a robot whose dark rim often
    passes right behind it: with a constant background that edge pulls the centre by 0.04 px.
    """
    left, right = window[:, :2].mean(axis=1), window[:, -2:].mean(axis=1)
    top, bottom = window[:2].mean(axis=0), window[-2:].mean(axis=0)
    middle = float(np.median(np.concatenate([left, right, top, bottom])))
    left, right, top, bottom = (np.clip(side, middle - levels, middle + levels) for side in (left, right, top, bottom))
    x, y = np.linspace(0, 1, window.shape[1]), np.linspace(0, 1, window.shape[0])[:, None]
    rows = left[:, None] * (1 - x) + right[:, None] * x
    columns = top * (1 - y) + bottom * y
    corners = (1 - y) * ((left[0] + top[0]) / 2 * (1 - x) + (right[0] + top[-1]) / 2 * x) + y * (
        (left[-1] + bottom[0]) / 2 * (1 - x) + (right[-1] + bottom[-1]) / 2 * x
    )
    steps = np.concatenate([np.diff(window[[0, -1]], axis=1).ravel(), np.diff(window[:, [0, -1]], axis=0).ravel()])
    noise = 1.4826 * float(np.median(np.abs(steps))) / np.sqrt(2)
    return rows + columns - corners, max(noise, 12**-0.5)


def _measure(
    light: NDArray[np.float32],
    labels: NDArray[np.int32],
    label: int,
    box: tuple[int, int, int, int],
    origin: tuple[int, int],
    shape: tuple[int, ...],
    t: Threshold,
) -> tuple[Array, Array, int, float, int] | None:
    left, top, width, height = box
    margin = 3
    x0, y0 = max(left - margin, 0), max(top - margin, 0)
    x1, y1 = min(left + width + margin, light.shape[1]), min(top + height + margin, light.shape[0])
    window = light[y0:y1, x0:x1].astype(float)
    inner = labels[y0:y1, x0:x1] == label
    background, noise = _background(window, t.levels)
    signal = window - background
    if signal[inner].max() < LEAST_CONTRAST * noise:
        return None
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
    # the background's own noise: a row (column) of it is the mean of four pixels, and off as a whole
    off = noise**2 / 4 * np.array([((w * dx).sum(axis=0) ** 2).sum(), ((w * dy).sum(axis=1) ** 2).sum()])
    spread = np.array(
        [[(weight * dx * dx).sum(), (weight * dx * dy).sum()], [(weight * dx * dy).sum(), (weight * dy * dy).sum()]]
    )
    covariance = 4 * (spread + np.diag(off)) / total**2

    eigenvalues, axes = np.linalg.eigh(shape_2x2)
    short, long = np.sqrt(np.maximum(eigenvalues, 1e-6))
    flags = Flag.NONE
    if (window[inner] >= t.saturation).any():
        flags |= Flag.SATURATED
    u, v = left + origin[0], top + origin[1]
    if u <= 0 or v <= 0 or u + width >= shape[1] or v + height >= shape[0]:
        flags |= Flag.CLIPPED
    if long > t.elongation * short:
        flags |= Flag.BLURRED
    # a spot, drawn out or not, is brightest in the middle; two that touch are darker there than to both sides
    along = centre + np.array([[0.0], [-1.0], [1.0]]) * long * axes[:, 1] - (x0, y0)
    middle, *sides = map_coordinates(signal, along[:, ::-1].T, order=1)
    if long > 1.4 * short and middle < DIP * min(sides):
        flags |= Flag.MERGED
    return centre + origin, covariance, int(flags), float(signal[inner].max()), int(inner.sum())
