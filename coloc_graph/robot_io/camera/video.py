"""A recorded video as a camera: a file or a folder of images, shown in real time."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import CameraError
from coloc_graph.robot_io.camera.source import WAIT, Clock, Frame
from coloc_graph.team import Camera

#: What a folder's images end with.
IMAGES = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".tif", ".tiff")


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
        paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGES)
        if not paths:
            raise CameraError(f"{self._name} cannot be opened: {folder} holds no images ({', '.join(IMAGES)})")

        def images() -> Iterator[NDArray[np.uint8]]:
            for path in paths:
                image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
                if image is None:
                    raise CameraError(f"{self._name}: {path} cannot be read as an image; take it out of the folder")
                yield np.asarray(image, np.uint8)

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
                yield np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image, np.uint8)

        return images()

    def grab(self) -> Frame | None:
        """The next image, once it is due."""
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
        """Let go of the file."""
        self._release()
