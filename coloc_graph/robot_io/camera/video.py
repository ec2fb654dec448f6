"""A recorded video as a camera: a file or a folder of images, shown in real time."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import CameraError, InputError
from coloc_graph.image_file import images_in, range_of, read_image, to_8_bits, to_grey
from coloc_graph.robot_io.camera.source import WAIT, Clock, Frame
from coloc_graph.team import Camera


class Video:
    """The frames of the file or the folder `path` at the camera's fps, from its opening on, once."""

    def __init__(self, name: str, path: str, camera: Camera, clock: Clock) -> None:
        self._name, self._clock, self._period = name, clock, 1 / camera.fps
        where = Path(path)
        self._release: Callable[[], None] = lambda: None
        if where.is_dir():
            self._images = self._of_folder(where)
        elif where.is_file():
            self._images = self._of_file(where)
        else:
            raise CameraError(f"{name} cannot be opened: there is no file or folder {path}")
        self._began, self._number = time.monotonic(), 0

    def _of_folder(self, folder: Path) -> Iterator[NDArray[np.uint8]]:
        try:
            paths = images_in(folder)
            values = range_of(paths, read_image(paths[0]))
        except InputError as error:
            raise CameraError(f"{self._name} cannot be opened: {error}") from error

        def images() -> Iterator[NDArray[np.uint8]]:
            for path in paths:
                try:
                    yield to_grey(to_8_bits(read_image(path), values))
                except InputError as error:
                    raise CameraError(f"{self._name}: {error}") from error

        return images()

    def _of_file(self, path: Path) -> Iterator[NDArray[np.uint8]]:
        capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        if not capture.isOpened():
            raise CameraError(f"{self._name} cannot be opened: {path} is no video that OpenCV reads")
        self._release = capture.release

        def images() -> Iterator[NDArray[np.uint8]]:
            while True:
                there, image = capture.read()
                if not there:
                    return
                yield to_grey(np.asarray(image, np.uint8))

        return images()

    def grab(self) -> Frame | None:
        """Return the next image, once it is due."""
        ahead = self._began + self._number * self._period - time.monotonic()
        if ahead > 0:
            time.sleep(min(ahead, WAIT))
            if ahead > WAIT:
                return None
        stamp = self._clock()
        image = next(self._images, None)
        if image is None:
            raise CameraError(f"{self._name} has ended after {self._number} images; open it anew to see it again")
        self._number += 1
        return Frame(stamp, image)

    def close(self) -> None:
        """Close the file."""
        self._release()
