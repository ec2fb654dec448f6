"""Draw the pictures of docs/: those of examples/, and good and bad recordings for docs/recording.md.

    python scripts/docs_pictures.py [NAME ...]      all, or examples, or recording

Images are rendered by the simulator's own camera model.
"""

import os
import runpy
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("MPLBACKEND", "agg")

import cv2
import numpy as np

from coloc_graph.geometry.lie import floor_pose
from coloc_graph.simulation import Sensor, reference_team
from coloc_graph.simulation.scenery import RobotInView, backdrop, draw, scenery_along

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"
GAP = 6  # px between two panels
TEAM = reference_team()
CAMERA, MOUNT, MARKERS = TEAM["A"].camera, TEAM["A"].mount, TEAM["C"].markers
WHITE, GREEN, RED = (255, 255, 255), (90, 220, 90), (90, 90, 255)  # BGR


def images(path, sensor=None, observer=(0.0, 0.0, 0.0), speed=None):
    """Render images (n, h, w) of a mover at poses (n, 3), as an observer sees it that stands at x, y, yaw."""
    sensor, rng = sensor or Sensor(), np.random.default_rng(1)
    T_world_camera = floor_pose(*observer) @ MOUNT.T_body_camera
    field = backdrop(CAMERA, T_world_camera, scenery_along(0.0, 2.0, np.random.default_rng(3)), rng)
    moved = np.gradient(path, axis=0) if speed is None else np.full_like(path, speed)
    per_image = 0.1 if speed is None else 1.0
    half = moved * sensor.exposure / per_image / 2
    bodies = [floor_pose(*(path + shift).T) for shift in (0.0 * half, -half, half)]
    view = RobotInView(CAMERA, [T_world_camera] * 3, bodies, MARKERS.p_body, sensor)
    noise = (rng.standard_normal(field.shape).astype(np.float32) for _ in path)
    return np.stack([draw(field, [view], i, sensor, one) for i, one in enumerate(noise)])


def panel(image, text, good):
    """Return an image in colour, enlarged, with a caption and a border that says whether it is good."""
    shown = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image
    shown = cv2.copyMakeBorder(shown, GAP, 26, GAP, GAP, cv2.BORDER_CONSTANT, value=GREEN if good else RED)
    cv2.putText(shown, text, (GAP, shown.shape[0] - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    return shown


def save(name, panels):
    """Write panels beside each other."""
    cv2.imwrite(str(IMAGES / "recording" / f"{name}.jpg"), cv2.hconcat(panels), [cv2.IMWRITE_JPEG_QUALITY, 88])


def trail(path, **options):
    """Return the brightest value of each pixel over all images of a drive."""
    return images(path, **options).max(axis=0)


def curve(n=60):
    """Return poses on a curve that crosses the whole view."""
    s = np.linspace(0, 1, n)
    x, y = 1.35 + 0.5 * np.sin(4 * np.pi * s), 0.55 * np.cos(2 * np.pi * s)
    return np.column_stack([x, y, np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))])


def recording():
    """Draw docs/images/recording."""
    (IMAGES / "recording").mkdir(parents=True, exist_ok=True)
    here = np.array([[1.2, 0.1, 0.2]] * 2)
    save("exposure", [
        panel(images(here)[0], "good: short exposure, dark room", True),
        panel(images(here, Sensor(led_level=4000.0, psf_sigma=1.6))[0], "bad: lights saturated and swollen", False),
        panel(images(here, Sensor(led_level=14.0))[0], "bad: hardly brighter than the noise", False),
    ])  # fmt: skip
    line = np.column_stack([np.full(60, 1.4), np.linspace(-0.6, 0.6, 60), np.full(60, np.pi / 2)])
    patch = np.column_stack([1.5 + 0.08 * np.sin(np.linspace(0, 9, 60)), 0.08 * np.cos(np.linspace(0, 9, 60)),
                             np.linspace(0, 3, 60)])  # fmt: skip
    save("path", [
        panel(trail(curve()), "good: curves all over the common view", True),
        panel(trail(line), "bad: a straight line", False),
        panel(trail(patch), "bad: a small patch", False),
    ])  # fmt: skip
    fast = np.array([0.4, 1.2, 1.5])
    save("blur", [
        panel(images(here, Sensor(exposure=4e-3), speed=fast)[0], "good: 4 ms", True),
        panel(images(here, Sensor(exposure=33e-3), speed=fast)[0], "bad: 33 ms, the same speed", False),
    ])  # fmt: skip
    drive = curve()
    save("overlap", [
        panel(trail(drive, observer=(0.0, 0.36, -0.3)), "A, turned to B: sees all of it", True),
        panel(trail(drive, observer=(0.0, -0.36, 0.3)), "B, turned to A: sees all of it", True),
        panel(trail(drive, observer=(0.0, -0.36, -0.55)), "B, turned away: sees a corner", False),
    ])  # fmt: skip
    far, side = np.array([[4.5, 0.3, 0.0]] * 2), np.array([[1.3, 0.0, 1.52]] * 2)
    save("lights", [
        panel(images(here)[0], "good: 1.2 m away, seen from behind", True),
        panel(images(far)[0], "bad: 4.5 m away", False),
        panel(images(side)[0], "bad for an image: one behind the other", False),
    ])  # fmt: skip


def examples():
    """Run every example, and keep its picture."""
    (IMAGES / "examples").mkdir(parents=True, exist_ok=True)
    for script in sorted((ROOT / "examples").glob("*.py")):
        with tempfile.TemporaryDirectory() as folder:
            back = Path.cwd()
            os.chdir(folder)
            try:
                runpy.run_path(str(script), run_name="__main__")
            finally:
                os.chdir(back)
            picture = cv2.imread(f"{folder}/{script.stem}.png")
            cv2.imwrite(str(IMAGES / "examples" / f"{script.stem}.png"), picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    for name in sys.argv[1:] or ("recording", "examples"):
        {"recording": recording, "examples": examples}[name]()
