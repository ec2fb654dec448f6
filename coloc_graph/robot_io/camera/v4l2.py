"""A camera on Linux through OpenCV: raw YUYV at the team's size and rate, of which Y is used.

Exposure and gain are set with V4L2's own calls: OpenCV supports neither automatic gain nor the exposure control of the
PS3 Eye's driver. Source: Linux, "V4L2 API", VIDIOC_S_CTRL; drivers/media/usb/gspca/ov534.c; OpenCV, cap_v4l.cpp.
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

MIN_STAMP_AGE = -1e-3  # s, least age of a kernel's time stamp, when it is read, that can be of CLOCK_MONOTONIC
MAX_STAMP_AGE = 1.0  # s, largest such age

log = logging.getLogger(__name__)


class V4l2Camera:
    """A V4L2 camera.

    Frames have the kernel's time stamps if those are of CLOCK_MONOTONIC, else the time of reading, with a warning.

    Parameters
    ----------
    name
        Name of the camera in messages.
    path
        Device, with settings in the driver's units if any: /dev/video0?exposure=60&gain=10.
    camera
        The team's description of the camera.
    clock
        Clock of the time stamps [ns].

    Raises
    ------
    CameraError
        If it cannot be opened, or does not deliver the format.
    InputError
        If a setting is not valid.
    """

    def __init__(self, name: str, path: str, camera: Camera, clock: Clock) -> None:
        self._name, self._camera, self._clock = name, camera, clock
        self._path, _, query = path.partition("?")
        settings = _settings(name, query)
        self._stamped: bool | None = None  # unknown before the first frame
        _check_device(name, self._path)
        # s that OpenCV waits for a frame, 10 by default; the device can only be closed after that
        os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "1")
        self._capture = cv2.VideoCapture(self._path, cv2.CAP_V4L2)
        if not self._capture.isOpened():
            raise CameraError(f"{name} cannot be opened: check that it is free and delivers images")
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
                    f"{self._name} does not deliver {words}: list its formats with v4l2-ctl --list-formats-ext, and "
                    "set team.toml to one of them"
                )
        fps = self._capture.get(cv2.CAP_PROP_FPS)
        if abs(fps - self._camera.fps) > 0.5:
            log.warning("%s delivers %g images a second, team.toml says %g", self._name, fps, self._camera.fps)

    def grab(self) -> Frame | None:
        """Return the next frame, None if there is none."""
        if not self._capture.grab():
            if not Path(self._path).exists():
                raise CameraError(f"{self._name} was unplugged: plug it in and open it again")
            time.sleep(WAIT / 10)  # it may have failed at once
            return None
        read = time.monotonic_ns()
        stamp = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
        there, raw = self._capture.retrieve()
        if not there:
            return None
        if self._stamped is None:
            self._stamped = MIN_STAMP_AGE <= (read - stamp) * 1e-9 <= MAX_STAMP_AGE
            if not self._stamped:
                log.warning(
                    "%s: the kernel's time stamps are not of CLOCK_MONOTONIC; the time of reading is used, which is "
                    "later and less regular",
                    self._name,
                )
        pixels = luma(self._name, np.asarray(raw, np.uint8), self._camera)
        return Frame((stamp if self._stamped else read) + clock_ahead(self._clock), pixels)

    def close(self) -> None:
        """Close the device."""
        self._capture.release()


def luma(name: str, raw: NDArray[np.uint8], camera: Camera) -> NDArray[np.uint8]:
    """Extract Y (height, width) from one YUYV image of any shape. Raises `CameraError` for a wrong size."""
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
            raise InputError(f"{name}: `{key}={value}` is not a setting; use exposure=NUMBER and gain=NUMBER")
        settings[key] = int(value)
    return settings


def _check_device(name: str, path: str) -> None:
    try:
        is_device = stat.S_ISCHR(Path(path).stat().st_mode)
    except OSError as error:
        raise CameraError(f"{name} cannot be opened ({error.strerror}): check that it is plugged in") from error
    if not is_device:
        raise CameraError(f"{name} cannot be opened: {path} is not a device; use video:{path} for a recorded video")
    if not os.access(path, os.R_OK | os.W_OK):
        raise CameraError(f"{name} cannot be opened: no permission for {path}; join its group (`video` on Debian)")


def _set_controls(name: str, path: str, settings: dict[str, int]) -> None:
    """Switch automatic exposure and gain off and apply the settings; warn if the driver refuses."""
    with Path(path).open("rb", buffering=0) as device:

        def set_control(control: int, value: int) -> bool:
            with contextlib.suppress(OSError):
                fcntl.ioctl(device, VIDIOC_S_CTRL, struct.pack("=Ii", control, value))
                return True
            return False

        if not set_control(EXPOSURE_AUTO, EXPOSURE_MANUAL):
            log.warning("%s: automatic exposure cannot be switched off; it may change while the team measures", name)
        set_control(AUTOGAIN, 0)  # many cameras have none
        if "exposure" in settings and not any(
            set_control(control, settings["exposure"]) for control in (EXPOSURE, EXPOSURE_ABSOLUTE)
        ):
            log.warning("%s refuses exposure=%d", name, settings["exposure"])
        if "gain" in settings and not set_control(GAIN, settings["gain"]):
            log.warning("%s refuses gain=%d", name, settings["gain"])
