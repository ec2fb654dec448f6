"""Read and write cameras as ROS `camera_info` YAML, as calibrators write it and as topics print it.

OpenCV's calibrations (YAML, XML) and Kalibr's camchain are read as well, see `camera_formats`.

Anything in it that `Camera` cannot express is refused, or reported in a warning. Numbers are read back bit for bit.
Source: ROS `sensor_msgs/CameraInfo`, and the files of `camera_calibration_parsers`.
"""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from msgspec.structs import replace
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.exchange.camera_formats import (
    OPENCV_XML,
    OPENCV_YAML,
    is_kalibr,
    of_kalibr,
    of_opencv,
    of_opencv_xml,
)
from coloc_graph.exchange.image_region import ImageRegion, image_region
from coloc_graph.input_file import decode_text, quoted, read_bytes
from coloc_graph.run.atomic_file import write_atomically
from coloc_graph.team import Camera
from coloc_graph.team.camera import MAX_SIDE

Array = NDArray[np.float64]

#: Distortion models of ROS that are OpenCV's, with their numbers of coefficients; "" is no distortion.
MODELS = {"plumb_bob": (0, 4, 5), "rational_polynomial": (8,), "": (0,), "equidistant": (4,), "fisheye": (4,)}
#: Names of the fisheye model: ROS's, and OpenCV's, which some drivers write.
FISHEYES = ("equidistant", "fisheye")
MAX_SIZE = 64 * 1024  # bytes of one camera_info; PyYAML takes a second for some hundred kilobytes
#: Names of the fields: those of a calibrator's file, of a message in ROS 2, and in ROS 1.
NAMES = {
    "width": ("image_width", "width"),
    "height": ("image_height", "height"),
    "model": ("distortion_model",),
    "K": ("camera_matrix", "k", "K"),
    "D": ("distortion_coefficients", "d", "D"),
    "R": ("rectification_matrix", "r", "R"),
    "P": ("projection_matrix", "p", "P"),
}


def write_camera_info(camera: Camera, name: str, path: Path) -> None:
    """Write a camera's size, intrinsics and distortion as `camera_info` YAML, with R the identity and P = [K 0]."""
    write_atomically(path, camera_info_text(camera, name))


def camera_info_text(camera: Camera, name: str) -> str:
    """Format a camera as `camera_info` YAML."""
    K = camera.K
    fields = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": _matrix(K),
        "distortion_model": ros_model(camera),
        "distortion_coefficients": _matrix(np.array([ros_coefficients(camera)])),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(np.hstack([K, np.zeros((3, 1))])),
    }
    return yaml.safe_dump(fields, sort_keys=False, default_flow_style=None, width=200)


def ros_model(camera: Camera) -> str:
    """Return the name of a camera's lens model in ROS and in Foxglove."""
    if camera.model == "fisheye":
        return FISHEYES[0]
    return "rational_polynomial" if len(camera.distortion) == 8 else "plumb_bob"


def ros_coefficients(camera: Camera) -> tuple[float, ...]:
    """Return a camera's coefficients of distortion; a fisheye has four also if it has no distortion."""
    return camera.distortion or (0.0,) * 4 if camera.model == "fisheye" else camera.distortion


def read_camera_info(
    path: str | Path, base: Camera | None = None, chain_camera: str | None = None
) -> tuple[Camera, tuple[str, ...]]:
    """Read a camera from a `camera_info` YAML, an OpenCV calibration (YAML, XML), or a Kalibr camchain.

    Parameters
    ----------
    path
        File.
    base
        Camera that provides what such a file does not contain (fps, noise).
    chain_camera
        Camera of a Kalibr camchain, as `cam1`; only needed if there are several.

    Returns
    -------
    tuple
        The camera of the images, of their region of interest and binning, and warnings on these and on ignored fields.

    Raises
    ------
    InputError
        The file is not a `camera_info`, or describes an unknown lens model, skewed pixels, or a region of interest
        beyond the image.
    """
    path = Path(path)
    fields = _fields(path, chain_camera)
    width, height = (_whole(path, fields, name) for name in ("width", "height"))
    K = _numbers(path, fields, "K", (3, 3))
    D = _numbers(path, fields, "D", None).ravel()
    model = str(_get(path, fields, "model"))
    if K[0, 0] == 0:
        raise InputError(f"{path}: the camera is not calibrated (its matrix is zero); calibrate it first")
    if model not in MODELS:
        known = "plumb_bob, rational_polynomial and equidistant"
        raise InputError(
            f"{path}: `distortion_model` is {quoted(model)}, and the lens models here are {known}; "
            "calibrate the camera anew with `coloc calibrate camera`"
        )
    most = max(MODELS[model])
    if not D[most:].any():
        D = D[:most]
    if len(D) not in MODELS[model]:
        counts = " or ".join(map(str, MODELS[model]))
        raise InputError(
            f"{path}: {quoted(model)} has {counts} coefficients (zeros behind them are left out), and there are "
            f"{len(D)}; check the file"
        )
    if K[0, 1] != 0 or K[1, 0] != 0 or (K[2] != (0, 0, 1)).any():
        raise InputError(
            f"{path}: the camera matrix is [fx {K[0, 1]:g} cx; {K[1, 0]:g} fy cy; ...], and a pinhole without skew has "
            "zeros there and 0 0 1 below; calibrate the camera anew without skew"
        )
    said = _left_out(path, fields, K)
    region = _region(path, fields, (width, height))
    if (region.width, region.height) != (width, height) or region.binning != (1, 1):
        said.append(f"{path}: the camera is that of the images, which show {region} of {width} x {height} px")
    width, height = region.size
    K = region.intrinsics(K)
    values: dict[str, Any] = {
        "width": width,
        "height": height,
        "fx": float(K[0, 0]),
        "fy": float(K[1, 1]),
        "cx": float(K[0, 2]),
        "cy": float(K[1, 2]),
        "model": "fisheye" if model in FISHEYES else "pinhole",
        "distortion": tuple(D.tolist()),
    }
    try:
        camera = Camera(**values) if base is None else replace(base, **values)
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: {error}") from error
    if (radius := camera.fold_radius()) is not None:
        raise InputError(
            f"{path}: its lens model folds {radius:.0f} px from the middle of the image, beyond which pixels have no "
            "ray; calibrate the camera again, with corners out to the image's border"
        )
    return camera, tuple(said)


def _matrix(values: Any) -> dict[str, Any]:
    rows, columns = values.shape
    return {"rows": rows, "cols": columns, "data": values.ravel().tolist()}


class _Loader(yaml.SafeLoader):
    """YAML loader without dates, and without aliases, which can expand a few lines a billion times."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            raise yaml.MarkedYAMLError(problem="it has an alias, which is not read", problem_mark=mark)
        return super().compose_node(parent, index)


_Loader.yaml_implicit_resolvers = {
    first: [(tag, expression) for tag, expression in resolvers if not tag.endswith(":timestamp")]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


def _text(path: Path) -> str:
    """Text of the first document of a file, since a printed topic separates messages by `---`."""
    remedy = "give the path of a camera_info YAML"
    data = read_bytes(path, remedy)
    if len(data) > MAX_SIZE:
        data = re.split(rb"(?<=.)^---", data[:MAX_SIZE], maxsplit=1, flags=re.MULTILINE | re.DOTALL)[0]
    if len(data) >= MAX_SIZE:
        raise InputError(f"{path}: its first camera_info is larger than {MAX_SIZE // 1024} KiB; {remedy}")
    return decode_text(path, data, remedy)


class _OpenCvLoader(_Loader):
    """The same for OpenCV's YAML, whose matrices have a tag of their own."""


def _mapping(loader: Any, node: Any) -> Any:
    return loader.construct_mapping(node, deep=True)


for _tag in ("opencv-matrix", "opencv-nd-matrix"):  # the latter is of an array of one dimension
    _OpenCvLoader.add_constructor(f"tag:yaml.org,2002:{_tag}", _mapping)


def _fields(path: Path, chain_camera: str | None) -> Mapping[str, Any]:
    """Return the fields of a `camera_info`, or those of another format under its names."""
    text = _text(path)
    fields: Mapping[str, Any]
    xml, head = OPENCV_XML.match(text), OPENCV_YAML.match(text)
    if xml:
        fields = of_opencv(path, of_opencv_xml(path, text))
    elif head:
        fields = of_opencv(path, _yaml_fields(path, text[head.end() :], _OpenCvLoader))
    elif is_kalibr(fields := _yaml_fields(path, text, _Loader)):
        return of_kalibr(path, fields, chain_camera)
    if chain_camera is not None:
        raise InputError(f"{path}: is not a Kalibr camera chain: leave out --chain-camera")
    return fields


def _yaml_fields(path: Path, text: str, loader: type[_Loader]) -> Mapping[str, Any]:
    try:
        fields = next(iter(yaml.load_all(text, loader)), None)
    except RecursionError as error:
        raise InputError(f"{path}: is nested too deep; give the path of a camera_info YAML") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark is not None else ""
        what = quoted(getattr(error, "problem", None) or error)
        raise InputError(f"{path}{where}: is not YAML that is read ({what}); check the file") from error
    except ValueError as error:  # a number of more digits than Python reads
        raise InputError(f"{path}: holds what is no number ({error}); check the file") from error
    if not isinstance(fields, dict):
        raise InputError(f"{path}: holds no fields; give a camera_info YAML, with camera_matrix and the others")
    return fields


def _get(path: Path, fields: Mapping[str, Any], name: str) -> Any:
    for one in NAMES[name]:
        if one in fields:
            return fields[one]
    raise InputError(f"{path}: has no `{NAMES[name][0]}`; give a camera_info YAML that is whole")


def _whole(path: Path, fields: Mapping[str, Any], name: str) -> int:
    value = _get(path, fields, name)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 < value <= MAX_SIDE:
        raise InputError(
            f"{path}: `{NAMES[name][0]}` is {quoted(value)}; give a whole number of pixels, {MAX_SIDE} at most"
        )
    return value


def _numbers(path: Path, fields: Mapping[str, Any], name: str, shape: tuple[int, int] | None) -> Any:
    value, called = _get(path, fields, name), next(one for one in NAMES[name] if one in fields)
    stated: tuple[Any, ...] | None = None
    if isinstance(value, dict):
        stated, value = (value.get("rows"), value.get("cols")), value.get("data")
    try:
        # YAML 1.1 takes 1e-05 for text, which C++ writes
        numbers = np.array([float(one) for one in value])
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: `{called}` is not a list of numbers; check the file") from error
    if not np.isfinite(numbers).all():
        raise InputError(f"{path}: `{called}` holds a number that is not finite; calibrate the camera anew")
    if stated is not None and not all(isinstance(one, int) and 0 <= one <= MAX_SIDE for one in stated):
        raise InputError(f"{path}: `{called}` has rows and cols that are not whole numbers; check the file")
    for size in (shape, stated):
        if size is not None and math.prod(size) != len(numbers):
            needed = "x".join(map(str, size))
            raise InputError(f"{path}: `{called}` has {len(numbers)} numbers where {needed} are needed; check the file")
    return numbers.reshape(shape) if shape is not None else numbers


def _region(path: Path, fields: Mapping[str, Any], size: tuple[int, int]) -> ImageRegion:
    roi = fields.get("roi") or {}
    if not isinstance(roi, dict):
        raise InputError(f"{path}: `roi` is {quoted(roi)}; give x_offset, y_offset, width and height, or leave it out")
    part = [roi.get(name, 0) for name in ("x_offset", "y_offset", "width", "height")]
    try:
        return image_region(size, part, [fields.get(name, 0) for name in ("binning_x", "binning_y")])
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error


def _left_out(path: Path, fields: Mapping[str, Any], K: Any) -> list[str]:
    said = []
    if any(name in fields for name in NAMES["R"]):
        R = _numbers(path, fields, "R", (3, 3))
        # the identity, or zeros where nobody filled it in
        if not np.array_equal(R, np.eye(3)) and R.any():
            said.append(
                f"{path}: `rectification_matrix` is ignored: it rotates the images of a stereo pair, and these are as "
                "the camera takes them"
            )
    if any(name in fields for name in NAMES["P"]):
        P = _numbers(path, fields, "P", (3, 4))
        if P.any() and not np.array_equal(P, np.hstack([K, np.zeros((3, 1))])):
            said.append(
                f"{path}: `projection_matrix` is ignored: it is of rectified images, and these are as the camera "
                "takes them"
            )
    return said
