"""A camera on Linux, through OpenCV: raw YUYV at the team's size and rate, of which Y is taken.

Exposure and gain are set by hand with V4L2's own calls: OpenCV knows no automatic gain, and not the exposure of the PS3
Eye's driver. Source: Linux, "V4L2 API", VIDIOC_S_CTRL; drivers/media/usb/gspca/ov534.c; OpenCV, cap_v4l.cpp.
"""

import contextlib
import fcntl
import logging
import os
import stat
import struct
import time
from pathlib import Path
from urllib.parse import parse_qsl

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import CameraError, InputError
from coloc_graph.robot_io.camera.source import WAIT, Clock, Frame, clock_ahead
from coloc_graph.team import Camera

#: _IOWR('V', 28, struct v4l2_control {u32 id; s32 value}), and the controls' ids.
VIDIOC_S_CTRL = 0xC008561C
EXPOSURE = 0x00980911
AUTOGAIN = 0x00980912
GAIN = 0x00980913
EXPOSURE_AUTO = 0x009A0901
EXPOSURE_ABSOLUTE = 0x009A0902
EXPOSURE_MANUAL = 1

#: A kernel's stamp lies so far back when the first frame is read [s], or it is not of CLOCK_MONOTONIC.
YOUNGEST = -1e-3
OLDEST = 1.0

log = logging.getLogger(__name__)


class V4l2Camera:
    """The camera at `path`, which may end with its settings: /dev/video0?exposure=60&gain=10, in the driver's units.

    Frames are stamped by the kernel where it stamps by CLOCK_MONOTONIC, else when they are read, with a warning.
    """

    def __init__(self, name: str, path: str, camera: Camera, clock: Clock) -> None:
        self._name, self._camera, self._clock = name, camera, clock
        self._path, _, query = path.partition("?")
        settings = _settings(name, query)
        self._stamped: bool | None = None  # not known before the first frame
        _check_device(name, self._path)
        # OpenCV waits so long for a frame [s], 10 by default, and only then the device can be closed
        os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "1")
        self._capture = cv2.VideoCapture(self._path, cv2.CAP_V4L2)
        if not self._capture.isOpened():
            raise CameraError(f"{name} cannot be opened: is it free, and does it deliver images?")
        try:
            self._set_up()
            self._capture.grab()  # the driver takes controls for good once it streams
            _set_controls(name, self._path, settings)
        except BaseException:
            self.close()
            raise

    def _set_up(self) -> None:
        wanted = (
            (cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"YUYV"), "the format YUYV"),
            (cv2.CAP_PROP_FRAME_WIDTH, self._camera.width, f"the width {self._camera.width} px"),
            (cv2.CAP_PROP_FRAME_HEIGHT, self._camera.height, f"the height {self._camera.height} px"),
        )
        for option, value, _ in wanted:
            self._capture.set(option, value)
        self._capture.set(cv2.CAP_PROP_FPS, self._camera.fps)
        self._capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        for option, value, words in wanted:
            if int(self._capture.get(option)) != value:
                raise CameraError(
                    f"{self._name} does not deliver {words}: list what it does with v4l2-ctl --list-formats-ext, and "
                    "set team.toml to that"
                )
        fps = self._capture.get(cv2.CAP_PROP_FPS)
        if abs(fps - self._camera.fps) > 0.5:
            log.warning("%s delivers %g images a second, the team says %g", self._name, fps, self._camera.fps)

    def grab(self) -> Frame | None:
        """The next frame."""
        if not self._capture.grab():
            if not Path(self._path).exists():
                raise CameraError(f"{self._name} was unplugged: plug it in and open it anew")
            time.sleep(WAIT / 10)  # it may have failed at once
            return None
        read = time.monotonic_ns()
        stamp = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
        there, raw = self._capture.retrieve()
        if not there:
            return None
        if self._stamped is None:
            self._stamped = YOUNGEST <= (read - stamp) * 1e-9 <= OLDEST
            if not self._stamped:
                log.warning(
                    "%s: its kernel's time stamps are not of CLOCK_MONOTONIC; images are stamped when they are read, "
                    "which is later and less even",
                    self._name,
                )
        pixels = luma(self._name, np.asarray(raw, np.uint8), self._camera)
        return Frame((stamp if self._stamped else read) + clock_ahead(self._clock), pixels)

    def close(self) -> None:
        """Let go of the device."""
        self._capture.release()


def luma(name: str, raw: NDArray[np.uint8], camera: Camera) -> NDArray[np.uint8]:
    """Y (height, width) of the bytes of one YUYV image, in whatever shape OpenCV has them."""
    if raw.size != 2 * camera.width * camera.height:
        raise CameraError(
            f"{name} delivers {raw.size} bytes an image, but {camera.width} x {camera.height} px in YUYV have "
            f"{2 * camera.width * camera.height}: set the camera's `width` and `height` in team.toml to what it has"
        )
    return np.ascontiguousarray(raw.reshape(camera.height, camera.width, 2)[..., 0])


def _settings(name: str, query: str) -> dict[str, int]:
    settings = {}
    for key, value in parse_qsl(query, keep_blank_values=True):
        if key not in ("exposure", "gain") or not value.isdecimal():
            raise InputError(f"{name}: `{key}={value}` is no setting; use exposure=NUMBER and gain=NUMBER")
        settings[key] = int(value)
    return settings


def _check_device(name: str, path: str) -> None:
    try:
        is_device = stat.S_ISCHR(Path(path).stat().st_mode)
    except OSError as error:
        raise CameraError(f"{name} cannot be opened ({error.strerror}): is it plugged in?") from error
    if not is_device:
        raise CameraError(f"{name} cannot be opened: {path} is no device; use video:{path} for a recorded video")
    if not os.access(path, os.R_OK | os.W_OK):
        raise CameraError(f"{name} cannot be opened: {path} is not yours to use; join its group (`video` on Debian)")


def _set_controls(name: str, path: str, settings: dict[str, int]) -> None:
    """Exposure and gain by hand, as they are or as they are set; a warning where the driver refuses."""
    with Path(path).open("rb", buffering=0) as device:

        def set_control(control: int, value: int) -> bool:
            with contextlib.suppress(OSError):
                fcntl.ioctl(device, VIDIOC_S_CTRL, struct.pack("=Ii", control, value))
                return True
            return False

        if not set_control(EXPOSURE_AUTO, EXPOSURE_MANUAL):
            log.warning("%s: its exposure cannot be set by hand; it may change while the team measures", name)
        set_control(AUTOGAIN, 0)  # many have none
        if "exposure" in settings and not any(
            set_control(control, settings["exposure"]) for control in (EXPOSURE, EXPOSURE_ABSOLUTE)
        ):
            log.warning("%s does not take exposure=%d", name, settings["exposure"])
        if "gain" in settings and not set_control(GAIN, settings["gain"]):
            log.warning("%s does not take gain=%d", name, settings["gain"])
