"""Summarise calibrations for calibration.json and --json, and read a camera's covariance back."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from coloc_graph._version import __version__
from coloc_graph.calibration.camera import CameraCalibration
from coloc_graph.calibration.mount import MountCalibration
from coloc_graph.calibration.team_file import CAMERA_FIELDS
from coloc_graph.calibration.verdict import verdict
from coloc_graph.errors import InputError
from coloc_graph.input_file import read_json
from coloc_graph.team import Camera

SUMMARY = "calibration.json"


def summarise_camera(calibration: CameraCalibration) -> dict[str, Any]:
    """Summarise a camera's calibration; missing numbers are null."""
    camera = msgspec.to_builtins(calibration.camera)
    return {
        "version": __version__,
        "board": dataclasses.asdict(calibration.board),
        "camera": {name: camera[name] for name in CAMERA_FIELDS},
        "parameters": list(calibration.names),
        "sigmas": calibration.sigmas.tolist(),
        "sigmas_if_corners_were_independent": np.sqrt(np.diag(calibration.independent_covariance)).tolist(),
        "covariance": calibration.covariance.tolist(),
        "rms_px": calibration.bundle.rms,
        "noise_px": calibration.camera.noise_px,
        "shared_px": calibration.shared_px,
        "lens_px": calibration.lens_px,
        "places": calibration.places,
        "distortion_tried": [_finite(dataclasses.asdict(trial)) for trial in calibration.trials],
        "images": [dataclasses.asdict(image) for image in calibration.images],
        "not_found": list(calibration.used.missed),
        "verdict": list(verdict(calibration)),
    }


def summarise_mount(calibration: MountCalibration, missed: tuple[str, ...] = ()) -> dict[str, Any]:
    """Summarise a mount's calibration; the covariance is of height [m], tilt and roll [rad]."""
    return {
        "version": __version__,
        "mount": msgspec.to_builtins(calibration.mount),
        "covariance": calibration.covariance.tolist(),
        "chi2": calibration.chi2,
        "dof": calibration.dof,
        "scale": calibration.scale,
        "noise_px": calibration.noise_px,
        "images": [dataclasses.asdict(image) for image in calibration.images],
        "not_found": list(missed),
    }


def read_covariance(path: str | Path, camera: Camera) -> NDArray[np.float64]:
    """Read the covariance (p, p) of a camera's intrinsics from the output of `coloc calibrate camera`.

    Parameters
    ----------
    path
        Folder, or calibration.json in it.
    camera
        Camera that the calibration must be of.

    Raises
    ------
    InputError
        The file is not a calibration, or is of another camera.
    """
    path = Path(path)
    path = path / SUMMARY if path.is_dir() else path
    try:
        summary = read_json(path, "give the folder that `coloc calibrate camera --out` wrote")
        covariance = np.array(summary["covariance"], float)
        of = msgspec.convert(summary["camera"], Camera)
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError, msgspec.ValidationError) as error:
        raise InputError(f"{path}: not the calibration of a camera ({error}); calibrate the camera again") from error
    names = [name for name in CAMERA_FIELDS if name not in ("noise_px", "bias_px")]
    if any(getattr(of, name) != getattr(camera, name) for name in names):
        raise InputError(
            f"{path}: calibration of another camera than the robot's in the team (fx {of.fx:.2f} and {camera.fx:.2f} "
            "px); write this one into the team first, with `coloc calibrate camera --team`"
        )
    size = 4 + len(camera.distortion)
    if covariance.shape != (size, size) or not np.isfinite(covariance).all():
        raise InputError(f"{path}: its covariance is not {size}x{size} numbers; calibrate the camera again")
    return covariance


def _finite(values: dict[str, Any]) -> dict[str, Any]:
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value for name, value in values.items()
    }
