"""Geometry of images that show a region of a sensor, or binned pixels, as ROS `CameraInfo` describes them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coloc_graph.input_file import quoted
from coloc_graph.team.camera import MAX_SIDE

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ImageRegion:
    """Region of the full image, and the number of its pixels that are binned to one.

    Parameters
    ----------
    x, y
        Top-left pixel of the region [px of the full image].
    width, height
        Size of the region [px of the full image].
    binning
        Numbers of columns and rows that are averaged to one pixel.
    """

    x: int
    y: int
    width: int
    height: int
    binning: tuple[int, int]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the images [px]."""
        return self.width // self.binning[0], self.height // self.binning[1]

    def intrinsics(self, K: Array) -> Array:
        """Intrinsics of the images, (3, 3), from those of the full image.

        Notes
        -----
        A pixel's centre is a whole number here, so that pixel u of b binned ones is the full image's
        x + b u + (b - 1) / 2. ROS's image_geometry leaves out the last term, and so is off by (b - 1) / (2 b) px.
        """
        (b_x, b_y), of_images = self.binning, K.astype(float)
        of_images[0] = [K[0, 0] / b_x, K[0, 1] / b_x, (K[0, 2] - self.x - (b_x - 1) / 2) / b_x]
        of_images[1] = [K[1, 0] / b_y, K[1, 1] / b_y, (K[1, 2] - self.y - (b_y - 1) / 2) / b_y]
        return of_images

    def __str__(self) -> str:
        w, h = self.size
        binned = "" if self.binning == (1, 1) else f", binned to {w} x {h},"
        return f"{self.width} x {self.height} px at ({self.x}, {self.y}){binned}"


def image_region(size: tuple[int, int], roi: Sequence[Any], binning: Sequence[Any]) -> ImageRegion:
    """Region of a `CameraInfo`, whose `roi` of zeros is the full image and whose binning of 0 is none.

    Parameters
    ----------
    size
        Width and height of the full image [px].
    roi
        `x_offset`, `y_offset`, `width` and `height` as they were read [px of the full image].
    binning
        `binning_x` and `binning_y` as they were read.

    Raises
    ------
    ValueError
        A number is not a whole one, or the region is not within the image; the sentence has no subject.
    """
    for name, value in zip(("binning_x", "binning_y", "roi.x_offset", "roi.y_offset", "roi.width", "roi.height"),
                           (*binning, *roi), strict=True):  # fmt: skip
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= MAX_SIDE:
            raise ValueError(f"has `{name}` {quoted(value)}; give a whole number from 0 to {MAX_SIDE}")
    x, y, width, height = roi
    if not any(roi):
        width, height = size
    if not width or not height or x + width > size[0] or y + height > size[1]:
        raise ValueError(
            f"has a `roi` of {width} x {height} px at ({x}, {y}), and the full image is {size[0]} x {size[1]}; "
            "`roi` is in px of the full image: correct it, or leave it out"
        )
    region = ImageRegion(x, y, width, height, (max(binning[0], 1), max(binning[1], 1)))
    if 0 in region.size:
        raise ValueError(
            f"bins {region.binning[0]} x {region.binning[1]} px to one, and its images are {width} x {height}; "
            "correct `binning_x` and `binning_y`"
        )
    return region
