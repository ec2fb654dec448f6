"""Rendering of the viewer to a film, stance by stance."""

import itertools
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

from coloc_graph.errors import InputError
from coloc_graph.viewer.app import Viewer
from coloc_graph.viewer.browser import rendered
from coloc_graph.viewer.frame import thinned_rows
from coloc_graph.viewer.overlay import caption_script

SUFFIX = ".mp4"
FPS = 10.0  # frames a second
STANCE_FRAMES = 10  # frames from one stance to the next, fewer in a long run
MAX_FRAMES = 600  # frames of all stances, a minute
HELD_FRAMES = 20  # frames of the last stance
MAX_STANCES = 240  # stances that are shown; of more a selection
SECONDS_A_FRAME = 30.0  # s for each frame, after which a film is given up; without a graphics card one takes 1 s


def instants(viewer: Viewer) -> list[float]:
    """Return the instants of the film's frames [s], ascending; the last one is held."""
    scene = viewer.scene
    rows = thinned_rows(len(scene) - 1, MAX_STANCES).tolist()
    if not rows:
        raise InputError("the result has no stance to film: solve a run with stances")
    steps = int(np.clip(MAX_FRAMES // len(rows), 1, STANCE_FRAMES))
    times = [scene.middle(rows[0])]
    for now, then in itertools.pairwise(rows):
        times += np.linspace(scene.middle(now), scene.middle(then), steps + 1)[1:].tolist()
    return times


def write_video(
    viewer: Viewer,
    path: str | Path,
    size: tuple[int, int] = (1280, 720),
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Render all stances to a film (MPEG-4), with legend, scale and caption, and return its number of frames.

    Parameters
    ----------
    viewer : Viewer
        The viewer.
    path : str or Path
        File that ends in .mp4; it appears whole or not at all.
    size : (int, int)
        Width and height [px].
    progress : callable, optional
        Called with the number of frames done and the total.

    Raises
    ------
    InputError
        There is no browser or no stance, or the film cannot be encoded.
    """
    path, times = Path(path), instants(viewer)
    with TemporaryDirectory(prefix=f".{path.name}-", dir=path.absolute().parent) as folder:
        part = Path(folder) / f"film{SUFFIX}"
        film = cv2.VideoWriter(str(part), cv2.VideoWriter.fourcc(*"mp4v"), FPS, size)
        if not film.isOpened():
            raise InputError(f"{path}: this OpenCV encodes no MPEG-4; write a page with --export instead")
        picture: Any = None
        try:
            with rendered(viewer, size, 120.0 + SECONDS_A_FRAME * len(times)) as page:
                for number, time in enumerate(times, start=1):
                    viewer.go_to(time)
                    viewer.wait_idle()
                    page.evaluate(caption_script(viewer.caption))
                    picture = cv2.imdecode(np.frombuffer(page.drawn(), np.uint8), cv2.IMREAD_COLOR)
                    film.write(picture)
                    if progress is not None:
                        progress(number, len(times))
            for _ in range(HELD_FRAMES):
                film.write(picture)
        finally:
            film.release()
        part.replace(path)
    return len(times) + HELD_FRAMES
