"""Slow contents of a frame, made by another thread: images, marker trajectories, and the picked edge."""

import itertools
from collections.abc import Callable, Iterable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from coloc_graph.frontend import PairMeasurement
from coloc_graph.frontend.learnt_noise import measure_alone
from coloc_graph.run import Run
from coloc_graph.viewer import inspect
from coloc_graph.viewer.frame import NO_LINES, Lines
from coloc_graph.viewer.scene import Scene
from coloc_graph.viewer.worker import Failure, Worker

MEASURED_LIMIT = 100  # pairs that are kept measured; each holds its tracks

Image = NDArray[np.uint8]
Picked = tuple[str, int]


class Details:
    """Contents that are ready later than their frame; `wake` is called when one is."""

    def __init__(self, wake: Callable[[], None]) -> None:
        self.images: dict[str, Image | None] = {}
        self.marker_lines: tuple[Lines, Lines] = (NO_LINES, NO_LINES)
        self._measured: dict[tuple[int, str, str], PairMeasurement] = {}
        self._worker = Worker(wake)

    def close(self) -> None:
        """End the worker."""
        self._worker.close()

    def keep(self, pairs: Iterable[PairMeasurement]) -> None:
        """Keep pairs that were measured already."""
        for pair in pairs:
            h = pair.homography
            self._measured[h.stance, h.robot_i, h.robot_j] = pair

    def look_up_images(self, scene: Scene, time: float, complain: Callable[[str, str], None]) -> bool:
        """Bring the images up to date with a time; True while some are being read."""
        if scene.run is None or not len(scene):
            return False
        moment, is_waiting = round(time, 1), False
        for robot in scene.robots:
            image = self._worker.ask(f"image {robot}", moment, partial(_image_in_a_tuple, scene.run, robot, moment))
            is_waiting |= image is None
            if isinstance(image, Failure):
                complain(f"No image of {robot}", image.why)
            elif image is not None:
                self.images[robot] = image[0]
        return is_waiting

    def look_up_markers(self, scene: Scene, row: int, *, dark: bool, rests: bool, wanted: bool) -> bool:
        """Bring the trajectories of the markers, drawn at rest only, up to date; True while they are being made."""
        if scene.run is None or not len(scene):
            return False
        if not rests:
            self.marker_lines = (NO_LINES, NO_LINES)
        if not rests or not wanted:
            return False
        lines = self._worker.ask("markers", (row, dark, id(scene)), lambda: self._marker_lines(scene, row, dark))
        self.marker_lines = lines if isinstance(lines, tuple) else (NO_LINES, NO_LINES)
        return lines is None

    def report(self, scene: Scene, picked: Picked, row: int) -> tuple[str, Image | None, bool] | None:
        """Return text and picture of the picked item, and whether more is being made; None if it is gone."""
        kind, number = picked
        if kind == "robot":
            return inspect.robot_report(scene, number, row), None, False
        if (edge := scene.edge(number)) is None:
            return None
        found = self._worker.ask("edge", (number, id(scene)), lambda: inspect.examine(*edge))
        if isinstance(found, Failure):
            return f"{inspect.edge_report(*edge, None)}\n\n{found.why}", None, False
        return inspect.edge_report(*edge, found), found.picture if found else None, found is None

    def _marker_lines(self, scene: Scene, row: int, dark: bool) -> tuple[Lines, Lines]:
        assert scene.run is not None
        stance = scene.stances[row]
        measured = []
        for pair in itertools.combinations(stance.observers, 2):
            one = self._measured.get((stance.index, *pair)) or measure_alone(scene.run, stance, *pair, scene.frontend)
            if len(self._measured) > MEASURED_LIMIT:
                self._measured.clear()
            self._measured[stance.index, *pair] = one
            measured.append(one)
        return inspect.marker_trajectories(scene, row, measured, dark)


def _image_in_a_tuple(run: Run, robot: str, time: float) -> tuple[Image | None]:
    return (inspect.camera_image(run, robot, time),)  # None alone is the worker's answer before it is ready
