"""Connected bright pixels of an image, and the windows in which they are measured."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

#: A rectangle of an image (u0, v0, u1, v1), u1 and v1 not included.
Box = tuple[int, int, int, int]
#: A bounding box (left, top, width, height) [px].
Bounds = tuple[int, int, int, int]

MARGIN = 3  # px between bright pixels and the border of their window
SIZES = (11, 15, 21, 31, 45, 63)  # px, sides of windows; a few sizes, so that many windows are measured at once
SIZE_FOR = [next(size for size in SIZES if size >= wanted) for wanted in range(SIZES[-1] + 1)]
COMPACT = 0.6  # share of a bounding box that a compact component fills, the centre of which is the box's
MAX_DEBLENDING_WINDOW = 31  # px, side of the largest window in which blobs are deblended
MAX_LED_SIZE = 14  # px, of a blob that is deblended; larger ones are lamps


class Component(NamedTuple):
    """Connected pixels: bounding box, number of pixels, and approximate centre (u, v) [px]."""

    bounds: Bounds
    pixels: int
    uv: tuple[float, float]


def components(above: NDArray[np.uint8]) -> list[Component]:
    """Find the connected pixels (8 neighbours) of a binary image (h, w).

    Contours take a tenth of the time of labels, which are needed only where a component has holes.
    """
    contours, hierarchy = cv2.findContours(above, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return []
    if len(contours) > 1 and (hierarchy[0, :, 3] >= 0).any():
        _, _, stats, centres = cv2.connectedComponentsWithStats(above, connectivity=8, ltype=cv2.CV_32S)
        return [
            Component((left, top, width, height), pixels, (u, v))
            for (left, top, width, height, pixels), (u, v) in zip(stats[1:].tolist(), centres[1:].tolist(), strict=True)
        ]
    found = []
    for contour in reversed(contours):
        # Pick's theorem: pixels within and on a polygon of pixel centres
        pixels = int(cv2.contourArea(contour) + len(contour) / 2 + 1)
        left, top, width, height = cv2.boundingRect(contour)
        if pixels >= COMPACT * width * height:
            uv = left + (width - 1) / 2, top + (height - 1) / 2
        else:
            m = cv2.moments(above[top : top + height, left : left + width], binaryImage=True)
            uv = left + m["m10"] / m["m00"], top + m["m01"] / m["m00"]
        found.append(Component((left, top, width, height), pixels, uv))
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
