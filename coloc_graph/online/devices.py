"""Devices of a robot's program: camera, detector, wheels and link; others in a simulation; `Devices`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from coloc_graph.frontend import detector_for
from coloc_graph.robot_io.camera.open import open_camera
from coloc_graph.robot_io.camera.source import CameraSource
from coloc_graph.robot_io.create.driver import Create
from coloc_graph.robot_io.link.session import LinkSession, OpenSession


@dataclass(frozen=True)
class Devices:
    """Openers of a robot's devices.

    Attributes
    ----------
    camera
        Opens the camera; see `open_camera`.
    detector
        Returns the detector of a kind of marker in a camera; see `detector_for`.
    wheels
        Makes the driver of the wheels; see `Create`.
    session
        Opens the link's session; see `LinkSession`.
    """

    camera: Callable[..., CameraSource] = open_camera
    detector: Callable[..., Callable[[Any], Any]] = detector_for
    wheels: Callable[..., Create] = Create
    session: OpenSession = LinkSession
