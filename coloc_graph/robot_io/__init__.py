"""Devices of a robot: cameras, wheels, clocks, messages, coordination (knows devices; no graph).

`Create` drives wheels, and sees to it that they stop; docs/wheels.md. Its emulator is in `create_emulator`.
`open_camera` opens cameras; docs/cameras.md.
"""

from coloc_graph.robot_io.camera.open import open_camera
from coloc_graph.robot_io.camera.source import CameraSource, Frame
from coloc_graph.robot_io.create.driver import Create
from coloc_graph.robot_io.create.state import CreateState

__all__ = ["CameraSource", "Create", "CreateState", "Frame", "open_camera"]
