"""Real infrared LEDs with reflections (OSVR): what is found, and what tells a core from a reflection.

    python benchmarks/led_images.py [--data DIR] [--grid DIR] [--out PICTURE.png]

The detector tells them by probability; the last line of a picture is the least certain of either kind. The threshold
was chosen on these pictures. Those of a grid of 35 LEDs by another camera (`learnt_noise.py`) were not used for it;
they stand beside, as they are and made worse.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.frontend import detect_leds
from coloc_graph.frontend.images.light_kinds import LED_PROBABILITY

Pixels = NDArray[np.uint8]

GRID = 35  # LEDs
NEAR = 3.0  # px, within which a light of a changed image is an LED's
CHANGES: dict[str, tuple[Callable[[Pixels], Pixels], float]] = {
    "as it is": (lambda image: image, 1.0),
    "a quarter of the pixels": (
        lambda image: np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8),
        0.5,
    ),
    "blurred by 1.5 px": (lambda image: np.asarray(cv2.GaussianBlur(image, (0, 0), 1.5), np.uint8), 1.0),
    "1.4 times as bright": (lambda image: _bytes(1.4 * image), 1.0),
    "0.6 times as bright": (lambda image: _bytes(0.6 * image), 1.0),
    "gamma 2.2": (lambda image: _bytes(255 * (image / 255) ** (1 / 2.2)), 1.0),
    "gamma 0.6": (lambda image: _bytes(255 * (image / 255) ** (1 / 0.6)), 1.0),
    "noise of 5 grey levels": (
        lambda image: _bytes(image + np.random.default_rng(0).normal(0, 5, image.shape)),
        1.0,
    ),
}
ROOT = Path(__file__).resolve().parents[1]
#: LED cores that a person sees in each picture [px], read off by eye.
SEEN = {
    "0001": "230,126 397,129 326,155 478,168 132,173 503,226 351,246 134,252 449,274 50,284 257,295 533,317 438,330 "
    "293,351 140,378",
    "0002": "231,128 397,131 325,155 478,169 132,175 504,228 352,247 135,253 450,276 50,285 257,297 534,319 439,332 "
    "295,355 140,380",
    "0003": "231,126 396,129 326,155 478,167 132,173 503,226 351,246 134,252 449,275 50,284 257,295 535,317 438,330 "
    "294,353 140,378",
    "0004": "231,128 397,130 327,156 478,169 132,175 504,228 351,246 135,253 450,276 49,284 257,297 534,319 439,332 "
    "294,355 140,380",
}


def _bytes(image: NDArray[np.float64]) -> Pixels:
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def grid_figures(folder: Path, change: Callable[[Pixels], Pixels], scale: float) -> tuple[int, int, int, int]:
    """Count LEDs of the grid, those found in changed images, and other lights there, and those taken for an LED."""
    counts = np.zeros(4, int)
    for path in sorted(folder.glob("*.png")):
        image = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
        places = (detect_leds(image).uv + 0.5) * scale - 0.5
        if len(places) != GRID:
            continue
        blobs = detect_leds(change(image))
        core = blobs.led > LED_PROBABILITY
        near = np.linalg.norm(places[:, None] - blobs.uv[None], axis=2) < NEAR * scale
        other = ~near.any(axis=0)
        counts += GRID, (near & core).any(axis=1).sum(), other.sum(), (other & core).sum()
    leds, found, others, taken = counts.tolist()
    return leds, found, others, taken


def main() -> int:
    """Print the table, draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data" / "led_images")
    parser.add_argument("--grid", type=Path, default=ROOT.parent / "shared" / "data" / "uvdar_led_grid")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    paths = sorted(args.data.glob("*.tif")) if args.data.is_dir() else []
    if not paths:
        print(f"{args.data}: no pictures; give the folder of 0001.tif to 0004.tif with --data", file=sys.stderr)
        return 2
    drawn = []
    for path in paths:
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        blobs = detect_leds(image)
        core = blobs.led > LED_PROBABILITY
        seen = np.array([[float(x) for x in place.split(",")] for place in SEEN[path.stem].split()])
        near = np.linalg.norm(seen[:, None] - blobs.uv[core][None], axis=2) < 6.0
        print(
            f"{path.name}: {near.any(axis=1).sum()} of {len(seen)} LED cores found, {(~near.any(axis=0)).sum()} more "
            f"called a core, {(~core).sum()} other lights; probability of the doubtfullest core "
            f"{blobs.led[core].min():.2f}, and of another light {blobs.led[~core].max(initial=0.0):.2f}"
        )
        for missed in seen[~near.any(axis=1)]:
            print(f"  missed {missed}")
        for extra in blobs.uv[core][~near.any(axis=0)]:
            print(f"  called a core: {extra.round(1)}")
        for uv, is_core, covariance in zip(blobs.uv, core, blobs.covariance, strict=True):
            colour = (150, 230, 60) if is_core else (0, 140, 255)
            centre = tuple(round(16 * float(x)) for x in uv)
            cv2.circle(image, centre, 16 * 17, colour, 1, cv2.LINE_AA, 4)
            if is_core:
                sigma = np.sqrt(np.trace(covariance) / 2)
                place = (int(uv[0]) + 14, int(uv[1]) - 12)
                cv2.putText(image, f"{sigma:.3f}", place, cv2.FONT_HERSHEY_SIMPLEX, 0.36, colour, 1, cv2.LINE_AA)
        drawn.append(image)
    for name, (change, scale) in CHANGES.items():
        leds, found, others, taken = grid_figures(args.grid, change, scale)
        print(f"grid, {name}: {found} of {leds} LEDs found, {taken} of {others} other lights taken for one")
    if args.out and len(drawn) >= 4:
        picture = np.vstack([np.hstack(drawn[:2]), np.hstack(drawn[2:4])])
        picture = cv2.resize(cv2.convertScaleAbs(picture, alpha=1.25, beta=8), None, fx=0.75, fy=0.75)
        cv2.imwrite(str(args.out), picture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
