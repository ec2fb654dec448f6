"""Image files, read one way by everything that reads them: calibration, imports, recorded videos.

Names are sorted with their numbers as numbers. Pixels are upright, as every viewer shows them: EXIF's orientation is
applied. Alpha is dropped. 16 bits are taken to 8 by the true range of the sensor (10, 12, 14 or 16 bits), which the
brightest pixel of all images of a camera tells. What is 8 bits, grey or colour, and upright needs no change.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.input_file import read_bytes
from coloc_graph.run.image_header import read_image_header, too_large

Pixels = NDArray[np.uint8]

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")
REMEDY = "leave it out, or give it anew"


@dataclass(frozen=True, eq=False)
class DecodedImage:
    """An image as it is in a file: `pixels` upright, (h, w) grey or (h, w, 3) BGR, uint8 or uint16.

    `unchanged` tells that they are what any decoder makes of the file, without orientation, alpha or depth.
    """

    pixels: NDArray[np.uint8] | NDArray[np.uint16]
    unchanged: bool

    @property
    def top(self) -> int:
        """Largest value of a pixel."""
        return int(self.pixels.max(initial=0))


def natural_key(path: Path) -> list[list[tuple[int, str]]]:
    """Key that sorts paths part by part, with numbers as numbers."""
    return [
        [(int(word), "") if word.isdigit() else (-1, word) for word in re.split(r"([0-9]+)", part)]
        for part in path.parts
    ]


def images_in(folder: Path) -> list[Path]:
    """Image files of a folder in natural order; `InputError` where there are none."""
    inside = sorted((path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES), key=natural_key)
    if not inside:
        raise InputError(f"{folder} holds no images ({' '.join(SUFFIXES)}); give the folder of the images, or files")
    return inside


def image_paths(given: Sequence[str | Path]) -> list[Path]:
    """Image files, and those in folders in natural order; `InputError` where one is missing or given twice."""
    paths: list[Path] = []
    for one in map(Path, given):
        if one.is_dir():
            paths += images_in(one)
        elif not one.is_file():
            raise InputError(f"{one}: there is no such image; give image files, or a folder of them")
        else:
            paths.append(one)
    known: set[Path] = set()
    for path in paths:
        if path.resolve() in known:
            raise InputError(f"{path} is given twice, and would count twice; give each image once")
        known.add(path.resolve())
    return paths


def decode_image(data: bytes, what: str) -> DecodedImage:
    """Decode an image file's bytes; `InputError`, which names `what` it is, where it is damaged or too large."""
    header = read_image_header(data)
    why = too_large(header, data) if header is not None else None
    if why is not None:
        raise InputError(f"{what}: {why}; leave it out, or make it smaller")
    try:
        buffer = np.frombuffer(data, np.uint8)
        raw = cv2.imdecode(buffer, cv2.IMREAD_UNCHANGED) if data else None
        upright = cv2.imdecode(buffer, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR) if data else None
    except (cv2.error, MemoryError):
        raw = upright = None
    if raw is None or upright is None:
        raise InputError(f"{what}: cannot be read as an image; {REMEDY}")
    if upright.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{what}: has pixels of {upright.dtype}; save it with 8 or 16 bits a channel")
    same = raw.shape == upright.shape and raw.dtype == np.uint8 and bool(np.array_equal(raw, upright))
    return DecodedImage(cast(NDArray[np.uint8], upright), same)


def read_image(path: Path) -> DecodedImage:
    """Read an image file."""
    return decode_image(read_bytes(path, REMEDY), str(path))


def sensor_range(tops: Iterable[int]) -> int:
    """Number of values that a sensor of 16-bit images has, by the largest values `tops` of its images."""
    top = max(tops, default=0)
    return next((1 << bits for bits in (8, 10, 12, 14) if top < 1 << bits), 1 << 16)


def to_8_bits(image: DecodedImage, values: int | None = None) -> Pixels:
    """Pixels of 8 bits; 16 bits are scaled from a sensor's number of `values`, by default of this image alone."""
    pixels = image.pixels
    if pixels.dtype == np.uint8:
        return np.asarray(pixels, np.uint8)
    values = sensor_range([image.top]) if values is None else values
    return np.asarray(np.minimum(pixels.astype(np.uint32) * 256 // values, 255), np.uint8)


def to_grey(pixels: Pixels) -> Pixels:
    """Grey values (h, w) of grey or BGR pixels."""
    return pixels if pixels.ndim == 2 else np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), np.uint8)


def range_of(paths: Sequence[Path], first: DecodedImage) -> int | None:
    """Number of values of a camera's sensor, by all its images; None where the `first` has 8 bits."""
    if first.pixels.dtype == np.uint8:
        return None
    return sensor_range(read_image(path).top for path in paths)
