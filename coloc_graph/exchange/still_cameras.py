"""Find the movements of a robot by its own images: the background of a camera at rest is still.

The median of the images just before a time is compared with the median of those just after, which suppresses noise and
passing robots; slow changes of the light are filtered out in space. The same comparison across a pause in the recording
tells whether the camera was carried meanwhile. A camera that shakes for less than half a window is not noticed, nor is
one that sees only an even surface.
"""

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.exchange.stances import Movements
from coloc_graph.image_file import to_grey

Array = NDArray[np.float64]
Small = NDArray[np.float32]

WIDTH = 160  # px, width at which images are compared
BLUR = 1.2  # px
HIGH_PASS = 5.0  # px, scale above which differences are changes of the light
CLIP = 6.0  # grey levels at which a pixel's difference saturates, such as of a light or a reflection
WINDOW = 15  # images before and after
STRIDE = 3  # images between the times that are tested
QUANTILE = 0.8  # share of the pixels that are unchanged with a still background
USUAL = 0.3  # quantile of the changes that is taken for noise
RATIO = 1.8  # ratio to the usual change above which the camera moved
MIN_CHANGE = 1.0  # grey levels times the root of the number of images, of a movement
PAUSE = 3.0  # median intervals between images above which the recording paused


def movements_by_images(robot: str, times: Array, images: Iterable[NDArray[np.uint8]]) -> Movements:
    """Find the intervals in which a robot moved, by its images at ascending `times` (n,) [UTC s]."""
    small = [_small(image) for image in images]
    gaps = np.diff(times)
    part = np.concatenate([[0], np.cumsum(gaps > PAUSE * np.median(gaps))]) if len(gaps) else np.zeros(1, np.int64)
    looked = [k for k in range(len(small) - 1) if part[k] != part[k + 1] or k % STRIDE == 0]
    changes = np.array([_change(_window(small, part, k, -1), _window(small, part, k + 1, 1)) for k in looked])
    moved: list[tuple[float, float]] = []
    if len(changes):
        moving = changes > max(MIN_CHANGE, RATIO * float(np.quantile(changes, USUAL)))
        for n in np.flatnonzero(moving).tolist():
            k = looked[n]
            end = k + 1 if part[k] != part[k + 1] else min(k + STRIDE, len(small) - 1)
            if moved and moved[-1][1] >= times[k]:
                moved[-1] = moved[-1][0], float(times[end])
            else:
                moved.append((float(times[k]), float(times[end])))
    return Movements(robot, float(times[0]), float(times[-1]), tuple(moved))


def _window(small: list[Small], part: NDArray[np.int64], k: int, step: int) -> list[Small]:
    """Images from k on, forward or backward, up to a pause."""
    return [small[n] for n in range(k, k + step * WINDOW, step) if 0 <= n < len(small) and part[n] == part[k]]


def _small(image: NDArray[np.uint8]) -> Small:
    grey = to_grey(image)
    size = WIDTH, max(1, round(WIDTH * grey.shape[0] / grey.shape[1]))
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(small, (0, 0), BLUR), np.float32)


def _change(before: list[Small], after: list[Small]) -> float:
    """Difference of the medians of two groups of images [grey levels], normalised for their numbers."""
    a, b = (np.median(np.stack(one), axis=0) for one in (before, after))
    gain = (float(np.median(a)) + 1) / (float(np.median(b)) + 1)
    a, b = (np.clip(one - cv2.GaussianBlur(one, (0, 0), HIGH_PASS), -CLIP, CLIP) for one in (a, gain * b))
    return float(np.quantile(np.abs(a - b), QUANTILE) / np.sqrt(1 / len(before) + 1 / len(after)))
