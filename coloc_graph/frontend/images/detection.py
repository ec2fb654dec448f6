"""Detect markers in images: white LEDs by brightness, coloured markers by hue.

Detection has two steps. `Detector.find` quickly returns candidates, an approximate centre and the pixels around it,
which is all that a tracker needs. `Detector.measure` turns many candidates at once into blobs, with sub-pixel centres,
covariances and flags (`Flag`).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.frontend.images.centroid import at_points, axes, long_axis
from coloc_graph.frontend.images.components import (
    Bounds,
    Box,
    bounds_of,
    bright_pixels,
    components,
    deblending_group,
    find_bright,
    window_of,
)
from coloc_graph.frontend.images.deblending import measure_lights
from coloc_graph.frontend.images.light_kinds import Forms, forms_of_records, forms_of_windows, led_probability
from coloc_graph.run.messages import Flag
from coloc_graph.team import Camera, Markers

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]
Light = NDArray[np.uint8] | NDArray[np.float32]

BORDER = 20  # px around a search box that are examined; more than the radius of the largest blob and its margin
MAX_PADDED_PIXELS = 1 << 16  # windows are padded to a larger size while all together hold no more pixels
MIN_CONTRAST = 4.0  # of a blob's peak, in standard deviations of the noise around it
MAX_LIGHTS = 200  # lights of an image that are measured, the largest ones
DIP = 0.8  # brightness between two spots, as a share of the darker one, below which they count as two


@dataclass(frozen=True, eq=False)
class Blobs:
    """Blobs of one image: `uv` (n, 2) [px], `covariance` (n, 2, 2) [px^2], `flags`, `peak`, `area` (n,).

    `left_out` lights of the image were not measured, since it has more than `MAX_LIGHTS`. `looks` are those of all
    blobs of the image, and `numbers` (n,) are the blobs' rows in it.
    """

    uv: Array
    covariance: Array
    flags: NDArray[np.uint8]
    peak: Array
    area: Array
    left_out: int = 0
    looks: "Looks | None" = None
    numbers: NDArray[np.int64] | None = None

    def __len__(self) -> int:
        return len(self.uv)

    @property
    def led(self) -> Array:
        """Probabilities (n,) that they are LEDs, and no reflections or lamps, by their looks in the image."""
        if self.looks is not None and self.numbers is not None:
            return self.looks.led[self.numbers]
        return led_probability(forms_of_records(self.peak, self.area, (self.flags & Flag.BLURRED) != 0))

    def __getitem__(self, which: NDArray[np.bool_]) -> "Blobs":
        return Blobs(
            self.uv[which],
            self.covariance[which],
            self.flags[which],
            self.peak[which],
            self.area[which],
            self.left_out,
            self.looks,
            None if self.numbers is None else self.numbers[which],
        )


class _Group(NamedTuple):
    """Blobs that are measured together: their boxes and their window in the searched light, and its pixels (h, w)."""

    boxes: Sequence[Bounds]
    window: Box
    light: Light


class Candidate(NamedTuple):
    """Blob before it is measured.

    Attributes
    ----------
    uv
        Approximate centre [px].
    area
        Number of pixels above `level`.
    group
        Blobs with which it is deblended, and the light around them.
    number
        Index of its own box in the group.
    corner
        Pixel (u, v) of the first element of the group's window.
    level
        Grey level above which a pixel is bright.
    clipped
        True if the blob touches the border of the image.
    touched
        True if other blobs near it are too large or too many to be deblended.
    """

    uv: tuple[float, float]
    area: int
    group: _Group
    number: int
    corner: tuple[int, int]
    level: float
    clipped: bool
    touched: bool


class Looks:
    """Looks of all lights of one image; what they are is computed when it is asked for."""

    def __init__(self, detector: "Detector", candidates: Sequence[Candidate]) -> None:
        self._detector, self._candidates = detector, candidates

    @cached_property
    def led(self) -> Array:
        """Probabilities (n,) that they are LEDs."""
        return led_probability(self._detector.forms(self._candidates))


@dataclass(frozen=True)
class Threshold:
    """Thresholds on the brightness, size and shape of a blob."""

    levels: float = 35.0  # grey levels above the background
    min_area: int = 2  # px above that threshold
    max_area: int = 1000  # px
    saturation: int = 250  # grey level
    elongation: float = 2.5  # ratio of long to short axis above which a blob is flagged as blurred
    shot_gain: float = 0.1  # variance that one grey level of light adds [grey levels]


@dataclass(frozen=True)
class Detector:
    """Detector of markers by brightness, or by hue if `hue_deg` is given.

    Attributes
    ----------
    threshold
        Thresholds on brightness, size and shape.
    hue_deg
        Hue of the markers [deg, HSV]. In a grey image no marker with a hue is found.
    tolerance_deg
        Largest deviation from that hue [deg].
    """

    threshold: Threshold = field(default_factory=Threshold)
    hue_deg: float | None = None
    tolerance_deg: float = 18.0

    def __call__(self, image: Pixels, box: Box | None = None) -> Blobs:
        """Detect and measure the blobs of an image, or those with their centre in `box`."""
        found, left_out = self._found(image, box)
        blobs, real = self.measure(found)
        looks = Looks(self, [one for one, kept in zip(found, real.tolist(), strict=True) if kept])
        blobs = replace(blobs, looks=looks, numbers=np.cumsum(real) - 1)
        if box is not None:
            u, v = blobs.uv.T
            real &= (u >= box[0] - 0.5) & (v >= box[1] - 0.5) & (u < box[2] - 0.5) & (v < box[3] - 0.5)
        return replace(blobs[real], left_out=left_out)

    def forms(self, candidates: Sequence[Candidate]) -> Forms:
        """Measure the forms of candidates, by which LEDs are told from other lights."""
        t, levels = self.threshold, np.array([one.level for one in candidates])
        light = np.zeros((0, 1, 1)) if not candidates else _padded([one.group.light for one in candidates])[0]
        boxes = [one.group._replace(boxes=one.group.boxes[one.number : one.number + 1]) for one in candidates]
        inner = _in_boxes(light.shape[1], boxes) if candidates else np.zeros((0, 1, 1), bool)
        inner &= light > levels[:, None, None]
        background = levels - t.levels
        return forms_of_windows(light - background[:, None, None], inner, t.levels, t.saturation - background)

    def light(self, part: Pixels) -> Light:
        """Return the light of markers in a part of an image, (h, w) [grey levels]: brightness, or chroma of the hue."""
        if self.hue_deg is None:
            return part if part.ndim == 2 else np.asarray(part.max(axis=2))
        if part.ndim == 2:
            return np.zeros(part.shape, np.uint8)
        hsv = cv2.cvtColor(np.ascontiguousarray(part), cv2.COLOR_BGR2HSV).astype(np.float32)
        off = np.abs((2 * hsv[..., 0] - self.hue_deg + 180) % 360 - 180)
        # chroma is linear in the light, and noise in a dark pixel, whose hue is random, has little of it
        chroma = hsv[..., 1] * hsv[..., 2] / 255
        return np.where(off <= self.tolerance_deg, chroma, 0.0).astype(np.float32)

    def find(self, image: Pixels, box: Box | None = None) -> list[Candidate]:
        """Find the candidates in an image, or those whose centre lies within a pixel of `box`; `MAX_LIGHTS` at most."""
        return self._found(image, box)[0]

    def _found(self, image: Pixels, box: Box | None = None) -> tuple[list[Candidate], int]:
        """Find the candidates as `find` does, and count those that are left out."""
        u0, v0 = (max(box[0] - BORDER, 0), max(box[1] - BORDER, 0)) if box else (0, 0)
        light = self.light(image[v0 : box[3] + BORDER, u0 : box[2] + BORDER] if box else image)
        t = self.threshold
        area = (0, 0, light.shape[1], light.shape[0])
        if box is not None:
            area = (box[0] - u0, box[1] - v0, box[2] - u0, box[3] - v0)
        level, bright = find_bright(light, area, t.levels, t.min_area, t.max_area)
        left_out = max(len(bright) - MAX_LIGHTS, 0)
        if left_out:
            bright = sorted(bright, key=lambda one: -one[1])[:MAX_LIGHTS]
        found = []
        groups: dict[Bounds, _Group] = {}
        every = None
        for own, pixels, (u, v), window, crowded in bright:
            group, touched = groups.get(own), False
            if group is None:
                boxes = [own]
                if crowded:
                    every = components(bright_pixels(light, level)) if every is None else every
                    boxes = deblending_group(own, every, light.shape)
                    touched = not boxes
                    boxes = boxes or [own]
                    window = window_of(bounds_of(boxes), light.shape)
                group = _Group(boxes, window, light[window[1] : window[3], window[0] : window[2]].copy())
                groups |= dict.fromkeys(boxes, group)
            left, top, width, height = own
            clipped = left + u0 <= 0 or top + v0 <= 0
            clipped |= left + u0 + width >= image.shape[1] or top + v0 + height >= image.shape[0]
            number, corner = group.boxes.index(own), (u0 + group.window[0], v0 + group.window[1])
            found.append(Candidate((u + u0, v + v0), pixels, group, number, corner, level, clipped, touched))
        return found, left_out

    def measure(self, candidates: Sequence[Candidate]) -> tuple[Blobs, NDArray[np.bool_]]:
        """Measure candidates.

        Returns
        -------
        tuple
            One blob a candidate, and a mask (n,) that is False for noise and bright edges.
        """
        n = len(candidates)
        uv, covariance = np.zeros((n, 2)), np.zeros((n, 2, 2))
        flags, peak, real = np.zeros(n, np.uint8), np.zeros(n), np.zeros(n, bool)
        for rows in _batches([max(one.group.light.shape) for one in candidates]):
            own = [candidates[row] for row in rows]
            uv[rows], covariance[rows], flags[rows], peak[rows], real[rows] = self._measure(own)
        return Blobs(uv, covariance, flags, peak, np.array([one.area for one in candidates], float)), real

    def _measure(self, candidates: list[Candidate]) -> tuple[Array, Array, NDArray[np.uint8], Array, NDArray[np.bool_]]:
        t = self.threshold
        groups = {id(one.group): one.group for one in candidates}
        light, size = _padded([one.light for one in groups.values()])
        counts = np.array([len(one.boxes) for one in groups.values()])
        first = dict(zip(groups, (np.cumsum(counts) - counts).tolist(), strict=True))
        wanted = np.array([first[id(one.group)] + one.number for one in candidates])
        window = np.repeat(np.arange(len(groups)), counts)
        levels = np.empty(len(groups))
        levels[window[wanted]] = [one.level for one in candidates]
        inner = _in_boxes(light.shape[1], groups.values())
        inner &= (light > levels[:, None, None])[window]
        spots, touching = measure_lights(light, size, inner, window, wanted, t.levels, t.shot_gain)
        inner, n, own = inner[wanted], np.arange(len(candidates)), window[wanted]
        pixel = np.minimum(np.maximum(np.rint(spots.centre), 0), size[own] - 1).astype(int)
        # a window that slid off its candidate found no spot there
        real = spots.found & inner[n, pixel[:, 1], pixel[:, 0]] & (spots.peak >= MIN_CONTRAST * spots.noise)

        short, long = axes(spots.shape)
        flags = np.zeros(len(candidates), np.uint8)
        at_limit = light >= t.saturation
        if at_limit.any():
            flags[(at_limit[own] & inner).any(axis=(1, 2))] |= np.uint8(Flag.SATURATED)
        flags[[one.clipped for one in candidates]] |= np.uint8(Flag.CLIPPED)
        flags[long > t.elongation * short] |= np.uint8(Flag.BLURRED)
        touching |= [one.touched for one in candidates]
        drawn_out = np.flatnonzero(long > 1.4 * short)
        if len(drawn_out):
            # one spot, even motion-blurred, has one hump along its long axis; two that touch have a dip in between
            steps = np.linspace(-1.25, 1.25, 11)
            along = long[drawn_out, None] * long_axis(spots.shape[drawn_out])
            points = spots.centre[drawn_out] + steps[:, None, None] * along
            rows = np.tile(drawn_out, len(steps))
            humps = at_points(spots.signal, rows, points.reshape(-1, 2), size[own]).reshape(len(steps), -1)
            dip = humps[3:8].min(axis=0) < DIP * np.minimum(humps[:5].max(axis=0), humps[6:].max(axis=0))
            touching[drawn_out[dip]] = True
        flags[touching] |= np.uint8(Flag.MERGED)
        corners = np.array([one.corner for one in candidates], float)
        return spots.centre + corners, spots.covariance, flags, spots.peak, real


def _batches(sizes: Sequence[int]) -> list[list[int]]:
    """Batches of windows, by index, that are padded to one size, from the windows' sides [px]."""
    order = sorted(range(len(sizes)), key=sizes.__getitem__)
    together: list[list[int]] = []
    for size, rows in groupby(order, key=sizes.__getitem__):
        if not together or len(together[-1]) * size**2 > MAX_PADDED_PIXELS:
            together.append([])
        together[-1] += rows
    return together


def _padded(windows: Sequence[Light]) -> tuple[Array, NDArray[np.int64]]:
    """Pad windows of several sizes into square ones (n, s, s), and return them with their sizes (n, 2) [px: u, v]."""
    shapes = np.array([window.shape for window in windows])
    side = shapes.max()
    if (shapes == side).all():
        return np.array(windows, float), shapes
    light = np.zeros((len(windows), side, side))
    for row, window in zip(light, windows, strict=True):
        row[: window.shape[0], : window.shape[1]] = window
    return light, shapes[:, ::-1]


def _in_boxes(side: int, groups: Iterable[_Group]) -> NDArray[np.bool_]:
    """Masks (m, side, side) of the pixels of the groups' windows that lie in their boxes, one after the other."""
    boxes = np.array([(*box, *one.window[:2]) for one in groups for box in one.boxes])
    begin = boxes[:, :2] - boxes[:, 4:]
    pixel = np.arange(side)
    along = (pixel >= begin[:, :, None]) & (pixel < (begin + boxes[:, 2:4])[:, :, None])
    return np.asarray(along[:, 1, :, None] & along[:, 0, None, :])


def detector_for(markers: Markers | None, camera: Camera | None = None) -> Detector:
    """Return the detector of a kind of marker in a camera: by hue if the markers have one, else by brightness."""
    threshold = Threshold(shot_gain=camera.shot_gain) if camera is not None else Threshold()
    return Detector(threshold, markers.hue_deg if markers is not None else None)


def detect_leds(image: Pixels, box: Box | None = None, threshold: Threshold | None = None) -> Blobs:
    """Detect bright blobs in a grey or BGR image.

    Parameters
    ----------
    image
        Image, (h, w) or (h, w, 3), uint8.
    box
        Part of the image to search, (u0, v0, u1, v1) [px], end excluded; by default all.
    threshold
        Thresholds on brightness, size and shape.

    Returns
    -------
    Blobs
        Measured blobs.
    """
    return Detector(threshold or Threshold())(image, box)


def detect_hue(image: Pixels, box: Box | None = None, *, hue_deg: float, threshold: Threshold | None = None) -> Blobs:
    """Detect blobs of one hue in a BGR image.

    Parameters
    ----------
    image, box, threshold
        As in `detect_leds`.
    hue_deg
        Hue [deg, HSV].

    Returns
    -------
    Blobs
        Measured blobs.
    """
    return Detector(threshold or Threshold(), hue_deg)(image, box)
