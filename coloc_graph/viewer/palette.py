"""Colours that are distinguishable with any colour vision, light and dark, and in the colour space of three.js."""

import numpy as np
from numpy.typing import NDArray

from coloc_graph.report.drawing import COLOURS, GREY, INK

Colours = NDArray[np.uint8]

_SRGB = np.arange(256) / 255
_LINEAR = np.rint(
    255 * np.where(_SRGB <= 0.04045, _SRGB / 12.92, ((_SRGB + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
).astype(np.uint8)

_FLAT = (0.7 * np.arange(256)).astype(np.uint8)


def rgb(code: str) -> tuple[int, int, int]:
    """Return the colour of `#rrggbb`."""
    return int(code[1:3], 16), int(code[3:5], 16), int(code[5:7], 16)


ROBOTS: Colours = np.array([rgb(code) for code in COLOURS], np.uint8)
# residuals of 0, 0.5, ... 3 sigma: noise is blue, from there over amber to red
RESIDUAL_STOPS = ("#2c7bb6", "#2c7bb6", "#2c7bb6", "#2aa198", "#e6a019", "#dd5f2c", "#c51b3a")
_STOPS = np.array([rgb(code) for code in RESIDUAL_STOPS], float)
STOPS_PER_SIGMA = 2  # stops of the residual scale in one sigma
MAX_SIGMA = (len(_STOPS) - 1) / STOPS_PER_SIGMA
PICKED: Colours = np.array([255, 0, 170], np.uint8)
SIGHTING: Colours = np.array(rgb("#7b5ea7"), np.uint8)
LANDMARK: Colours = np.array(rgb("#d6a01e"), np.uint8)
ODOMETRY: Colours = np.array(rgb("#8a6d3b"), np.uint8)


def robot_colours(count: int, dark: bool = False) -> Colours:
    """Return one colour per robot (count, 3); the seventh has the first's again."""
    return seen_on(ROBOTS[np.arange(count) % len(ROBOTS)], dark)


def seen_on(colours: Colours, dark: bool) -> Colours:
    """Return colours (..., 3) made for a light background, lighter for a dark one."""
    return np.rint(colours + 0.3 * (255.0 - colours)).astype(np.uint8) if dark else colours


def ink(dark: bool) -> Colours:
    """Colour of text and truth."""
    return np.array((235, 238, 242) if dark else rgb(INK), np.uint8)


def grey(dark: bool) -> Colours:
    """Colour of rejected and of unknown measurements."""
    return np.array((150, 158, 168) if dark else rgb(GREY), np.uint8)


def paper(dark: bool) -> Colours:
    """Colour of the background."""
    return np.array((30, 33, 38) if dark else (255, 255, 255), np.uint8)


def faded(colours: Colours, dark: bool, share: float) -> Colours:
    """Mix colours (..., 3) with a share of the background."""
    return np.asarray(np.rint((1 - share) * colours.astype(float) + share * paper(dark)), np.uint8)


def residual_colours(sigmas: NDArray[np.float64], dark: bool) -> Colours:
    """Colours (n, 3) of residuals (n,) [sigma]; grey where they are not known."""
    at = STOPS_PER_SIGMA * np.clip(np.nan_to_num(sigmas), 0, MAX_SIGMA)
    low = np.minimum(at.astype(int), len(_STOPS) - 2)
    share = (at - low)[:, None]
    colours = np.rint(_STOPS[low] * (1 - share) + _STOPS[low + 1] * share).astype(np.uint8)
    return np.where(np.isfinite(sigmas)[:, None], seen_on(colours, dark), grey(dark))


def flat(colours: Colours) -> Colours:
    """Return darker colours for items on the floor, which the lights from above would wash out."""
    return np.asarray(_FLAT[colours])


def linear(colours: Colours) -> Colours:
    """Return linear colours, as viser expects of line vertices and batches, of sRGB ones."""
    return np.asarray(_LINEAR[colours])
