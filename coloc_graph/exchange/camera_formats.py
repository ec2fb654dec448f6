"""Calibrations of OpenCV and of Kalibr as the fields of a ROS `camera_info`.

Sources: OpenCV's camera_calibration sample, which writes FileStorage as YAML or XML; Kalibr's camchain.yaml,
https://github.com/ethz-asl/kalibr/wiki/yaml-formats.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from coloc_graph.errors import InputError
from coloc_graph.input_file import quoted, shortened

OPENCV_YAML = re.compile(r"%YAML[ :]1\.\d\s*\n(?:---\s*\n)?")
OPENCV_XML = re.compile(r"\s*(?:<\?xml[^>]*>\s*)?<opencv_storage>")
_KALIBR = re.compile(r"cam\d+")

#: Names by which OpenCV's programs write a field.
_OPENCV = {
    "image_width": ("image_width", "image_Width", "imageWidth", "width"),
    "image_height": ("image_height", "image_Height", "imageHeight", "height"),
    "camera_matrix": ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K"),
    "distortion_coefficients": ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs", "D"),
}
_STEREO = ("M1", "M2", "K1", "K2", "D1", "D2", "cameraMatrix1", "cameraMatrix2")
#: Lens models of Kalibr that have a name in ROS; of the others what they are.
_LENSES = {"radtan": "plumb_bob", "equidistant": "equidistant", "equi": "equidistant", "none": ""}
_PROJECTIONS = {
    "omni": "Mei's unified omnidirectional model",
    "ds": "the double sphere model",
    "eucm": "the extended unified model",
    "fov": "the FOV model",
}


def of_opencv_xml(path: Path, text: str) -> dict[str, Any]:
    """Return the fields of an OpenCV storage in XML, matrices with rows, cols and data.

    Raises
    ------
    InputError
        It is not XML, or declares entities.
    """
    if "<!" in re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL):
        raise InputError(f"{path}: declares entities or a document type, which OpenCV does not write; check the file")
    try:
        root = ElementTree.fromstring(text.encode())
    except (ElementTree.ParseError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not XML that is read ({shortened(error)}); check the file") from error
    fields: dict[str, Any] = {}
    for one in root:
        if one.find("data") is not None:
            numbers = (one.findtext("data") or "").split()
            fields[one.tag] = {name: _whole(one.findtext(name)) for name in ("rows", "cols")} | {"data": numbers}
        else:
            fields[one.tag] = _whole(one.text)
    return fields


def _whole(text: str | None) -> Any:
    stripped = (text or "").strip()
    return int(stripped) if stripped.isdecimal() and len(stripped) < 10 else stripped


def of_opencv(path: Path, fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return an OpenCV calibration as `camera_info`.

    Raises
    ------
    InputError
        It is of a stereo pair, has no camera, or has a lens model that is not read.
    """
    if any(name in fields for name in _STEREO):
        raise InputError(f"{path}: is OpenCV's calibration of a stereo pair; give the file of one camera")
    found: dict[str, Any] = {}
    for name, names in _OPENCV.items():
        value = next((fields[one] for one in names if one in fields), None)
        if value is None:
            raise InputError(f"{path}: is an OpenCV calibration without `{name}`; add it, or give another file")
        found[name] = value
    D = found["distortion_coefficients"]
    numbers = D.get("data") if isinstance(D, dict) else D
    if not isinstance(numbers, list):
        raise InputError(f"{path}: `distortion_coefficients` is not a list of numbers; check the file")
    numbers = _without_zeros(path, numbers)
    wide = fields.get("fisheye_model", 0) in (1, True, "1", "true")
    if not wide and len(numbers) > 8:
        kind = "a tilted sensor" if len(numbers) > 12 else "a thin prism"
        raise InputError(
            f"{path}: has OpenCV's {len(numbers)} coefficients, those of {kind} among them, and up to 8 are read; "
            "calibrate the camera anew with `coloc calibrate camera`"
        )
    model = "equidistant" if wide else "plumb_bob" if len(numbers) <= 5 else "rational_polynomial"
    size = 4 if wide or len(numbers) <= 4 else 5 if len(numbers) <= 5 else 8
    return found | {
        "distortion_coefficients": numbers + [0.0] * (size - len(numbers)),
        "distortion_model": model,
    }


def _without_zeros(path: Path, numbers: list[Any]) -> list[Any]:
    """Leave out the zeros behind the last coefficient."""
    try:
        last = max((n for n, one in enumerate(numbers, start=1) if float(one) != 0), default=0)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: `distortion_coefficients` is not a list of numbers; check the file") from error
    return numbers[:last]


def is_kalibr(fields: Mapping[str, Any]) -> bool:
    """Return whether fields are those of a Kalibr camchain."""
    return any(
        isinstance(name, str) and _KALIBR.fullmatch(name) and isinstance(one, dict) and "intrinsics" in one
        for name, one in fields.items()
    )


def of_kalibr(path: Path, fields: Mapping[str, Any], chosen: str | None) -> dict[str, Any]:
    """Return one camera of a Kalibr camchain as `camera_info`.

    Raises
    ------
    InputError
        The chain has several cameras and none is chosen, or a model that is not read.
    """
    names = sorted(name for name in fields if isinstance(name, str) and _KALIBR.fullmatch(name))
    if chosen is None and len(names) > 1:
        raise InputError(f"{path}: is a Kalibr chain of {', '.join(names)}; choose one with --chain-camera")
    name = names[0] if chosen is None else chosen
    one = fields.get(name)
    if not isinstance(one, dict):
        raise InputError(f"{path}: has no camera {quoted(name)}; it has {', '.join(names)}")
    where = f"{path}, {name}"
    projection, lens = str(one.get("camera_model", "pinhole")), str(one.get("distortion_model", "none"))
    if projection != "pinhole":
        what = _PROJECTIONS.get(projection, "no pinhole")
        raise InputError(
            f"{where}: `camera_model` is {quoted(projection)}, {what}, and pinholes are read, with radtan or "
            "equidistant; calibrate with one of these"
        )
    if lens not in _LENSES:
        what = _PROJECTIONS.get(lens, "a lens model")
        raise InputError(
            f"{where}: `distortion_model` is {quoted(lens)}, {what} that is not read; use radtan or equidistant"
        )
    intrinsics, size = one.get("intrinsics"), one.get("resolution")
    if not isinstance(intrinsics, list) or len(intrinsics) != 4:
        raise InputError(f"{where}: `intrinsics` are fu, fv, pu, pv of a pinhole; check the file")
    if not isinstance(size, list) or len(size) != 2:
        raise InputError(f"{where}: `resolution` is width and height; check the file")
    fu, fv, pu, pv = intrinsics
    return {
        "image_width": size[0],
        "image_height": size[1],
        "camera_matrix": [fu, 0.0, pu, 0.0, fv, pv, 0.0, 0.0, 1.0],
        "distortion_model": _LENSES[lens],
        "distortion_coefficients": one.get("distortion_coeffs", []) if lens != "none" else [],
    }
