"""Convert images and cameras of ROS messages."""

import math
from typing import Any, Literal

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.exchange.camera_info import FISHEYES, MODELS
from coloc_graph.exchange.image_region import image_region
from coloc_graph.exchange.ros_bag import COMPRESSED_IMAGE, Bag, BagMessage
from coloc_graph.image_file import decode_image, to_8_bits
from coloc_graph.input_file import quoted
from coloc_graph.run import EncodedImage, Image
from coloc_graph.run.image_header import read_image_header, too_large
from coloc_graph.team import Camera

#: Encodings of sensor_msgs/Image that are read: bytes a pixel, and what makes grey or BGR of them.
#: ROS names a Bayer pattern by its first two rows, OpenCV by the second and third pixel of the second row.
ENCODINGS: dict[str, tuple[int, int | None]] = {
    "mono8": (1, None),
    "8UC1": (1, None),
    "bgr8": (3, None),
    "8UC3": (3, None),
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "8UC4": (4, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    "yuv422": (2, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2BGR_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2BGR_YUY2),
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2BGR),
}
#: How files of an image begin.
MAGIC: dict[bytes, Literal["jpeg", "png"]] = {b"\xff\xd8\xff": "jpeg", b"\x89PNG\r\n\x1a\n": "png"}


def image_of(bag: Bag, message: BagMessage, robot: str, time: float, camera: Camera) -> Image | EncodedImage:
    """Convert the image of a message; JPEG and PNG are kept.

    Raises
    ------
    BagError
        The encoding is not supported, or the size is not the camera's; the message names topic and time.
    """
    found = bag.decode(message)
    if message.type == COMPRESSED_IMAGE:
        data = bytes(found.data)
        image_format = next((name for magic, name in MAGIC.items() if data.startswith(magic)), None)
        if image_format is None:
            raise bag.error(message, f"has format {quoted(found.format)}; record JPEG, PNG, or sensor_msgs/Image")
        header = read_image_header(data)
        if header is None:
            raise bag.error(message, f"is a {image_format} that is damaged; record the bag again")
        _require_size(bag, message, (header.height, header.width), camera)
        if why := too_large(header, data):
            raise bag.error(message, f"{why}; record smaller images")
        try:
            decoded = decode_image(data, image_format)
        except InputError:
            raise bag.error(message, f"is a {image_format} that is damaged; record the bag again") from None
        pixels = decoded.pixels
        if pixels.dtype != np.uint8:  # of how many bits the sensor is one message does not tell
            raise bag.error(
                message, f"is a {image_format} of {pixels.dtype} {pixels.shape}; record 8 bits, grey or colour"
            )
        _require_size(bag, message, pixels.shape, camera)
        if not decoded.unchanged:
            return Image(robot, time, to_8_bits(decoded))
        return EncodedImage(robot, time, image_format, data)
    pixels = _pixels(bag, message, found)
    _require_size(bag, message, pixels.shape, camera)
    return Image(robot, time, pixels)


def _pixels(bag: Bag, message: BagMessage, found: Any) -> NDArray[np.uint8]:
    if found.encoding not in ENCODINGS:
        raise bag.error(message, f"has encoding {quoted(found.encoding)}; what is read is {', '.join(ENCODINGS)}")
    size, conversion = ENCODINGS[found.encoding]
    height, width, step = int(found.height), int(found.width), int(found.step)
    data = np.asarray(found.data, np.uint8)
    if not width or not height or step < width * size or len(data) < step * height:
        raise bag.error(message, f"has {len(data)} bytes, which are not {width} x {height} {found.encoding}")
    rows = data[: step * height].reshape(height, step)[:, : width * size]
    pixels = np.ascontiguousarray(rows).reshape((height, width) if size == 1 else (height, width, size))
    if conversion is None:
        return pixels
    try:
        return np.asarray(cv2.cvtColor(pixels, conversion), np.uint8)
    except cv2.error as error:
        raise bag.error(message, f"is no {width} x {height} {found.encoding} ({error.err})") from error


def _require_size(bag: Bag, message: BagMessage, shape: tuple[int, ...], camera: Camera) -> None:
    if shape[:2] != (camera.height, camera.width):
        raise bag.error(
            message,
            f"has {shape[1]} x {shape[0]} pixels, and the camera is {camera.width} x {camera.height}: give its "
            "`camera_info` (with its `roi` and binning), or correct the camera in the team, and its calibration",
        )


def camera_of(bag: Bag, message: BagMessage, stated: Camera, *, rectified: bool) -> Camera:
    """Convert a sensor_msgs/CameraInfo, with missing fields from `stated`; rectified images have camera P, undistorted.

    A region of interest and binning are applied: the camera is that of the images.

    Raises
    ------
    BagError
        The lens model is not supported, the region is not within the image, or the camera is not calibrated.
    """
    found = bag.decode(message)
    K, D = _numbers(found, "k"), _numbers(found, "d")
    if rectified:
        P = _numbers(found, "p")
        K, D = [*P[0:3], *P[4:7], *P[8:11]], []
    elif found.distortion_model not in MODELS:
        raise bag.error(
            message,
            f"has the lens model {quoted(found.distortion_model)}; calibrate with plumb_bob, "
            "rational_polynomial or equidistant, or "
            "import rectified images with `rectified = true`",
        )
    wide = not rectified and found.distortion_model in FISHEYES
    sizes = (0, 4) if wide else (0, 4, 5, 8)
    D = D[: next((n for n in sizes if not any(D[n:])), len(D))]
    if not all(map(math.isfinite, (*K, *D))) or K[0] <= 0 or K[4] <= 0 or not found.width or not found.height:
        raise bag.error(message, "is of a camera that is not calibrated; calibrate it, or leave `camera_info` out")
    if len(D) not in sizes:
        raise bag.error(
            message, f"has {len(D)} coefficients of distortion; what is read is up to OpenCV's first {sizes[-1]}"
        )
    roi = [int(getattr(found.roi, name)) for name in ("x_offset", "y_offset", "width", "height")]
    try:
        region = image_region((int(found.width), int(found.height)), roi, (int(found.binning_x), int(found.binning_y)))
    except ValueError as error:
        raise bag.error(message, str(error)) from error
    (width, height), K = region.size, region.intrinsics(np.reshape(K, (3, 3))).ravel().tolist()
    try:
        camera = msgspec.structs.replace(
            stated,
            width=width,
            height=height,
            fx=float(K[0]),
            fy=float(K[4]),
            cx=float(K[2]),
            cy=float(K[5]),
            model="fisheye" if wide else "pinhole",
            distortion=tuple(float(one) for one in D),
        )
    except ValueError as error:
        raise bag.error(message, f"is of no camera ({error}); calibrate it, or leave `camera_info` out") from error
    if (radius := camera.fold_radius()) is not None:
        raise bag.error(
            message,
            f"has a lens model that folds {radius:.0f} px from the middle of the image, so that pixels beyond have no "
            "ray; calibrate the camera anew, or leave `camera_info` out of the map and give the camera in the team",
        )
    return camera


def _numbers(found: Any, name: str) -> list[float]:
    """Field whose name ROS 1 writes with a capital letter."""
    values = getattr(found, name) if hasattr(found, name) else getattr(found, name.upper())
    return [float(one) for one in values]


def differences(found: Camera, stated: Camera) -> list[str]:
    """Describe the differences between a camera_info and the camera in the team."""
    said = []
    for name in ("width", "height", "fx", "fy", "cx", "cy"):
        a, b = getattr(found, name), getattr(stated, name)
        if not math.isclose(a, b, rel_tol=1e-6, abs_tol=1e-6):
            said.append(f"{name} {a:g} (stated {b:g})")
    if found.model != stated.model:
        said.append(f"a {found.model} (stated a {stated.model})")
    if not np.allclose(_padded(found), _padded(stated), rtol=1e-6, atol=1e-9):
        said.append(f"distortion {_list(found)} (stated {_list(stated)})")
    return said


def _padded(camera: Camera) -> list[float]:
    return [*camera.distortion, *[0.0] * (8 - len(camera.distortion))]


def _list(camera: Camera) -> str:
    return "[" + ", ".join(f"{one:g}" for one in camera.distortion) + "]"
