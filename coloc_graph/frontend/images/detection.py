"""Detect markers in images: white LEDs by brightness, coloured markers by hue.

Detection has two steps. `Detector.find` quickly returns candidates, an approximate centre and the pixels around it,
which is all that a tracker needs. `Detector.measure` turns many candidates at once into blobs, with sub-pixel centres,
covariances and flags (`Flag`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.frontend.images.centroid import at_points, axes, measure_first
from coloc_graph.run.messages import Flag
from coloc_graph.team import Camera, Markers

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]
#: A rectangle of an image (u0, v0, u1, v1), u1 and v1 not included.
Box = tuple[int, int, int, int]

BORDER = 20  # px around a search box that are examined; more than the radius of the largest blob and its margin
RIM = 4  # px around a search box that are examined first
MAX_SINGLE_SPOT_AREA = 400  # px, bounding box of bright pixels that may be one spot without labelling
MARGIN = 3  # px between a candidate and the border of its window
SIZES = (11, 15, 21, 31, 45, 63)  # px, sides of windows; a few sizes, so that many windows are measured at once
SIZE_FOR = [next(size for size in SIZES if size >= wanted) for wanted in range(SIZES[-1] + 1)]
MAX_PADDED_PIXELS = 1 << 16  # windows are padded to a larger size while all together hold no more pixels
MAX_DEBLENDING_WINDOW = 31  # px, side of the largest window in which blobs are deblended
MAX_LED_SIZE = 14  # px, of a blob that is deblended; larger ones are lamps
MIN_CONTRAST = 4.0  # of a blob's peak, in standard deviations of the noise around it
MAX_LIGHTS = 200  # lights of an image that are measured, the largest ones
DIP = 0.8  # brightness between two spots, as a share of the darker one, below which they count as two


@dataclass(frozen=True, eq=False)
class Blobs:
    """Blobs of one image: `uv` (n, 2) [px], `covariance` (n, 2, 2) [px^2], `flags`, `peak`, `area` (n,).

    `left_out` lights of the image were not measured, since it has more than `MAX_LIGHTS`.
    """

    uv: Array
    covariance: Array
    flags: NDArray[np.uint8]
    peak: Array
    area: Array
    left_out: int = 0

    def __len__(self) -> int:
        return len(self.uv)

    def __getitem__(self, which: NDArray[np.bool_]) -> "Blobs":
        return Blobs(
            self.uv[which], self.covariance[which], self.flags[which], self.peak[which], self.area[which], self.left_out
        )


@dataclass(frozen=True, eq=False, slots=True)
class Candidate:
    """Blob before it is measured.

    Attributes
    ----------
    uv
        Approximate centre [px].
    area
        Number of pixels above `level`.
    window
        Light around the blob, (h, w) [grey levels].
    corner
        Pixel (u, v) of the window's first element.
    box
        Bounding box of the blob's bright pixels, (left, top, width, height) [px in the window].
    level
        Grey level above which a pixel is bright.
    clipped
        True if the blob touches the border of the image.
    others
        Bounding boxes of other blobs in the window.
    touched
        True if another blob in the window is too large to be deblended.
    """

    uv: tuple[float, float]
    area: int
    window: NDArray[np.uint8] | NDArray[np.float32]
    corner: tuple[int, int]
    box: tuple[int, int, int, int]
    level: float
    clipped: bool
    others: tuple[tuple[int, int, int, int], ...] = ()
    touched: bool = False


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
        if box is not None:
            u, v = blobs.uv.T
            real &= (u >= box[0] - 0.5) & (v >= box[1] - 0.5) & (u < box[2] - 0.5) & (v < box[3] - 0.5)
        return replace(blobs[real], left_out=left_out)

    def light(self, part: Pixels) -> NDArray[np.uint8] | NDArray[np.float32]:
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
        if box is None:
            area = (0, 0, light.shape[1], light.shape[0])
        else:  # the box and a rim; what is cut by the rim is looked at again with all that is around
            left, top = max(box[0] - RIM - u0, 0), max(box[1] - RIM - v0, 0)
            area = (left, top, min(box[2] + RIM - u0, light.shape[1]), min(box[3] + RIM - v0, light.shape[0]))
        part = light[area[1] : area[3], area[0] : area[2]]
        # some fifty pixels tell the median to a grey level, and a small list is sorted faster than an array
        coarse = max(1, min(part.shape) // 6)
        few = sorted(part[::coarse, ::coarse].ravel().tolist())
        level = float(few[len(few) // 2]) + t.levels
        blobs = _components(part, level)
        if box is not None and any(_cut_off(blob, area, light.shape) for blob, _ in blobs):
            area = (0, 0, light.shape[1], light.shape[0])
            blobs = _components(light, level)
        every = blobs if area == (0, 0, light.shape[1], light.shape[0]) else None
        blobs = [one for one in blobs if t.min_area <= one[0][4] <= t.max_area]
        left_out = max(len(blobs) - MAX_LIGHTS, 0)
        if left_out:
            blobs = sorted(blobs, key=lambda one: -one[0][4])[:MAX_LIGHTS]
        found = []
        for (left, top, width, height, pixels), (x, y) in blobs:
            left, top = left + area[0], top + area[1]
            u, v = x + area[0] + u0, y + area[1] + v0
            inside = box is None or (box[0] - 1 <= u < box[2] + 1 and box[1] - 1 <= v < box[3] + 1)
            if inside:
                clipped = left + u0 <= 0 or top + v0 <= 0
                clipped |= left + u0 + width >= image.shape[1] or top + v0 + height >= image.shape[0]
                own = (left, top, width, height)
                window = _window(own, light.shape)
                # any other light there?
                around = light[window[1] : window[3], window[0] : window[2]]
                group: list[tuple[int, int, int, int]] = []
                touched = False
                if max(width, height) <= MAX_LED_SIZE and np.count_nonzero(around > level) > pixels:
                    every = _components(light, level) if every is None else every
                    group, touched = _deblending_group(own, [tuple(blob) for blob, _ in every], light.shape)
                if len(group) < 2:
                    corner = window[0] + u0, window[1] + v0
                    box_in_window = left - window[0], top - window[1], width, height
                    one = Candidate((u, v), pixels, around.copy(), corner, box_in_window, level, clipped, (), touched)
                    found.append(one)
                else:
                    found.append(_cut(light, group, (u0, v0), (u, v), pixels, level, clipped, touched))
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
        for rows in _batches([max(one.window.shape) for one in candidates]):
            own = [candidates[row] for row in rows]
            uv[rows], covariance[rows], flags[rows], peak[rows], real[rows] = self._measure(own)
        return Blobs(uv, covariance, flags, peak, np.array([one.area for one in candidates], float)), real

    def _measure(self, candidates: list[Candidate]) -> tuple[Array, Array, NDArray[np.uint8], Array, NDArray[np.bool_]]:
        t = self.threshold
        light, size = _padded([one.window for one in candidates])
        boxes = np.array([box for one in candidates for box in (one.box, *one.others)])
        counts = np.array([1 + len(one.others) for one in candidates])
        window, first = np.repeat(np.arange(len(candidates)), counts), np.cumsum(counts) - counts
        level = np.array([one.level for one in candidates])[:, None, None]
        each = _in_boxes(light.shape, boxes) & (light > level)[window]
        inner = each[first]
        spots, touching = measure_first(light, size, each, window, t.levels, t.shot_gain)
        peak = np.where(inner, spots.signal, 0.0).max(axis=(1, 2))
        n = np.arange(len(candidates))
        pixel = np.clip(np.rint(spots.centre), 0, size - 1).astype(int)
        # a window that slid off its candidate found no spot there
        on_it = inner[n, pixel[:, 1], pixel[:, 0]]
        real = spots.found & on_it & (peak >= MIN_CONTRAST * spots.noise)

        short, long, along = axes(spots.shape)
        # one spot, even motion-blurred, has one hump along its long axis; two that touch have a dip in between
        steps = np.linspace(-1.25, 1.25, 11)
        points = spots.centre + steps[:, None, None] * (long[:, None] * along)
        humps = at_points(spots.signal, np.tile(n, len(steps)), points.reshape(-1, 2), size).reshape(len(steps), -1)
        dip = humps[3:8].min(axis=0) < DIP * np.minimum(humps[:5].max(axis=0), humps[6:].max(axis=0))
        flags = np.zeros(len(candidates), np.uint8)
        flags[(inner & (light >= t.saturation)).any(axis=(1, 2))] |= np.uint8(Flag.SATURATED)
        flags[np.array([one.clipped for one in candidates])] |= np.uint8(Flag.CLIPPED)
        flags[long > t.elongation * short] |= np.uint8(Flag.BLURRED)
        touching |= np.array([one.touched for one in candidates])
        flags[touching | ((long > 1.4 * short) & dip)] |= np.uint8(Flag.MERGED)
        corners = np.array([one.corner for one in candidates], float)
        return spots.centre + corners, spots.covariance, flags, peak, real


def _components(light: NDArray[np.uint8] | NDArray[np.float32], level: float) -> list[tuple[list[int], list[float]]]:
    """Connected pixels above a level: (left, top, width, height, pixels) and the approximate centre of each."""
    above = cv2.threshold(light, level, 255, cv2.THRESH_BINARY)[1]
    if above.dtype != np.uint8:
        above = above.astype(np.uint8)
    left, top, width, height = cv2.boundingRect(above)
    if not width:
        return []
    if max(width, height) <= 1.5 * min(width, height) + 1 and width * height <= MAX_SINGLE_SPOT_AREA:
        # most patches hold one compact spot, which needs no labels: two apart would leave the box half empty
        pixels = cv2.countNonZero(above)
        if pixels >= 0.6 * width * height:
            return [([left, top, width, height, pixels], [left + (width - 1) / 2, top + (height - 1) / 2])]
    _, _, stats, centres = cv2.connectedComponentsWithStats(above, connectivity=8, ltype=cv2.CV_16U)
    return list(zip(stats[1:].tolist(), centres[1:].tolist(), strict=True))


def _cut_off(blob: list[int], area: Box, shape: tuple[int, ...]) -> bool:
    """Return whether a blob is cut by the border of the searched area inside the light (h, w)."""
    left, top, width, height, _ = blob
    return (
        (left == 0 and area[0] > 0)
        or (top == 0 and area[1] > 0)
        or (left + width == area[2] - area[0] and area[2] < shape[1])
        or (top + height == area[3] - area[1] and area[3] < shape[0])
    )


def _window(box: tuple[int, int, int, int], shape: tuple[int, ...]) -> Box:
    """Smallest standard window that holds a box with a margin, moved to lie in the light (h, w)."""
    left, top, width, height = box
    wanted = max(width, height) + 2 * MARGIN
    size = SIZE_FOR[wanted] if wanted < len(SIZE_FOR) else wanted
    x = max(min(left + (width - size) // 2, shape[1] - size), 0)
    y = max(min(top + (height - size) // 2, shape[0] - size), 0)
    return x, y, x + size, y + size


def _around(boxes: Sequence[tuple[int, int, int, int]]) -> tuple[int, int, int, int]:
    """Bounding box of boxes (left, top, width, height)."""
    left, top = min(box[0] for box in boxes), min(box[1] for box in boxes)
    return left, top, max(box[0] + box[2] for box in boxes) - left, max(box[1] + box[3] for box in boxes) - top


def _deblending_group(
    own: tuple[int, int, int, int], blobs: Sequence[tuple[int, ...]], shape: tuple[int, ...]
) -> tuple[list[tuple[int, int, int, int]], bool]:
    """Boxes of a blob and of all that must be deblended with it, since they lie in the window of the group.

    Returns only its own box, and True, if the group is too large.
    """
    group = [own]
    while True:
        window = _window(_around(group), shape)
        if window[2] - window[0] > MAX_DEBLENDING_WINDOW or max(max(box[2:]) for box in group) > MAX_LED_SIZE:
            return [own], True
        more = [
            blob
            for blob in blobs
            if blob[0] < window[2]
            and blob[1] < window[3]
            and blob[0] + blob[2] > window[0]
            and blob[1] + blob[3] > window[1]
            and blob[:4] not in group
        ]
        if not more:
            return group, False
        group += [(blob[0], blob[1], blob[2], blob[3]) for blob in more]


def _cut(
    light: NDArray[np.uint8] | NDArray[np.float32],
    group: Sequence[tuple[int, int, int, int]],
    origin: tuple[int, int],
    uv: tuple[float, float],
    area: int,
    level: float,
    clipped: bool,
    touched: bool,
) -> Candidate:
    """Candidate with a window that holds all boxes of a group, the first of which is its own."""
    x, y, end_x, end_y = _window(_around(group), light.shape)
    box, *others = ((left - x, top - y, width, height) for left, top, width, height in group)
    window = light[y:end_y, x:end_x].copy()
    corner = (x + origin[0], y + origin[1])
    return Candidate(uv, area, window, corner, box, level, clipped, tuple(others), touched)


def _batches(sizes: Sequence[int]) -> list[list[int]]:
    """Batches of windows, by index, that are padded to one size, from the windows' sides [px]."""
    order = sorted(range(len(sizes)), key=sizes.__getitem__)
    together: list[list[int]] = []
    for size, rows in groupby(order, key=sizes.__getitem__):
        if not together or len(together[-1]) * size**2 > MAX_PADDED_PIXELS:
            together.append([])
        together[-1] += rows
    return together


def _padded(windows: Sequence[NDArray[np.uint8] | NDArray[np.float32]]) -> tuple[Array, NDArray[np.int64]]:
    """Pad windows of several sizes into one array (n, h, w), and return it with their sizes (n, 2) [px: u, v]."""
    shapes = np.array([window.shape for window in windows])
    light = np.zeros((len(windows), *shapes.max(axis=0)))
    for row, window in zip(light, windows, strict=True):
        row[: window.shape[0], : window.shape[1]] = window
    return light, shapes[:, ::-1]


def _in_boxes(shape: tuple[int, ...], boxes: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Masks (m, h, w) of the pixels of windows that lie in boxes (m, 4)."""
    left, top, width, height = boxes.T[..., None]
    x, y = np.arange(shape[2]), np.arange(shape[1])
    in_x, in_y = (x >= left) & (x < left + width), (y >= top) & (y < top + height)
    return np.asarray(in_y[..., :, None] & in_x[..., None, :])


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
