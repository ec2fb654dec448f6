"""Size of an encoded image by its header, before anything is decoded."""

import struct
from typing import NamedTuple

MAX_PIXELS = 2**26  # pixels of a decoded image; a grey one of this size takes 64 MiB
MAX_SCANNED_PIXELS = 2**28  # pixels times scans: a progressive JPEG is decoded once per scan
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
JPEG_MAGIC = b"\xff\xd8\xff"
#: Channels by PNG's colour type: grey, RGB, palette (decoded to BGR), grey and alpha, RGB and alpha.
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 4, 6: 4}
#: JPEG's markers that begin a frame; the others from C0 to CF are tables.
_FRAMES = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})


class ImageHeader(NamedTuple):
    """Size [px], channels and bits per channel of an encoded image."""

    width: int
    height: int
    channels: int
    bits: int

    def __str__(self) -> str:
        return f"{self.width} x {self.height} pixels, {self.channels} channels of {self.bits} bits"


def read_image_header(data: bytes) -> ImageHeader | None:
    """Read the header of a PNG or JPEG; None if the bytes are neither, or end before it."""
    if data.startswith(PNG_MAGIC):
        return _png(data)
    if data.startswith(JPEG_MAGIC):
        return _jpeg(data)
    return None


def too_large(header: ImageHeader, data: bytes) -> str | None:
    """Return the reason why an image takes too much memory or time to decode; None if it does not."""
    pixels = header.width * header.height
    if pixels > MAX_PIXELS:
        return f"has {header.width} x {header.height} pixels, and {MAX_PIXELS} are decoded at most"
    scans = data.count(b"\xff\xda") if data.startswith(JPEG_MAGIC) else 1
    if pixels * scans > MAX_SCANNED_PIXELS and scans > 1:
        return f"has {header.width} x {header.height} pixels in {scans} scans, which takes too long to decode"
    return None


def _png(data: bytes) -> ImageHeader | None:
    if len(data) < 29 or data[12:16] != b"IHDR":
        return None
    width, height, bits, colour = struct.unpack_from(">IIBB", data, 16)
    return ImageHeader(width, height, _PNG_CHANNELS.get(colour, 4), 8 if colour == 3 else bits)


def _jpeg(data: bytes) -> ImageHeader | None:
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            return None
        marker = data[at + 1]
        if marker == 0xFF:  # filling
            at += 1
            continue
        if marker in _FRAMES and at + 10 <= len(data):
            bits, height, width, channels = struct.unpack_from(">BHHB", data, at + 4)
            return ImageHeader(width, height, channels, bits)
        if marker == 0xDA or not 0xC0 <= marker <= 0xFE:
            return None
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None
