"""Bright connected pixels of an image, and the windows in which they are measured.

`kernel/components.c` computes the same, and is changed along with it: `tests/frontend/test_kernel.py` compares them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.frontend.compiled import kernel

#: A rectangle of an image (u0, v0, u1, v1), u1 and v1 not included.
Box = tuple[int, int, int, int]
#: A bounding box (left, top, width, height) [px].
Bounds = tuple[int, int, int, int]
#: Bright blob: bounding box, number of pixels, approximate centre (u, v) [px], window in which it is measured, and True
#: if other bright pixels are in that.
Bright = tuple[Bounds, int, tuple[float, float], Box, bool]

RIM = 4  # px around a search box that are examined first
MARGIN = 3  # px between bright pixels and the border of their window
SIZES = (11, 15, 21, 31, 45, 63)  # px, sides of windows; a few sizes, so that many windows are measured at once
SIZE_FOR = [next(size for size in SIZES if size >= wanted) for wanted in range(SIZES[-1] + 1)]
COMPACT_PERCENT = 60  # of a bounding box, at least, is filled by a compact component, the centre of which is the box's
MAX_DEBLENDING_WINDOW = 31  # px, side of the largest window in which blobs are deblended
MAX_LED_SIZE = 14  # px, of a blob that is deblended; larger ones are lamps


class Component(NamedTuple):
    """Connected pixels: bounding box, number of pixels, and approximate centre (u, v) [px]."""

    bounds: Bounds
    pixels: int
    uv: tuple[float, float]


def find_bright(
    light: NDArray[np.uint8] | NDArray[np.float32], box: Box, levels: float, min_area: int, max_area: int
) -> tuple[float, list[Bright]]:
    """Find the bright blobs whose centre lies within a pixel of a box.

    Parameters
    ----------
    light
        Light of markers, (h, w) [grey levels].
    box
        Part of the light to search. A rim around it is examined as well, and all the light if the rim cuts a blob.
    levels
        Height of the threshold above the background, which is the median of the box [grey levels].
    min_area, max_area
        Bounds on the number of pixels of a blob.

    Returns
    -------
    tuple
        Grey level above which a pixel is bright, and the blobs.
    """
    if kernel is not None and light.dtype == np.uint8 and light.strides[1] == 1:
        compiled: tuple[float, list[Bright]] = kernel.find_bright(light, box, levels, min_area, max_area)
        return compiled
    height, width = light.shape
    area = max(box[0] - RIM, 0), max(box[1] - RIM, 0), min(box[2] + RIM, width), min(box[3] + RIM, height)
    part = light[area[1] : area[3], area[0] : area[2]]
    if not part.size:
        return levels, []
    # some fifty pixels tell the median to a grey level, and a small list is sorted faster than an array
    coarse = max(1, min(part.shape) // 6)
    few = sorted(part[::coarse, ::coarse].ravel().tolist())
    level = float(few[len(few) // 2]) + levels
    above = bright_pixels(light, level)
    blobs = components(above[area[1] : area[3], area[0] : area[2]])
    if any(cut_off(blob, area, light.shape) for blob in blobs):
        area = (0, 0, width, height)
        blobs = components(above)
    found: list[Bright] = []
    for (left, top, *size), pixels, (x, y) in blobs:
        u, v = x + area[0], y + area[1]
        inside = box[0] - 1 <= u < box[2] + 1 and box[1] - 1 <= v < box[3] + 1
        if inside and min_area <= pixels <= max_area:
            own = left + area[0], top + area[1], size[0], size[1]
            window = window_of(own, light.shape)
            around = above[window[1] : window[3], window[0] : window[2]]
            crowded = max(size) <= MAX_LED_SIZE and cv2.countNonZero(around) > pixels
            found.append((own, pixels, (u, v), window, crowded))
    return level, found


def bright_pixels(light: NDArray[np.uint8] | NDArray[np.float32], level: float) -> NDArray[np.uint8]:
    """Binary image (h, w) of the pixels above a level."""
    return cv2.threshold(light, level, 255, cv2.THRESH_BINARY)[1].astype(np.uint8, copy=False)


def components(above: NDArray[np.uint8]) -> list[Component]:
    """Find the connected pixels (8 neighbours) of a binary image (h, w).

    Contours take a tenth of the time of labels, which are needed only where a component has holes or is not compact.
    """
    contours, hierarchy = cv2.findContours(above, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return []
    found = []
    if len(contours) == 1 or (hierarchy[0, :, 3] < 0).all():
        for contour in reversed(contours):
            # Pick's theorem: pixels within and on a polygon of pixel centres
            pixels = int(cv2.contourArea(contour) + len(contour) / 2 + 1)
            left, top, width, height = cv2.boundingRect(contour)
            if 100 * pixels < COMPACT_PERCENT * width * height:
                break
            uv = left + (width - 1) / 2, top + (height - 1) / 2
            found.append(Component((left, top, width, height), pixels, uv))
        else:
            return found
    _, _, stats, centres = cv2.connectedComponentsWithStats(above, connectivity=8, ltype=cv2.CV_32S)
    found = []
    for (left, top, width, height, pixels), (u, v) in zip(stats[1:].tolist(), centres[1:].tolist(), strict=True):
        if 100 * pixels >= COMPACT_PERCENT * width * height:
            u, v = left + (width - 1) / 2, top + (height - 1) / 2
        found.append(Component((left, top, width, height), pixels, (u, v)))
    return found


def cut_off(component: Component, area: Box, shape: tuple[int, ...]) -> bool:
    """Return whether a component is cut by the border of the searched area inside the light (h, w)."""
    left, top, width, height = component.bounds
    return (
        (left == 0 and area[0] > 0)
        or (top == 0 and area[1] > 0)
        or (left + width == area[2] - area[0] and area[2] < shape[1])
        or (top + height == area[3] - area[1] and area[3] < shape[0])
    )


def window_of(bounds: Bounds, shape: tuple[int, ...]) -> Box:
    """Smallest standard window that holds a box with a margin, moved to lie in the light (h, w)."""
    left, top, width, height = bounds
    wanted = max(width, height) + 2 * MARGIN
    size = SIZE_FOR[wanted] if wanted < len(SIZE_FOR) else wanted
    x = max(min(left + (width - size) // 2, shape[1] - size), 0)
    y = max(min(top + (height - size) // 2, shape[0] - size), 0)
    return x, y, x + size, y + size


def bounds_of(boxes: Sequence[Bounds]) -> Bounds:
    """Bounding box of boxes."""
    left, top = min(box[0] for box in boxes), min(box[1] for box in boxes)
    return left, top, max(box[0] + box[2] for box in boxes) - left, max(box[1] + box[3] for box in boxes) - top


def deblending_group(own: Bounds, every: Sequence[Component], shape: tuple[int, ...]) -> list[Bounds]:
    """Boxes of a blob and of all that must be deblended with it, since they lie in the window of the group.

    Returns an empty list if the group is too large.
    """
    group = [own]
    while True:
        u0, v0, u1, v1 = window_of(bounds_of(group), shape)
        if u1 - u0 > MAX_DEBLENDING_WINDOW or max(max(box[2:]) for box in group) > MAX_LED_SIZE:
            return []
        more = [
            one.bounds
            for one in every
            if one.bounds[0] < u1
            and one.bounds[1] < v1
            and one.bounds[0] + one.bounds[2] > u0
            and one.bounds[1] + one.bounds[3] > v0
            and one.bounds not in group
        ]
        if not more:
            return group
        group += more
